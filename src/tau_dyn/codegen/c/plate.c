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
}
