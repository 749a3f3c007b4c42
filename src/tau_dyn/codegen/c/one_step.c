/* One sample through a filter of order 3 (direct form II transposed); `f` holds b and a, 4 numbers each, a[0] = 1. */
static double one_step(const double *f, double *state, double in)
{
    const double out = f[0] * in + state[0];
    for (int k = 0; k < 2; ++k) state[k] = f[k + 1] * in - f[k + 5] * out + state[k + 1];
    state[2] = f[3] * in - f[7] * out;
    return out;
}
