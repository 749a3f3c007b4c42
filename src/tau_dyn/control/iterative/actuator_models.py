"""Fitted controlled actuators of all axes: the result of `tau-dyn actuators`, and the file that `learn` and `lead-through` read.

Each axis is `time_constant y' + y = gain r(t - delay)`, (6.11) of the thesis, from logs of references and positions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_yaml, write_whole
from tau_dyn.log import Log
from tau_dyn.message_codes import CodedWarning
from tau_dyn.modes import Actuator, ActuatorFit, Record, build_records, fit_actuators
from tau_dyn.results import Z95, Shown

_FORMAT = 1  # version of the file's layout
_VALUES = ("gain", "time_constant", "delay")
_POOR_PERCENT = 80.0  # fit below which a first-order system with a delay is no model of an axis


@dataclass(frozen=True, eq=False)
class ActuatorModels(Shown):
    """One fitted actuator an axis.

    Attributes:
        inputs: Reference columns.
        outputs: Position columns.
        fits: Fit of each axis.
        records: Data of the fits.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    fits: tuple[ActuatorFit, ...]
    records: tuple[Record, ...]

    @property
    def dt(self) -> float:
        """Sampling step [s]."""
        return self.records[0].dt

    @property
    def warnings(self) -> tuple[str, ...]:
        """Axes that no first-order system with a delay describes."""
        return _list_poor_fits(self.outputs, [fit.fit_percent for fit in self.fits])

    def to_rows(self) -> list[dict[str, Any]]:
        """Return one row an axis: the parameters with standard errors, and (6.11) as `a`, `b`, `d`."""
        rows = []
        for u, y, fit in zip(self.inputs, self.outputs, self.fits, strict=True):
            b, a, d = fit.actuator.discrete(self.dt)
            rows.append({
                "input": u, "output": y, "gain": fit.actuator.gain, "gain_stderr": fit.stderr.gain,
                "time_constant_s": fit.actuator.time_constant, "time_constant_stderr_s": fit.stderr.time_constant,
                "delay_s": fit.actuator.delay, "delay_stderr_s": fit.stderr.delay,
                "bandwidth_hz": fit.actuator.bandwidth_hz, "bandwidth_stderr_hz": fit.bandwidth_stderr_hz,
                "fit_percent": fit.fit_percent, "discrete": {"a": a, "b": b.tolist(), "d": d},
            })  # fmt: skip
        return rows

    def save(self, path: Path) -> None:
        """Write the actuators' file atomically."""
        axes = []
        for y, f in zip(self.outputs, self.fits, strict=True):
            values = {name: getattr(f.actuator, name) for name in _VALUES}
            stderr = {f"{name}_stderr": getattr(f.stderr, name) for name in _VALUES}
            axes.append({"axis": _strip(y), **values, **stderr, "fit_percent": float(f.fit_percent)})
        write_whole(path, yaml.safe_dump({"tau_dyn_actuators": _FORMAT, "axes": axes}, sort_keys=False))


def fit_actuator_models(
    logs: Sequence[Log],
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    progress: Callable[[str], None] = lambda step: None,
) -> ActuatorModels:
    """Return the actuators of logs' axes.

    Args:
        logs: Steps or multisines of the references.
        inputs: Reference columns; by default every `q_ref_J` that has a `q_J`.
        outputs: Position columns, in the order of the inputs.
        progress: Called with the progress.

    Raises:
        InputError: A column is missing, or no reference is found.
        CannotAnswer: See `fit_actuators`.
    """
    if not inputs and not outputs:
        axes = [n.removeprefix("q_ref_") for n in logs[0].channels if n.startswith("q_ref_")]
        axes = [axis for axis in axes if f"q_{axis}" in logs[0].channels]
        inputs, outputs = [f"q_ref_{axis}" for axis in axes], [f"q_{axis}" for axis in axes]
    if not inputs or len(inputs) != len(outputs):
        raise InputError(
            "missing_column",
            f"{logs[0].name}: every axis needs its reference and its position, as columns q_ref_J and q_J or named by --inputs "
            "and --outputs in one order",
        )
    records = [r for log in logs for r in build_records(log, inputs, outputs)]
    return ActuatorModels(tuple(inputs), tuple(outputs), fit_actuators(records, progress), tuple(records))


