void @NAME@_start(double state[7 * M], const double kinematic[M])
{
    for (int k = 0; k < 6 * M; ++k) state[k] = 0.0;
    for (int i = 0; i < M; ++i) state[6 * M + i] = kinematic[i];
}

int @NAME@_step(double state[7 * M], const double kinematic[M], const double acceleration[M], double z[M])
{
    double next[7 * M], out[M];
    const double *rest = next + 6 * M;
    if (!sound(M, kinematic) || !sound(M, acceleration)) return 1;
    for (int k = 0; k < 7 * M; ++k) next[k] = state[k];
    for (int i = 0; i < M; ++i)
        out[i] = rest[i] + one_step(filters + 16 * i, next + 6 * i, kinematic[i] - rest[i])
                 + one_step(filters + 16 * i + 8, next + 6 * i + 3, acceleration[i]);
    if (!sound(7 * M, next) || !sound(M, out)) return 1;
    for (int k = 0; k < 7 * M; ++k) state[k] = next[k];
    for (int i = 0; i < M; ++i) z[i] = out[i]; /* z may be where kinematic is */
    return 0;
}
