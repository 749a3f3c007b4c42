enum { NE = NT + @POSE@, NK = NX + NE };
@IF IDLE@
static const double cost[NA] = {@COST@};
@END@

/* One step towards the pose from configuration x; its size, or -1 where there is none; *off is what the pose lacks. */
static double step(double *x, const double *p, const double *R, const double *toward, double *off)
{
    double C[NE * NX], c[NE], T[6 * NX], at[3], turn[9], left[3], K[NK * NK], b[NK];
    int rows[NK];
@IF SOLVED@
    double gap[NT], G[NT * NX];
    equations(x, x + NA, gap, G);
    for (int i = 0; i < NT; ++i) c[i] = gap[i];
    for (int i = 0; i < NT * NX; ++i) C[i] = G[i];
@END@
    tool(x, x + NA, at, turn, T);
    turn_between(turn, R, left);
    for (int i = 0; i < 3; ++i) {
        c[NT + i] = at[i] - p[i];
        for (int j = 0; j < NX; ++j) C[(NT + i) * NX + j] = T[i * NX + j];
    }
@IF WHOLE@
    for (int i = 0; i < 3; ++i) {
        c[NT + 3 + i] = -left[i];
        for (int j = 0; j < NX; ++j) C[(NT + 3 + i) * NX + j] = T[(3 + i) * NX + j];
    }
@END@
    *off = largest(NE, c);
    for (int i = 0; i < NK * NK; ++i) K[i] = 0.0;
    for (int i = 0; i < NX; ++i) {
        K[i * NK + i] = 1e-6;
        b[i] = 0.0;
    }
@IF IDLE@
    for (int i = 0; i < NA; ++i) {
        K[i * NK + i] += cost[i];
        b[i] += cost[i] * (toward[i] - x[i]); /* of all positions those nearest to the start */
    }
@END@
@IF BUSY@
    (void)toward;
@END@
@IF TURNING@
    for (int i = 0; i < NX; ++i) for (int k = 0; k < 3; ++k) {
        b[i] += T[(3 + k) * NX + i] * left[k];
        for (int j = 0; j < NX; ++j) K[i * NK + j] += T[(3 + k) * NX + i] * T[(3 + k) * NX + j];
    }
@END@
    for (int i = 0; i < NE; ++i) {
        for (int j = 0; j < NX; ++j) K[(NX + i) * NK + j] = K[j * NK + NX + i] = C[i * NX + j];
        K[(NX + i) * NK + NX + i] = -1e-11; /* rows that say the same twice are met in the mean */
        b[NX + i] = -c[i];
    }
    if (!factor(NK, K, rows)) return -1.0;
    solve(NK, K, rows, b);
    const double most = largest(NX, b);
    if (!(most < 1e6)) return -1.0;
    if (most > 0.3) for (int i = 0; i < NX; ++i) b[i] *= 0.3 / most;
    for (int i = 0; i < NA; ++i) x[i] += b[i];
@IF SOLVED@
    moved(x + NA, b + NA);
@END@
    return most;
}

@IF BRANCHES@
/* On which side of its own singularity each group of legs is: the determinant of its equations by its drives. */
static void branches(const double *x, double side[@GROUPS@])
{
    double gap[NT], G[NT * NX];
    equations(x, x + NA, gap, G);
@SIDES@
}

/* Whether a group is on another side at x than at start. */
static int passes(const double *start, const double *x)
{
    double before[@GROUPS@], after[@GROUPS@];
    branches(start, before);
    branches(x, after);
    for (int k = 0; k < @GROUPS@; ++k) if (!(before[k] * after[k] > 0.0)) return 1;
    return 0;
}

@END@
int @NAME@_ik(double start[NA + NZ], const double p[3], const double R[9], double q[NA])
{
    double x[NA + NZ], p0[3], R0[9], T[6 * NX], w[3], way[3], size = -1.0, off = 1.0;
    if (!sound(3, p) || !is_rotation(R)) return 1;
    for (int k = 0; k < NA + NZ; ++k) x[k] = start[k];
    tool(x, x + NA, p0, R0, T);
    turn_between(R0, R, w);
    for (int k = 0; k < 3; ++k) way[k] = p[k] - p0[k];
    const double shift = largest(3, way), turn = 0.5 * largest(3, w), far = shift > turn ? shift : turn;
    if (!(shift + turn <= 2.0 * @LEG@ * @LEGS@ && far <= @LEG@ * @LEGS@)) return 2;
    const int legs = far > @LEG@ ? (int)ceil(far / @LEG@) : 1;
    for (int i = 1; i < legs; ++i) {
        double pi[3], Ri[9], wi[3];
        for (int k = 0; k < 3; ++k) {
            pi[k] = p0[k] + way[k] * i / legs;
            wi[k] = w[k] * i / legs;
        }
        for (int k = 0; k < 9; ++k) Ri[k] = R0[k];
        rotated(wi, Ri);
        for (int k = 0; k < @ON_THE_WAY@; ++k) if (step(x, pi, Ri, start, &off) < 0.0) return 2;
@IF BRANCHES@
        if (!(off < @LEG@ * @NEAR@)) return 2; /* out of reach on the way */
        if (passes(start, x)) return 4;
@END@
    }
    for (int k = 0; k < @ROUNDS@; ++k) {
        size = step(x, p, R, start, &off);
        if (size < 0.0 || (size < 1e-11 && off < 1e-9)) break;
    }
    if (!(size >= 0.0 && size < 1e-9 && off < 1e-9)) return 2;
@IF BRANCHES@
    if (passes(start, x)) return 4;
@END@
    if (!within(x)) return 3;
    for (int k = 0; k < NA + NZ; ++k) start[k] = x[k];
    for (int k = 0; k < NA; ++k) q[k] = x[k];
    return 0;
}
