"""What a fit is made from, in memory or on disk: the same questions to both.

Logs in memory become a `Regression` that holds every row. As soon as one recording is larger than that, all go block by
block (`streaming.py`), and the regression holds their totals; estimates, errors and warnings are made from either alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tau_dyn.estimate import Regression
from tau_dyn.identify.choices import scale_outputs
from tau_dyn.identify.log_inputs import log_warnings
from tau_dyn.identify.log_integrity import check_integrity
from tau_dyn.identify.preparation import ROUNDING, Preparation
from tau_dyn.identify.regression import build_regression
from tau_dyn.identify.short_pieces import list_crumbs, refuse_short
from tau_dyn.identify.streaming import (
    BlockExecutor,
    Progress,
    build_stream_regression,
    list_channels,
    refuse_missing,
    split_recording_evenly,
)
from tau_dyn.log import MIN_SEGMENT_SAMPLES, Log, Recording, mend_log, resample_segments
from tau_dyn.model import Model

TRAIN_SHARE = 0.7
"""Where no held-out log is given, a fit of this first part of each log predicts the rest."""


@dataclass(eq=False)
class Data:
    """Logs for one model.

    Attributes:
        model: What is fitted to them.
        logs: The logs.
        preparation: Filters and masks; None to choose them from the logs.
        exclude: Columns whose nonzero samples are left out.
        factors: Factor of an output's measurements, by name.
        campaigns: Names of logs that are numbered before these.
        engine: Who computes blocks.
        progress: Told how far it is.

    `pieces` are the even pieces, those that are too short for the filters until the first regression tells them apart; what is
    left out stands in `left_out`.
    """

    model: Model
    logs: Sequence[Log | Recording]
    preparation: Preparation | None = None
    exclude: tuple[str, ...] = ()
    factors: dict[str, float] = field(default_factory=dict)
    campaigns: tuple[str, ...] = ()
    engine: BlockExecutor = BlockExecutor()
    progress: Progress = lambda step: None

    def __post_init__(self) -> None:
        """Cut logs in memory into even pieces."""
        self.streams = any(isinstance(log, Recording) for log in self.logs)
        self.pieces = [] if self.streams else [piece for log in self.logs for piece in self._mended(log)]
        self._parts: tuple[Regression, Regression] | None = None
        self.left_out: tuple[str, ...] = () if self.streams else tuple(list_crumbs(self.logs))

    def _mended(self, log: Log | Recording) -> list[Log]:
        """Return a log's even pieces, its few lost samples being gaps in the clock."""
        return resample_segments(mend_log(log, self.model.robot.actuated)) if isinstance(log, Log) else []

    def warnings(self) -> list[str]:
        """Return what is doubtful about the logs, what spoils them first; of a large one, about a stretch in its middle."""
        whole = [log for log in self.logs if isinstance(log, Log)]
        found: list[Log] = []
        for log in self.logs if self.streams else ():
            if isinstance(log, Recording):
                refuse_missing(self.model, [log], self.exclude)
                for stretch in split_recording_evenly(log):
                    middle = max(0, stretch.n_samples // 2 - 2**15)
                    part = stretch.window(
                        middle, min(stretch.n_samples, middle + 2**16), list_channels(self.model, self.exclude)
                    )
                    found.append(part.with_warnings(*log.warnings, *stretch.warnings))
                    whole.append(part)
            else:
                found += resample_segments(log)
        spoilt = check_integrity(self.model.robot, whole, self.exclude)
        return [*spoilt, *log_warnings(self.model.robot, [*self.pieces, *found])]

    def regression(self, at: Model) -> Regression:
        """Return the regression, with signals at a model's values."""
        if self.streams:
            whole, *parts = build_stream_regression(
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
            self.preparation = whole.settings["preparation"]
            self._parts = parts[0], parts[1]
            self.left_out = whole.settings["left_out"]
            return whole
        logs = [log for log in self.logs if isinstance(log, Log)]
        if logs and not self.pieces:
            raise refuse_short(logs, MIN_SEGMENT_SAMPLES / min(log.rate_hz for log in logs))
        built = build_regression(
            self.model,
            self.pieces,
            preparation=self.preparation,
            exclude=self.exclude,
            at=at,
            campaigns=self.campaigns,
        )
        self.left_out += built.settings["left_out"]
        self.pieces = [self.pieces[k] for k in built.settings["kept"]]
        return scale_outputs(built, self.factors) if self.factors else built

    def parts(self, regression: Regression) -> tuple[Regression, Regression, bool]:
        """Return the first and the last part of the regression built last, and whether their rows are there to look at."""
        if self._parts is not None:
            return *self._parts, False
        return *_split(regression), True


def _split(regression: Regression) -> tuple[Regression, Regression]:
    """Cut each run in time, leaving a gap as wide as the filters' memory."""
    preparation: Preparation = regression.settings["preparation"]
    first, last = [], []
    for run in regression.runs:
        cut = int(TRAIN_SHARE * len(run.t))
        gap = int(np.ceil(preparation.rate_hz / preparation.force_cutoff_hz - ROUNDING)) if len(run.t) > 1 else 0
        first.append(run.window(slice(0, cut)))
        last.append(run.window(slice(min(cut + gap, len(run.t) - 1), len(run.t))))
    return replace(regression, runs=tuple(first)), replace(regression, runs=tuple(last))
