"""Data of a fit, in memory or on disk, behind the same interface.

Logs in memory become a `Regression` that holds every row. If one recording is too large for memory, all recordings are processed
block by block (`streaming.py`), and the regression holds their totals. Estimates, errors and warnings are made from both forms
in the same way.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from scipy.interpolate import CubicSpline

from tau_dyn.estimate import ROUNDING, Preparation, Regression
from tau_dyn.exceptions import InputError
from tau_dyn.identify.common_samples import has_common_samples
from tau_dyn.identify.fitted_model import scale_outputs
from tau_dyn.identify.integrity.log_integrity import check_integrity
from tau_dyn.identify.motor_electrics import RECORDED
from tau_dyn.identify.per_log import split_by_log
from tau_dyn.identify.preparation import SATURATION_RATIO, list_crumbs, refuse_jumps, refuse_short
from tau_dyn.identify.regression import build_regression_of_pieces
from tau_dyn.identify.streaming import (
    BlockExecutor,
    Progress,
    build_stream_regression,
    list_channels,
    refuse_missing,
    split_recording_evenly,
)
from tau_dyn.log import (
    MIN_SEGMENT_SAMPLES,
    DataTable,
    Log,
    LogSource,
    Recording,
    as_log,
    check_signals,
    find_moving_samples,
    list_unit_warnings,
    mend_log,
    resample_segments,
)
from tau_dyn.message_codes import UNCODED, CodedWarning, get_code
from tau_dyn.model import Model
from tau_dyn.robot import Robot

Kind = TypeVar("Kind", bound=Log | Recording)
Logs: TypeAlias = LogSource | Recording | Iterable[LogSource | Recording]
"""One log or several: each a log, a recording on disk, the path of a file, or a table."""

_CHANNEL_FAULTS = ("frozen", "clipping")
"""Codes of channel faults that a fit does not detect by itself."""

_NOT_MENDED = "This is of the middle of a recording larger than memory, which is used as it is."

_MAX_LISTED_WARNINGS = 4  # warnings about one log before they are counted instead of listed


def get_log_list(logs: Logs) -> list[Log | Recording]:
    """Return one log or many as a list; paths are read, and tables become logs; see `as_log`.

    Raises:
        InputError: One of them is not a log.
    """
    if isinstance(logs, Log | Recording | str | Path | DataTable) or not isinstance(logs, Iterable):
        return [as_log(logs)]
    return [as_log(one) for one in logs]


def list_provenance(train: Sequence[Log | Recording], held: Sequence[Log | Recording], seed: int) -> dict[str, Any]:
    """Return the source of a model file's values: the logs' names, hashes and column maps, the version, the seed."""
    from tau_dyn.version import __version__

    trained_on, held_out = ([_describe_source(log) for log in logs] for logs in (train, held))
    return {"tool_version": __version__, "trained_on": trained_on, "held_out": held_out, "seed": seed}


def _describe_source(log: Log | Recording) -> dict[str, Any]:
    """Return a log's name and hash, and the entries of the column map that it was read by."""
    map_ = log.map_ if isinstance(log, Recording) else log.origin.column_map
    columns = {} if map_ is None else {"columns": map_.to_dict()}
    return {"path": log.name, "sha256": log.sha256, **columns}


def drop_repeated_logs(train: Sequence[Kind], held: Sequence[Kind]) -> tuple[list[Kind], list[Kind], list[str]]:
    """Return logs to train on and held-out logs with no samples twice, and a warning about each log that is left out.

    Repeated samples would count as double evidence; errors on logs that are also trained on are not held-out errors.
    """
    trained, doubled = _keep_once(train)
    both = [log for log in held if any(has_common_samples(log, other) for other in trained)]
    doubled += [
        CodedWarning(
            "copied_data",
            f"{log.name} is both trained on and held out{_name_original(log, trained)}; its errors are not held-out errors "
            "and are left out",
        )
        for log in both
    ]
    judged, more = _keep_once([log for log in held if log not in both])
    return trained, judged, doubled + more


def _keep_once(logs: Sequence[Kind]) -> tuple[list[Kind], list[str]]:
    """Return the logs without repetitions, and a warning for each repeated log."""
    once: list[Kind] = []
    doubled = []
    for log in logs:
        if any(has_common_samples(log, other) for other in once):
            sentence = f"{log.name} is given twice, or overlaps with a log given before{_name_original(log, once)}"
            doubled.append(CodedWarning("copied_data", f"{sentence}; it counts once"))
        else:
            once.append(log)
    return once, doubled


def _name_original(log: Log | Recording, others: Sequence[Log | Recording]) -> str:
    """Return the name of the log that a copy under another name shares its samples with, as part of a sentence."""
    original = next(other for other in others if has_common_samples(log, other))
    return "" if original.name == log.name else f": it holds samples of {original.name}"


