r"""A robot whose springs may yield: linearised about a pose in actuated and spring coordinates.

With `z = [q_a; s]`, the actuated positions and the springs' deflections, the mechanism is an ordinary rigid one whose loops
close as ever, and virtual work gives

    M(z) z'' + h(z, z') + [0; k s + d s'] = [tau; 0] + J_f' f.

At rest with the actuators held, the springs sag until `h_s + k s = 0`. About that point `M` is the mechanism's mass matrix,
`D` the dampers, and `K` the springs plus the change of the weight's share, `dh/dz`, by central differences. `linearised.py`
says what follows from the three.

Springs are `<tau_dyn:spring>` elements on passive joints of any robot file; for every other purpose the robot is rigid.
Reference: Khalil & Dombre 2002, ch. 7; Wittbrodt, Adamiec-Wojcik & Wojciech 2006, Dynamics of Flexible Multibody Systems
(rigid finite elements), ch. 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism.linearised import Linearised
from tau_dyn.mechanism.tree import TreeMechanism
from tau_dyn.robot import Robot, load_robot_from_urdf

_STEP = 1e-5  # [m or rad] of the central differences
_WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


@dataclass(frozen=True, eq=False)
class _Rest:
    """Where the robot rests: all coordinates (n,) and the tree's configuration (nq,)."""

    z: np.ndarray
    tree: np.ndarray


