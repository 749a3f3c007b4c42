"""Changes of a running robot with their time: residuals of a model, in a few directions, block by block.

Forces are prepared as identification prepares them (filters, gate around reversals) and the model's own are subtracted; the
possible changes are in `directions.py`.

The first minute of motion is the reference: its model error counts as normal (`change_detection.py`), and its residual gives
the noise model of each joint. After an alarm the next minute is the new reference. Logs follow each other in the given order;
a block is 2 s in which a joint moves, and only such blocks count as time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.effects import EFFECTS, PARAMETER_CAUSES
from tau_dyn.estimate import Autoregression, Preparation, RegressionRun, Whitener, fit_autoregression
from tau_dyn.evidence import Finding
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify import (
    TooShort,
    check_against_robot,
    choose_preparation,
    complete_positions,
    cut_into_pieces,
    log_warnings,
    prepare_segment,
    require_forces,
)
from tau_dyn.log import Log, find_true_runs
from tau_dyn.message_codes import format_warnings
from tau_dyn.model import Model
from tau_dyn.monitor.change_detection import (
    BLOCK_S,
    FALSE_ALARMS_PER_HOUR,
    ChangeDetector,
    DetectedChange,
)
from tau_dyn.monitor.directions import (
    CAUSES,
    Direction,
    compute_direction_columns,
    group_payload,
    list_felt,
    list_named,
)
from tau_dyn.monitor.normal_state import BlockScore
from tau_dyn.parameters import Parameter
from tau_dyn.results import Shown

REFERENCE_S = 60.0
"""Motion from which the normal state is learned [s]: 30 blocks, whose scatter is known to 13 %."""
MIN_REFERENCE_S = 40.0
"""Shortest reference [s]: below 20 blocks the threshold for the false-alarm rate exceeds 12 standard errors."""
_MIN_SHARE = 0.25
"""Part of a block's samples, over all joints, that must be usable; fewer carry little information and scatter much."""


@dataclass(frozen=True, eq=False)
class WatchResult(Shown):
    """Changes detected in watched logs.

    Attributes:
        model: The model.
        directions: The monitored changes.
        unfelt: Changes that do not affect the forces of this robot.
        changes: The detected changes.
        trace: Time [s], log and largest statistic over its threshold, of each block.
        logs: Names of the logs.
        watched_s: Motion watched, without references [s].
        reference_s: Motion of each reference [s].
        rate: Expected false alarms per hour.
        threshold: Threshold in standard errors; NaN if no reference was complete.
        warnings: Doubts, as sentences.
    """

    model: Model
    directions: tuple[Direction, ...]
    unfelt: tuple[Direction, ...]
    changes: tuple[DetectedChange, ...]
    trace: tuple[tuple[float, str, float], ...]
    logs: tuple[str, ...]
    watched_s: float
    reference_s: float
    rate: float
    threshold: float
    warnings: tuple[str, ...]

    def rows(self) -> list[Mapping[str, Any]]:
        """Return the alarms in the contract's form."""
        return [describe_change(change, self.directions) for change in self.changes]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The alarms as findings of the kind that `diagnose` gives."""
        return tuple(build_change_finding(change, self.directions, self.watched_s / 3600) for change in self.changes)

    @property
    def watched_for(self) -> list[Direction]:
        """The monitored changes, each once."""
        return list_named(self.directions)

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's JSON result, without the entries that the command adds."""
        return {
            "alarms": self.rows(),
            "findings": [f.to_dict() for f in self.findings],
            "false_alarm_rate_per_hour": self.rate,
            "threshold": None if np.isnan(self.threshold) else self.threshold,
            "watched_s": self.watched_s,
            "reference_s": self.reference_s,
            "watched_for": [{"what": d.what, "joint": d.joint or None, "unit": d.unit} for d in self.watched_for],
            "not_felt": [{"what": d.what, "joint": d.joint or None} for d in self.unfelt],
            **format_warnings(self.warnings),
        }


def describe_change(change: DetectedChange, directions: Sequence[Direction]) -> dict[str, Any]:
    """Return an alarm in the contract's form."""
    d = directions[change.direction]
    return {
        "since_t": change.since_t, "since_log": change.since_log, "since_ci95": list(change.since_ci95),
        "detected_t": change.detected_t, "log": change.detected_log, "what": d.what, "joint": d.joint or None,
        "size": change.size, "unit": d.unit, "ci95": list(change.ci95),
        "false_alarm_rate": change.false_alarms_per_hour,
        "indistinguishable_from": [
            {"what": directions[k].what, "joint": directions[k].joint or None} for k in change.twins
        ],
    }  # fmt: skip


