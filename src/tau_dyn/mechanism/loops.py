"""The closed loops solved one sample at a time, and the passive bearings in them; all in world axes, all loops at once.

A loop k requires that two points of the tree coincide, `c_k(q) = p_A(q) - p_B(q) = 0`. Pinocchio gives each joint's column of
the tree's Jacobian as the motion `(v_o, w)` seen at the world's origin, so a point moves with `v_o + w x p`. With
`J_c = dc/dv_tree`, split into actuated and passive columns,

    v_tree = G v_a,   G = [1; -J_p^+ J_a] S,   a_tree = G a_a + g_0,   g_0 = [0; -J_p^+ gamma],

where `gamma` is the constraint's acceleration at zero joint acceleration and `S` holds the travel of the joints per reading of
their drives (`Robot.drive_scale`). Closure is by Newton on the passive joints, started
where `G` points from the last configuration; the inverse of `J_p` is kept while it converges well. The first configuration is
reached by continuation from the robot's home, which selects the assembly mode. `loop_arrays.py` closes many samples at once.
Reference: Khalil & Dombre 2002, ch. 7; Featherstone 2008, ch. 8.

A bearing connects two bodies with mass. So passive hinges that follow each other through links without mass are one (a
universal joint), and a cut ball is one. A chain with a passive slide in it only describes the position of a body (a
Gantry-Tau's plate, relative to the base) and is no bearing. Only mechanisms with loops have passive joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import LoopClosureError
from tau_dyn.mechanism.frames import Frames, Joint
from tau_dyn.mechanism.small_systems import invert_matrix, measure_column_lengths
from tau_dyn.robot import Loop, Robot

_CROSS = np.zeros((3, 3, 3))  # (a x b)_i = _CROSS[i, j, k] a_j b_k
_CROSS[[0, 1, 2], [1, 2, 0], [2, 0, 1]], _CROSS[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = 1.0, -1.0
_WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class Constraints:
    """The loops of one tree: the first half of all points are the loops' ends A, the second half their ends B."""

    def __init__(self, model: pin.Model, data: pin.Data, loops: Sequence[Loop]) -> None:
        """Find where the points sit and which joints carry them."""
        self.model, self.data, self._n = model, data, len(loops)
        self._frames = [*(loop.frame_a for loop in loops), *(loop.frame_b for loop in loops)]
        frames = [model.frames[k] for k in self._frames]
        joints, self._at = np.unique([f.parentJoint for f in frames], return_inverse=True)
        self._joints = joints.tolist()  # Pinocchio's vectors take Python's integers only
        self._local = np.array([[*f.placement.translation, 1.0] for f in frames]).reshape(-1, 4, 1)
        self._carries = np.zeros((len(frames), model.nv))
        for row, frame in zip(self._carries, frames, strict=True):
            for joint in model.supports[frame.parentJoint].tolist()[1:]:
                row[model.joints[joint].idx_v :][: model.joints[joint].nv] = 1.0

    def gap(self, q: np.ndarray) -> np.ndarray:
        """Return `p_A - p_B` of all loops (3 * loops,) [m]."""
        pin.forwardKinematics(self.model, self.data, q)
        return self._difference(self._points()).ravel()

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the gap's derivative (3 * loops, nv)."""
        tree = pin.computeJointJacobians(self.model, self.data, q)
        turned = (self._points() @ _CROSS.reshape(9, 3).T).reshape(-1, 3) @ tree[3:]  # w x p
        rows = (turned.reshape(-1, 3, self.model.nv) + tree[:3]) * self._carries[:, None]
        return self._difference(rows).reshape(-1, self.model.nv)

    def acceleration_at_rest(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the gap's acceleration (3 * loops,) [m/s^2] at velocity `v` (nv,) without joint acceleration."""
        model, data, of = self.model, self.data, pin.getFrameClassicalAcceleration
        pin.forwardKinematics(model, data, q, v, np.zeros(model.nv))
        return self._difference(np.array([of(model, data, k, _WORLD).linear for k in self._frames])).ravel()

    def _points(self) -> np.ndarray:
        oMi = self.data.oMi
        places = np.array([oMi[j].homogeneous for j in self._joints])
        return (places[self._at] @ self._local)[:, :3, 0]

    def _difference(self, x: np.ndarray) -> np.ndarray:
        return x[: self._n] - x[self._n :]


_TOLERANCE = 1e-14  # [m] a step is the last one when it should leave no more than this
_ROUNDED = 1e-10  # [m] error by rounding in a large robot
_STEP = 0.05  # [m or rad] largest actuated step taken at once when coming from afar
MAX_CORRECTION = 0.5  # of a step along `G`; near a dead centre the other assembly mode is as far away as the step
_LONG = 0.5  # [m or rad] step of a joint along `G` that is halved
_SHORT = 0.02  # [m or rad] the same for an older `G`, as samples in turn have
_SLIGHT = 0.1  # of such a step, its largest correction
_HALVINGS = 40  # of a step whose correction is larger, before the position counts as out of reach
_UNSOLVED = 8  # halvings for which a step without any closure counts: mostly there is no closure


@dataclass
class TreeState:
    """One configuration of the whole tree.

    Attributes:
        q: Configuration (nq,).
        v: Velocity (nv,).
        a: Acceleration (nv,).
        G: Tree velocity per actuated velocity (nv, na).
        g0: Tree acceleration at zero actuated acceleration (nv,).
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    G: np.ndarray
    g0: np.ndarray


class LoopSolver:
    """Solves the loops of one robot, keeping the last configuration as the next one's start."""

    def __init__(self, robot: Robot, model: pin.Model | None = None) -> None:
        """Prepare for a robot; `model` may carry other masses, its kinematics must be the robot's."""
        self.robot = robot
        self.model = model if model is not None else robot.model
        self.data = self.model.createData()
        self.active_v, self.passive_v = robot.active_v, robot.passive_v
        driven = [self.model.joints[self.model.getJointId(j)] for j in (*robot.actuated, *robot.mimics)]
        self._driven_q, self._driven_v = (np.array([getattr(j, x) for j in driven]) for x in ("idx_q", "idx_v"))
        self._turning = np.array([j.nq == 2 for j in driven])
        self._share, self._offset = robot.coupling
        self._start = self._with_passive_home(pin.neutral(self.model))
        self._constraints = Constraints(self.model, self.data, robot.loops)
        self._inverse, self._G = np.zeros((0, 0)), self._share
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def close(self, q_a: np.ndarray) -> np.ndarray:
        """Return the tree's configuration (nq,) that closes all loops at actuated positions `q_a` (na,).

        Raises:
            LoopClosureError: No closure was found on the way from home; the robot cannot reach these positions.
        """
        q_a = np.asarray(q_a, float)
        if not self.robot.loops:
            return self._with_active(self._start, q_a)
        q = None
        if self._last is not None and np.abs(q_a - self._last[0]).max() <= _STEP:
            q = self._step_to(q_a, *self._last)
        if q is None:
            q = self._from_home(q_a)
        self._last = (q_a.copy(), q)
        return q

    def state(self, q_a: np.ndarray, v_a: np.ndarray, a_a: np.ndarray) -> TreeState:
        """Return the tree's motion at one sample of actuated motion, each (na,)."""
        q = self.close(q_a)
        G, g0 = self._share, np.zeros(self.model.nv)
        if self.robot.loops:
            self._linearise(q)
            G = self._G
            g0[self.passive_v] = -self._inverse @ self._constraints.acceleration_at_rest(q, G @ v_a)
        return TreeState(q, G @ v_a, G @ a_a + g0, G, g0)

    def condition(self, q_a: np.ndarray) -> float:
        """Return the conditioning of the passive constraint Jacobian with unit columns; 1 without loops."""
        if not self.robot.loops:
            return 1.0
        J_p = self._constraints.jacobian(self.close(q_a))[:, self.passive_v]
        s = np.linalg.svd(J_p / measure_column_lengths(J_p), compute_uv=False)
        return float(s[0] / s[-1]) if s[-1] > 1e-10 * s[0] else np.inf

    def free_motions(self) -> np.ndarray:
        """Return the passive motions (nv, k) that loops and actuated joints leave free at home, as unit columns.

        Raises:
            LoopClosureError: The loops do not let the actuated joints move independently of each other.
        """
        jacobian = self._constraints.jacobian(self.close(self.robot.home))
        J_p, J_a = jacobian[:, self.passive_v], jacobian @ self._share
        _, s, vt = np.linalg.svd(J_p) if J_p.size else (None, np.zeros(0), np.eye(len(self.passive_v)))
        rank = int(np.sum(s > 1e-9 * s.max(initial=0.0)))
        stuck = J_a - J_p @ np.linalg.lstsq(J_p, J_a, rcond=1e-9)[0] if J_p.size else J_a
        if np.abs(stuck).max() > 1e-6 * np.abs(J_a).max():
            raise LoopClosureError(
                f"{self.robot.source}: at home the loops do not let {', '.join(self.robot.actuated)} move independently; "
                "choose another home (<tau_dyn:home>), or name fewer --actuated joints"
            )
        free = np.zeros((self.model.nv, len(self.passive_v) - rank))
        free[self.passive_v] = vt[rank:].T
        return free

    def closure_error(self, q: np.ndarray) -> float:
        """Return the largest distance between two points that should coincide [m]."""
        return float(np.abs(self._constraints.gap(q)).max()) if self.robot.loops else 0.0

    def _with_active(self, q: np.ndarray, q_a: np.ndarray) -> np.ndarray:
        q, index = q.copy(), self._driven_q
        x = (self._share @ q_a + self._offset)[self._driven_v]
        q[index] = x
        if self._turning.any():  # a continuous joint's configuration is a cosine and a sine
            index, angle = index[self._turning], x[self._turning]
            q[index], q[index + 1] = np.cos(angle), np.sin(angle)
        return q

    def _with_passive_home(self, q: np.ndarray) -> np.ndarray:
        """Return a configuration (nq,) with the passive joints where the robot file's home has them."""
        for name, value in self.robot.passive_home.items():
            item = self.model.joints[self.model.getJointId(name)]
            if item.nv == 1:  # a continuous joint's configuration is a cosine and a sine
                q[item.idx_q : item.idx_q + item.nq] = value if item.nq == 1 else (np.cos(value), np.sin(value))
        return q

    def _from_home(self, q_a: np.ndarray) -> np.ndarray:
        """Walk from home to `q_a` in small steps, so that the assembly mode is home's."""
        home = self.robot.home
        steps = np.ceil(np.max(np.abs(q_a - home)) / _STEP)
        if not steps <= 2000:
            raise LoopClosureError(
                f"{self.robot.source}: {self._listed(q_a)} is far outside the robot; positions must be in m and rad"
            )
        start = self._with_active(self._start, home)
        self._linearise(start)
        q = self._newton(start)
        if q is None:
            raise LoopClosureError(f"{self.robot.source}: the loops cannot be closed at home {self._listed(home)}")
        at = home
        for share in np.linspace(0, 1, int(steps) + 1)[1:]:
            there = home + share * (q_a - home)
            q = self._step_to(there, at, q)
            if q is None:
                raise LoopClosureError(
                    f"{self.robot.source}: the loops cannot be closed at {self._listed(q_a)}: out of reach"
                )
            at = there
        return q

    def _step_to(self, q_a: np.ndarray, last_a: np.ndarray, last: np.ndarray, halvings: int = 0) -> np.ndarray | None:
        """Return the closure at `q_a`, started where `G` points from the last one; by two halves where that misses by much."""
        for longest, share in ((_SHORT, _SLIGHT), (_LONG, MAX_CORRECTION)):
            if longest == _LONG:
                self._linearise(last)
            guess = self._with_active(pin.integrate(self.model, last, self._G @ (q_a - last_a)), q_a)
            step = np.abs(pin.difference(self.model, last, guess)).max()
            q = self._newton(guess) if step <= longest else None
            if q is not None and np.abs(pin.difference(self.model, guess, q)).max() <= share * step + _ROUNDED:
                return q
        halvings += _UNSOLVED if q is None else 1
        if halvings > _HALVINGS:
            return None
        half = 0.5 * (q_a + last_a)
        middle = self._step_to(half, last_a, last, halvings)
        return None if middle is None else self._step_to(q_a, half, middle, halvings)

    def _newton(self, q: np.ndarray) -> np.ndarray | None:
        step, before, error, fresh = np.zeros(self.model.nv), np.inf, np.inf, False
        for _ in range(30):
            gap = self._constraints.gap(q)
            error = np.abs(gap).max()
            if not np.isfinite(error):
                return None
            rate = min(1.0, error / before) if np.isfinite(before) else 1.0
            if fresh and rate > 0.5 and error < _ROUNDED:
                return q
            if rate > 0.1 and np.isfinite(before):
                self._linearise(q)
                fresh = True
            change = -self._inverse @ gap
            step[self.passive_v] = change * min(1.0, 0.5 / max(np.abs(change).max(initial=0.0), 1e-300))
            q = pin.integrate(self.model, q, step)
            if error * rate < _TOLERANCE:
                return q
            before = error
        return q if error < _ROUNDED else None

    def _linearise(self, q: np.ndarray) -> None:
        """Keep the inverse of `J_p` and `G` at this configuration."""
        jacobian = self._constraints.jacobian(q)
        self._inverse = invert_matrix(jacobian[:, self.passive_v])
        self._G = self._share.copy()
        self._G[self.passive_v] = -self._inverse @ (jacobian @ self._share)

    def _listed(self, q_a: np.ndarray) -> str:
        pairs = zip(self.robot.actuated, q_a, self.robot.position_units, strict=True)
        return ", ".join(f"{j} = {x:.4g} {unit}" for j, x, unit in pairs)


class BearingPair(NamedTuple):
    """One passive bearing.

    Attributes:
        name: Its joints' names, or the cut's.
        weights: How each velocity of the tree turns it (nv,): 1, 0 or -1.
        hinge: Index of its only hinge in the tree's velocity, or None for a bearing with more than one axis.
    """

    name: str
    weights: np.ndarray
    hinge: int | None


def find_passive_pairs(robot: Robot, model: pin.Model) -> tuple[BearingPair, ...]:
    """Return the passive bearings of a robot; empty without loops."""
    if not robot.loops:
        return ()
    pairs = [_of_chain(model, chain) for chain in _chains(robot, model) if _turns(model, chain)]
    for loop in robot.loops:
        a, b = (_carries(model, model.frames[k].parentJoint) for k in (loop.frame_a, loop.frame_b))
        pairs.append(BearingPair(loop.name.replace("_link", ""), a - b, None))
    return tuple(pairs)


def compute_turning_rates(
    pairs: Sequence[BearingPair], joints: Sequence[Joint], at: Frames, G: np.ndarray
) -> np.ndarray:
    """Return angular velocities per actuated speed (n, 3, na, N).

    Args:
        pairs: The bearings.
        joints: The tree.
        at: Where its joints are.
        G: Tree velocity per actuated speed (nv, na, N).
    """
    out = np.zeros_like(G, shape=(len(pairs), 3, *G.shape[1:]))
    turning = [joint for joint in joints if not joint.slides]
    for k, pair in enumerate(pairs):
        if pair.hinge is not None:
            out[k, 0] = G[pair.hinge]
            continue
        for joint in turning:
            if pair.weights[joint.v]:
                out[k] += pair.weights[joint.v] * at.axis[joint.index][:, None] * G[joint.v]
    return out


def _chains(robot: Robot, model: pin.Model) -> list[list[int]]:
    """Return the passive joints, those joined by a link without mass together, base to tip."""
    driven = (*robot.actuated, *robot.redundant_joints)
    passive = [j for j in range(1, model.njoints) if model.names[j] not in driven]
    heavy = {link.joint_id for link in robot.links}
    chains: dict[int, list[int]] = {}
    for joint in passive:
        parent = model.parents[joint]
        follows = parent in chains and parent not in heavy and list(model.parents).count(parent) == 1
        chains[joint] = [*(chains.pop(parent) if follows else []), joint]
    return list(chains.values())


def _turns(model: pin.Model, chain: list[int]) -> bool:
    """Return whether a chain only turns: hinges and balls."""
    kinds = [model.joints[j].shortname() for j in chain]
    return all(kind.startswith(("JointModelR", "JointModelSpherical")) for kind in kinds)


def _of_chain(model: pin.Model, chain: list[int]) -> BearingPair:
    weights = np.zeros(model.nv)
    for j in chain:
        weights[model.joints[j].idx_v :][: model.joints[j].nv] = 1.0
    only = model.joints[chain[0]] if len(chain) == 1 else None
    hinge = only.idx_v if only is not None and only.nv == 1 else None
    return BearingPair("+".join(model.names[j] for j in chain), weights, hinge)


def _carries(model: pin.Model, joint: int) -> np.ndarray:
    """Return 1 for each velocity that moves a joint's link (nv,)."""
    weights = np.zeros(model.nv)
    for j in model.supports[joint].tolist()[1:]:
        weights[model.joints[j].idx_v :][: model.joints[j].nv] = 1.0
    return weights
