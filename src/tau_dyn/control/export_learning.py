"""A learning law's filters as C99: `name_q` and `name_l` over one trial, and `name_update`, the next trial's correction.

`u_{k+1} = Q_w Q_z (u_k + L e_k)` (thesis 7.2, 7.10, 7.13): L shifts forwards and scales, Q_z runs forwards and backwards, the
weights fade it in and out. All of it is for a whole trial, between two of them: nothing here has to keep a controller's time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.control.export_c_filters import SECTIONS
from tau_dyn.control.export_c_text import format_header, format_numbers, format_source, format_table, require_c_name
from tau_dyn.control.iterative import LearningLaw
from tau_dyn.exceptions import InputError
from tau_dyn.version import __version__


def write_learning_source(law: LearningLaw, limit: float | Sequence[float], name: str = "learning") -> tuple[str, str]:
    """Return the filters of a law as C: the source and its header.

    Args:
        law: Filters Q and L.
        limit: Largest correction that may leave, one or one a channel [m or rad].
        name: With which all functions begin; also of the header, `name.h`.

    Raises:
        InputError: The law is no pair of filters, a limit is not positive, or the name is no identifier of C.
    """
    require_c_name(name)
    if not isinstance(law, LearningLaw):
        raise InputError(
            "unsupported",
            f"{type(law).__name__} is no pair of filters; its matrices over a whole trial are not written out",
        )
    m = len(law.forgetting)
    limits = np.broadcast_to(np.asarray(limit, float), (m,)) if np.shape(limit) in ((), (m,)) else np.zeros(1)
    if not np.all(np.isfinite(limits) & (limits > 0)):
        raise InputError(
            "invalid_value", f"the largest correction must be a positive number, or {m} of them, one a channel"
        )
    first = f"Learning filters for {m} channel(s), written by tau-dyn {__version__}."
    ends = np.cumsum([0, *(len(q.sections) for q in law.forgetting)])
    body = [
        f"enum {{ M = {m}, SHIFT = {law.learning.samples} }};",
        "",
        format_table(
            "double",
            "forgetting",
            format_numbers(np.concatenate([q.sections for q in law.forgetting])),
            str(6 * ends[-1]),
        ),
        format_table("int", "first", [str(k) for k in ends], "M + 1"),
        format_table("double", "limit", format_numbers(limits), "M"),
        "",
        SECTIONS,
        "",
        _LEARNING.replace("@NAME@", name).replace("@GAIN@", repr(float(law.learning.gain))),
    ]
    said = [
        first,
        f"Sampling step {law.learning.dt!r} s. L: {law.learning.gain:g}, {law.learning.samples} samples ahead.",
        "",
    ]
    shown = [f"#define {name.upper()}_CHANNELS {m}", *(line.replace("@NAME@", name) for line in _DECLARED)]
    lines = [line for part in body for line in (part.splitlines() or [""])]
    return format_source(name, first, lines), format_header(name, [*said, *_WORDS], shown)


_WORDS = (
    "Signals are n samples by channels, row by row.",
    "q: Q without weights, forwards and backwards, on one channel's n numbers in place.",
    "l: L on a signal; out must be another array.",
    "update: correction becomes weight Q (correction + L error); weight holds n numbers, or is NULL for ones; work holds",
    "n numbers a channel. Returns 0; 1 where n < 1 or a number is not finite; 2 where a correction larger than the limit",
    "would leave: then the correction is as before. No allocation, no state.",
)
_DECLARED = (
    "void @NAME@_q(int channel, int n, double *x);",
    "void @NAME@_l(int n, const double *error, double *out);",
    "int @NAME@_update(int n, const double *weight, const double *error, double *correction, double *work);",
)

_LEARNING = """\
static void both_ways(int channel, int n, int m, double *x)
{
    const double *s = forgetting + 6 * first[channel];
    const int count = first[channel + 1] - first[channel];
    sections(count, s, n, m, x, 0);
    sections(count, s, n, m, x, 1);
}

void @NAME@_q(int channel, int n, double *x)
{
    if (channel >= 0 && channel < M) both_ways(channel, n, 1, x);
}

void @NAME@_l(int n, const double *error, double *out)
{
    for (int k = 0; k < n; ++k) for (int i = 0; i < M; ++i)
        out[k * M + i] = @GAIN@ * error[(k + SHIFT < n ? k + SHIFT : n - 1) * M + i];
}

int @NAME@_update(int n, const double *weight, const double *error, double *correction, double *work)
{
    if (n < 1) return 1;
    for (int k = 0; k < n * M; ++k) if (!(fabs(error[k]) < 1e300 && fabs(correction[k]) < 1e300)) return 1;
    @NAME@_l(n, error, work);
    for (int k = 0; k < n * M; ++k) work[k] += correction[k];
    for (int i = 0; i < M; ++i) both_ways(i, n, M, work + i);
    for (int k = 0; k < n; ++k) for (int i = 0; i < M; ++i) {
        if (weight) work[k * M + i] *= weight[k];
        if (!(fabs(work[k * M + i]) < 1e300)) return 1;
        if (fabs(work[k * M + i]) > limit[i]) return 2;
    }
    for (int k = 0; k < n * M; ++k) correction[k] = work[k];
    return 0;
}"""