def build_change_finding(change: DetectedChange, directions: Sequence[Direction], watched_h: float) -> Finding:
    """Return an alarm as a finding: a number that differs from its value in the reference.

    Args:
        change: The alarm.
        directions: The monitored changes.
        watched_h: Motion watched [h], over which a false alarm may occur.
    """
    d = directions[change.direction]
    name = f"{d.joint}.{d.cause}" if d.joint else d.cause
    size = Parameter(name, CAUSES[d.what][1] * change.size, d.unit, stderr=change.stderr, origin=d.cause)
    others = dict.fromkeys(directions[k].cause for k in change.twins)
    amount = f"{change.size:+.3g} {d.unit}".removesuffix(" 1")
    loaded = any(directions[k].what == "payload" for k in change.simultaneous)
    why = "its size is that of the robot without the payload that changed at the same time" if loaded else ""
    return Finding(
        d.cause,
        (d.joint,) if d.joint else (),
        "suspected" if why else "parameter",
        change.statistic,
        float(-np.expm1(-change.false_alarms_per_hour * watched_h)),
        (size,),
        None,
        tuple(cause for cause in others if cause != d.cause),
        (PARAMETER_CAUSES | {n: effect.equation for n, effect in EFFECTS.items()})[d.cause],
        f"{d.words[:1].upper()}{d.words[1:]} changes by {amount} since t = {change.since_t:.4g} s of {change.since_log}.",
        why_not_confirmed=why,
        logs=tuple(dict.fromkeys((change.since_log, change.detected_log))),
    )


class _Block(NamedTuple):
    """A block's rows: times (n,), residual (n, na), columns of the directions (n, na, D), and the usable entries (n, na)."""

    log: str
    t: np.ndarray
    e: np.ndarray
    X: np.ndarray
    usable: np.ndarray


@dataclass(eq=False)
class Watch:
    """Takes logs of one robot one by one; see the module.

    Attributes:
        model: The model of the normal robot.
        reference_s: Motion from which the normal state is learned [s].
        rate: False alarms per hour.
        exclude: Log columns whose nonzero samples are left out.
        detector: Detector of changes; None before the first log.
        logs: Names of the logs so far.
        warnings: Doubts about the logs.
        directions: The monitored changes, known from the first log on.
        unfelt: Changes that do not affect the forces.
    """

    model: Model
    reference_s: float = REFERENCE_S
    rate: float = FALSE_ALARMS_PER_HOUR
    exclude: tuple[str, ...] = ()
    detector: ChangeDetector | None = None
    logs: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    directions: tuple[Direction, ...] = ()
    unfelt: tuple[Direction, ...] = ()
    _chosen: tuple[int, ...] = ()
    _preparation: Preparation | None = None
    _noise: list[Autoregression] | None = None
    _learning: list[_Block] = field(default_factory=list)
    _watched: int = 0
    _threshold: float = np.nan

    def __post_init__(self) -> None:
        """Refuse a reference that is too short, and effects that need more than a motion."""
        if self.reference_s < MIN_REFERENCE_S:
            raise InputError(
                "invalid_value",
                f"a reference takes {MIN_REFERENCE_S:g} s of motion or more, not {self.reference_s:g} s",
            )

    def feed(self, log: Log) -> list[dict[str, Any]]:
        """Add a log, or the next segment of one; return the alarms that it completes.

        Raises:
            InputError: It lacks a column, or the robot cannot move as logged.
            CannotAnswer: The first log is too short for the filters.
        """
        (log,) = complete_positions(self.model.robot, [log])
        require_forces(self.model.robot, [log])
        if log.name not in self.logs:
            self.logs.append(log.name)
        pieces = cut_into_pieces(log, self.model.robot, self.exclude)
        self.warnings += [w for w in log_warnings(self.model.robot, pieces) if w not in self.warnings]
        if self._preparation is None:
            self._preparation = choose_preparation(self.model.robot, pieces, self.exclude)
            self.warnings += check_against_robot(self.model.robot, [log], self.exclude)
        done = 0 if self.detector is None else len(self.detector.changes)
        for piece in pieces:
            try:
                blocks = list(self._cut(piece, self._preparation))
            except TooShort:
                continue
            for block in blocks:
                self._add(block)
        changes = [] if self.detector is None else self.detector.changes[done:]
        return [describe_change(change, self.directions) for change in changes]

    def finish(self) -> WatchResult:
        """Return the result.

        Raises:
            CannotAnswer: The logs are not longer than the reference.
        """
        if self.detector is None or not self._watched:
            have = BLOCK_S * (len(self._learning) if np.isnan(self._threshold) else self._wanted)
            raise CannotAnswer(
                "too_little_data",
                f"no change was found: the logs hold {have:g} s of motion that can be used, and the first {self.reference_s:g} s "
                "are the reference",
                f"name logs of the normal robot first, with {self.reference_s:g} s of motion or more, such as those that the "
                "model was fitted to; then those to watch",
            )
        self.detector.settle()
        return WatchResult(
            self.model, self.directions, self.unfelt, tuple(self.detector.changes), tuple(self.detector.trace),
            tuple(self.logs), BLOCK_S * self._watched, self.reference_s, self.rate, self._threshold, tuple(self.warnings),
        )  # fmt: skip

    def _cut(self, piece: Log, preparation: Preparation) -> Iterator[_Block]:
        """Yield the blocks of an evenly sampled segment in which a joint moves."""
        if piece.n_samples < 4 * preparation.factor(piece.rate_hz) or piece.duration < BLOCK_S:
            return
        made = prepare_segment(self.model, piece, preparation)
        motion, forces = made.motion, self._compute_forces(made.motion)
        candidates, columns = compute_direction_columns(self.model, motion, forces, piece.dt)
        if not self.directions:
            self._chosen = list_felt(candidates, columns, forces)
            self.directions = tuple(candidates[k] for k in self._chosen)
            self.unfelt = tuple(list_named([d for k, d in enumerate(candidates) if k not in self._chosen]))
        X = made.columns(columns[:, :, self._chosen])
        e = made.passed(made.gate * (made.force - forces)) / made.weight
        t = piece.t[:: made.factor][: len(e)]
        number = np.floor((t - t[0]) / BLOCK_S + 1e-6).astype(int)
        for k in range(number[-1] + 1):
            rows = number == k
            if made.usable[rows].mean() >= _MIN_SHARE and t[rows][-1] - t[rows][0] > 0.8 * BLOCK_S:
                yield _Block(piece.name, t[rows], e[rows], X[rows], made.usable[rows])

    @property
    def _wanted(self) -> int:
        """Blocks of a reference."""
        return int(np.ceil(self.reference_s / BLOCK_S))

    def _compute_forces(self, motion: Any) -> np.ndarray:
        return self.model.mechanism.inverse_dynamics(motion.q, motion.v, motion.a) + self.model.effect_force(motion)

    def _add(self, block: _Block) -> None:
        """Learn from a block, or watch it."""
        if self.detector is None:
            sizes = np.array([d.typical for d in self.directions])
            self.detector = ChangeDetector(sizes, self._wanted, self.rate, group_payload(self.directions))
        if self._noise is None or self.detector.normal is None:
            self._learning.append(block)
            if len(self._learning) < self._wanted:
                return
            self._noise = fit_noise(self._learning)
            for row in self._learning:
                self.detector.add(compute_score(row, self._noise))
            self._learning, self._threshold = [], self.detector.threshold
            return
        self.detector.add(compute_score(block, self._noise))
        self._watched += 1


