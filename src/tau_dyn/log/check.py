"""Check whether a log is fit for use: its clock, channels, motion and units are judged before any estimation.

`check_log` judges clock and units here and calls `signal_checks.py`, `check_motion.py`, the robot if there is one, and
`data_integrity.py` for losses on the way to the file. Wiring and the time of the forces need a model:
`identify/integrity/log_integrity.py`.

Positions in millimetres or degrees are the likeliest mistake in a foreign log. A robot's joint limits show a wrong unit with
enough certainty for a warning; without a robot, only a number that no joint reaches does. This module converts no units: the
remedy is a `scale` in the column map.
"""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tau_dyn.exceptions import require_kind
from tau_dyn.log.check_motion import check_motion, find_moving_samples
from tau_dyn.log.column_names import format_names
from tau_dyn.log.data_integrity import list_data_warnings, mend_log
from tau_dyn.log.log import Log
from tau_dyn.log.recording import LogSource, as_log
from tau_dyn.log.resample import (
    MAX_RELATIVE_JITTER,
    Clock,
    describe_gaps,
    examine_clock,
    resample_segments,
    split_at_gaps,
)
from tau_dyn.log.signal_checks import (
    CheckFinding,
    LogCheck,
    Severity,
    build_fault,
    check_jumps,
    check_signals,
    choose_finding,
)
from tau_dyn.message_codes import UNCODED, CodedWarning, get_code
from tau_dyn.results import count

MAX_AXIS_LENGTH_M = 20.0
"""Largest plausible position of a prismatic joint without limits [m]."""

WIDEST_TURN = 16 * np.pi
"""Largest plausible position of a revolute joint without limits [rad]: eight turns."""

ROUNDED_JITTER = 1e-6
"""Difference of steps, relative to a step, below which it is the rounding of the stamps' numbers."""

SUSPECT = 100.0
"""Without a robot, positions beyond this give a warning [m or rad]."""


@runtime_checkable
class JointLimits(Protocol):
    """A robot's actuated joints: names, kinds (`prismatic` or `revolute`) and limits (na,) [m or rad]."""

    @property
    def actuated(self) -> Sequence[str]: ...  # noqa: D102

    @property
    def joint_kinds(self) -> Sequence[str]: ...  # noqa: D102

    @property
    def lower(self) -> NDArray[np.float64]: ...  # noqa: D102

    @property
    def upper(self) -> NDArray[np.float64]: ...  # noqa: D102


def list_unit_warnings(log: Log, robot: JointLimits | None = None) -> tuple[str, ...]:
    """Return a sentence for every joint whose positions do not look like m or rad.

    Args:
        log: The log, as read.
        robot: Its robot, or None if unknown: then only positions beyond 100 are doubted.

    Returns:
        Sentences; empty if all positions are plausible. With limits, a joint is doubted if it leaves them by more than half
        their width.
    """
    if robot is None:
        return tuple(_doubt_without_robot(log))
    sentences = []
    limits = zip(robot.actuated, robot.joint_kinds, robot.lower, robot.upper, strict=True)
    for joint, kind, lower, upper in limits:
        if log.has("q", [joint]):
            sentences.append(_doubt(log, joint, kind, float(lower), float(upper)))
    return tuple(CodedWarning("scale_wrong", sentence) for sentence in sentences if sentence)


def _doubt(log: Log, joint: str, kind: str, lower: float, upper: float) -> str:
    """Return a sentence if a joint's positions are far outside its limits, naming the unit that explains it."""
    low, high = _extent(log, joint)
    prismatic = kind == "prismatic"
    unit, foreign, scale = ("m", "mm", 1e-3) if prismatic else ("rad", "degrees", np.pi / 180)
    if not prismatic and not np.isfinite(upper - lower):
        return ""  # a joint that turns without end may be at any angle
    reach = MAX_AXIS_LENGTH_M if prismatic else WIDEST_TURN
    lower, upper = max(lower, -reach), min(upper, reach)
    margin = (upper - lower) / 2
    if low >= lower - margin and high <= upper + margin:
        return ""
    where = f"{log.name}: q_{joint} runs from {low:.4g} to {high:.4g}, far outside {lower:.4g} to {upper:.4g} {unit}"
    slack = 0.1 * margin
    if low * scale >= lower - slack and high * scale <= upper + slack:
        line = f"q_{joint}: {{column: q_{joint}, scale: {scale:.9g}}}"
        return f"{where}; the unit is probably {foreign} (a gear ratio looks alike): write `{line}` into a column map."
    return f"{where}; is it this joint, at its own side of the gear, in {unit}?"


