/* Forwards over the signal and as long a tail (its last value, or zeros), backwards from where that has settled. */
static void both_ways(const double *f, int n, const double *x, double rest, int held, double *work)
{
    double state[3] = {0.0, 0.0, 0.0}, b = 0.0, a = 0.0;
    for (int k = 0; k < 2 * n; ++k) {
        const double in = k < n ? x[k * M] - rest : held ? x[(n - 1) * M] - rest : 0.0;
        work[k] = one_step(f, state, in);
    }
    const double end = work[2 * n - 1];
    for (int k = 0; k < 4; ++k) {
        b += f[8 + k];
        a += f[12 + k];
        if (k < 3) state[k] = 0.0;
    }
    for (int k = 2 * n - 1; k >= 0; --k) work[k] = one_step(f + 8, state, work[k] - end) + end * b / a;
}

static double largest(int n, const double *x)
{
    double most = 0.0;
    for (int k = 0; k < n; ++k) if (!(fabs(x[k]) <= most)) most = fabs(x[k]);
    return most;
}

int @NAME@_trial(int n, const double *kinematic, const double *acceleration, double *z, double *work)
{
    if (n < 2 || n > 100000000 / M || !sound(n * M, kinematic) || !sound(n * M, acceleration)) return 1;
    for (int i = 0; i < M; ++i) { /* no answer beyond @MOST@ is begun */
        double most = fabs(kinematic[i]);
        both_ways(filters + 32 * i, n, kinematic + i, kinematic[i], 1, work);
        most += largest(n, work);
        both_ways(filters + 32 * i + 16, n, acceleration + i, 0.0, 0, work);
        if (!(most + largest(n, work) <= @MOST@)) return 1;
    }
    for (int i = 0; i < M; ++i) {
        const double rest = kinematic[i];
        both_ways(filters + 32 * i, n, kinematic + i, rest, 1, work);
        for (int k = 0; k < n; ++k) z[k * M + i] = rest + work[k];
        both_ways(filters + 32 * i + 16, n, acceleration + i, 0.0, 0, work);
        for (int k = 0; k < n; ++k) z[k * M + i] += work[k];
    }
    return 0;
}
