r"""The C99 text of inverse kinematics: in closed form, or by Newton's method on drives and loops at once.

    [H  C'; C  -eps] (dx, y) = (H pull, -c),   C = [G; T_place (; T_turn)].

Drives that reach all six freedoms meet the whole pose and, if some motion of theirs is idle, stay near where they started.
Others meet the place and turn as near as they can, `H = T_turn' T_turn + small`: the equations of
`mechanism/small_systems.py` (Nocedal & Wright 2006, ch. 16). `@WORDS@` are blanks.
"""

ROUNDS, ON_THE_WAY, LEGS, LEG = 40, 3, 60, 0.1
"""Most iterations at the goal, on the way, most pieces of the way, and how long one may be [m or 2 rad]."""

LIMITS = """\
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
}"""

CLOSED_INVERSE = """\
int @NAME@_ik(const double p[3], const double R[9], double q[NA])
{
    double x[NA];
    if (drives(p, R, x)) return 1;
@BEYOND@
    if (!within(x)) return 3;
    for (int k = 0; k < NA; ++k) q[k] = x[k];
    return 0;
}"""

BEYOND = """\
    double z[NZ], a[3], gap[NT], G[NT * NX], A[NT * NT];
    int rows[NT];
    for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j) {
        z[3 + 3 * i + j] = 0.0;
        for (int k = 0; k < 3; ++k) z[3 + 3 * i + j] += R[3 * i + k] * tool_turn[3 * j + k];
    }
    for (int i = 0; i < 3; ++i) {
        a[i] = 0.0;
        for (int k = 0; k < 3; ++k) a[i] += z[3 + 3 * i + k] * tool_place[k];
        z[i] = p[i] - a[i];
    }
    equations(x, z, gap, G);
    for (int i = 0; i < NT; ++i) for (int j = 0; j < NT; ++j) A[i * NT + j] = G[i * NX + NA + j];
    if (factor(NT, A, rows) != @HOME_SIDE@) return 1; /* beyond a singularity from home */"""

LOGARITHM = """\
/* The rotation vector that leads from R to S, w = log(S R'); half a turn has no direction and is given a small one. */
static void turn_between(const double *R, const double *S, double *w)
{
    double E[9];
    for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j) {
        E[3 * i + j] = 0.0;
        for (int k = 0; k < 3; ++k) E[3 * i + j] += S[3 * i + k] * R[3 * j + k];
    }
    w[0] = 0.5 * (E[7] - E[5]);
    w[1] = 0.5 * (E[2] - E[6]);
    w[2] = 0.5 * (E[3] - E[1]);
    const double sine = sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]), cosine = 0.5 * (E[0] + E[4] + E[8] - 1.0);
    const double stretch = sine > 1e-9 ? atan2(sine, cosine) / sine : 1.0;
    for (int k = 0; k < 3; ++k) w[k] *= stretch;
}"""

GAPS = """\
    double gap[NT], G[NT * NX];
    equations(x, x + NA, gap, G);
    for (int i = 0; i < NT; ++i) c[i] = gap[i];
    for (int i = 0; i < NT * NX; ++i) C[i] = G[i];"""

WHOLE_POSE = """\
    for (int i = 0; i < 3; ++i) {
        c[NT + 3 + i] = -left[i];
        for (int j = 0; j < NX; ++j) C[(NT + 3 + i) * NX + j] = T[(3 + i) * NX + j];
    }"""

COSTS = """\
static const double cost[NA] = {@COST@};"""

AIM_NEAR = """\
    for (int i = 0; i < NA; ++i) {
        K[i * NK + i] += cost[i];
        b[i] += cost[i] * (toward[i] - x[i]); /* of all positions those nearest to the start */
    }"""

AIM_NOWHERE = """\
    (void)toward;"""

AIM_TURN = """\
    (void)toward;
    for (int i = 0; i < NX; ++i) for (int k = 0; k < 3; ++k) {
        b[i] += T[(3 + k) * NX + i] * left[k];
        for (int j = 0; j < NX; ++j) K[i * NK + j] += T[(3 + k) * NX + i] * T[(3 + k) * NX + j];
    }"""

INVERSE = """\
enum { NE = NT + @POSE@, NK = NX + NE };
@COSTS@

/* One step towards the pose from configuration x; its size, or -1 where there is none; *off is what the pose lacks. */
static double step(double *x, const double *p, const double *R, const double *toward, double *off)
{
    double C[NE * NX], c[NE], T[6 * NX], at[3], turn[9], left[3], K[NK * NK], b[NK], most = 0.0;
    int rows[NK];
@EQUATIONS@
    tool(x, x + NA, at, turn, T);
    turn_between(turn, R, left);
    for (int i = 0; i < 3; ++i) {
        c[NT + i] = at[i] - p[i];
        for (int j = 0; j < NX; ++j) C[(NT + i) * NX + j] = T[i * NX + j];
    }
@WHOLE@
    *off = 0.0;
    for (int i = 0; i < NE; ++i) if (!(fabs(c[i]) <= *off)) *off = fabs(c[i]);
    for (int i = 0; i < NK * NK; ++i) K[i] = 0.0;
    for (int i = 0; i < NX; ++i) {
        K[i * NK + i] = 1e-6;
        b[i] = 0.0;
    }
@AIM@
    for (int i = 0; i < NE; ++i) {
        for (int j = 0; j < NX; ++j) K[(NX + i) * NK + j] = K[j * NK + NX + i] = C[i * NX + j];
        K[(NX + i) * NK + NX + i] = -1e-11; /* rows that say the same twice are met in the mean */
        b[NX + i] = -c[i];
    }
    if (!factor(NK, K, rows)) return -1.0;
    solve(NK, K, rows, b);
    for (int i = 0; i < NX; ++i) if (!(fabs(b[i]) <= most)) most = fabs(b[i]);
    if (!(most < 1e6)) return -1.0;
    if (most > 0.3) for (int i = 0; i < NX; ++i) b[i] *= 0.3 / most;
    for (int i = 0; i < NA; ++i) x[i] += b[i];
@MOVED@
    return most;
}

int @NAME@_ik(double start[NA + NZ], const double p[3], const double R[9], double q[NA])
{
    double x[NA + NZ], p0[3], R0[9], T[6 * NX], w[3], way[3], far = 0.0, size = -1.0, off = 1.0;
    for (int k = 0; k < NA + NZ; ++k) x[k] = start[k];
    tool(x, x + NA, p0, R0, T);
    turn_between(R0, R, w);
    for (int k = 0; k < 3; ++k) {
        way[k] = p[k] - p0[k];
        if (!(fabs(way[k]) <= far)) far = fabs(way[k]);
        if (!(0.5 * fabs(w[k]) <= far)) far = 0.5 * fabs(w[k]);
    }
    if (!(far <= @LEG@ * @LEGS@)) return 2;
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
    }
    for (int k = 0; k < @ROUNDS@; ++k) {
        size = step(x, p, R, start, &off);
        if (size < 0.0 || (size < 1e-11 && off < 1e-9)) break;
    }
    if (!(size >= 0.0 && size < 1e-9 && off < 1e-9)) return 2;
    if (!within(x)) return 3;
    for (int k = 0; k < NA + NZ; ++k) start[k] = x[k];
    for (int k = 0; k < NA; ++k) q[k] = x[k];
    return 0;
}"""
