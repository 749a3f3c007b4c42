"""Comparison of a model with logs: measured and predicted forces, and the error of each joint."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tau_dyn.estimate import Regression
from tau_dyn.exceptions import InputError
from tau_dyn.identify.data import Logs, get_log_list, require_forces
from tau_dyn.identify.loop_positions import complete_positions
from tau_dyn.identify.regression import build_regression
from tau_dyn.identify.result import ForceErrors, build_force_errors, list_plotted_segments
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.results import Brief, plot_outputs, to_plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class ModelFit(Brief):
    """Measured and predicted forces of a given model, without a fit.

    Attributes:
        model: The model.
        regression: The filtered data, with the samples that count.
        errors: Errors as `identify` defines them.
    """

    model: Model
    regression: Regression
    errors: ForceErrors

    @property
    def measured(self) -> np.ndarray:
        """Measured forces (N, na) [N or N m], all logs in sequence, filtered as for a fit."""
        return np.concatenate([run.y_all for run in self.regression.runs])

    @property
    def predicted(self) -> np.ndarray:
        """Predicted forces (N, na) at the same samples."""
        theta = self.model.parameters.values
        return np.concatenate([run.W_all @ theta for run in self.regression.runs])

    @property
    def used(self) -> np.ndarray:
        """Samples that count for the errors (N, na)."""
        return np.concatenate([run.usable for run in self.regression.runs])

    @property
    def fit_percent(self) -> dict[str, float]:
        """Fit of each joint, `100 (1 - |measured - predicted| / |measured - mean|)` over the samples that count.

        100 is perfect, and 0 is no better than the mean; nan without a sample that counts.
        """
        found = {}
        for k, joint in enumerate(self.regression.outputs):
            y, fitted = (x[self.used[:, k], k] for x in (self.measured, self.predicted))
            away = np.linalg.norm(y - y.mean()) if y.size else 0.0
            found[joint] = float(100 * (1 - np.linalg.norm(y - fitted) / away)) if away > 0 else float("nan")
        return found

    def plot(self) -> Figure:
        """Return a Matplotlib figure of measured and predicted forces and their difference.

        Raises:
            InputError: Matplotlib is not installed.
        """
        return plot_outputs(
            list_plotted_segments(self.regression, self.model.parameters.values),
            self.regression.outputs,
            self.regression.units,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the errors and fits by joint."""
        return to_plain({**self.errors.to_dict(), "fit_percent": self.fit_percent})

    def __repr__(self) -> str:
        """Return one line a joint."""
        rows = zip(
            self.regression.outputs, self.errors.rms, self.errors.per_joint_percent, self.regression.units, strict=True
        )
        lines = [
            f"  {joint}: fit {self.fit_percent[joint]:.1f} %, error {percent:.3g} %, {rms:.3g} {unit}"
            for joint, rms, percent, unit in rows
        ]
        return "\n".join([f"ModelFit: error {self.errors.relative_error_percent:.3g} %", *lines])


def compare_fit(model: Model | str | Path, logs: Logs, *, exclude: tuple[str, ...] = ()) -> ModelFit:
    """Predict the forces of logs by a model as it is, and compare them with the measured ones.

    Args:
        model: A model, or the path of a model file. None of its parameters is fitted.
        logs: Logs with `q_J` and `tau_J` of every actuated joint: each a log, the path of a file, or a table.
        exclude: Columns whose nonzero samples are left out.

    Raises:
        InputError: The model file or a log is at fault.
        CannotAnswer: The filters and masks leave no sample.

    Example:
        >>> t, w = np.arange(0.0, 10.0, 0.005), np.array([[3.0], [7.0]])
        >>> q, v, a = (np.sum(x, axis=0) for x in (0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t), -0.1 * w**2 * np.sin(w * t)))

        >>> model = td.Model.of(td.load_robot("linear_axis")).with_values({"carriage_link.mass": 90.0})
        >>> fit = td.compare_fit(model, td.Log(t, {"q_axis": q, "tau_axis": 99.0 * a}))
        >>> round(fit.errors.relative_error_percent, 1), round(fit.fit_percent["axis"], 1)
        (9.1, 90.9)
    """
    machine = model if isinstance(model, Model) else Model.load(model)
    given = [log for log in get_log_list(logs) if isinstance(log, Log)]
    if not given:
        raise InputError("missing_input", "no log was given; give a log with q_J and tau_J of every actuated joint")
    complete = complete_positions(machine.robot, given)
    require_forces(machine.robot, complete)
    regression = build_regression(machine, complete, exclude=exclude)
    return ModelFit(machine, regression, build_force_errors(regression, machine.parameters.values))
