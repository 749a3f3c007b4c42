/* Whether R is a rotation to four digits. */
static int is_rotation(const double *R)
{
    if (!sound(9, R)) return 0;
    for (int i = 0; i < 3; ++i) for (int j = 0; j <= i; ++j) {
        const double product = R[3 * i] * R[3 * j] + R[3 * i + 1] * R[3 * j + 1] + R[3 * i + 2] * R[3 * j + 2];
        if (fabs(product - (i == j ? 1.0 : 0.0)) > 1e-4) return 0;
    }
    return R[0] * (R[4] * R[8] - R[5] * R[7]) - R[1] * (R[3] * R[8] - R[5] * R[6]) + R[2] * (R[3] * R[7] - R[4] * R[6]) > 0.0;
}