def watch_logs(
    model: Model,
    logs: Iterable[Log],
    *,
    reference_s: float = REFERENCE_S,
    exclude: tuple[str, ...] = (),
    progress: Callable[[str], None] = lambda step: None,
    alarm: Callable[[dict[str, Any]], None] = lambda row: None,
) -> WatchResult:
    """Watch logs, one after another.

    Args:
        model: The model of the normal robot.
        logs: Logs in the order of time, or segments of a growing log.
        reference_s: Motion from which the normal state is learned [s].
        exclude: Log columns whose nonzero samples are left out.
        progress: Called with a word for each log.
        alarm: Called with each alarm as soon as it is complete.

    Raises:
        InputError: A log is invalid.
        CannotAnswer: The logs are not longer than the reference.
    """
    watch = Watch(model, reference_s, exclude=exclude)
    for log in logs:
        progress(log.name)
        for row in watch.feed(log):
            alarm(row)
    return watch.finish()


def fit_noise(blocks: Sequence[_Block]) -> list[Autoregression]:
    """Return each joint's noise model, fitted to the residual without the directions."""
    D, na = blocks[0].X.shape[2], blocks[0].e.shape[1]
    found = []
    W = np.concatenate([block.X[block.usable] for block in blocks])
    y = np.concatenate([block.e[block.usable] for block in blocks])
    scale = np.maximum(np.linalg.norm(W, axis=0), 1e-300)
    theta = np.linalg.lstsq(W / scale, y, rcond=1e-10)[0] / scale if D else np.zeros(0)
    for k in range(na):
        stretches = []
        for block in blocks:
            left = block.e[:, k] - block.X[:, k] @ theta
            stretches += [left[run] for run in find_true_runs(block.usable[:, k])]
        found.append(fit_autoregression(stretches) if stretches else Autoregression(np.zeros(0), 1.0))
    return found


def compute_score(block: _Block, noise: Sequence[Autoregression]) -> BlockScore:
    """Return a block's score and information; the rows of each block are whitened separately."""
    run = RegressionRun(block.log, block.t, block.X, block.e, block.usable, block.X, block.e)
    whiten = Whitener.of([run], [block.usable], noise)
    e, X = whiten([block.e]), whiten([block.X])
    return BlockScore((float(block.t[0]), float(block.t[-1])), block.log, X.T @ e, X.T @ X, float(e @ e), len(e))
