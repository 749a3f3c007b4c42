void @NAME@_start(double state[3 * M + 1], double x)
{
    for (int k = 0; k < 3 * M; ++k) state[k] = 0.0;
    state[3 * M] = x; /* where the signal rests, which a gain of one leaves alone */
}

int @NAME@_step(double state[3 * M + 1], double x, double *y)
{
    double next[3 * M + 1], out = x - state[3 * M];
    if (!sound(1, &x)) return 1;
    for (int k = 0; k < 3 * M + 1; ++k) next[k] = state[k];
    for (int i = 0; i < M; ++i) out = one_step(filters + 8 * i, next + 3 * i, out);
    out += next[3 * M];
    if (!sound(3 * M + 1, next) || !sound(1, &out)) return 1;
    for (int k = 0; k < 3 * M; ++k) state[k] = next[k];
    *y = out;
    return 0;
}
