static const double lower[NA] = {@LOWER@}, upper[NA] = {@UPPER@};
static const int turns[NA] = {@TURNS@};

/* Whether drives keep their ranges; one that turns may do so a whole turn away, and is moved there. */
static int within(double *q)
{
    for (int k = 0; k < NA; ++k) {
        if (turns[k] && q[k] < lower[k] - 1e-9 && q[k] + @WHOLE_TURN@ <= upper[k] + 1e-9) q[k] += @WHOLE_TURN@;
        if (turns[k] && q[k] > upper[k] + 1e-9 && q[k] - @WHOLE_TURN@ >= lower[k] - 1e-9) q[k] -= @WHOLE_TURN@;
        if (!(q[k] >= lower[k] - 1e-9 && q[k] <= upper[k] + 1e-9)) return 0;
    }
    return 1;
}
