"""Learning filters and tool observers as C99, with fixed texts (folder `c`) around the numbers of a tuned filter.

Learning: `u_{k+1} = Q_w Q_z (u_k + L e_k)` (thesis 7.2, 7.10, 7.13) over a whole trial, between two of them: `name_q`, `name_l`
and `name_update`. L shifts forwards and scales, Q_z runs forwards and backwards, the weights fade it in and out.

Observers: the causal complementary filter and the stationary Kalman filter run a sample at a time, as a controller does:
`name_start` at rest, then `name_step`. The complementary filter with zero phase takes the whole trial: `name_trial`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from scipy.signal import sosfilt

from tau_dyn.codegen.c_writer import (
    MAX_NUMBER,
    fill_template,
    format_header,
    format_source,
    format_table,
    require_c_name,
)
from tau_dyn.exceptions import InputError
from tau_dyn.version import __version__

_MEMORY = 100_000  # samples after which an impulse has decayed: poles up to 1 - 3e-4


class FilterLaw(Protocol):
    """A law of two filters, as `control.LearningLaw`: Q one a channel, as sections (s, 6), and L, a gain and a shift."""

    forgetting: Sequence[Any]
    learning: Any


@runtime_checkable
class ComplementaryObserver(Protocol):
    """A complementary filter, as `control.ComplementaryToolObserver`."""

    dt: float
    axes: int
    causal: bool
    cutoff_hz: Any

    def pairs(self) -> Any:
        """Return the filters of each axis, of positions and of accelerations."""
        ...


class KalmanObserver(Protocol):
    """A stationary Kalman filter, as `control.KalmanToolObserver`."""

    dt: float
    axes: int
    extended: Any
    correction: np.ndarray
    aligned: bool
    predict: bool


def write_learning_source(law: Any, limit: float | Sequence[float], name: str = "learning") -> tuple[str, str]:
    """Return the filters of a law as C: the source and its header.

    Args:
        law: Filters Q and L: a `control.LearningLaw`.
        limit: Largest correction that may leave, one or one a channel [m or rad].
        name: Prefix of all functions, and name of the header, `name.h`.

    Raises:
        InputError: The law is no pair of filters, a limit is not positive, or the name is no identifier of C.
    """
    require_c_name(name)
    if not (hasattr(law, "forgetting") and hasattr(getattr(law, "learning", None), "samples")):
        raise InputError(
            "unsupported",
            f"{type(law).__name__} is no low-pass and shift; its matrices over a whole trial are not written out",
        )
    return _write_filters(law, limit, name)


def _write_filters(law: FilterLaw, limit: float | Sequence[float], name: str) -> tuple[str, str]:
    m = len(law.forgetting)
    limits = np.broadcast_to(np.asarray(limit, float), (m,)) if np.shape(limit) in ((), (m,)) else np.zeros(1)
    if not np.all(np.isfinite(limits) & (limits > 0)):
        raise InputError(
            "invalid_value", f"the largest correction must be a positive number, or {m} of them, one a channel"
        )
    first = f"Learning filters for {m} channel(s), written by tau-dyn {__version__}."
    ends = np.cumsum([0, *(len(q.sections) for q in law.forgetting)]).tolist()
    sections = np.concatenate([q.sections for q in law.forgetting])
    parts = [
        f"enum {{ M = {m}, SHIFT = {law.learning.samples} }};",
        format_table("double", "forgetting", sections.ravel(), 6 * ends[-1]),
        format_table("int", "first", ends, "M + 1"),
        format_table("double", "limit", limits, "M"),
        format_table("double", "most_in", [MAX_NUMBER / _compute_growth(q.sections) for q in law.forgetting], "M"),
        fill_template("checks"),
        fill_template("sections"),
        fill_template("learning", NAME=name, GAIN=repr(float(law.learning.gain))),
    ]
    about = f"Sampling step {law.learning.dt!r} s. L: {law.learning.gain:g}, {law.learning.samples} samples ahead."
    declared = [f"#define {name.upper()}_CHANNELS {m}", *(line.format(name=name) for line in _LEARNING)]
    return format_source(name, first, parts), format_header(name, [first, about, "", *_LEARNING_WORDS], declared)


def _compute_growth(sections: np.ndarray) -> float:
    """Return a bound on the result of both passes for a signal of magnitude 1 at most: the square of the sum of |h|."""
    impulse = np.zeros(_MEMORY)
    impulse[0] = 1.0
    return float(np.sum(np.abs(sosfilt(sections, impulse))) ** 2)


_LEARNING = (
    "int {name}_q(int channel, int n, double *x);",
    "int {name}_l(int n, const double *error, double *out);",
    "int {name}_update(int n, const double *weight, const double *error, double *correction, double *work);",
)
_LEARNING_WORDS = (
    "Signals are n samples by channels, row by row.",
    "q: Q without weights, forwards and backwards, on one channel's n numbers in place.",
    "l: L on a signal; out must be another array.",
    "update: correction becomes weight Q (correction + L error); weight holds n numbers, or is NULL for ones; work holds",
    "n numbers a channel. Each returns 0;",
    f"1 where n < 1, or a number goes in or may come out that is none or beyond {MAX_NUMBER:g};",
    "update returns 2 where a correction larger than the limit would leave. Then the outputs are left alone.",
    "No allocation, no state.",
    "Compile without -ffast-math, which takes the checks of numbers away.",
)


def write_observer_source(observer: ComplementaryObserver | KalmanObserver, name: str = "observer") -> tuple[str, str]:
    """Return a tool observer as C: the source and its header.

    Args:
        observer: A `control.ComplementaryToolObserver` or `control.KalmanToolObserver`, tuned.
        name: Prefix of all functions, and name of the header, `name.h`.

    Raises:
        InputError: The name is no identifier of C.
    """
    require_c_name(name)
    axes = observer.axes
    if not isinstance(observer, ComplementaryObserver):
        what = f"Stationary Kalman filter for the tool's place, {len(observer.extended.A)} states"
        parts, size = _yield_kalman(observer, name), len(observer.extended.A) + 3 * axes
    else:
        cutoffs = ", ".join(f"{f:g}" for f in observer.cutoff_hz)
        phase = "causal" if observer.causal else "zero phase"
        what = f"Complementary filter for the tool's place, {phase}, {cutoffs} Hz"
        parts, size = _yield_complementary(observer, name), 7 * axes if observer.causal else 0
    first = f"{what}, written by tau-dyn {__version__}."
    about = f"Sampling step {observer.dt!r} s; {axes} axes [m], [m/s^2] without gravity."
    words = [first, about, "", *(_STEP_WORDS if size else _TRIAL_WORDS), *_CHECK_WORDS]
    declared = [f"#define {name.upper()}_AXES {axes}"]
    if size:
        state, one = f"double state[{name.upper()}_STATE]", f"const double kinematic[{axes}]"
        declared += [
            f"#define {name.upper()}_STATE {size}",
            f"void {name}_start({state}, {one});",
            f"int {name}_step({state}, {one}, const double acceleration[{axes}], double z[{axes}]);",
        ]
    else:
        declared.append(
            f"int {name}_trial(int n, const double *kinematic, const double *acceleration, double *z, double *work);"
        )
    return format_source(name, first, parts), format_header(name, words, declared)


_STEP_WORDS = (
    "start: at rest, with the tool where the actuators say it is. step: one call a sample, in order; z is the tool",
    "and may be kinematic.",
    "step returns 0, or 1; then state and z are left alone.",
)
_TRIAL_WORDS = (
    "trial: the whole of it at once, n samples by axes, row by row; work holds 2 n numbers. z may be kinematic.",
    "Returns 0, or 1, also where n < 2; then z is left alone.",
)
_CHECK_WORDS = (
    f"1: an input, the state or the answer is no number, or beyond {MAX_NUMBER:g}.",
    "Compile without -ffast-math, which takes this check away. No allocation, no state but the caller's.",
)


def _yield_complementary(observer: ComplementaryObserver, name: str) -> Iterator[str]:
    rows = []
    for pair in observer.pairs():
        for passes in pair:
            rows.append(pad_to_third_order(*passes.forwards))
            if not observer.causal:
                rows.append(pad_to_third_order(*passes.backwards))
    yield f"enum {{ M = {observer.axes} }};"
    yield format_table("double", "filters", np.ravel(rows), f"{16 if observer.causal else 32} * M")
    yield fill_template("checks")
    yield fill_template("one_step")
    yield fill_template("observer_causal" if observer.causal else "observer_trial", NAME=name)


def _yield_kalman(observer: KalmanObserver, name: str) -> Iterator[str]:
    e = observer.extended
    yield f"enum {{ N = {len(e.A)}, M = {observer.axes} }};"
    matrices = {"A": e.A, "B": e.B, "Cy": e.acceleration, "Cz": e.position, "K": observer.correction}
    yield "\n".join(format_table("double", x, matrix.ravel(), matrix.size) for x, matrix in matrices.items())
    yield fill_template("checks")
    yield fill_template(
        "observer_kalman",
        NAME=name,
        U="kinematic[j] - rest[j]" if e.ahead else "last[j]",
        Y="felt[i]" if observer.aligned else "acceleration[i]",
        OUT="before" if observer.predict else "x",
    )


def pad_to_third_order(b: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return a filter of order 3 at most as 8 numbers, b then a, with a[0] = 1."""
    out = np.zeros(8)
    out[: len(b)], out[4 : 4 + len(a)] = np.asarray(b) / a[0], np.asarray(a) / a[0]
    return out
