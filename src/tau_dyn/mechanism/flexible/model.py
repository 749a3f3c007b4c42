"""A robot with springs: linearised about a pose, its natural modes, static compliance and state space.

With `z = [a; s]`, the actuated positions and the springs' deflections, the mechanism is an ordinary rigid one whose loops close
in the same way. A drive's spring yields between the drive, where `a` is measured, and the link: the joint is at `a + s`, and
the drive's inertia moves with `a` alone. Virtual work gives

    M(z) z'' + h(z, z') + [0; k s + d s'] = [tau; 0] + J_f' f.

At rest with the actuators held, the springs sag until `h_s + k s = 0`. About that point `M` is the mechanism's mass matrix,
`D` the dampers, and `K` the springs plus the change of the weight's share, `dh/dz`, by central differences; the tool moves by
`J z`. With the actuators' motion `a(t)` given, the springs obey

    M_ss s'' + D_ss s' + K_ss s = -M_sa a'' - K_sa a + J_fs' f.

Accelerations of the input are rarely logged, so they are eliminated: with `F = -M_ss^-1 M_sa`, `s = F a + x1` and
`x2 = x1' + M_ss^-1 D_ss F a`,

    x1' = x2 - M_ss^-1 D_ss F a
    x2' = -M_ss^-1 (D_ss x1' + K_ss x1) + M_ss^-1 (J_fs' f - (K_sa + K_ss F) a),

which is exact. An accelerometer is a second-order low-pass on the true acceleration, which makes its signal finite even where
a drive's speed jumps. Springs are `<tau_dyn:spring>` elements on passive joints and `<tau_dyn:drive_spring>` elements on
actuated ones; for every other purpose the robot is rigid.
Reference: Khalil & Dombre 2002, ch. 7; Wittbrodt, Adamiec-Wojcik & Wojciech 2006 (rigid finite elements), ch. 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.linalg import eigh

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import AXES, TreeMechanism
from tau_dyn.mechanism.flexible.file_masses import require_file_masses
from tau_dyn.mechanism.flexible.linear_system import ContinuousModel, PositionDrives
from tau_dyn.robot import Robot, Spring, load_robot_from_urdf


@dataclass(frozen=True, eq=False)
class NaturalMode:
    """A vibration mode of a robot with its actuators at rest.

    Attributes:
        frequency_hz: Undamped natural frequency, `|s| / 2 pi`.
        damping_ratio: `-Re s / |s|`.
        springs: Deflection of each spring (ns,), complex, the largest 1.
        tool: Displacement of the tool (3,), complex, in base axes, at that deflection.
    """

    frequency_hz: float
    damping_ratio: float
    springs: np.ndarray
    tool: np.ndarray


@dataclass(frozen=True, eq=False)
class Linearised:
    """A flexible robot near one pose; made by `FlexibleModel.at`.

    Attributes:
        robot: The rigid robot.
        springs: Names of the spring joints, those of drives last; all matrices have the actuated joints first, then these.
        q: Actuated positions (na,).
        deflection: The springs' deflection at rest (ns,).
        M: Mass matrix (n, n).
        D: Damping matrix (n, n).
        K: Stiffness matrix (n, n), with the weight's share.
        tool: The tool's velocity per coordinate's (3, n), in base axes.
        pushed: The same for the point that outside forces act on (3, n).
        tool_position: Position of the tool at rest (3,) [m].
        unloaded_position: Position of the tool without deflection of any spring, at the same positions of the drives (3,) [m].
    """

    robot: Robot
    springs: tuple[str, ...]
    q: np.ndarray
    deflection: np.ndarray
    M: np.ndarray
    D: np.ndarray
    K: np.ndarray
    tool: np.ndarray
    pushed: np.ndarray
    tool_position: np.ndarray
    unloaded_position: np.ndarray

    @property
    def na(self) -> int:
        """Number of actuated joints."""
        return len(self.q)

    def natural_frequencies(self) -> np.ndarray:
        """Return the undamped natural frequencies with the actuators held (ns,) [Hz], rising."""
        a = self.na
        values = eigh(self.K[a:, a:], self.M[a:, a:], eigvals_only=True)
        return np.sqrt(values) / (2 * np.pi)

    def modes(self) -> tuple[NaturalMode, ...]:
        """Return the damped modes with the actuators held, slowest first; overdamped modes are left out."""
        A = self._springs_alone()
        poles, vectors = np.linalg.eig(A)
        found = []
        for k in np.argsort(np.abs(poles)):
            if poles[k].imag > 1e-9 * abs(poles[k]):
                shape = vectors[: len(self.springs), k]
                shape = shape / shape[np.argmax(np.abs(shape))]
                size = abs(poles[k])
                found.append(
                    NaturalMode(
                        float(size / (2 * np.pi)), float(-poles[k].real / size), shape, self.tool[:, self.na :] @ shape
                    )
                )
        return tuple(found)

    def compliance(self) -> np.ndarray:
        """Return the tool's static displacement per outside force (3, 3) [m/N], actuators held."""
        a = self.na
        return self.tool[:, a:] @ np.linalg.solve(self.K[a:, a:], self.pushed[:, a:].T)

    def state_space(
        self, drives: PositionDrives | None = None, *, acceleration: bool = False, accelerometer_hz: float = 300.0
    ) -> ContinuousModel:
        """Return the way from actuators and outside force to actuators and tool, as deviations from rest.

        Args:
            drives: Takes references `q_ref_J` to positions `q_J`; None makes the actuators' positions `q_J` the inputs.
            acceleration: Also give the tool's acceleration as an accelerometer reads it, without gravity.
            accelerometer_hz: The accelerometer's bandwidth [Hz].

        Inputs are `q_ref_J` (or `q_J`) and `fx_tool fy_tool fz_tool` [N], outputs `q_J`, `x_tool y_tool z_tool` [m] and, if
        asked for, `ax_tool ay_tool az_tool` [m/s^2].
        """
        model = self._from_motion()
        if drives is not None:
            model = self._driven(model, drives)
        return self._with_accelerometer(model, accelerometer_hz) if acceleration else model

    def _springs_alone(self) -> np.ndarray:
        a, ns = self.na, len(self.springs)
        slope = np.linalg.solve(self.M[a:, a:], np.hstack([self.K[a:, a:], self.D[a:, a:]]))
        return np.block([[np.zeros((ns, ns)), np.eye(ns)], [-slope]])

    def _from_motion(self) -> ContinuousModel:
        """Return the springs between given actuator motion and the tool: states x1, x2."""
        a, ns = self.na, len(self.springs)
        M, D, K = self.M[a:, a:], self.D[a:, a:], self.K[a:, a:]
        F = -np.linalg.solve(M, self.M[a:, :a])
        damped = np.linalg.solve(M, D)
        A = self._springs_alone()
        push = np.linalg.solve(M, self.pushed[:, a:].T)
        by_motion = np.vstack(
            [-damped @ F, damped @ damped @ F - np.linalg.solve(M, self.K[a:, :a] + K @ F)]
        )  # x1' = x2 - M^-1 D F a, and the same inside x2'
        B = np.hstack([by_motion, np.vstack([np.zeros((ns, 3)), push])])
        C = np.vstack([np.zeros((a, 2 * ns)), np.hstack([self.tool[:, a:], np.zeros((3, ns))])])
        through = np.vstack([np.eye(a), self.tool[:, :a] + self.tool[:, a:] @ F])
        names = [f"q_{j}" for j in self.robot.actuated]
        inputs = (*names, *(f"f{x}_tool" for x in AXES))
        outputs = (*names, *(f"{x}_tool" for x in AXES))
        return ContinuousModel(A, B, C, np.hstack([through, np.zeros((a + 3, 3))]), inputs, outputs, np.zeros(a + 3))

    def _driven(self, model: ContinuousModel, drives: PositionDrives) -> ContinuousModel:
        """Return the same system behind drives: their positions become states."""
        a, n = self.na, model.order
        if len(drives.time_constants) != a:
            raise InputError(
                "mismatch", f"{len(drives.time_constants)} drive(s) for {a} actuated joint(s); give one each"
            )
        lag = np.diag(1 / np.array(drives.time_constants))
        A = np.block([[-lag, np.zeros((a, n))], [model.B[:, :a], model.A]])
        B = np.block([[lag, np.zeros((a, 3))], [np.zeros((n, a)), model.B[:, a:]]])
        C = np.hstack([model.D[:, :a], model.C])
        D = np.hstack([np.zeros((len(C), a)), model.D[:, a:]])
        inputs = (*(f"q_ref_{j}" for j in self.robot.actuated), *model.inputs[a:])
        return ContinuousModel(A, B, C, D, inputs, model.outputs, np.array([drives.delay] * a + [0.0] * 3))

    def _with_accelerometer(self, model: ContinuousModel, bandwidth_hz: float) -> ContinuousModel:
        """Return the same system with three outputs more, `w^2 s^2 / (s^2 + sqrt(2) w s + w^2)` of the tool's position."""
        if not 0 < bandwidth_hz < np.inf:
            raise InputError("invalid_value", f"an accelerometer's bandwidth must be positive, not {bandwidth_hz:g} Hz")
        w, n, m = 2 * np.pi * bandwidth_hz, model.order, len(model.inputs)
        C, D = model.C[self.na :], model.D[self.na :]
        eye, none = np.eye(3), np.zeros((3, 3))
        A = np.block(
            [
                [model.A, np.zeros((n, 6))],
                [np.zeros((3, n)), none, eye],
                [w**2 * C, -(w**2) * eye, -np.sqrt(2) * w * eye],
            ]
        )
        B = np.vstack([model.B, np.zeros((3, m)), w**2 * D])
        rows = np.vstack([np.hstack([model.C, np.zeros((len(model.C), 6))]), A[-3:]])
        outputs = (*model.outputs, *(f"a{x}_tool" for x in AXES))
        return ContinuousModel(A, B, rows, np.vstack([model.D, w**2 * D]), model.inputs, outputs, model.delay)