@dataclass(frozen=True)
class SavedActuators:
    """The actuators of a file.

    Attributes:
        axes: Their names.
        actuators: Their values.
        stderr: Standard errors of these values; zero where the file has none.
        fit_percent: Their fits; 100 where the file has none.
    """

    axes: tuple[str, ...]
    actuators: tuple[Actuator, ...]
    stderr: tuple[Actuator, ...]
    fit_percent: tuple[float, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Axes that no first-order system with a delay describes."""
        return _list_poor_fits(self.axes, self.fit_percent)

    @property
    def slowest(self) -> Actuator:
        """The longest time constant and delay of all axes, at the upper ends of their 95 % intervals.

        A time constant far below a sample, next to a delay, has no standard error (inf); its value counts.
        """
        known = [
            Actuator(*(x if np.isfinite(x) else 0.0 for x in (e.gain, e.time_constant, e.delay))) for e in self.stderr
        ]
        pairs = list(zip(self.actuators, known, strict=True))
        return Actuator(1.0, *(max(getattr(a, n) + Z95 * getattr(e, n) for a, e in pairs) for n in _VALUES[1:]))


def read_actuators(path: str | Path, axes: Sequence[str] = ()) -> tuple[Actuator, ...]:
    """Return the actuators of a file; see `read_saved_actuators`."""
    return read_saved_actuators(path, axes).actuators


def read_saved_actuators(path: str | Path, axes: Sequence[str] = ()) -> SavedActuators:
    """Return the actuators of a file that `ActuatorModels.save` wrote, in the order of axes, or all of them.

    Raises:
        InputError: The file is missing or no file of actuators, an axis is missing, or a value is out of range.
    """
    content = read_yaml(path)
    if not isinstance(content, dict) or content.get("tau_dyn_actuators") != _FORMAT:
        raise InputError(
            "file_format",
            f"{path}: no actuators' file (its first key is 'tau_dyn_actuators: {_FORMAT}'), as `tau-dyn actuators --out` writes",
        )
    found = {}
    for row in content.get("axes") or []:
        try:
            values = [float(row[name]) for name in _VALUES]
            errors = [float(row.get(f"{name}_stderr", 0.0)) for name in _VALUES]
            fit = float(row.get("fit_percent", 100.0))
        except (KeyError, TypeError, ValueError):
            raise InputError("file_format", f"{path}: an axis needs axis, gain, time_constant and delay") from None
        if not (
            np.isfinite([*values, fit]).all() and values[1] > 0 and values[2] >= 0 and np.all(np.array(errors) >= 0)
        ):
            raise InputError(
                "invalid_value",
                f"{path}: axis {row.get('axis')}: a time constant is above zero, a delay or a standard error not below",
            )
        found[str(row.get("axis"))] = Actuator(*values), Actuator(*errors), fit
    missing = next((axis for axis in axes if axis not in found), None)
    if missing is not None:
        raise InputError("mismatch", f"{path}: there is no axis {missing}; there are {', '.join(found)}")
    if not found:
        raise InputError("file_format", f"{path}: it has no axis")
    names = tuple(axes or found)
    return SavedActuators(names, *zip(*(found[name] for name in names), strict=True))


def _list_poor_fits(axes: Sequence[str], fit_percent: Sequence[float]) -> tuple[str, ...]:
    """Return a warning for each axis whose fit is poor."""
    return tuple(
        CodedWarning(
            "poor_fit",
            f"{name}: the fit explains {fit:.3g} % of the position; it is no first-order system with a delay",
            (_strip(name),),
        )
        for name, fit in zip(axes, fit_percent, strict=True)
        if fit < _POOR_PERCENT
    )


def _strip(column: str) -> str:
    return column.removeprefix("q_")
