"""Any tree, with or without loops, through Pinocchio: `tau_a = G' tau_tree` (virtual work; passive joints frictionless).

The regressor is Pinocchio's, projected by `G` and mapped to `robot.parameters`. Pinocchio's `rnea` and `crba` add drive
inertia; its torque regressor does not, so we append those columns. Reference: Khalil & Dombre 2002, ch. 7 and 10.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from tau_dyn.dynamics.mechanism import Mechanism
from tau_dyn.exceptions import InputError
from tau_dyn.kinematics import LoopSolver
from tau_dyn.robot import Robot


class TreeMechanism(Mechanism):
    """Dynamics of a tree with loops, sample by sample."""

    def __init__(self, robot: Robot) -> None:
        """Prepare Pinocchio's model with the robot's parameter values."""
        super().__init__(robot)
        self.model = robot.model_with(robot.parameters)
        self.solver = LoopSolver(robot, self.model)
        self.data = self.solver.data
        self._map = self._parameter_map()
        self._upper = np.triu(np.ones((self.model.nv, self.model.nv))) - 0.5 * np.eye(self.model.nv)  # crba's half
        if robot.loops:
            self._refuse_free_motion()
        self._gravity_only = [p.name for p in robot.parameters if p.name.endswith(".gravity_mass")]

    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return `Y` (N, na, p); see `Mechanism.regressor`."""
        q, v, a = self._checked(q, v, a)
        names = self.robot.parameters.names
        Y = np.zeros((len(q), self.robot.na, len(names)))
        n_inertial = self._map.shape[1]
        first_armature = n_inertial
        for k in range(len(q)):
            state = self.solver.state(q[k], v[k], a[k])
            tree = pin.computeJointTorqueRegressor(self.model, self.data, state.q, state.v, state.a)
            tree = tree.reshape(self.model.nv, -1)  # eigenpy hands a single row out as a vector
            Y[k, :, :n_inertial] = state.G.T @ tree @ self._map
            for name in self._gravity_only:
                Y[k, :, names.index(name)] = state.G.T @ self._weight(state.q, name.rsplit(".", 1)[0])
        joints = range(self.robot.na)
        Y[:, joints, [first_armature + j for j in joints]] = a
        return Y

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return actuated forces (N, na); see `Mechanism.inverse_dynamics`."""
        q, v, a = self._checked(q, v, a)
        if any(inertia.mass == 0 and np.any(inertia.inertia) for inertia in self.model.inertias):
            return super().inverse_dynamics(q, v, a)  # Pinocchio divides a first moment by the mass
        tau = np.empty_like(q)
        for k in range(len(q)):
            state = self.solver.state(q[k], v[k], a[k])
            tau[k] = state.G.T @ (pin.rnea(self.model, self.data, state.q, state.v, state.a) + self._extra(state.q))
        return tau

    def mass_and_bias(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `M` and `h` of one sample; see `Mechanism.mass_and_bias`."""
        state = self.solver.state(q, v, np.zeros(self.robot.na))
        upper = self._upper * pin.crba(self.model, self.data, state.q).reshape(self.model.nv, -1)
        half = state.G.T @ upper @ state.G
        h = pin.rnea(self.model, self.data, state.q, state.v, state.g0) + self._extra(state.q)
        return half + half.T, state.G.T @ h

    def tool_position(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's position (N, 3) [m]; see `Mechanism.tool_position`."""
        (q,) = self._checked(q)
        frame = self.robot.tool_frame
        if frame is None:
            raise InputError(f"{self.robot.source}: the robot file has no frame named tool")
        out = np.empty((len(q), 3))
        for k in range(len(q)):
            pin.framesForwardKinematics(self.model, self.data, self.solver.close(q[k]))
            out[k] = self.data.oMf[frame].translation
        return out

    def condition(self, q: np.ndarray) -> np.ndarray:
        """Return the closure's conditioning (N,)."""
        (q,) = self._checked(q)
        return np.array([self.solver.condition(x) for x in q])

    def _refuse_free_motion(self) -> None:
        """Refuse a mechanism whose passive joints could move by themselves; a rod's spin, which nothing drives, is fine."""
        free = self.solver.free_motions()
        if not free.size:
            return
        state = self.solver.state(self.robot.home, np.zeros(self.robot.na), np.zeros(self.robot.na))
        upper = self._upper * pin.crba(self.model, self.data, state.q).reshape(self.model.nv, -1)
        M, weight = upper + upper.T, pin.computeGeneralizedGravity(self.model, self.data, state.q)
        driven = np.abs(free.T @ M @ state.G).max() > 1e-6 * np.abs(state.G.T @ M @ state.G).max()
        pulled = np.abs(free.T @ weight).max() > 1e-6 * max(np.abs(weight).max(), 1e-12)
        if driven or pulled:
            raise InputError(
                f"{self.robot.source}: loops and actuated joints ({', '.join(self.robot.actuated)}) leave "
                f"{free.shape[1]} motion(s) of the passive joints free; name more actuated joints"
            )

    def _parameter_map(self) -> np.ndarray:
        """Return the map from inertial parameters to Pinocchio's stacked `pi` (10 * (njoints - 1), n_inertial)."""
        blocks = np.zeros((10 * (self.model.njoints - 1), sum(len(li.own) for li in self.robot.links)))
        column = 0
        for link in self.robot.links:
            row = 10 * (link.joint_id - 1)
            blocks[row : row + 10, column : column + len(link.own)] = link.map
            column += len(link.own)
        return blocks

    def _extra(self, q: np.ndarray) -> np.ndarray:
        """Return the tree forces of mass that only gravity feels (nv,)."""
        tau = np.zeros(self.model.nv)
        for name in self._gravity_only:
            tau += self.robot.parameters[name].value * self._weight(q, name.rsplit(".", 1)[0])
        return tau

    def _weight(self, q: np.ndarray, link: str) -> np.ndarray:
        """Return the tree forces (nv,) that hold 1 kg at a link's origin against gravity."""
        frame = self.model.getFrameId(link)
        jacobian = pin.computeFrameJacobian(self.model, self.data, q, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        return -jacobian[:3].T @ self.model.gravity.linear