def _doubt_without_robot(log: Log) -> list[str]:
    sentences: list[str] = []
    for joint in log.joints("q"):
        low, high = _extent(log, joint)
        if max(abs(low), abs(high)) > SUSPECT:
            sentence = (
                f"{log.name}: q_{joint} runs from {low:.4g} to {high:.4g}, in mm or degrees, or through "
                f"{(high - low) / (2 * np.pi):.0f} turns; positions are in m or rad (scale 0.001 or 0.0174532925 in a column "
                "map). The robot file decides: tau-dyn check LOG ROBOT."
            )
            sentences.append(CodedWarning("scale_wrong", sentence))
    return sentences


def _extent(log: Log, joint: str) -> tuple[float, float]:
    q = log.joint("q", [joint])
    return float(q.min()), float(q.max())


MIN_RATE_HZ = 50.0
"""Below this rate [Hz], positions hardly give the accelerations of a machine."""

MIN_PART_SHARE = 0.05
"""Parts between gaps count for the motion from this share of the longest part's length."""

_UNITS = ((2e5, "nanoseconds", "1e-9"), (200.0, "microseconds", "1e-6"), (0.5, "milliseconds", "0.001"))
"""Steps from which a clock is probably in another unit, as machines log at 5 Hz to 2 kHz, and its scale to seconds."""

MIN_DURATION_S = 5.0
"""Shorter logs [s] rarely hold enough independent motion."""


def check_clock(log: Log, used: Log | None = None) -> tuple[list[CheckFinding], dict[str, Any]]:
    """Judge the clock of a log.

    Args:
        log: A log as read.
        used: The log with its short gaps filled; by default the log itself.

    Returns:
        Findings, and the numbers `n_samples`, `duration` [s], `rate_hz`, `jitter` (share of a step), `n_missing`,
        `gaps` (from, to) [s] and `times_rounded`.
    """
    clock = examine_clock(log)
    numbers = {
        "n_samples": log.n_samples,
        "duration": log.duration,
        "rate_hz": 1.0 / clock.dt,
        "jitter": clock.jitter,
        "n_missing": clock.n_missing,
        "gaps": [[float(log.t[i]), float(log.t[i + 1])] for i in clock.gaps],
        "times_rounded": clock.rounded,
    }
    return [_rate(log, clock), _evenness(log, clock), _gaps(used or log, clock)], numbers


def _rate(log: Log, clock: Clock) -> CheckFinding:
    rate = 1.0 / clock.dt
    what = f"{log.name} has {log.n_samples} samples at {rate:.6g} Hz, {log.duration:.4g} s."
    if clock.dt >= 0.5:
        unit, scale = next((name, scale) for least, name, scale in _UNITS if clock.dt >= least)
        remedy = f"Give t in s: `t: {{column: t, scale: {scale}}}` in a column map (--columns)."
        return CheckFinding("fault", "sampling", f"{what} The time step suggests {unit}.", remedy)
    return choose_finding(
        "sampling",
        what,
        (rate < MIN_RATE_HZ, f"{what} The sampling rate is too low for accelerations.", "Log at 250 Hz or more."),
        (log.duration < MIN_DURATION_S, f"{what} The log is short.", "Record 10 s or more of varied motion."),
    )


def _evenness(log: Log, clock: Clock) -> CheckFinding:
    rounded = f"{log.name}: uniform clock, rounded stamps."
    differ = f"{log.name}: steps differ from {clock.dt:.6g} s by up to {100 * clock.jitter:.2g} %."
    if clock.jitter < ROUNDED_JITTER:
        differ = f"{log.name}: steps are equal, {clock.dt:.6g} s."
    uneven, remedy = clock.jitter > MAX_RELATIVE_JITTER, "Stamp samples in the real-time loop; the log is resampled."
    rounding = (clock.rounded, rounded, "Write more digits; a uniform clock is used.")
    return choose_finding("jitter", differ, rounding, (uneven, differ, remedy))


def _choose_used(log: Log, joints: Sequence[str]) -> Log:
    """Return the mended log if gaps of the log are filled in it, else the log."""
    n_gaps = len(examine_clock(log).gaps)
    mended = mend_log(log, joints) if n_gaps else log
    return mended if len(examine_clock(mended).gaps) < n_gaps else log


def _gaps(log: Log, clock: Clock) -> CheckFinding:
    lost = (
        f"{count(clock.n_missing, 'sample')} {'is' if clock.n_missing == 1 else 'are'} missing, never three in a row."
    )
    left = examine_clock(log)
    cut = describe_gaps(log, left) if left.gaps else ""
    filled = f"{log.name} has {count(len(clock.gaps), 'gap')} in time, which the samples around it determine."
    return choose_finding(
        "gaps",
        f"{log.name}: no sample is missing.",
        (bool(left.gaps), cut, "Record without interruption; the parts are used separately."),
        (bool(clock.gaps), filled, "Record without interruption; the gaps are interpolated."),
        (
            clock.n_missing > 0,
            f"{log.name}: {lost}",
            "Give the logger more priority; missing samples are interpolated.",
        ),
    )


