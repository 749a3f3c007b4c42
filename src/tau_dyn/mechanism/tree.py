"""Dynamics of any tree, all samples at once or one by one, and the choice of dynamics for a robot.

Any tree, with or without loops, through Pinocchio: `tau_a = G' tau_tree` (virtual work; passive joints frictionless).

The regressor is Pinocchio's, projected by `G` and mapped to `robot.parameters`. Pinocchio's `rnea` and `crba` add drive
inertia; its torque regressor does not, so we append those columns. Reference: Khalil & Dombre 2002, ch. 7 and 10.

Forces inside come from the same virtual work: no drive holds the passive joints, so the loops' forces `lambda` do,
`J_p' lambda = tau_p`; with them in place a recursion over the tree gives the load of each joint.
"""

from __future__ import annotations

from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism.batched import BatchedTree, WeightArms, find_velocity_indices, iterate_blocks
from tau_dyn.mechanism.frames import Joint, add_vectors, list_joints, rotate_into_frame
from tau_dyn.mechanism.gantry_tau import GantryTauMechanism
from tau_dyn.mechanism.loops import Constraints, LoopSolver, compute_turning_rates, find_passive_pairs
from tau_dyn.mechanism.mechanism import Mechanism, require_tool_frame
from tau_dyn.mechanism.newton_euler import Weight, list_weights
from tau_dyn.mechanism.small_systems import measure_column_lengths
from tau_dyn.robot import Robot, as_robot


