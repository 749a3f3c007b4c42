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
}

@IF SEARCHES@
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
}
@END@
