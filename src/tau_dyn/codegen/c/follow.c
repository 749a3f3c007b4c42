static const int solved[NT] = {@ROWS@}; /* of the equations; the others repeat these */

@IF JOINTS@
/* The passive joints are moved. */
static void moved(double *z, const double *dz)
{
    for (int k = 0; k < NT; ++k) z[k] += dz[k];
}

@END@
/* Newton's method on z at drives q; 0 where it does not end with closed loops, or beyond a singularity from home. */
static int newton(const double *q, double *z)
{
    double gap[NG], G[NT * WIDE], step[NT];
    int rows[NT];
@IF COPIED@
    double A[NT * NT];
@END@
@IF DIRECT@
    double *A = G;
@END@
    for (int k = 0; k < @ITERATIONS@; ++k) {
        equations(q, z, gap, G);
@IF COPIED@
        for (int i = 0; i < NT; ++i) for (int j = 0; j < NT; ++j) A[i * NT + j] = G[i * WIDE + NA + j];
@END@
        const int side = factor(NT, A, rows);
        if (!side) return 0;
        for (int i = 0; i < NT; ++i) step[i] = -gap[solved[i]];
        solve(NT, A, rows, step);
        const double left = largest(NG, gap), most = largest(NT, step);
        if (!(most < 1e6)) return 0;
        if (most > 0.3) for (int i = 0; i < NT; ++i) step[i] *= 0.3 / most;
        moved(z, step);
        if (left < 1e-7 && most < 1e-6) return @SIDE@; /* the step just taken leaves its square */
    }
    return 0;
}

/* Follow the drives from start to q in bounded steps; start is moved along only where this ends well. */
static int follow(double *start, const double *q)
{
    double at[NA], z[NZ];
    for (int k = 0; k < NZ; ++k) z[k] = start[NA + k];
    for (int k = 0; k < NA; ++k) at[k] = q[k] - start[k];
    const double far = largest(NA, at);
    if (!(far <= @STEP@ * @STEPS@)) return 0;
    const int steps = far > @STEP@ ? (int)ceil(far / @STEP@) : 1;
    for (int i = 1; i <= steps; ++i) {
        for (int k = 0; k < NA; ++k) at[k] = i == steps ? q[k] : start[k] + (q[k] - start[k]) * i / steps;
        if (!newton(at, z)) return 0;
    }
    for (int k = 0; k < NA; ++k) start[k] = q[k];
    for (int k = 0; k < NZ; ++k) start[NA + k] = z[k];
    return 1;
}
