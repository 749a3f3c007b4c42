void @NAME@_start(double state[N], double x)
{
    for (int k = 0; k < N; ++k) state[k] = x;
}

int @NAME@_step(double state[N], double x, double *y)
{
    double out = 0.0;
    if (!sound(1, &x) || !sound(N, state)) return 1;
    for (int i = 0; i < TAPS; ++i) out += amplitude[i] * (delay[i] > 0 ? state[delay[i] - 1] : x);
    if (!sound(1, &out)) return 1;
    for (int k = N - 1; k > 0; --k) state[k] = state[k - 1]; /* the newest first */
    state[0] = x;
    *y = out;
    return 0;
}
