typedef struct {
    double q[NA], w[NA], a[NA], held[NA]; /* positions, velocities half a step back, accelerations, friction */
    double h, time;                       /* last step and time [s] */
    int started, stuck[NA];
    double start[NA + NP];                /* where the loops were closed last */
@IF LOOPS@
    double earlier[2][NP];                /* passive joints one sample and two before that */
    int known;                            /* how many of these there are */
@END@
@IF REMEMBERS@
    double memory[NM], felt[NR];          /* what effects remember, and temperatures */
@END@
    double tau[NA], theta[NTHETA], q0[NA], v0[NA], step;
} Plant;

@IF LOOPS@
/* Close the loops: from a parabola through the last three samples one step of Newton's method does; else follow the drives. */
static int close_loops(Plant *s)
{
    double z[NP], far = 0.0;
    const double *last = s->start + NA;
    for (int i = 0; i < NA; ++i) far = fmax(far, fabs(s->q[i] - s->start[i]));
    const int smooth = far <= @STEP@;
    for (int k = 0; k < NP; ++k) z[k] = 3.0 * (last[k] - s->earlier[0][k]) + s->earlier[1][k];
    const int found = smooth && s->known == 2 && newton(s->q, z);
    memcpy(s->earlier[1], s->earlier[0], sizeof z);
    memcpy(s->earlier[0], last, sizeof z);
    s->known = !smooth ? 0 : s->known < 2 ? s->known + 1 : 2;
    if (!found) return follow(s->start, s->q);
    memcpy(s->start, s->q, sizeof s->q);
    memcpy(s->start + NA, z, sizeof z);
    return 1;
}

@END@
/* X of A X = B by elimination with row exchanges; B (n, m) becomes X. 0 where A is singular. */
static int eliminate(int n, int m, double *A, double *B)
{
    for (int k = 0; k < n; ++k) {
        int best = k;
        for (int i = k + 1; i < n; ++i) if (fabs(A[i * n + k]) > fabs(A[best * n + k])) best = i;
        if (!(fabs(A[best * n + k]) > 0.0)) return 0;
        for (int j = 0; j < n && best != k; ++j) {
            const double x = A[k * n + j];
            A[k * n + j] = A[best * n + j];
            A[best * n + j] = x;
        }
        for (int j = 0; j < m && best != k; ++j) {
            const double x = B[k * m + j];
            B[k * m + j] = B[best * m + j];
            B[best * m + j] = x;
        }
        for (int i = k + 1; i < n; ++i) {
            const double x = A[i * n + k] / A[k * n + k];
            for (int j = k + 1; j < n; ++j) A[i * n + j] -= x * A[k * n + j];
            for (int j = 0; j < m; ++j) B[i * m + j] -= x * B[k * m + j];
        }
    }
    for (int k = n - 1; k >= 0; --k) for (int j = 0; j < m; ++j) {
        for (int i = k + 1; i < n; ++i) B[k * m + j] -= A[k * n + i] * B[i * m + j];
        B[k * m + j] /= A[k * n + k];
    }
    return 1;
}

@IF FRICTION@
/* u = free - A f with f = upper where u > 0, lower where u < 0, between them where u = 0 (Moreau 1988). f comes as a guess. */
static int slip(const double *A, const double *free_, const double *lower, const double *upper, double *f, double *u, int *stuck)
{
    double most = 1e-12;
    int wrong = 0, n = 0, which[NA];
    for (int i = 0; i < NA; ++i) {
        u[i] = free_[i];
        for (int j = 0; j < NA; ++j) u[i] -= A[i * NA + j] * f[j];
        wrong |= (u[i] > 0.0 && f[i] != upper[i]) || (u[i] < 0.0 && f[i] != lower[i]) || (u[i] == 0.0 && lower[i] < upper[i]);
        stuck[i] = 0;
        if (fabs(lower[i]) > most) most = fabs(lower[i]);
        if (fabs(upper[i]) > most) most = fabs(upper[i]);
    }
    if (!wrong) return 1;
    for (int sweep = 0; sweep < 500; ++sweep) { /* projected Gauss-Seidel finds who sticks */
        double largest = 0.0;
        for (int i = 0; i < NA; ++i) {
            double x = free_[i];
            for (int j = 0; j < NA; ++j) x -= A[i * NA + j] * f[j];
            x = f[i] + x / A[i * NA + i];
            x = x < lower[i] ? lower[i] : x > upper[i] ? upper[i] : x;
            if (fabs(x - f[i]) > largest) largest = fabs(x - f[i]);
            f[i] = x;
        }
        if (largest <= 1e-11 * most) break;
    }
    for (int i = 0; i < NA; ++i) if (f[i] > lower[i] && f[i] < upper[i]) {
        stuck[i] = 1;
        which[n++] = i;
    }
    if (n) { /* and a linear solve holds those exactly still */
        double S[NA * NA], b[NA];
        for (int i = 0; i < n; ++i) {
            b[i] = free_[which[i]];
            for (int j = 0; j < NA; ++j) if (!stuck[j]) b[i] -= A[which[i] * NA + j] * f[j];
            for (int j = 0; j < n; ++j) S[i * n + j] = A[which[i] * NA + which[j]];
        }
        if (!eliminate(n, 1, S, b)) return 0;
        for (int i = 0; i < n; ++i) f[which[i]] = b[i];
    }
    for (int i = 0; i < NA; ++i) {
        u[i] = free_[i];
        for (int j = 0; j < NA; ++j) u[i] -= A[i * NA + j] * f[j];
        if (stuck[i]) u[i] = 0.0;
    }
    return 1;
}

