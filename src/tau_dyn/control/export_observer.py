"""Tool observers as C99, one call a sample: `name_start` at rest, then `name_step` from actuators and accelerometer.

The causal complementary filter and the stationary Kalman filter run a sample at a time, as a controller does; the
complementary filter with zero phase needs the whole trial, and gets a function that takes it.
"""

from __future__ import annotations

from collections.abc import Iterator

from tau_dyn.control.export_c_filters import ONE_STEP, pad_to_third_order
from tau_dyn.control.export_c_text import format_header, format_numbers, format_source, format_table, require_c_name
from tau_dyn.control.observers import ComplementaryToolObserver, KalmanToolObserver
from tau_dyn.version import __version__

Observer = ComplementaryToolObserver | KalmanToolObserver


def write_observer_source(observer: Observer, name: str = "observer") -> tuple[str, str]:
    """Return a tool observer as C: the source and its header.

    Args:
        observer: The observer, tuned.
        name: With which all functions begin; also of the header, `name.h`.

    Raises:
        InputError: The name is no identifier of C.
    """
    require_c_name(name)
    first = f"{_what(observer)}, written by tau-dyn {__version__}."
    if isinstance(observer, KalmanToolObserver):
        body, declared, words = _kalman(observer), _stepping(name, _size(observer)), _STEP_WORDS
    elif observer.causal:
        body, declared, words = _causal(observer), _stepping(name, 7 * observer.axes), _STEP_WORDS
    else:
        body, declared, words = _zero_phase(observer), [_TRIAL + ";"], _TRIAL_WORDS
    axes = f"#define {name.upper()}_AXES {observer.axes}"
    said = [first, f"Sampling step {observer.dt!r} s; {observer.axes} axes [m], [m/s^2] without gravity.", "", *words]
    lines = [line.replace("@NAME@", name) for part in body for line in part.splitlines()]
    shown = [line.replace("@NAME@", name).replace("@M@", str(observer.axes)) for line in [axes, *declared]]
    return format_source(name, first, lines), format_header(name, said, shown)


_STEP_WORDS = (
    "start: at rest, with the tool where the actuators say it is. step: one call a sample, in order; z is the tool",
    "and may be kinematic.",
    "step returns 0, or 1 where an input is not finite; then state and z are as before.",
    "No allocation, no state but the caller's.",
)
_TRIAL_WORDS = (
    "trial: the whole of it at once, n samples by axes, row by row; work holds 2 n numbers. z may be kinematic.",
    "Returns 0, or 1 where n < 2 or an input is not finite; then z is as before. No allocation, no state.",
)
_TRIAL = "int @NAME@_trial(int n, const double *kinematic, const double *acceleration, double *z, double *work)"


def _what(observer: Observer) -> str:
    if isinstance(observer, KalmanToolObserver):
        return f"Stationary Kalman filter for the tool's place, {len(observer.extended.A)} states"
    cutoffs = ", ".join(f"{f:g}" for f in observer.cutoff_hz)
    return f"Complementary filter for the tool's place, {'causal' if observer.causal else 'zero phase'}, {cutoffs} Hz"


def _stepping(name: str, size: int) -> list[str]:
    state = f"double state[{name.upper()}_STATE]"
    return [
        f"#define {name.upper()}_STATE {size}",
        f"void {name}_start({state}, const double kinematic[@M@]);",
        f"int {name}_step({state}, const double kinematic[@M@], const double acceleration[@M@], double z[@M@]);",
    ]


def _causal(observer: ComplementaryToolObserver) -> Iterator[str]:
    rows = [pad_to_third_order(*passes.forwards) for pair in observer.pairs() for passes in pair]
    yield f"enum {{ M = {observer.axes} }};"
    yield ""
    yield format_table("double", "filters", [x for row in rows for x in format_numbers(row)], "16 * M")
    yield ""
    yield ONE_STEP
    yield ""
    yield _CAUSAL


def _size(observer: KalmanToolObserver) -> int:
    return len(observer.extended.A) + 3 * observer.axes


def _kalman(observer: KalmanToolObserver) -> Iterator[str]:
    e = observer.extended
    yield f"enum {{ N = {len(e.A)}, M = {observer.axes} }};"
    yield ""
    for name, matrix in (
        ("A", e.A),
        ("B", e.B),
        ("Cy", e.acceleration),
        ("Cz", e.position),
        ("K", observer.correction),
    ):
        yield format_table("double", name, format_numbers(matrix), str(matrix.size))
    yield ""
    text = _KALMAN.replace("@U@", "kinematic[j] - rest[j]" if e.ahead else "last[j]")
    text = text.replace("@Y@", "felt[i]" if observer.aligned else "acceleration[i]")
    yield text.replace("@OUT@", "before" if observer.predict else "x")


