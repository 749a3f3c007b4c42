"""An exported MJCF with its callback, moved, asked for forces and driven by our controllers in MuJoCo."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np

from tau_dyn.exchange import Exported, build_mjcf
from tau_dyn.mechanism import LoopSolver, TreeMechanism
from tau_dyn.model import Model
from tau_dyn.robot import Robot


@contextmanager
def open_in_mujoco(made: Exported, *, callback: bool = True) -> Iterator[Any]:
    """Yield MuJoCo's model of a file, its callback installed while it is open."""
    theirs = mujoco.MjModel.from_xml_string(made.text)
    if callback and made.callback:
        effects: dict[str, Any] = {}
        exec(made.callback, effects)
        effects["install"](theirs)
    try:
        yield theirs
    finally:
        mujoco.set_mjcb_passive(None)


def start_in_mujoco(theirs: Any, robot: Robot, q: np.ndarray, v: np.ndarray) -> Any:
    """Return MuJoCo's data at actuated positions and speeds (na,), loops closed, drives without limits."""
    data = mujoco.MjData(theirs)
    state = LoopSolver(robot).state(q, v, 0 * v)
    for joint, speed in zip(list(robot.model.names)[1:], state.v, strict=True):
        item = robot.model.joints[robot.model.getJointId(joint)]
        place = state.q[item.idx_q : item.idx_q + item.nq]
        found = theirs.joint(joint)
        data.qpos[found.qposadr[0]] = np.arctan2(place[1], place[0]) if item.nq == 2 else place[0]
        data.qvel[found.dofadr[0]] = speed
    theirs.actuator_ctrllimited[:] = False
    return data


def move_in_mujoco(robot: Robot, theirs: Any, v0: np.ndarray, force: np.ndarray, seconds: float) -> np.ndarray:
    """Return actuated positions (n, na), one a millisecond, that `mj_step` makes from home under constant forces."""
    data = start_in_mujoco(theirs, robot, robot.home, v0)
    data.ctrl[:] = force
    drives = [theirs.joint(n).qposadr[0] for n in robot.actuated]
    found = [data.qpos[drives].copy()]
    for _ in range(round(seconds / theirs.opt.timestep)):
        mujoco.mj_step(theirs, data)
        found.append(data.qpos[drives].copy())
    return np.array(found)[:: round(1e-3 / theirs.opt.timestep)]


def compute_mujoco_forces(model: Model, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the rigid forces (N, na) of `mj_inverse` over the file's tree, projected through our loops."""
    robot, tree = model.robot, TreeMechanism(model.robot)
    with open_in_mujoco(build_mjcf(model), callback=False) as theirs:
        theirs.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        theirs.dof_damping[:] = 0
        theirs.dof_dampingpoly[:] = 0
        light = (theirs.body_mass < 1e-6) & (theirs.body_gravcomp == 0)
        theirs.body_mass[light], theirs.body_inertia[light] = 0.0, 0.0
        mujoco.mj_setConst(theirs, mujoco.MjData(theirs))
        order = [theirs.joint(n).dofadr[0] for n in list(robot.model.names)[1:]]
        found = np.empty_like(q)
        for k, (place, speed, change) in enumerate(zip(q, v, a, strict=True)):
            state = tree.solver.state(place, speed, change)
            data = start_in_mujoco(theirs, robot, place, speed)
            data.qacc[order] = state.a
            mujoco.mj_inverse(theirs, data)
            found[k] = state.G.T @ data.qfrc_inverse[order]
    return found


class MujocoPlant:
    """The exported file as a plant for `tau_dyn.simulate.replay`: our leapfrog is MuJoCo's step, speeds at half steps."""

    def __init__(self, theirs: Any, model: Model, q: np.ndarray, v: np.ndarray, dt: float) -> None:
        """Start at positions and speeds (na,) with MuJoCo's own step, which `dt` [s] must be."""
        robot = model.robot
        if not np.isclose(dt, theirs.opt.timestep):
            raise ValueError(
                f"MuJoCo steps by {theirs.opt.timestep:g} s, not by {dt:g} s; choose the replay's substeps so"
            )
        self.theirs, self.data, self.dt = theirs, start_in_mujoco(theirs, robot, q, v), dt
        self.places = [theirs.joint(n).qposadr[0] for n in robot.actuated]
        self.dofs = [theirs.joint(n).dofadr[0] for n in robot.actuated]
        self.started = False

    @property
    def q(self) -> np.ndarray:
        """Positions (na,) at the current sample."""
        return self.data.qpos[self.places].copy()

    def step(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Apply forces (na,), and return speed, acceleration and who stands still."""
        self.data.ctrl[:] = tau
        if not self.started:  # the first speed is one at the sample: go back by half of a step
            self.started = True
            mujoco.mj_forward(self.theirs, self.data)
            self.data.qvel[:] -= 0.5 * self.dt * self.data.qacc
        before = self.data.qvel[self.dofs].copy()
        mujoco.mj_step(self.theirs, self.data)
        after = self.data.qvel[self.dofs].copy()
        return (before + after) / 2, (after - before) / self.dt, np.abs(after) < 1e-9
