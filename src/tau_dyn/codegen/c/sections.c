/* Second-order sections over an array of n, every m-th number: forwards, or backwards from its end; both from rest. */
static void sections(int count, const double *s, int n, int m, double *x, int backwards)
{
    for (int i = 0; i < count; ++i, s += 6) {
        double a = 0.0, b = 0.0;
        for (int k = 0; k < n; ++k) {
            double *at = x + (backwards ? n - 1 - k : k) * m;
            const double in = *at, out = s[0] * in + a;
            a = s[1] * in - s[4] * out + b;
            b = s[2] * in - s[5] * out;
            *at = out;
        }
    }
}
