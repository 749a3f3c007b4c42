"""The flexible L1 with and without its wrist, near home, and the signals that the thesis derives from its carts."""

from functools import cache

import numpy as np

from tau_dyn.log import Log
from tau_dyn.mechanism import FlexibleModel, Linearised, Mechanism, build_mechanism
from tau_dyn.modes import Record
from tau_dyn.robot import load_robot

CARTS = ("cart1", "cart2", "cart3")
AXES = ("x", "y", "z")


@cache
def with_wrist() -> Linearised:
    """The tool is the metal block on the wrist that the gauges touch; pushes act on the plate."""
    robot = load_robot("gantry_tau", arms="complete", flexible="true", wrist="serial2")
    return FlexibleModel(robot).at(tool="gauge_block_link", pushed="tool")


@cache
def without_wrist() -> Linearised:
    return FlexibleModel(load_robot("gantry_tau", arms="complete", flexible="true")).at()


@cache
def kinematics() -> Mechanism:
    """The rigid robot that a controller knows."""
    return build_mechanism(load_robot("gantry_tau"))


def with_tool_side(log: Log) -> Log:
    """Add the tool's reference z_r (`x_r y_r z_r`) and the tool computed from the carts z_c (`x_c y_c z_c`) [m]."""
    sides = {"r": log.joint("q_ref", CARTS), "c": log.joint("q", CARTS)}
    tools = {side: kinematics().tool_position(q) for side, q in sides.items()}
    return log.with_channels(**{f"{axis}_{side}": p[:, k] for side, p in tools.items() for k, axis in enumerate(AXES)})


def record(log: Log, inputs: list[str], outputs: list[str]) -> Record:
    """Return columns of a log as deviations from their means."""
    u, y = (np.column_stack([log.channels[c] for c in columns]) for columns in (inputs, outputs))
    return Record(u - u.mean(axis=0), y - y.mean(axis=0), round(log.dt, 12), tuple(inputs), tuple(outputs), log.name)


def fit_percent(measured: np.ndarray, simulated: np.ndarray) -> np.ndarray:
    """Return 100 (1 - |y - model| / |y - mean|), one an output."""
    spread = np.linalg.norm(measured - measured.mean(axis=0), axis=0)
    return 100 * (1 - np.linalg.norm(measured - simulated, axis=0) / spread)
