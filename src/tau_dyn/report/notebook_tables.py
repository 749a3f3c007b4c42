"""The table behind each result: one row a thing, SI units, the unit in a column of its own where rows differ in it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import singledispatch
from typing import Any

import numpy as np
import pandas as pd

from tau_dyn.calibrate import Calibration
from tau_dyn.compare import Comparison
from tau_dyn.diagnose import Diagnosis
from tau_dyn.identify import Identification
from tau_dyn.kinematics import PoseTable
from tau_dyn.kinematics.accuracy import AccuracyResult
from tau_dyn.kinematics.workspace import Study, build_points_table
from tau_dyn.log import Log, LogCheck
from tau_dyn.model import Model
from tau_dyn.modes import Z95, Modes, OperationalModes
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot


@singledispatch
def build_result_table(found: Any) -> pd.DataFrame:
    """Return a result's main table."""
    raise TypeError(f"{type(found).__name__} has no table")


@build_result_table.register
def _log(found: Log) -> pd.DataFrame:
    """One row a sample, `t` first."""
    return found.to_frame()


@build_result_table.register
def _parameters(found: Parameters) -> pd.DataFrame:
    """One row a parameter."""
    keys = ("name", "value", "unit", "stderr", "lower", "upper", "free", "origin")
    return pd.DataFrame([{k: getattr(p, k) for k in keys} for p in found], columns=list(keys)).astype({"stderr": float})


@build_result_table.register
def _model(found: Model) -> pd.DataFrame:
    """One row a parameter."""
    return _parameters(found.parameters)


@build_result_table.register
def _robot(found: Robot) -> pd.DataFrame:
    """One row an actuated joint, with its limits."""
    rows = zip(
        found.actuated, found.joint_kinds, found.position_units, found.lower, found.upper, found.velocity_limit,
        found.effort_limit, found.force_units, strict=True,
    )  # fmt: skip
    names = ("joint", "kind", "position_unit", "lower", "upper", "velocity_limit", "effort_limit", "force_unit")
    return pd.DataFrame(list(rows), columns=list(names))


@build_result_table.register
def _identification(found: Identification) -> pd.DataFrame:
    """One row a parameter that was asked for, as in the result: value, standard error, interval, nominal value."""
    return _tidy(found.rows())


@build_result_table.register
def _calibration(found: Calibration) -> pd.DataFrame:
    """One row a dimension of the chosen model."""
    return _tidy(found.parameter_rows())


@build_result_table.register
def _diagnosis(found: Diagnosis) -> pd.DataFrame:
    """One row a finding, strongest first; its gain is on data used for nothing else."""
    rows = []
    for f in found.findings:
        gain = {"gain_percent": np.nan, "gain_low": np.nan, "gain_high": np.nan}
        if f.gain is not None:
            gain = dict(zip(gain, (f.gain.reduction_percent, *f.gain.ci95), strict=True))
        about = {"cause": f.cause, "joints": ", ".join(f.joints), "status": f.status, "score": f.score}
        rows.append({**about, "p_value": f.p_value, **gain, "equation": f.equation, "sentence": f.sentence})
    names = (
        "cause",
        "joints",
        "status",
        "score",
        "p_value",
        "gain_percent",
        "gain_low",
        "gain_high",
        "equation",
        "sentence",
    )
    return pd.DataFrame(rows, columns=list(names))


@build_result_table.register
def _modes(found: Modes | OperationalModes) -> pd.DataFrame:
    """One row a resonance, slowest first."""
    names = ("frequency_hz", "frequency_stderr", "damping_ratio", "damping_stderr")
    frame = pd.DataFrame([[getattr(m, n) for n in names] for m in found.modes], columns=list(names))
    for quantity, value in (("frequency", "frequency_hz"), ("damping", "damping_ratio")):
        for end, sign in (("low", -1), ("high", 1)):
            frame[f"{quantity}_{end}"] = frame[value] + sign * Z95 * frame[f"{quantity}_stderr"]
    return frame


@build_result_table.register
def _check(found: LogCheck) -> pd.DataFrame:
    """One row a thing that was looked at."""
    names = ("severity", "topic", "sentence", "remedy")
    return pd.DataFrame([[getattr(f, n) for n in names] for f in found.findings], columns=list(names))


@build_result_table.register
def _workspace(found: Study) -> pd.DataFrame:
    """One row a judged point: place [m], positions [m or rad], whether it belongs, why not, maps."""
    return build_points_table(found)


@build_result_table.register
def _accuracy(found: AccuracyResult) -> pd.DataFrame:
    """One row a pose: positions [m or rad], place [m], the largest error by each method [m]."""
    a = found.accuracy
    if a is None:
        return pd.DataFrame()
    columns = {f"q_{j}": a.q[:, k] for k, j in enumerate(found.robot.actuated)}
    columns |= {f"{axis}_tool": a.position[:, k] for k, axis in enumerate("xyz")}
    return pd.DataFrame({**columns, **{f"largest_{m}": x for m, x in a.largest.items()}})


@build_result_table.register
def _poses(found: PoseTable) -> pd.DataFrame:
    """One row a pose, as the command writes them."""
    return pd.DataFrame(found.columns())


@build_result_table.register
def _comparison(found: Comparison) -> pd.DataFrame:
    """One row a quantity that both have."""
    return _tidy([c.to_dict() for c in found.changes])


def _tidy(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Return rows of the contract's form as a table: an interval's ends in columns of their own, lists as text."""
    flat = []
    for row in rows:
        new = {k: v for k, v in row.items() if k != "ci95"}
        new = {k: ", ".join(map(str, v)) if isinstance(v, list | tuple) else v for k, v in new.items()}
        low, high = row.get("ci95") or (np.nan, np.nan)
        flat.append({**new, "ci95_low": low, "ci95_high": high})
    frame = pd.DataFrame(flat)
    numbers = [n for n in ("value", "stderr", "nominal", "nominal_stderr", "p_value") if n in frame]
    return frame.astype(dict.fromkeys(numbers, float))