/* One slip with friction as it is at velocities v and accelerations a. */
static int slip_at(Plant *s, const double *A, const double *free_, const double *v, const double *a, double *u)
{
    double lower[NA], upper[NA], f[NA];
    const int status = friction(s->q, PASSIVE(s) REMEMBERED(s) v, a, s->theta, lower, upper);
    if (status) return status;
    for (int i = 0; i < NA; ++i) {
        if (lower[i] > upper[i]) lower[i] = upper[i] = v[i] > 0.0 ? upper[i] : lower[i];
        f[i] = s->held[i] < lower[i] ? lower[i] : s->held[i] > upper[i] ? upper[i] : s->held[i];
        if (s->w[i] != 0.0) f[i] = s->w[i] > 0.0 ? upper[i] : lower[i];
    }
    if (!slip(A, free_, lower, upper, f, u, s->stuck)) return 3;
    for (int i = 0; i < NA; ++i) s->held[i] = f[i];
    return 0;
}

@END@
/* The velocity u half a step after the sample, under a kick of that length; 0, or why not. */
static int after(Plant *s, double kick, double *u)
{
    double v[NA], M[NA * NA], h[NA], A[NA * NA], free_[NA];
    for (int i = 0; i < NA; ++i) v[i] = s->w[i] + 0.5 * s->h * s->a[i];
    int status = CLOSED(s);
    if (status) return status;
    status = dynamics(s->q, PASSIVE(s) v, s->theta, M, h);
    if (status) return status;
@IF MASS@
    double added[NA * NA];
    status = mass(s->q, PASSIVE(s) REMEMBERED(s) v, s->theta, added);
    if (status) return status;
    for (int i = 0; i < NA * NA; ++i) M[i] += added[i];
@END@
    for (int i = 0; i < NA * NA; ++i) A[i] = i % (NA + 1) ? 0.0 : kick;
    if (!eliminate(NA, NA, M, A)) return 3;
    for (int i = 0; i < NA; ++i) {
        free_[i] = s->w[i];
        for (int j = 0; j < NA; ++j) free_[i] += A[i * NA + j] * (s->tau[j] - h[j]);
        u[i] = free_[i];
    }
@IF FRICTION@
    double mean[NA], a[NA], held[NA];
    for (int i = 0; i < NA; ++i) held[i] = s->held[i];
    status = slip_at(s, A, free_, v, s->a, u);
    if (status) return status;
    for (int i = 0; i < NA; ++i) {
        mean[i] = 0.5 * (s->w[i] + u[i]);
        a[i] = (u[i] - s->w[i]) / kick;
        s->held[i] = held[i]; /* the guess of both slips is the last sample's */
    }
    status = slip_at(s, A, free_, mean, a, u);
    if (status) return status;
@END@
    for (int i = 0; i < NA; ++i) if (!isfinite(u[i])) return 3;
    return 0;
}

static void begin(Plant *s)
{
    for (int i = 0; i < NA; ++i) {
        s->q[i] = s->q0[i];
        s->w[i] = s->v0[i];
        s->a[i] = s->held[i] = 0.0;
        s->stuck[i] = 0;
    }
    s->started = 0;
@IF LOOPS@
    s->known = 0;
@END@
    s->h = 0.0;
}

/* Move on by h [s] under s->tau: 0, 1 or 2 out of reach, 3 no finite motion. s may be half moved where it is not 0. */
static int advance(Plant *s, double h)
{
    double u[NA];
    int status;
    if (!s->started) { /* w is the velocity at the sample: go back by half a step */
        s->h = h;
        status = after(s, h, u);
        if (status) return status;
        for (int i = 0; i < NA; ++i) {
            s->a[i] = (u[i] - s->w[i]) / h;
            s->w[i] -= 0.5 * h * s->a[i];
        }
        s->started = 1;
    }
    const double kick = 0.5 * (s->h + h);
    status = after(s, kick, u);
    if (status) return status;
    for (int i = 0; i < NA; ++i) {
        s->a[i] = (u[i] - s->w[i]) / kick;
        s->w[i] = u[i];
        s->q[i] += h * u[i];
    }
    s->h = h;
    s->time += h;
    return sound(NA, s->q) && sound(NA, s->w) && sound(NA, s->a) ? 0 : 3;
}
