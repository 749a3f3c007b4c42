"""Robots that move freely in MuJoCo, from an exported file and its callback."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.mechanism import LoopSolver
from tau_dyn.robot import load_robot

FREE = {
    "l1": lambda: load_robot("gantry_tau", gravity_mass=22.38),
    "d1": lambda: load_robot("gantry_tau", arms="complete", prototype="d1"),
    "f1": lambda: load_robot("gantry_tau_f1"),
    "delta": lambda: load_robot("delta"),
    "stewart": lambda: load_robot("stewart"),
    "ur5": lambda: load_robot("ur5"),
}
SPEEDS = {"stewart": 0.02}
"""Speed at the start [m/s or rad/s] where 0.2 would leave the workspace."""


def move_in_mujoco(
    robot, text: str, v0: np.ndarray, force: np.ndarray, seconds: float, callback: str = ""
) -> np.ndarray:
    """Return actuated positions (n, na), one a millisecond, that `mj_step` makes of a file from home under constant forces."""
    mujoco = pytest.importorskip("mujoco")
    theirs = mujoco.MjModel.from_xml_string(text)
    if callback:
        effects: dict = {}
        exec(callback, effects)
        effects["install"](theirs)
    try:
        return _step_mujoco(mujoco, theirs, robot, v0, force, seconds)
    finally:
        mujoco.set_mjcb_passive(None)


def _step_mujoco(mujoco, theirs, robot, v0: np.ndarray, force: np.ndarray, seconds: float) -> np.ndarray:
    data = mujoco.MjData(theirs)
    mujoco.mj_resetDataKeyframe(theirs, data, 0)
    names = list(robot.model.names)[1:]
    data.qvel[[theirs.joint(n).dofadr[0] for n in names]] = LoopSolver(robot).state(robot.home, v0, 0 * v0).v
    theirs.actuator_ctrllimited[:] = False
    data.ctrl[:] = force
    drives = [theirs.joint(n).qposadr[0] for n in robot.actuated]
    found = [data.qpos[drives].copy()]
    for _ in range(round(seconds / theirs.opt.timestep)):
        mujoco.mj_step(theirs, data)
        found.append(data.qpos[drives].copy())
    return np.array(found)[:: round(1e-3 / theirs.opt.timestep)]