def log_warnings(robot: Robot, logs: Sequence[Log]) -> list[str]:
    """Return warnings about the logs' pieces; for many similar ones from one file, the first two and their number."""
    found: list[str] = []
    for name in dict.fromkeys(log.name for log in logs):
        pieces = [log for log in logs if log.name == name]
        of_logs = (w for log in pieces for w in (*log.warnings, *list_unit_warnings(log, robot)))
        longest = max(pieces, key=lambda log: log.n_samples)
        said = list(dict.fromkeys([*of_logs, *_channel_warnings(robot, longest)]))
        found += said if len(said) <= _MAX_LISTED_WARNINGS else _some(said, name)
    return found


def _some(said: list[str], name: str) -> list[str]:
    """Return the first two of many warnings, the first of each other code, and how many more there are."""
    codes = [get_code(sentence) for sentence in said]
    shown = [s for k, s in enumerate(said) if k < 2 or (codes[k] != UNCODED and codes[k] not in codes[:k])]
    return shown if len(shown) == len(said) else [*shown, f"{name}: {len(said) - len(shown)} more warnings like these"]


def _channel_warnings(robot: Robot, log: Log) -> list[str]:
    """Return the faults of the channels that the fit uses, without forces at the drives' limits, which are gated out."""
    if log.n_samples < MIN_SEGMENT_SAMPLES:
        return []
    columns = {f"{signal}_{joint}" for signal in ("q", "tau") for joint in robot.driven}
    limits = dict(zip((f"tau_{joint}" for joint in robot.actuated), robot.effort_limit, strict=True))
    used = {
        c: x
        for c, x in log.channels.items()
        if c in columns and np.abs(x).max() < SATURATION_RATIO * limits.get(c, np.inf)
    }
    channels = Log(log.t, used, log.name)
    moving = {joint: find_moving_samples(channels, joint) for joint in channels.joints("q")}
    found = check_signals(channels, moving)[0]
    doubtful = [f for f in found if f.topic in _CHANNEL_FAULTS and f.severity != "ok"]
    return [CodedWarning(f.code, f.sentence) if f.code else f.sentence for f in doubtful]


def require_forces(robot: Robot, logs: Sequence[Log | Recording]) -> None:
    """Refuse logs that hold positions but no force, and list the columns that are needed.

    Raises:
        InputError: A log has no force of any actuated joint.
    """
    for log in logs:
        if isinstance(log, Log) and log.has("q", robot.driven) and not any(log.has("tau", [j]) for j in robot.driven):
            commands = " and commands" if log.has("cmd", robot.driven[:1]) else ""
            raise InputError(
                "missing_column",
                f"{log.name} holds positions{commands} and no force; log each drive's force (tau_{robot.driven[0]}), or its "
                "current, which a column map scales by torque constant and gear ratio; tool positions (x_tool, y_tool, z_tool) "
                "are diagnosed without forces",
            )


def cut_into_pieces(log: Log, robot: Robot, exclude: tuple[str, ...] = ()) -> list[Log]:
    """Return a log's even stretches between gaps, which lost samples are, except for a walker: its joints jump at touchdown.

    Raises:
        InputError: A joint's position jumps at a sample that no column of `exclude` flags.
    """
    mended = log if robot.base_coordinates else mend_log(log, robot.actuated)
    refuse_jumps(mended, robot, exclude)
    return resample_segments(mended)


TRAIN_SHARE = 0.7
"""If no held-out log is given, a fit of this first part of each log predicts the rest."""