class SamplewiseTree(Mechanism):
    """Dynamics of a tree with loops, one sample after the other."""

    equations = "tree"

    def __init__(self, robot: Robot) -> None:
        """Prepare Pinocchio's model with the robot's parameter values."""
        super().__init__(robot)
        self.model = robot.model_with(robot.parameters)
        self.solver = LoopSolver(robot, self.model)
        self.data = self.solver.data
        self._map = self._parameter_map()
        centres = np.array([inertia.lever for inertia in self.model.inertias])
        self._unplaced = not np.isfinite(centres).all()  # a first moment without mass, which Pinocchio cannot hold
        self._upper = np.triu(np.ones((self.model.nv, self.model.nv))) - 0.5 * np.eye(self.model.nv)  # crba's half
        self._constraints = Constraints(self.model, self.data, robot.loops)
        self._pairs = find_passive_pairs(robot, self.model)
        self._sliding = [k for k, kind in enumerate(robot.joint_kinds) if kind == "prismatic"]
        if robot.loops:
            self._refuse_free_motion()
        self._weights = list_weights(robot, lambda name: robot.parameters[name].value)

    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return `Y` (N, na, p); see `Mechanism.regressor`."""
        q, v, a = self._checked(q, v, a)
        Y = np.zeros((len(q), self.robot.na, len(self.robot.parameters)))
        n_inertial = self._map.shape[1]
        for k in range(len(q)):
            state = self.solver.state(q[k], v[k], a[k])
            tree = pin.computeJointTorqueRegressor(self.model, self.data, state.q, state.v, state.a)
            tree = tree.reshape(self.model.nv, -1)  # eigenpy hands a single row out as a vector
            Y[k, :, :n_inertial] = state.G.T @ tree @ self._map
            for weight in self._weights:
                Y[k, :, weight.column] = state.G.T @ self._hold(state.q, weight)
        joints = range(self.robot.na)
        Y[:, joints, [n_inertial + j for j in joints]] = a
        return Y

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return actuated forces (N, na); see `Mechanism.inverse_dynamics`."""
        q, v, a = self._checked(q, v, a)
        if self._unplaced:
            return super().inverse_dynamics(q, v, a)
        tau = np.empty_like(q)
        for k in range(len(q)):
            state = self.solver.state(q[k], v[k], a[k])
            tau[k] = state.G.T @ (pin.rnea(self.model, self.data, state.q, state.v, state.a) + self._extra(state.q))
        return tau

    def mass_and_bias(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `M` and `h` of one sample; see `Mechanism.mass_and_bias`."""
        if self._unplaced:
            rest = np.zeros((1, self.robot.na))
            return self.inertia(rest + q)[0], self.inverse_dynamics(rest + q, rest + v, rest)[0]
        state = self.solver.state(q, v, np.zeros(self.robot.na))
        upper = self._upper * pin.crba(self.model, self.data, state.q).reshape(self.model.nv, -1)
        half = state.G.T @ upper @ state.G
        h = pin.rnea(self.model, self.data, state.q, state.v, state.g0) + self._extra(state.q)
        return half + half.T, state.G.T @ h

    def tool_position(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's position (N, 3) [m]; see `Mechanism.tool_position`."""
        (q,) = self._checked(q)
        frame, out = require_tool_frame(self.robot), np.empty((len(q), 3))
        for k in range(len(q)):
            pin.framesForwardKinematics(self.model, self.data, self.solver.close(q[k]))
            out[k] = self.data.oMf[frame].translation
        return out

    def tool_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's velocity per actuated speed (N, 3, na); see `Mechanism.tool_jacobian`."""
        (q,) = self._checked(q)
        rest = np.zeros(self.robot.na)
        out = np.empty((len(q), 3, self.robot.na))
        for k in range(len(q)):
            state = self.solver.state(q[k], rest, rest)
            out[k] = self._tool_of_tree(state.q) @ state.G
        return out

    def cart_sensitivity(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's displacement per link's displacement (N, 3, na, 3); see `Mechanism.cart_sensitivity`.

        A shifted link carries all bodies that hang on it; the passive joints close the gaps that this causes in the loops.
        """
        (q,) = self._checked(q)
        passive, n_loops = self.solver.passive_v, len(self.robot.loops)
        out = np.zeros((len(q), 3, self.robot.na, 3))
        tool, ends = self._carried_by()
        for k in range(len(q)):
            full = self.solver.close(q[k])
            jacobian = self._tool_of_tree(full)
            if n_loops:
                closing = -jacobian[:, passive] @ np.linalg.pinv(self._constraints.jacobian(full)[:, passive])
            for i in range(self.robot.na):
                out[k, :, i] = tool[i] * np.eye(3)
                if n_loops:
                    out[k, :, i] += np.einsum("xly,l->xy", closing.reshape(3, n_loops, 3), ends[i])
        return out

    def guide_force(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the force across each prismatic joint's axis (N, na, 3); see `Mechanism.guide_force`."""
        q, v, a = self._checked(q, v, a)
        out = np.zeros((*q.shape, 3))
        for k in range(len(q) if self._sliding else 0):
            state = self.solver.state(q[k], v[k], a[k])
            tau = pin.rnea(self.model, self.data, state.q, state.v, state.a) + self._extra(state.q)
            pin.updateGlobalPlacements(self.model, self.data)
            pulls = self._loop_forces(state.q, tau)
            for i in self._sliding:
                out[k, i] = self._across(i, pulls)
        return out

    def passive_rates(self, q: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        """Return how fast passive bearings turn (N, n, 3, na); see `Mechanism.passive_rates` and `loops.py`."""
        (q,) = self._checked(q)
        rest = np.zeros(self.robot.na)
        out = np.zeros((len(q), len(self._pairs), 3, self.robot.na))
        for k in range(len(q) if self._pairs else 0):
            state = self.solver.state(q[k], rest, rest)
            jacobian = pin.computeJointJacobians(self.model, self.data, state.q)[3:]
            for row, pair in zip(out[k], self._pairs, strict=True):
                if pair.hinge is not None:
                    row[0] = state.G[pair.hinge]
                else:
                    row[:] = (jacobian * pair.weights) @ state.G
        return tuple(pair.name for pair in self._pairs), out

    def redundant_motion(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the motion of redundant drives (N, r, na + 2); see `Mechanism.redundant_motion`."""
        q, v, a = self._checked(q, v, a)
        rows = find_velocity_indices(self.model, self.robot.redundant_joints)
        out = np.zeros((len(q), len(rows), self.robot.na + 2))
        for k in range(len(q)):
            state = self.solver.state(q[k], v[k], a[k])
            out[k] = np.column_stack([state.G[rows], state.v[rows], state.a[rows]])
        return out

    def condition(self, q: np.ndarray) -> np.ndarray:
        """Return the closure's conditioning (N,)."""
        (q,) = self._checked(q)
        return np.array([self.solver.condition(x) for x in q])

    def _tool_of_tree(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's velocity per tree velocity (3, nv) at a tree's configuration (nq,)."""
        frame = require_tool_frame(self.robot)
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        jacobian = pin.computeFrameJacobian(self.model, self.data, q, frame, axes)
        return jacobian.reshape(6, self.model.nv)[:3]  # eigenpy hands a single column out as a vector

    def _carried_by(self) -> tuple[np.ndarray, np.ndarray]:
        """Return whether each actuated link carries the tool (na,), and each loop's end A (1), B (-1) or both (0) (na, loops)."""
        ids = [self.model.getJointId(joint) for joint in self.robot.actuated]

        def carried(frame: int) -> np.ndarray:
            supports = self.model.supports[self.model.frames[frame].parentJoint].tolist()
            return np.array([float(j in supports) for j in ids])

        loops = [carried(loop.frame_a) - carried(loop.frame_b) for loop in self.robot.loops]
        tool = self.robot.tool_frame
        return carried(tool) if tool is not None else np.zeros(len(ids)), np.array(loops).reshape(-1, len(ids)).T

    def _loop_forces(self, q: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return the forces (loops, 3) that hold the passive joints, at a configuration and its tree forces (nv,)."""
        if not self.robot.loops:
            return np.zeros((0, 3))
        passive = self.solver.passive_v
        jacobian = self._constraints.jacobian(q)[:, passive]
        return np.linalg.lstsq(jacobian.T, tau[passive], rcond=1e-10)[0].reshape(-1, 3)

    def _across(self, i: int, pulls: np.ndarray) -> np.ndarray:
        """Return the force (3,) across a slide's axis from beyond its own link, after `rnea`, with loop forces (loops, 3)."""
        model, data, joint = self.model, self.data, self.model.getJointId(self.robot.actuated[i])
        beyond = self._carried_by()[1][i] @ pulls
        for child in (c for c in range(1, model.njoints) if model.parents[c] == joint):
            beyond = beyond - data.oMi[child].rotation @ data.f[child].linear
        for weight in self._weights:
            if weight.joint != joint and joint in model.supports[weight.joint].tolist():
                beyond = beyond + weight.mass * model.gravity.linear
        axis = data.oMi[joint].rotation @ np.asarray(data.joints[joint].S).reshape(6, -1)[:3, 0]
        return beyond - (beyond @ axis) * axis

    def _refuse_free_motion(self) -> None:
        """Refuse a mechanism whose passive joints could move by themselves; a rod's spin, which is not driven, is accepted."""
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
                "unsupported",
                f"{self.robot.source}: loops and actuated joints ({', '.join(self.robot.actuated)}) leave "
                f"{free.shape[1]} motion(s) of the passive joints free; name more actuated joints",
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
        """Return the tree forces of mass that only gravity acts on (nv,)."""
        return sum((weight.mass * self._hold(q, weight) for weight in self._weights), np.zeros(self.model.nv))

    def _hold(self, q: np.ndarray, weight: Weight) -> np.ndarray:
        """Return the tree forces (nv,) that hold 1 kg at a weight's place against gravity."""
        jacobian = pin.computeFrameJacobian(
            self.model, self.data, q, weight.frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        return -jacobian[:3].T @ self.model.gravity.linear


class LoadedTree(BatchedTree):
    """Batched dynamics, and internal loads of a mechanism: forces across guideways, and the rotation of bearings.

    No drive holds the passive joints, so the loops' forces `lambda` do: `J_p' lambda = tau_p`, where `tau_p` are the forces
    that the open tree would need there. The force of all bodies beyond a slide's own link on that link is then the loops'
    forces on its subtree minus the forces that accelerate and carry the bodies beyond it. Moments do not enter it.
    """

    def __init__(self, robot: Robot, solver: LoopSolver, joints: list[Joint], *given: Any) -> None:
        """Prepare for a robot; see `BatchedTree`."""
        super().__init__(robot, solver, joints, *given)
        self._pairs = find_passive_pairs(robot, solver.model)

    def guide_force(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the force across each prismatic joint's axis (N, na, 3); see `Mechanism.guide_force`."""
        out = np.zeros_like(q, shape=(self.robot.na, 3, len(q)), order="C")
        for part in iterate_blocks(len(q)):
            self._fill_guides(out[:, :, part], q[part], v[part], a[part])
        return out.transpose(2, 0, 1)

    def passive_rates(self, q: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        """Return how fast passive bearings turn per actuated speed (N, n, 3, na); see `loops.py`."""
        pairs = self._pairs
        out = np.zeros_like(q, shape=(len(pairs), 3, self.robot.na, len(q)), order="C")
        for part in iterate_blocks(len(q) if pairs else 0):
            closed = self.loops.close(q[part])
            out[:, :, :, part] = compute_turning_rates(pairs, self.joints, closed.at, closed.G)
        return tuple(pair.name for pair in pairs), out.transpose(3, 0, 1, 2)

    def condition(self, q: np.ndarray) -> np.ndarray:
        """Return the closure's conditioning (N,); see `Mechanism.condition`."""
        if not self.robot.loops:
            return np.ones(len(q))
        found = []
        for part in iterate_blocks(len(q)):
            J = self.loops.jacobian(self.loops.close(q[part]).at)
            s = np.linalg.svd(J / measure_column_lengths(J)[:, None, :], compute_uv=False)
            singular = s[:, -1] <= 1e-10 * s[:, 0]
            found.append(np.divide(s[:, 0], s[:, -1], out=np.full(len(s), np.inf), where=~singular))
        return np.concatenate(found)

    def _fill_guides(self, out: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
        closed, tree = self.open_tree(q, v, a)
        pulls = closed.inverse.solve_transposed(tree.tau[self.loops.passive]) if self.robot.loops else None
        for i, (name, kind) in enumerate(zip(self.robot.actuated, self.robot.joint_kinds, strict=True)):
            if kind != "prismatic":
                continue
            own = self.solver.model.getJointId(name)
            back, carried = closed.at.rotation[own].transpose(1, 0, 2), tree.beyond[own]
            beyond = None if carried is None else rotate_into_frame(back, carried)
            beyond = add_vectors(beyond, None if pulls is None else self.loops.carried_force(pulls, own))
            if beyond is not None:
                axis = closed.at.axis[own]
                out[i] = beyond - (beyond * axis).sum(axis=0) * axis


MAX_ONE_BY_ONE = 12
"""Samples up to which one by one is quicker."""


def _by_number(name: str) -> Any:
    """Return a method that takes few samples one by one through Pinocchio, and many all at once."""
    one = getattr(SamplewiseTree, name)

    @wraps(one)
    def method(self: TreeMechanism, q: np.ndarray, *rest: np.ndarray) -> Any:
        if self.batched is None or np.ndim(q) != 2 or len(q) <= MAX_ONE_BY_ONE:
            return one(self, q, *rest)
        return getattr(self.batched, name)(*self._checked(q, *rest))

    return method


_inverse_dynamics, _inertia = _by_number("inverse_dynamics"), _by_number("inertia")


class TreeMechanism(SamplewiseTree):
    """Dynamics of a tree with loops.

    A controller and a simulator need one sample at a time, for which Pinocchio is 50 times as fast as arrays; for two thousand
    samples arrays are three to six times as fast. Trees with joints of more than one degree of freedom are computed one by one.
    Both give the same numbers.
    """

    regressor = _by_number("regressor")
    guide_force = _by_number("guide_force")
    passive_rates = _by_number("passive_rates")
    tool_position = _by_number("tool_position")
    tool_jacobian = _by_number("tool_jacobian")
    condition = _by_number("condition")
    redundant_motion = _by_number("redundant_motion")

    def __init__(self, robot: Robot) -> None:
        """Prepare for the robot's parameter values."""
        super().__init__(robot)
        joints = list_joints(self.model)
        self.batched = None if joints is None else LoadedTree(robot, self.solver, joints)
        free = not (robot.loops or self._weights or self._unplaced)
        self._plain = free and self.model.nq == self.model.nv and hasattr(pin, "rneaInParallel")

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return actuated forces (N, na); Pinocchio takes many samples of a tree without loops in one call."""
        if not self._plain or np.ndim(q) != 2 or len(q) <= MAX_ONE_BY_ONE:
            return _inverse_dynamics(self, q, v, a)
        share, offset = self.robot.coupling
        x, *rates = (np.asfortranarray(share @ one.T) for one in self._checked(q, v, a))
        tree = pin.rneaInParallel(1, pin.ModelPool(self.model, 1), x + offset[:, None], *rates)
        return np.ascontiguousarray((share.T @ tree.reshape(x.shape)).T)

    def weight_arms(self, q: np.ndarray) -> WeightArms:
        """Return the factors of gravity at actuated positions (N, na): forces at rest, body by body.

        Raises:
            InputError: The robot has a joint of several freedoms.
            LoopClosureError: The robot cannot reach a position.
        """
        if self.batched is None:
            raise InputError("unsupported", f"{self.robot.source}: a joint has several freedoms")
        return self.batched.weight_arms(*self._checked(q))

    def inertia(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrix (N, na, na); of a tree without loops by Pinocchio's composite bodies, sample by sample."""
        if not self._plain or np.ndim(q) != 2:
            return _inertia(self, q)
        share, offset = self.robot.coupling
        rows = self._checked(q)[0] @ share.T + offset
        tree = np.empty((len(rows), self.model.nv, self.model.nv))
        for k, row in enumerate(rows):
            tree[k] = pin.crba(self.model, self.data, row)
        half = share.T @ (self._upper * tree) @ share
        return half + half.swapaxes(1, 2)


def build_mechanism(robot: Robot | str | Path) -> Mechanism:
    """Return the fastest exact dynamics for a robot: the closed form if its file declares a valid one, else Pinocchio.

    It is valid if rods are slender, start at the carts' origins and follow their masses; one sample near home is checked.
    Dynamics keep the last closure, so every call makes its own; the kinematics are cached for the robot (`build_kinematics`).

    Example:
        >>> mechanism = td.build_mechanism(td.load_robot("linear_axis"))
        >>> mechanism.inverse_dynamics(np.array([[0.0]]), np.array([[0.0]]), np.array([[1.0]]))
        array([[95.]])
    """
    robot = as_robot(robot)
    mechanism: Mechanism = TreeMechanism(robot)
    if GantryTauMechanism.describes(robot) and not robot.redundant_joints:
        closed = GantryTauMechanism(robot)
        sample = robot.home[None] + 0.01, np.array([[0.3, -0.2, 0.1]]), np.array([[1.0, -1.0, 0.5]])
        Y = mechanism.regressor(*sample)
        same_forces = np.abs(closed.regressor(*sample) - Y).max() < 1e-7 * np.abs(Y).max()
        same_tool = np.abs(closed.tool_position(sample[0]) - mechanism.tool_position(sample[0])).max() < 1e-9
        mechanism = closed if same_forces and same_tool else mechanism
    return mechanism
