r"""The C99 text of forward kinematics that are solved for: Newton's method on the configuration, in steps from the last one.

A configuration is the drives `q` and `z`, what the loops decide: a plate's place and rotation, or passive joints. Its
equations `gap(q, z) = 0` and their derivative `G` are traced. `z` follows `q` from the last configuration in bounded
steps; the Jacobian is `T_q - T_z G_z^-1 G_q`, with `T` the tool's twist. `@WORDS@` are blanks.
"""

STEP, STEPS, ITERATIONS = 0.05, 100, 12
"""Largest step of a drive at once [m or rad], most steps a call, most Newton iterations a step."""

SIZES = """\
enum { NA = @NA@, NT = @NT@, NZ = @NZ@, NX = NA + NT };
"""

START = """\
static const double home[NA + NZ] = {@HOME@};

void @NAME@_start(double start[NA + NZ])
{
    for (int k = 0; k < NA + NZ; ++k) start[k] = home[k];
}"""

ROTATED = """\
/* R becomes Exp(w) R (Rodrigues), made a rotation again to the last digit. */
static void rotated(const double *w, double *R)
{
    const double square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2], angle = sqrt(square);
    const double s = angle > 1e-4 ? sin(angle) / angle : 1.0 - square / 6.0;
    const double half = angle > 1e-4 ? sin(0.5 * angle) / (0.5 * angle) : 1.0 - square / 24.0;
    const double c = 0.5 * half * half;
    double S[9], G[9];
    for (int j = 0; j < 3; ++j) {
        const double x[3] = {R[j], R[3 + j], R[6 + j]};
        const double a[3] = {w[1] * x[2] - w[2] * x[1], w[2] * x[0] - w[0] * x[2], w[0] * x[1] - w[1] * x[0]};
        const double b[3] = {w[1] * a[2] - w[2] * a[1], w[2] * a[0] - w[0] * a[2], w[0] * a[1] - w[1] * a[0]};
        for (int i = 0; i < 3; ++i) S[3 * i + j] = x[i] + s * a[i] + c * b[i];
    }
    for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j) {
        G[3 * i + j] = i == j ? 1.5 : 0.0;
        for (int k = 0; k < 3; ++k) G[3 * i + j] -= 0.5 * S[3 * k + i] * S[3 * k + j];
    }
    for (int i = 0; i < 3; ++i) for (int j = 0; j < 3; ++j) {
        R[3 * i + j] = 0.0;
        for (int k = 0; k < 3; ++k) R[3 * i + j] += S[3 * i + k] * G[3 * k + j];
    }
}"""

PLATE = """\
/* The plate is moved by a small twist. */
static void moved(double *z, const double *dz)
{
    for (int k = 0; k < 3; ++k) z[k] += dz[k];
    rotated(dz + 3, z + 3);
}

static const double tool_place[3] = {@PLACE@};
static const double tool_turn[9] = {@TURN@};

/* The tool on the plate: place, rotation, and its twist by drives and plate. */
static void tool(const double *q, const double *z, double *p, double *R, double *T)
{
    double a[3];
    (void)q;
    for (int i = 0; i < 3; ++i) {
        a[i] = 0.0;
        for (int k = 0; k < 3; ++k) a[i] += z[3 + 3 * i + k] * tool_place[k];
        p[i] = z[i] + a[i];
        for (int j = 0; j < 3; ++j) {
            R[3 * i + j] = 0.0;
            for (int k = 0; k < 3; ++k) R[3 * i + j] += z[3 + 3 * i + k] * tool_turn[3 * k + j];
        }
    }
    for (int k = 0; k < 6 * NX; ++k) T[k] = 0.0;
    for (int i = 0; i < 6; ++i) T[i * NX + NA + i] = 1.0;
    T[0 * NX + NA + 4] = a[2];
    T[0 * NX + NA + 5] = -a[1];
    T[1 * NX + NA + 3] = -a[2];
    T[1 * NX + NA + 5] = a[0];
    T[2 * NX + NA + 3] = a[1];
    T[2 * NX + NA + 4] = -a[0];
}"""

JOINTS = """\
/* The passive joints are moved. */
static void moved(double *z, const double *dz)
{
    for (int k = 0; k < NT; ++k) z[k] += dz[k];
}"""

FOLLOW = """\
/* Newton's method on z at drives q; 0 where it does not end with closed loops, or beyond a singularity from home. */
static int newton(const double *q, double *z)
{
    double gap[NT], G[NT * NX], A[NT * NT];
    int rows[NT];
    for (int k = 0; k < @ITERATIONS@; ++k) {
        double most = 0.0;
        equations(q, z, gap, G);
        for (int i = 0; i < NT; ++i) for (int j = 0; j < NT; ++j) A[i * NT + j] = G[i * NX + NA + j];
        const int side = factor(NT, A, rows);
        if (!side) return 0;
        for (int i = 0; i < NT; ++i) gap[i] = -gap[i];
        solve(NT, A, rows, gap);
        for (int i = 0; i < NT; ++i) if (!(fabs(gap[i]) <= most)) most = fabs(gap[i]);
        if (!(most < 1e6)) return 0;
        if (most > 0.3) for (int i = 0; i < NT; ++i) gap[i] *= 0.3 / most;
        moved(z, gap);
        if (most < 1e-8) return @SIDE@; /* the step just taken leaves its square */
    }
    return 0;
}

/* Follow the drives from start to q in bounded steps; start is moved along only where this ends well. */
static int follow(double *start, const double *q)
{
    double at[NA], z[NZ], far = 0.0;
    for (int k = 0; k < NZ; ++k) z[k] = start[NA + k];
    for (int k = 0; k < NA; ++k) if (!(fabs(q[k] - start[k]) <= far)) far = fabs(q[k] - start[k]);
    if (!(far <= @STEP@ * @STEPS@)) return 0;
    const int steps = far > @STEP@ ? (int)ceil(far / @STEP@) : 1;
    for (int i = 1; i <= steps; ++i) {
        for (int k = 0; k < NA; ++k) at[k] = i == steps ? q[k] : start[k] + (q[k] - start[k]) * i / steps;
        if (!newton(at, z)) return 0;
    }
    for (int k = 0; k < NA; ++k) start[k] = q[k];
    for (int k = 0; k < NZ; ++k) start[NA + k] = z[k];
    return 1;
}"""

FORWARD = """\
int @NAME@_fk(double start[NA + NZ], const double q[NA], double p[3], double R[9])
{
    double T[6 * NX];
    if (!follow(start, q)) return 2;
    tool(q, start + NA, p, R, T);
    return 0;
}

int @NAME@_jacobian(double start[NA + NZ], const double q[NA], double J[6 * NA])
{
    double gap[NT], G[NT * NX], A[NT * NT], T[6 * NX], p[3], R[9];
    int rows[NT];
    if (!follow(start, q)) return 2;
    equations(q, start + NA, gap, G);
    tool(q, start + NA, p, R, T);
    for (int i = 0; i < NT; ++i) for (int j = 0; j < NT; ++j) A[i * NT + j] = G[i * NX + NA + j];
    if (!factor(NT, A, rows)) return 2;
    for (int a = 0; a < NA; ++a) {
        for (int i = 0; i < NT; ++i) gap[i] = G[i * NX + a];
        solve(NT, A, rows, gap);
        for (int i = 0; i < 6; ++i) {
            J[i * NA + a] = T[i * NX + a];
            for (int k = 0; k < NT; ++k) J[i * NA + a] -= T[i * NX + NA + k] * gap[k];
        }
    }
    return 0;
}"""