@dataclass(frozen=True, eq=False)
class Data:
    """Logs for one model.

    Attributes:
        model: The model that is fitted to them.
        logs: The logs.
        pieces: Even stretches of logs in memory; empty if one of the logs is a recording on disk.
        preparation: Filters and masks; None to choose them from the logs.
        exclude: Columns whose nonzero samples are left out.
        factors: Factor of an output's measurements, by name.
        campaigns: Names of logs that are numbered before these.
        per_log: Parameters that have a value per log.
        engine: Executor that computes the blocks.
        progress: Callback that receives the progress.
    """

    model: Model
    logs: tuple[Log | Recording, ...]
    pieces: tuple[Log, ...]
    preparation: Preparation | None = None
    exclude: tuple[str, ...] = ()
    factors: Mapping[str, float] = field(default_factory=dict)
    campaigns: tuple[str, ...] = ()
    per_log: tuple[str, ...] = ()
    engine: BlockExecutor = BlockExecutor()
    progress: Progress = lambda step: None

    @classmethod
    def of(cls, model: Model, logs: Sequence[Log | Recording], **options: Any) -> Data:
        """Cut logs in memory into even pieces; their few lost samples are gaps in the clock."""
        here = [log for log in logs if isinstance(log, Log)]
        exclude = options.get("exclude", ())
        pieces = [p for log in here if len(here) == len(logs) for p in cut_into_pieces(log, model.robot, exclude)]
        return cls(model, tuple(logs), tuple(pieces), **options)

    @property
    def streams(self) -> bool:
        """Whether the rows are on disk."""
        return any(isinstance(log, Recording) for log in self.logs)

    def warnings(self) -> list[str]:
        """Return warnings about the logs, faults first; for a large log, about a stretch in its middle."""
        whole = [log for log in self.logs if isinstance(log, Log)]
        found: list[Log] = []
        for log in self.logs if self.streams else ():
            if isinstance(log, Recording):
                refuse_missing(self.model, [log], self.exclude)
                for stretch in split_recording_evenly(log):
                    middle = max(0, stretch.n_samples // 2 - 2**15)
                    channels = list_channels(self.model, self.exclude)
                    part = stretch.window(middle, min(stretch.n_samples, middle + 2**16), channels)
                    found.append(part.with_warnings(*log.warnings, *stretch.warnings))
                    whole.append(part)
            else:
                found += resample_segments(log)
        spoilt = check_integrity(self.model.robot, whole, self.exclude)
        if self.streams:
            spoilt = [CodedWarning(w.code, f"{w} {_NOT_MENDED}", w.joints) for w in spoilt]
        return [*spoilt, *log_warnings(self.model.robot, [*self.pieces, *found])]

    def build(self, at: Model) -> BuiltData:
        """Return the regression, with signals at a model's values."""
        if self.streams:
            if self.per_log:
                raise InputError(
                    "unsupported", "--per-log needs all rows in memory, and a recording is too large; give an excerpt"
                )
            built = build_stream_regression(
                self.model,
                self.logs,
                preparation=self.preparation,
                exclude=self.exclude,
                at=at,
                campaigns=self.campaigns,
                factors=self.factors,
                share=TRAIN_SHARE,
                engine=self.engine,
                progress=self.progress,
            )
            data = replace(self, preparation=built.whole.preparation)
            return BuiltData(data, built.whole, (built.first, built.last), tuple(built.left_out))
        logs = [log for log in self.logs if isinstance(log, Log)]
        if logs and not self.pieces:
            raise refuse_short(logs, MIN_SEGMENT_SAMPLES / min(log.rate_hz for log in logs))
        built, kept = build_regression_of_pieces(
            self.model, self.pieces, preparation=self.preparation, exclude=self.exclude, at=at, campaigns=self.campaigns
        )
        data = replace(self, pieces=tuple(kept.of(self.pieces)), preparation=built.preparation)
        regression = scale_outputs(built, self.factors) if self.factors else built
        if self.per_log:
            regression = split_by_log(regression, self.per_log)
        return BuiltData(data, regression, None, (*list_crumbs(logs), *kept.warnings))

    def shifted(self, seconds: float) -> Data:
        """Return the data with forces that are read `seconds` later."""
        joints = self.model.robot.actuated
        return replace(self, pieces=tuple(shift_forces(piece, joints, seconds) for piece in self.pieces))


class BuiltData(NamedTuple):
    """A regression and the data it was made from.

    Attributes:
        data: The pieces that gave rows, and the filters and masks they went through.
        regression: All rows.
        blocks: Regressions of the first and the last part of each log, as totals without rows; None for logs in memory.
        left_out: Warnings about pieces that gave no rows.
    """

    data: Data
    regression: Regression
    blocks: tuple[Regression, Regression] | None
    left_out: tuple[str, ...]

    def parts(self) -> tuple[Regression, Regression]:
        """Return the first and the last part, cut in time with a gap between as wide as the filters' memory."""
        if self.blocks is not None:
            return self.blocks
        first, last, preparation = [], [], self.regression.preparation
        for run in self.regression.runs:
            cut = int(TRAIN_SHARE * len(run.t))
            gap = int(np.ceil(preparation.rate_hz / preparation.force_cutoff_hz - ROUNDING)) if len(run.t) > 1 else 0
            first.append(run.window(slice(0, cut)))
            last.append(run.window(slice(min(cut + gap, len(run.t) - 1), len(run.t))))
        return replace(self.regression, runs=tuple(first)), replace(self.regression, runs=tuple(last))


def shift_forces(log: Log, joints: Sequence[str], seconds: float) -> Log:
    """Return a log whose forces and voltages are read `seconds` later, by cubic interpolation; its ends keep their last value."""
    t = np.clip(log.t + seconds, log.t[0], log.t[-1])
    names = [n for joint in joints for s in ("tau", *RECORDED) if (n := f"{s}_{joint}") in log.channels]
    return replace(log, channels={**log.channels, **{n: CubicSpline(log.t, log.channels[n])(t) for n in names}})
