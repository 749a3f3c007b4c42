int @NAME@_fk(double start[NA + NZ], const double q[NA], double p[3], double R[9])
{
    double T[6 * NX], at[12], next[NA + NZ];
    if (!sound(NA, q)) return 1;
    for (int k = 0; k < NA + NZ; ++k) next[k] = start[k];
    if (!follow(next, q)) return 2;
    tool(q, next + NA, at, at + 3, T);
    if (!sound(12, at)) return 1;
    for (int k = 0; k < NA + NZ; ++k) start[k] = next[k];
    for (int k = 0; k < 3; ++k) p[k] = at[k];
    for (int k = 0; k < 9; ++k) R[k] = at[3 + k];
    return 0;
}

int @NAME@_jacobian(double start[NA + NZ], const double q[NA], double J[6 * NA])
{
    double gap[NT], G[NT * NX], A[NT * NT], T[6 * NX], p[3], R[9], out[6 * NA], next[NA + NZ];
    int rows[NT];
    if (!sound(NA, q)) return 1;
    for (int k = 0; k < NA + NZ; ++k) next[k] = start[k];
    if (!follow(next, q)) return 2;
    equations(q, next + NA, gap, G);
    tool(q, next + NA, p, R, T);
    for (int i = 0; i < NT; ++i) for (int j = 0; j < NT; ++j) A[i * NT + j] = G[i * NX + NA + j];
    if (!factor(NT, A, rows)) return 2;
    for (int a = 0; a < NA; ++a) {
        for (int i = 0; i < NT; ++i) gap[i] = G[i * NX + a];
        solve(NT, A, rows, gap);
        for (int i = 0; i < 6; ++i) {
            out[i * NA + a] = T[i * NX + a];
            for (int k = 0; k < NT; ++k) out[i * NA + a] -= T[i * NX + NA + k] * gap[k];
        }
    }
    if (!sound(6 * NA, out)) return 1;
    for (int k = 0; k < NA + NZ; ++k) start[k] = next[k];
    for (int k = 0; k < 6 * NA; ++k) J[k] = out[k];
    return 0;
}
