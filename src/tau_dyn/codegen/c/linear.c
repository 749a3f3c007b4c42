/* The largest size among n numbers; NaN where one is none. */
static double largest(int n, const double *x)
{
    double most = 0.0;
    for (int k = 0; k < n; ++k) if (fabs(x[k]) > most || x[k] != x[k]) most = fabs(x[k]);
    return most;
}

/* LU factors of a matrix, row by row in place, with row exchanges: its determinant's sign, 0 where it is singular. */
static int factor(int n, double *A, int *rows)
{
    int sign = 1;
    for (int k = 0; k < n; ++k) {
        int best = k;
        for (int i = k + 1; i < n; ++i) if (fabs(A[i * n + k]) > fabs(A[best * n + k])) best = i;
        rows[k] = best;
        if (!(fabs(A[best * n + k]) > 1e-12)) return 0;
        if ((best != k) != (A[best * n + k] < 0.0)) sign = -sign;
        if (best != k) for (int j = 0; j < n; ++j) {
            const double x = A[k * n + j];
            A[k * n + j] = A[best * n + j];
            A[best * n + j] = x;
        }
        const double inverse = 1.0 / A[k * n + k];
        for (int i = k + 1; i < n; ++i) {
            const double x = A[i * n + k];
            if (x == 0.0) continue;
            A[i * n + k] = x * inverse;
            for (int j = k + 1; j < n; ++j) A[i * n + j] -= A[i * n + k] * A[k * n + j];
        }
    }
    return sign;
}

/* b becomes the x of A x = b. */
static void solve(int n, const double *A, const int *rows, double *b)
{
    for (int k = 0; k < n; ++k) {
        const double x = b[rows[k]];
        b[rows[k]] = b[k];
        b[k] = x;
    }
    for (int i = 1; i < n; ++i) for (int j = 0; j < i; ++j) b[i] -= A[i * n + j] * b[j];
    for (int i = n - 1; i >= 0; --i) {
        for (int j = i + 1; j < n; ++j) b[i] -= A[i * n + j] * b[j];
        b[i] /= A[i * n + i];
    }
}

@IF TRANSPOSED@
/* b becomes the x of A' x = b. */
static void solve_t(int n, const double *A, const int *rows, double *b)
{
    for (int i = 0; i < n; ++i) {
        for (int j = 0; j < i; ++j) b[i] -= A[j * n + i] * b[j];
        b[i] /= A[i * n + i];
    }
    for (int i = n - 2; i >= 0; --i) for (int j = i + 1; j < n; ++j) b[i] -= A[j * n + i] * b[j];
    for (int k = n - 1; k >= 0; --k) {
        const double x = b[rows[k]];
        b[rows[k]] = b[k];
        b[k] = x;
    }
}
@END@