def _zero_phase(observer: ComplementaryToolObserver) -> Iterator[str]:
    rows = []
    for pair in observer.pairs():
        for passes in pair:
            assert passes.backwards is not None
            rows += [pad_to_third_order(*passes.forwards), pad_to_third_order(*passes.backwards)]
    yield f"enum {{ M = {observer.axes} }};"
    yield ""
    yield format_table("double", "filters", [x for row in rows for x in format_numbers(row)], "32 * M")
    yield ""
    yield ONE_STEP
    yield ""
    yield _ZERO_PHASE.replace("@TRIAL@", _TRIAL)


_FINITE = """\
    for (int i = 0; i < M; ++i) if (!(fabs(kinematic[i]) < 1e300 && fabs(acceleration[i]) < 1e300)) return 1;"""

_CAUSAL = f"""\
void @NAME@_start(double state[7 * M], const double kinematic[M])
{{
    for (int k = 0; k < 6 * M; ++k) state[k] = 0.0;
    for (int i = 0; i < M; ++i) state[6 * M + i] = kinematic[i];
}}

int @NAME@_step(double state[7 * M], const double kinematic[M], const double acceleration[M], double z[M])
{{
    const double *rest = state + 6 * M;
{_FINITE}
    for (int i = 0; i < M; ++i) /* z may be where kinematic is */
        z[i] = rest[i] + one_step(filters + 16 * i, state + 6 * i, kinematic[i] - rest[i])
               + one_step(filters + 16 * i + 8, state + 6 * i + 3, acceleration[i]);
    return 0;
}}"""

_KALMAN = f"""\
/* The state: x after the last sample, then that sample's input and acceleration, then the place at rest. */
void @NAME@_start(double state[N + 3 * M], const double kinematic[M])
{{
    for (int k = 0; k < N + 2 * M; ++k) state[k] = 0.0;
    for (int i = 0; i < M; ++i) state[N + 2 * M + i] = kinematic[i];
}}

int @NAME@_step(double state[N + 3 * M], const double kinematic[M], const double acceleration[M], double z[M])
{{
    double *x = state, *last = state + N, *felt = state + N + M, before[N], off[M];
    const double *rest = state + N + 2 * M;
{_FINITE}
    for (int i = 0; i < N; ++i) {{
        before[i] = 0.0;
        for (int j = 0; j < N; ++j) before[i] += A[i * N + j] * x[j];
        for (int j = 0; j < M; ++j) before[i] += B[i * M + j] * (@U@);
    }}
    for (int i = 0; i < M; ++i) {{
        off[i] = @Y@;
        for (int j = 0; j < N; ++j) off[i] -= Cy[i * N + j] * before[j];
    }}
    for (int i = 0; i < N; ++i) {{
        x[i] = before[i];
        for (int j = 0; j < M; ++j) x[i] += K[i * M + j] * off[j];
    }}
    for (int i = 0; i < M; ++i) {{
        last[i] = kinematic[i] - rest[i];
        felt[i] = acceleration[i];
        z[i] = rest[i]; /* which may be where kinematic is */
        for (int j = 0; j < N; ++j) z[i] += Cz[i * N + j] * @OUT@[j];
    }}
    return 0;
}}"""

_ZERO_PHASE = """\
/* Forwards over the signal and as long a tail (its last value, or zeros), backwards from where that has settled. */
static void both_ways(const double *f, int n, const double *x, double rest, int held, double *work)
{
    double state[3] = {0.0, 0.0, 0.0}, b = 0.0, a = 0.0;
    for (int k = 0; k < 2 * n; ++k) {
        const double in = k < n ? x[k * M] - rest : held ? x[(n - 1) * M] - rest : 0.0;
        work[k] = one_step(f, state, in);
    }
    const double end = work[2 * n - 1];
    for (int k = 0; k < 4; ++k) {
        b += f[8 + k];
        a += f[12 + k];
        if (k < 3) state[k] = 0.0;
    }
    for (int k = 2 * n - 1; k >= 0; --k) work[k] = one_step(f + 8, state, work[k] - end) + end * b / a;
}

@TRIAL@
{
    if (n < 2) return 1;
    for (int k = 0; k < n * M; ++k) if (!(fabs(kinematic[k]) < 1e300 && fabs(acceleration[k]) < 1e300)) return 1;
    for (int i = 0; i < M; ++i) {
        const double rest = kinematic[i];
        both_ways(filters + 32 * i, n, kinematic + i, rest, 1, work);
        for (int k = 0; k < n; ++k) z[k * M + i] = rest + work[k];
        both_ways(filters + 32 * i + 16, n, acceleration + i, 0.0, 0, work);
        for (int k = 0; k < n; ++k) z[k * M + i] += work[k];
    }
    return 0;
}"""
