/* Whether n numbers are ones that a robot can have: finite, and no larger than @MOST@ in SI units. */
static int sound(int n, const double *x)
{
    for (int k = 0; k < n; ++k) if (!(fabs(x[k]) <= @MOST@)) return 0;
    return 1;
}
