int @NAME@_ik(const double p[3], const double R[9], double q[NA])
{
    double x[NA];
    if (!sound(3, p)@ROTATION@) return 1;
    if (drives(p, R, x) || !sound(NA, x)) return 1;
@IF PLATE@
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
    if (factor(NT, A, rows) != @HOME_SIDE@) return 1; /* beyond a singularity from home */
@END@
    if (!within(x)) return 3;
    for (int k = 0; k < NA; ++k) q[k] = x[k];
    return 0;
}
