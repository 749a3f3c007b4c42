"""C99 text of digital filters: second-order sections and short filters with a state of the caller, as SciPy runs them."""

from __future__ import annotations

import numpy as np

SECTIONS = """\
/* Second-order sections over an array of n, every m-th number: forwards, or backwards from its end; both from rest. */
static void sections(int count, const double *s, int n, int m, double *x, int backwards)
{
    for (int i = 0; i < count; ++i, s += 6) {
        double a = 0.0, b = 0.0;
        for (int k = 0; k < n; ++k) {
            double *at = x + (backwards ? n - 1 - k : k) * m;
            const double in = *at, out = s[0] * in + a;
            a = s[1] * in - s[4] * out + b;
            b = s[2] * in - s[5] * out;
            *at = out;
        }
    }
}"""

ONE_STEP = """\
/* One sample through a filter of order 3 (direct form II transposed); `f` holds b and a, 4 numbers each, a[0] = 1. */
static double one_step(const double *f, double *state, double in)
{
    const double out = f[0] * in + state[0];
    for (int k = 0; k < 2; ++k) state[k] = f[k + 1] * in - f[k + 5] * out + state[k + 1];
    state[2] = f[3] * in - f[7] * out;
    return out;
}"""


def pad_to_third_order(b: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return a filter of order 3 at most as 8 numbers, b then a, with a[0] = 1."""
    out = np.zeros(8)
    out[: len(b)], out[4 : 4 + len(a)] = np.asarray(b) / a[0], np.asarray(a) / a[0]
    return out
