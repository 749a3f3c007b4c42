static void both_ways(int channel, int n, int m, double *x)
{
    const double *s = forgetting + 6 * first[channel];
    const int count = first[channel + 1] - first[channel];
    sections(count, s, n, m, x, 0);
    sections(count, s, n, m, x, 1);
}

int @NAME@_q(int channel, int n, double *x)
{
    if (channel < 0 || channel >= M || n < 1) return 1;
    for (int k = 0; k < n; ++k) if (!(fabs(x[k]) <= most_in[channel])) return 1;
    both_ways(channel, n, 1, x);
    return 0;
}

int @NAME@_l(int n, const double *error, double *out)
{
    if (n < 1 || n > 100000000 / M || !sound(n * M, error)) return 1;
    for (int k = 0; k < n * M; ++k) if (!(fabs(@GAIN@ * error[k]) <= @MOST@)) return 1;
    for (int k = 0; k < n; ++k) for (int i = 0; i < M; ++i)
        out[k * M + i] = @GAIN@ * error[(k + SHIFT < n ? k + SHIFT : n - 1) * M + i];
    return 0;
}

int @NAME@_update(int n, const double *weight, const double *error, double *correction, double *work)
{
    if (@NAME@_l(n, error, work) || !sound(n * M, correction)) return 1;
    for (int k = 0; k < n * M; ++k) work[k] += correction[k];
    for (int i = 0; i < M; ++i) both_ways(i, n, M, work + i);
    for (int k = 0; k < n; ++k) for (int i = 0; i < M; ++i) {
        if (weight) work[k * M + i] *= weight[k];
        if (!sound(1, work + k * M + i)) return 1;
        if (fabs(work[k * M + i]) > limit[i]) return 2;
    }
    for (int k = 0; k < n * M; ++k) correction[k] = work[k];
    return 0;
}
