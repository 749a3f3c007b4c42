"""A motor's circuit from its voltage and its current or force: resistance, back-EMF, inductance.

    u = R i + k_e v + L di/dt + u_0

If a log has `voltage_J` and its forces are not computed from it, this is a separate regression in addition to the robot's.
Without `current_J` the force replaces the current, and `R` and `L` are per unit of force. Noise of a sampled current would pull
`R` towards zero, so the identified model's force is the instrument for the current, and its rate for the current's rate. Standard
errors come from the scatter of 2 s blocks, which includes the model error. Behind an ideal gear `k_e` at the joint is the
joint's torque constant [N m/A]: it gives the scale of the forces without a weighed payload. Reference: Hughes & Drury 2013, 3;
Young 1970 (instrumental variables); White 1980.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from tau_dyn.effects import PULSE_WIDTH, VOLTAGE, is_proportional, makes_force
from tau_dyn.estimate import BLOCK_S, Estimate, Regression, RegressionRun, assign_blocks
from tau_dyn.log import Log
from tau_dyn.message_codes import CodedWarning
from tau_dyn.parameters import Parameter, Parameters

CURRENT = "current"
SPEED = "speed"
"""Signal of the speeds through the forces' filter, for the regression of a circuit."""
RECORDED = (VOLTAGE, CURRENT, PULSE_WIDTH)
"""Signals of a motor that a log may hold."""
_MIN_BLOCKS = 20
"""Least number of 2 s blocks: with fewer, the scatter of four numbers is uncertain by more than a fifth."""


def list_voltage_warnings(logs: Sequence[object], joints: Sequence[str]) -> list[str]:
    """Return a warning about quantities that forces computed from voltages or pulse widths do not determine."""
    made = [
        log.name for log in logs if isinstance(log, Log) for x in (VOLTAGE, PULSE_WIDTH) if makes_force(log, joints, x)
    ]
    if not made:
        return []
    sentence = (
        f"the forces of {made[0]} are voltages: viscous friction holds the motors' back-EMF, and masses and friction are "
        "as right as the scale k_t / R of the column map; log the currents as well, and identify gives resistance and back-EMF"
    )
    return [CodedWarning("force_is_voltage", sentence)]


def estimate_motor_electrics(estimate: Estimate) -> Parameters:
    """Return resistance, back-EMF, inductance and offset of each joint whose voltage is logged with current or force.

    Args:
        estimate: The solved regression of the robot; its runs carry the voltages.
    """
    regression = estimate.regression
    runs = [run for run in regression.runs if VOLTAGE in run.signals]
    if regression.everything is not None or not runs:
        return Parameters([])
    found: list[Parameter] = []
    for k, made in enumerate(np.any([is_proportional(run.y_all, run.signals[VOLTAGE]) for run in runs], axis=0)):
        if not made:
            found += _estimate_joint(regression, runs, estimate.theta, k)
    return Parameters(found)


def list_short_voltage_warnings(estimate: Estimate) -> list[str]:
    """Return why resistance, back-EMF and inductance are left out of logs with voltages that are too short for them."""
    runs = [run for run in estimate.regression.runs if VOLTAGE in run.signals]
    if estimate.regression.everything is not None or not runs:
        return []
    blocks = sum(len(np.unique(assign_blocks(run.t - run.t[0])[run.usable.any(axis=1)])) for run in runs)
    made = np.any([is_proportional(run.y_all, run.signals[VOLTAGE]) for run in runs], axis=0)
    joints = [joint for joint, is_voltage in zip(estimate.regression.outputs, made, strict=True) if not is_voltage]
    if blocks >= _MIN_BLOCKS or not joints:
        return []
    return [
        f"resistance, back-EMF and inductance of {', '.join(joints)} are left out: the logs hold {BLOCK_S * blocks:.0f} s "
        f"of motion with voltages, and their errors need {BLOCK_S * _MIN_BLOCKS:.0f} s or more; log voltage and current that long"
    ]


def _estimate_joint(
    regression: Regression, runs: Sequence[RegressionRun], theta: np.ndarray, k: int
) -> list[Parameter]:
    """Return one joint's circuit; an empty list if the logs are too short or do not separate its terms."""
    rows, current = [_build_rows(run, theta, k) for run in runs], CURRENT in runs[0].signals
    X, Z, u = (np.concatenate(parts) for parts in list(zip(*rows, strict=True))[:3])
    blocks = np.concatenate([1000 * n * np.ones(len(row[3])) + row[3] for n, row in enumerate(rows)])
    size = np.linalg.norm(X, axis=0)
    cross = (Z / np.linalg.norm(Z, axis=0)).T @ (X / size)
    names, place = np.unique(blocks, return_inverse=True)
    if len(names) < _MIN_BLOCKS or np.linalg.cond(cross) > 1e6:
        return []
    Z = Z / np.linalg.norm(Z, axis=0)
    beta = np.linalg.solve(Z.T @ X, Z.T @ u)
    score = np.zeros((len(names), 4))
    np.add.at(score, place, Z * (u - X @ beta)[:, None])
    inverse = np.linalg.inv(Z.T @ X)
    cov = inverse @ (score.T @ score) @ inverse.T * len(names) / (len(names) - 4)
    joint, force = regression.outputs[k], regression.units[k]
    speed, force = ("m/s" if force == "N" else "rad/s"), ("N" if force == "N" else "(N m)")
    units = ("ohm" if current else f"V/{force}", f"V/({speed})", "H" if current else f"V s/{force}", "V")
    terms = zip(
        ("resistance", "back_emf", "inductance", "voltage_offset"), beta, np.sqrt(np.diag(cov)), units, strict=True
    )
    return [
        Parameter(f"{joint}.{name}", float(x), unit, stderr=float(sd), origin="voltage") for name, x, sd, unit in terms
    ]


def _build_rows(run: RegressionRun, theta: np.ndarray, k: int) -> tuple[np.ndarray, ...]:
    """Return a run's columns (n, 4), their instruments (n, 4), voltages (n,) and blocks (n,), the filters' ends left out."""
    model, v, one = run.W_all[:, k] @ theta, run.signals[SPEED][:, k], np.ones(len(run.t))
    current = run.signals.get(CURRENT, run.y_all)[:, k]
    # forces through the gate at both ends of a run are complete; between them reversals count as well
    ends = np.flatnonzero(run.usable.any(axis=1))
    part = slice(ends[0], ends[-1] + 1) if ends.size else slice(0, 0)
    X, Z = (np.column_stack([x, v, CubicSpline(run.t, x)(run.t, 1), one]) for x in (current, model))
    return X[part], Z[part], run.signals[VOLTAGE][part, k], assign_blocks(run.t - run.t[0])[part]