_READING = {
    UNCODED: "Let the logger finish its file.",
    "log_layout": "Check that it was meant so.",
    "clock_converted": "Check the rate above.",
    "stamps_chosen": "No remedy needed: they give the time of the measurement better.",
    "clocks_joined": "Log all signals by one clock.",
    "column_without_numbers": "Log it, or map another column.",
    "samples_left_out": "Let the logger fill every cell.",
}
"""Remedies of remarks on reading, by their codes; sentences without a code are about an incomplete last line."""


def check_log(log: LogSource, robot: JointLimits | None = None) -> LogCheck:
    """Judge whether a log is fit for identification.

    Args:
        log: A log as read, the path of its file, or a table. If it has gaps that are not filled, channels are judged on its
            longest part.
        robot: The robot it belongs to, for joints and limits; None leaves those out.

    Returns:
        Findings in the order clock, reading, columns, units, channels, motion, and the numbers behind them.

    Raises:
        InputError: The log cannot be read, or log or robot is something else.

    Example:
        >>> t = np.delete(np.arange(0.0, 10.0, 0.01), slice(300, 400))
        >>> log = td.Log(t, {"q_axis": np.sin(t), "tau_axis": np.cos(t)}, "lost.csv")
        >>> [finding.topic for finding in td.check_log(log).findings if finding.severity != "ok"]
        ['gaps', 'excitation']
    """
    log = as_log(log)
    if robot is not None:
        require_kind(robot, JointLimits, "robot", "a Robot")
    joints = () if robot is None else robot.actuated
    used = _choose_used(log, joints)
    findings, numbers = check_clock(log, used)
    findings += [
        CheckFinding("warning", "reading", sentence, _READING.get(get_code(sentence), "See the message."))
        for sentence in log.warnings
    ]
    findings += _columns(log, robot) + _check_units(log, robot)
    findings += [build_fault(warning) for warning in list_data_warnings(log, joints)]
    parts = split_at_gaps(used)
    if not parts:
        lost = f"{log.name}: no stretch of it is without a gap."
        return LogCheck(log.name, (*findings, CheckFinding("fault", "gaps", lost, "Record it again.")), numbers)
    longest = int(np.argmax([part.n_samples for part in parts]))
    even = resample_segments(used)
    raw, part = parts[longest], even[longest]
    others = [other for other in even if other is not part and other.n_samples >= MIN_PART_SHARE * part.n_samples]
    nearest = np.searchsorted(part.t[:-1] + part.dt / 2, raw.t)  # an uneven clock has another number of samples
    moving = {joint: find_moving_samples(part, joint)[nearest] for joint in log.joints("q")}
    findings += _find_jumps(raw, robot)
    known = " ".join(finding.sentence for finding in findings if finding.topic == "frozen")
    kinds = {} if robot is None else dict(zip(robot.actuated, robot.joint_kinds, strict=True))
    units = {joint: "m" if kind == "prismatic" else "rad" for joint, kind in kinds.items()}
    for more, figures in (check_signals(raw, moving), check_motion(part, others, units)):
        findings += [f for f in more if f.topic != "frozen" or f"{_name_column(log, f)} stays at the same" not in known]
        numbers.update(figures)
    findings.append(_force_lag(log))
    return LogCheck(log.name, tuple(findings), numbers)


def _name_column(log: Log, finding: CheckFinding) -> str:
    """Return the column at the start of a finding's sentence."""
    return finding.sentence.removeprefix(f"{log.name}: ").split()[0]


def _columns(log: Log, robot: JointLimits | None) -> list[CheckFinding]:
    """Compare the log's columns with what identification needs."""
    joints: Any = log.joints("q") if robot is None else tuple(robot.actuated)
    if not joints:
        return [
            CheckFinding(
                "fault",
                "columns",
                f"{log.name} has no q_ column; it has {format_names(log.channels)}.",
                "Log joint positions.",
            )
        ]
    findings = []
    wanted: tuple[tuple[str, Severity, str], ...] = (
        ("q", "fault", "position"),
        ("tau", "warning", "force, and identification needs it"),
    )
    for signal, severity, why in wanted:
        missing = [f"{signal}_{joint}" for joint in joints if not log.has(signal, [joint])]
        if missing:
            others = [joint for joint in log.joints(signal) if joint not in joints]
            instead = f" It has those of {format_names(others)}: another robot's log?" if others else ""
            sentence = f"{log.name} has no {format_names(missing)}: the joint's {why}.{instead}"
            findings.append(
                CheckFinding(severity, "columns", sentence, "Log it, or name it in a map (--columns MAP.yaml).")
            )
    return findings or [
        CheckFinding("ok", "columns", f"{log.name} has positions and forces of {format_names(joints)}.")
    ]


