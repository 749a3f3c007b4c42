/* The state: x after the last sample, then that sample's input and acceleration, then the place at rest. */
void @NAME@_start(double state[N + 3 * M], const double kinematic[M])
{
    for (int k = 0; k < N + 2 * M; ++k) state[k] = 0.0;
    for (int i = 0; i < M; ++i) state[N + 2 * M + i] = kinematic[i];
}

int @NAME@_step(double state[N + 3 * M], const double kinematic[M], const double acceleration[M], double z[M])
{
    const double *last = state + N, *felt = state + N + M, *rest = state + N + 2 * M;
    double before[N], x[N], off[M], out[M];
    (void)last, (void)felt;
    if (!sound(M, kinematic) || !sound(M, acceleration)) return 1;
    for (int i = 0; i < N; ++i) {
        before[i] = 0.0;
        for (int j = 0; j < N; ++j) before[i] += A[i * N + j] * state[j];
        for (int j = 0; j < M; ++j) before[i] += B[i * M + j] * (@U@);
    }
    for (int i = 0; i < M; ++i) {
        off[i] = @Y@;
        for (int j = 0; j < N; ++j) off[i] -= Cy[i * N + j] * before[j];
    }
    for (int i = 0; i < N; ++i) {
        x[i] = before[i];
        for (int j = 0; j < M; ++j) x[i] += K[i * M + j] * off[j];
    }
    for (int i = 0; i < M; ++i) {
        out[i] = rest[i];
        for (int j = 0; j < N; ++j) out[i] += Cz[i * N + j] * @OUT@[j];
    }
    if (!sound(N, x) || !sound(M, out)) return 1;
    for (int i = 0; i < N; ++i) state[i] = x[i];
    for (int i = 0; i < M; ++i) {
        state[N + i] = kinematic[i] - rest[i];
        state[N + M + i] = acceleration[i];
    }
    for (int i = 0; i < M; ++i) z[i] = out[i]; /* z may be where kinematic is */
    return 0;
}