_STEP = 1e-5  # [m or rad] of the central differences
_WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


@dataclass(frozen=True, eq=False)
class _Rest:
    """Rest position of the robot: all coordinates (n,) and the tree's configuration (nq,)."""

    z: np.ndarray
    tree: np.ndarray


class FlexibleModel:
    """A robot with the springs of its file as coordinates.

    Attributes:
        robot: The rigid robot, springs locked.
        springs: Its springs, those of its drives last; the order of all deflections.
        freed: The same robot with its springs as coordinates in addition to the actuated joints.
        mechanism: Rigid-body dynamics in all those coordinates.
    """

    def __init__(self, robot: Robot) -> None:
        """Free the springs of a robot.

        Raises:
            InputError: The robot has no springs, or its parameters are not those of its file any more.
        """
        self.springs = (*robot.springs, *robot.drive_springs)
        if not self.springs:
            raise InputError(
                "unsupported",
                f"{robot.source} has no <tau_dyn:spring>; name the joints that yield in the file, or, for gantry_tau, "
                "load it with arms=complete flexible=true",
            )
        require_file_masses(robot)
        joints = [*robot.actuated, *(s.joint for s in robot.springs)]
        self.robot = robot
        self.freed = load_robot_from_urdf(robot.urdf, robot.source, actuated=joints, lock_springs=False)
        self.mechanism = TreeMechanism(self.freed)
        self._order = [self.freed.actuated.index(j) for j in joints]  # ours -> the tree's
        self._stiffness, self._damping = self._list_forces(self.springs)
        driven = [robot.actuated.index(s.joint) for s in robot.drive_springs]
        behind = np.zeros((len(joints), len(driven)))
        behind[driven, range(len(driven))] = 1.0
        self._joints_by_z = np.hstack([np.eye(len(joints)), behind])
        self._drive_inertia = np.zeros(len(joints))
        self._drive_inertia[driven] = [self.freed.parameters[f"{s.joint}.armature"].value for s in robot.drive_springs]

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
            springs=tuple(s.joint for s in self.springs),
            q=rest.z[:na],
            deflection=rest.z[na:],
            M=M,
            D=np.diag(self._damping),
            K=K,
            tool=self._jacobian(rest, tool),
            pushed=self._jacobian(rest, pushed or tool),
            tool_position=self._position(rest.tree, tool),
            unloaded_position=self._position(
                self._tree(np.concatenate([rest.z[:na], np.zeros(len(self.springs))])), tool
            ),
        )

    def with_springs(self, springs: Sequence[Spring]) -> FlexibleModel:
        """Return the same robot with other stiffness and damping of its springs, in the order of `springs`."""
        other = copy(self)
        other.springs = tuple(springs)
        other._stiffness, other._damping = self._list_forces(springs)
        return other

    def _list_forces(self, springs: Sequence[Spring]) -> np.ndarray:
        """Return stiffness and damping of all coordinates (2, n), zero for the actuated ones."""
        values = np.array([[s.stiffness, s.damping] for s in springs]).T
        return np.hstack([np.zeros((2, self.robot.na)), values])

    def compute_jacobian(self, near: Linearised, frame: str) -> np.ndarray:
        """Return the velocity of a frame's or link's origin per coordinate's at a pose (3, n), in base axes."""
        z = np.concatenate([near.q, near.deflection])
        return self._jacobian(_Rest(z, self._tree(z)), frame)

    def _checked(self, q: Sequence[float] | np.ndarray | None) -> np.ndarray:
        q = self.robot.home if q is None else np.asarray(q, float)
        if q.shape != (self.robot.na,) or not np.isfinite(q).all():
            joints = ", ".join(self.robot.actuated)
            raise InputError("wrong_shape", f"a pose has one finite position for each of {joints}, not {q}")
        return q

    def _rest(self, q: np.ndarray, sag: bool) -> _Rest:
        """Return the rest position of the robot with its actuators at `q`: Newton with the springs' own stiffness as slope."""
        na = self.robot.na
        z = np.concatenate([q, np.zeros(len(self.springs))])
        k = self._stiffness[na:]
        for _ in range(100 if sag else 0):
            slack = (self._bias(z)[na:] + k * z[na:]) / k
            if not np.abs(slack).max() < 0.2:  # [m or rad] also stops a diverging iteration
                break
            z[na:] -= slack
            if np.abs(slack).max() < 1e-11:
                return _Rest(z, self._tree(z))
        if sag:
            worst = self.springs[int(np.argmax(np.abs(self._bias(z)[na:] / k + z[na:])))].joint
            raise InputError(
                "robot_structure",
                f"{self.robot.source}: spring '{worst}' is too soft to carry the robot's weight at this pose",
            )
        return _Rest(z, self._tree(z))

    def _tree(self, z: np.ndarray) -> np.ndarray:
        return self.mechanism.solver.close(self._theirs(z))

    def _theirs(self, z: np.ndarray) -> np.ndarray:
        """Return the joints' positions in the tree's order."""
        out = np.empty(len(self._order))
        out[self._order] = self._joints_by_z @ z
        return out

    def _mass(self, z: np.ndarray) -> np.ndarray:
        joints = self._theirs(z)
        M, _ = self.mechanism.mass_and_bias(joints, np.zeros(len(joints)))
        of_links = M[np.ix_(self._order, self._order)] - np.diag(self._drive_inertia)
        out = self._joints_by_z.T @ of_links @ self._joints_by_z
        n = len(joints)
        out[:n, :n] += np.diag(self._drive_inertia)
        return out

    def _bias(self, z: np.ndarray) -> np.ndarray:
        """Return the forces that hold the robot without springs (n,)."""
        joints = self._theirs(z)
        _, h = self.mechanism.mass_and_bias(joints, np.zeros(len(joints)))
        return self._joints_by_z.T @ h[self._order]

    def _weight_stiffness(self, z: np.ndarray) -> np.ndarray:
        """Return `dh/dz` (n, n), symmetric because weight has a potential."""
        T = self._joints_by_z
        steps = _STEP * np.eye(len(z))[: len(T)]  # a drive's spring moves its joint as the drive does
        slope = np.column_stack([(self._bias(z + e) - self._bias(z - e)) / (2 * _STEP) for e in steps])[: len(T)]
        return T.T @ ((slope + slope.T) / 2) @ T

    def _frame(self, name: str) -> int:
        model = self.mechanism.model
        if not model.existFrame(name):
            raise UnknownName("frame", name, [f.name for f in model.frames[1:]], self.robot.source)
        return model.getFrameId(name)

    def _jacobian(self, rest: _Rest, name: str) -> np.ndarray:
        """Return a frame's velocity per coordinate's (3, n), in base axes."""
        frame, mechanism = self._frame(name), self.mechanism
        nothing = np.zeros(len(self._order))
        G = mechanism.solver.state(self._theirs(rest.z), nothing, nothing).G
        tree = pin.computeFrameJacobian(mechanism.model, mechanism.data, rest.tree, frame, _WORLD)
        return (tree.reshape(6, -1)[:3] @ G)[:, self._order] @ self._joints_by_z

    def _position(self, tree: np.ndarray, name: str) -> np.ndarray:
        pin.framesForwardKinematics(self.mechanism.model, self.mechanism.data, tree)
        return self.mechanism.data.oMf[self._frame(name)].translation.copy()

    def _refuse(self, M: np.ndarray, K: np.ndarray) -> None:
        """Refuse springs without mass behind them, whose motion is undefined, and weight that springs cannot hold."""
        names = [s.joint for s in self.springs]
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