def _check_units(log: Log, robot: JointLimits | None) -> list[CheckFinding]:
    doubts = [
        CheckFinding(
            "warning" if robot is None else "fault",
            "units",
            sentence,
            "Give the map with --columns MAP.yaml.",
            "" if get_code(sentence) == UNCODED else get_code(sentence),
        )
        for sentence in list_unit_warnings(log, robot)
    ]
    return doubts or [CheckFinding("ok", "units", f"{log.name}: positions look like m and rad.")]


def _find_jumps(log: Log, robot: JointLimits | None) -> list[CheckFinding]:
    kinds = {} if robot is None else dict(zip(robot.actuated, robot.joint_kinds, strict=True))
    turns = {joint: kinds[joint] != "prismatic" if joint in kinds else None for joint in log.joints("q")}
    found = (check_jumps(log, joint, revolute=revolute) for joint, revolute in turns.items())
    return [finding for finding in found if finding is not None]


def _force_lag(log: Log) -> CheckFinding:
    sentence = f"{log.name}: a lag between force and motion was not tested; it takes the robot file."
    return CheckFinding("ok", "synchronisation", sentence)


MIN_CORRELATION = 0.9
"""Correlation of a signal with one that it follows, or that follows it, from which their ratio is a scale."""
MAX_RATIO = 5.0
"""Ratio of standard deviations, or its inverse, beyond which a unit differs; a drooping servo stays above a half."""
MIN_OFFSET = 0.5
"""Offset [rad or m] beyond any droop: the zero of an encoder."""
UNITS = {
    "degrees": np.pi / 180,
    "thousandths": 1e-3,
    "turns": 2 * np.pi,
    "multiples of g": 9.80665,
    **{f"steps of {n} a turn": 2 * np.pi / n for n in (1024, 4096, 16384, 65536)},
}
MAX_QUARTER_ERROR = 0.2  # of a quarter turn, to which droop may move the zero of an encoder
UNIT_TOLERANCE = 0.1
"""Relative difference of a ratio from a unit's that friction and droop may cause."""


def describe_other_scale(
    column: str, x: np.ndarray, trusted: str, y: np.ndarray, *, correlated: float = MIN_CORRELATION, key: str = ""
) -> str:
    """Return a sentence if a signal has another unit or sign than one that it follows or that follows it.

    Args:
        column: Name of the doubted signal.
        x: Its samples (N,).
        trusted: Name of the other signal, in SI.
        y: Its samples (N,).
        correlated: Least correlation from which the ratio of both counts.
        key: Name of the doubted signal in a column map; its own by default.

    Returns:
        The sentence, with a line for the column map; empty where their ratio is plausible, or tells nothing.
    """
    sizes = float(np.std(y)), float(np.std(x))
    if min(sizes) <= 0:
        return ""
    correlation = float(np.corrcoef(x, y)[0, 1])
    ratio, size = float(np.sign(correlation) * sizes[0] / sizes[1]), sizes[0] / sizes[1]
    if abs(correlation) < correlated or 1 / MAX_RATIO < ratio < MAX_RATIO:
        return ""
    usual = 1 / MAX_RATIO < size < MAX_RATIO
    unit = "" if usual else next((name for name, of in UNITS.items() if abs(size / of - 1) < UNIT_TOLERANCE), "")
    scale = np.sign(ratio) * (1.0 if usual else UNITS.get(unit, float(f"{size:.2g}")))
    offset = float(np.mean(y) - scale * np.mean(x))
    quarters = offset / (np.pi / 2)  # an encoder's zero; droop under gravity moves the mean off it
    if unit.startswith("steps") and abs(quarters - round(quarters)) < MAX_QUARTER_ERROR:
        offset = round(quarters) * np.pi / 2
    shift = f", offset: {offset:.6g}" if abs(offset) > MIN_OFFSET else ""
    what = [f"runs against {trusted}"] if ratio < 0 else []
    what += [] if usual else [f"is {1 / size:.3g} times as large as {trusted}" + (f", as if in {unit}" if unit else "")]
    line = f"{key or column}: {{column: {column}, scale: {scale:.6g}{shift}}}"
    return f"{column} {' and '.join(what)}; write `{line}` into a column map"