class FlexibleModel:
    """A robot file's springs set free.

    Attributes:
        robot: The rigid robot, springs locked.
        freed: The same robot with its springs as coordinates beside the actuated joints.
        mechanism: Rigid-body dynamics in all those coordinates.
    """

    def __init__(self, robot: Robot) -> None:
        """Free the springs of a robot.

        Raises:
            InputError: The robot has no springs, or its parameters are not those of its file any more.
        """
        if not robot.springs:
            raise InputError(
                "unsupported",
                f"{robot.source} has no <tau_dyn:spring>; name the joints that yield in the file, or, for gantry_tau, "
                "load it with arms=complete flexible=true",
            )
        as_filed = load_robot_from_urdf(robot.urdf, robot.source, actuated=robot.actuated).parameters
        if as_filed.names != robot.parameters.names or np.any(as_filed.values != robot.parameters.values):
            raise InputError(
                "unsupported",
                f"{robot.source}: a flexible model takes its masses from the robot file; change them there",
            )
        joints = [*robot.actuated, *(s.joint for s in robot.springs)]
        self.robot = robot
        self.freed = load_robot_from_urdf(robot.urdf, robot.source, actuated=joints, lock_springs=False)
        self.mechanism = TreeMechanism(self.freed)
        self._order = [self.freed.actuated.index(j) for j in joints]  # ours -> the tree's
        self._stiffness = np.array([0.0] * robot.na + [s.stiffness for s in robot.springs])
        self._damping = np.array([0.0] * robot.na + [s.damping for s in robot.springs])

    def at(
        self,
        q: Sequence[float] | np.ndarray | None = None,
        *,
        tool: str = "tool",
        pushed: str | None = None,
        sag: bool = True,
    ) -> Linearised:
        """Linearise about a pose.

        Args:
            q: Actuated positions (na,) [m or rad]; by default the robot's home.
            tool: Frame or link whose position is the output.
            pushed: Frame or link whose origin the outside force acts on; by default the tool's.
            sag: Let the springs give way to the weight; otherwise they are preloaded to carry it at no deflection.

        Raises:
            InputError: The pose is out of reach, the springs cannot carry the weight, or a spring moves no mass.
            UnknownName: There is no such frame.
        """
        rest = self._rest(self._checked(q), sag)
        na = self.robot.na
        M = self._mass(rest.z)
        K = self._weight_stiffness(rest.z) + np.diag(self._stiffness)
        self._refuse(M[na:, na:], K[na:, na:])
        return Linearised(
            robot=self.robot,
            springs=tuple(s.joint for s in self.robot.springs),
            q=rest.z[:na],
            deflection=rest.z[na:],
            M=M,
            D=np.diag(self._damping),
            K=K,
            tool=self._jacobian(rest, tool),
            pushed=self._jacobian(rest, pushed or tool),
            tool_position=self._position(rest, tool),
        )

    def _checked(self, q: Sequence[float] | np.ndarray | None) -> np.ndarray:
        q = self.robot.home if q is None else np.asarray(q, float)
        if q.shape != (self.robot.na,) or not np.isfinite(q).all():
            joints = ", ".join(self.robot.actuated)
            raise InputError("wrong_shape", f"a pose has one finite position for each of {joints}, not {q}")
        return q

    def _rest(self, q: np.ndarray, sag: bool) -> _Rest:
        """Return where the robot rests with its actuators at `q`: Newton with the springs' own stiffness as slope."""
        na = self.robot.na
        z = np.concatenate([q, np.zeros(len(self.robot.springs))])
        k = self._stiffness[na:]
        for _ in range(100 if sag else 0):
            slack = (self._bias(z)[na:] + k * z[na:]) / k
            if not np.abs(slack).max() < 0.2:  # [m or rad] also stops what runs away
                break
            z[na:] -= slack
            if np.abs(slack).max() < 1e-11:
                return _Rest(z, self._tree(z))
        if sag:
            worst = self.robot.springs[int(np.argmax(np.abs(self._bias(z)[na:] / k + z[na:])))].joint
            raise InputError(
                "robot_structure",
                f"{self.robot.source}: spring '{worst}' is too soft to carry the robot's weight at this pose",
            )
        return _Rest(z, self._tree(z))

    def _tree(self, z: np.ndarray) -> np.ndarray:
        return self.mechanism.solver.close(self._theirs(z))

    def _theirs(self, z: np.ndarray) -> np.ndarray:
        out = np.empty(len(z))
        out[self._order] = z
        return out

    def _mass(self, z: np.ndarray) -> np.ndarray:
        M, _ = self.mechanism.mass_and_bias(self._theirs(z), np.zeros(len(z)))
        return M[np.ix_(self._order, self._order)]

    def _bias(self, z: np.ndarray) -> np.ndarray:
        """Return the forces that hold the robot without springs (n,)."""
        _, h = self.mechanism.mass_and_bias(self._theirs(z), np.zeros(len(z)))
        return h[self._order]

    def _weight_stiffness(self, z: np.ndarray) -> np.ndarray:
        """Return `dh/dz` (n, n), symmetric because weight has a potential."""
        steps = _STEP * np.eye(len(z))
        slope = np.column_stack([(self._bias(z + e) - self._bias(z - e)) / (2 * _STEP) for e in steps])
        return (slope + slope.T) / 2

    def _frame(self, name: str) -> int:
        model = self.mechanism.model
        if not model.existFrame(name):
            raise UnknownName("frame", name, [f.name for f in model.frames[1:]], self.robot.source)
        return model.getFrameId(name)

    def _jacobian(self, rest: _Rest, name: str) -> np.ndarray:
        """Return a frame's velocity per coordinate's (3, n), in base axes."""
        frame, mechanism = self._frame(name), self.mechanism
        nothing = np.zeros(len(rest.z))
        G = mechanism.solver.state(self._theirs(rest.z), nothing, nothing).G
        tree = pin.computeFrameJacobian(mechanism.model, mechanism.data, rest.tree, frame, _WORLD)
        return (tree.reshape(6, -1)[:3] @ G)[:, self._order]

    def _position(self, rest: _Rest, name: str) -> np.ndarray:
        pin.framesForwardKinematics(self.mechanism.model, self.mechanism.data, rest.tree)
        return self.mechanism.data.oMf[self._frame(name)].translation.copy()

    def _refuse(self, M: np.ndarray, K: np.ndarray) -> None:
        """Refuse springs without mass behind them, whose motion is undefined, and weight that springs cannot hold."""
        names = [s.joint for s in self.robot.springs]
        scale = 1 / np.sqrt(np.abs(np.diag(K)))
        values, vectors = np.linalg.eigh(scale[:, None] * M * scale)
        if values[0] < 1e-10 * values[-1]:  # a mode 1e5 times faster than the slowest
            culprit = names[int(np.argmax(np.abs(vectors[:, 0])))]
            raise InputError(
                "robot_structure",
                f"{self.robot.source}: spring '{culprit}' moves no mass of its own; give the link behind it mass and inertia",
            )
        if np.linalg.eigvalsh(scale[:, None] * K * scale)[0] <= 0:
            raise InputError(
                "robot_structure",
                f"{self.robot.source}: the robot tips over at this pose; its springs are too soft for its weight",
            )
