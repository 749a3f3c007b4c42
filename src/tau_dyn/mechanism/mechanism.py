r"""Interface of every mechanism, and its kinematics: a plate on legs, or any tree.

    tau_a = M(q) a + h(q, v) = Y(q, v, a) theta

in actuated coordinates. All later rooms use this interface and never ask whether there are loops. `theta` are
`robot.parameters`, inertial numbers first, then drive inertia, then gravity-only mass; friction is not among them, since it is
an effect. Functions of the geometry alone are in `mechanism.kinematics`; the functions here call them for a robot, at its
file's dimensions, or for given kinematics. Kinematics are cached for the robots that were used last, by identity and for each
thread, since some solvers keep their last state: a robot is frozen and does not change.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import ClassVar, Self, TypeVar

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.mechanism.kinematics import Kinematics
from tau_dyn.mechanism.plate_on_legs import PlateOnLegs, build_rods
from tau_dyn.mechanism.poses import ForwardResult, InverseResult, InverseSolutions, Poses, convert_from_quaternions
from tau_dyn.mechanism.recognise import NotRods
from tau_dyn.mechanism.tree_kinematics import TreeKinematics
from tau_dyn.robot import Robot, as_robot

T = TypeVar("T")
_MAX_ROBOTS = 16  # robots whose solvers are kept; the one that was not asked for longest goes first


class _Shelves(threading.local):
    """A thread's shelves, one a robot."""

    def __init__(self) -> None:
        self.of = lru_cache(maxsize=_MAX_ROBOTS)(self._make_shelf)

    @staticmethod
    def _make_shelf(owner: object) -> dict[str, object]:
        return {}


_SHELVES = _Shelves()


def get_cached(owner: object, name: str, make: Callable[[], T]) -> T:
    """Return the object cached for a robot under a name; the first call makes it."""
    shelf = _SHELVES.of(owner)
    if name not in shelf:
        shelf[name] = make()
    return shelf[name]  # type: ignore[return-value]


def build_kinematics(robot: Robot | Kinematics) -> Kinematics:
    """Return a robot's kinematics: a plate on legs if it has one, else its tree. They are cached for the robot.

    Raises:
        InputError: A tree without a tool frame, or with a joint of several freedoms.
        LoopClosureError: The loops cannot be closed at home.
    """
    return get_cached(robot, "kinematics", lambda: _build(robot)) if isinstance(robot, Robot) else robot


def _build(robot: Robot) -> Kinematics:
    try:
        return build_rods(robot)
    except NotRods:
        return TreeKinematics(robot)


def get_robot(robot: Robot | Kinematics) -> Robot:
    """Return the robot itself."""
    return robot if isinstance(robot, Robot) else robot.robot


def get_rods(robot: Robot | Kinematics) -> PlateOnLegs | None:
    """Return a robot's plate on legs, or None for a robot of another kind."""
    return build_kinematics(robot).legs  # type: ignore[return-value]


def get_solver(robot: Robot | Kinematics) -> object:
    """Return the solver of a robot's forward kinematics.

    Raises:
        LoopClosureError: Its loops cannot be closed at home.
    """
    return build_kinematics(robot).engine  # type: ignore[attr-defined]


def forward_kinematics(
    robot: Robot | Kinematics | str | Path, q: np.ndarray, *, start: Poses | None = None
) -> ForwardResult:
    """Return where the tool is at actuated positions; see `Kinematics.forward`.

    Example:
        >>> robot = td.load_robot("gantry_tau")
        >>> found = td.forward_kinematics(robot, robot.home)
        >>> found
        ForwardResult: 1 of 1 answered
        >>> found.poses.position.round(3).tolist()
        [[1.75, -0.6, 0.75]]
    """
    return build_kinematics(_as_machine(robot)).forward(q, start=start)


def inverse_kinematics(
    robot: Robot | Kinematics | str | Path,
    poses: Poses | ArrayLike,
    *,
    configuration: Sequence[int] | np.ndarray | None = None,
    start: np.ndarray | None = None,
    limits: bool = True,
) -> InverseResult:
    """Return the actuated positions that put the tool at poses; see `Kinematics.inverse`.

    Poses may be plain numbers: positions (N, 3) [m], with the orientation at home, or with quaternions `x y z w` (N, 7).

    Raises:
        InputError: The numbers have another shape.

    Example:
        >>> robot = td.load_robot("gantry_tau")
        >>> poses = td.forward_kinematics(robot, robot.home).poses
        >>> bool(np.allclose(td.inverse_kinematics(robot, poses).q, robot.home))
        True
    """
    machine = build_kinematics(_as_machine(robot))
    return machine.inverse(_as_poses(machine, poses), configuration=configuration, start=start, limits=limits)


def _as_machine(robot: Robot | Kinematics | str | Path) -> Robot | Kinematics:
    """Return a robot or kinematics as they are; a path or a name is loaded."""
    return robot if isinstance(robot, Kinematics) else as_robot(robot)


def _as_poses(machine: Kinematics, poses: Poses | ArrayLike) -> Poses:
    """Return poses as they are, or from numbers, with the orientation at home where only positions are given.

    Raises:
        InputError: The numbers are neither positions (N, 3) nor positions and quaternions `x y z w` (N, 7).
    """
    if isinstance(poses, Poses):
        return poses
    try:
        numbers = np.atleast_2d(np.array(poses, dtype=float))
    except (TypeError, ValueError):
        numbers = np.zeros((0, 0))
    if numbers.ndim != 2 or numbers.shape[1] not in (3, 7):
        raise InputError(
            "wrong_shape",
            "poses are positions x y z [m], one or (N, 3), with quaternions x y z w (N, 7), or Poses(position, rotation)",
        )
    if numbers.shape[1] == 7:
        return convert_from_quaternions(numbers[:, :3], numbers[:, 3:])
    home = machine.forward(machine.robot.home[None]).poses.rotation[0]
    return Poses(numbers, np.broadcast_to(home, (len(numbers), 3, 3)))


def find_all_solutions(robot: Robot | Kinematics, poses: Poses) -> InverseSolutions:
    """Return all positions that put the tool at poses, and whether they are proved to be all; see `Kinematics.solutions`."""
    return build_kinematics(robot).solutions(poses)


def solve_all_configurations(robot: Robot | Kinematics, poses: Poses) -> np.ndarray:
    """Return the positions of all configurations (N, n_configurations, na); see `Kinematics.solutions`."""
    return build_kinematics(robot).solutions(poses).q


def jacobian(robot: Robot | Kinematics, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
    """Return the tool's twist per actuated velocity (N, 6 or 3, na); see `Kinematics.jacobian`."""
    return build_kinematics(robot).jacobian(q, poses)


SINGULAR = 1e4
"""Conditioning of the closure above which a warning is due; double precision loses half its digits at 1e8."""

_STEP = 1e-4
"""Change of a position [m or rad] over which weights change by a small part of themselves, and far above rounding."""


class Mechanism(ABC):
    """Rigid-body dynamics of one robot with its `robot.parameters`, in actuated coordinates.

    Attributes:
        robot: The robot.
        equations: Kind of the equations, for code generation: "tree", or "gantry_tau" for its closed form.
    """

    equations: ClassVar[str]

    def __init__(self, robot: Robot) -> None:
        """Prepare for a robot and the values of its parameters."""
        self.robot = robot

    def __repr__(self) -> str:
        """Return a line: whose dynamics."""
        return f"{type(self).__name__} of {self.robot.name} ({', '.join(self.robot.actuated)})"

    @cached_property
    def kinematics(self) -> Kinematics:
        """The kinematics at the robot file's dimensions.

        Raises:
            InputError: The robot has no tool frame.
        """
        return build_kinematics(self.robot)

    @abstractmethod
    def regressor(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return `Y` (N, na, p): actuated forces per unit of each parameter.

        Args:
            q: Actuated positions (N, na) [m or rad].
            v: Actuated velocities (N, na).
            a: Actuated accelerations (N, na).

        Raises:
            LoopClosureError: The robot cannot reach a position.
        """

    @abstractmethod
    def mass_and_bias(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return `M` (na, na) and `h` (na,) of one sample, so that `tau = M a + h` without friction."""

    @abstractmethod
    def tool_position(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's position in the base frame (N, 3) [m] for actuated positions (N, na).

        Raises:
            InputError: The robot file has no frame named `tool`.
        """

    @abstractmethod
    def condition(self, q: np.ndarray) -> np.ndarray:
        """Return the closure's conditioning (N,) for actuated positions (N, na); 1 without loops."""

    @abstractmethod
    def guide_force(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the force [N] across each prismatic joint's axis (N, na, 3), in base axes, at the parameters' values.

        It is the force of all bodies beyond the joint's own link on that link; on a Gantry-Tau, the force of the rod across the
        guideway. The cart's own weight is constant and left out. Zero for revolute joints.
        """

    def guide_load(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the load of each actuated joint's guide (N, na), at the parameters' values.

        Prismatic: the size of `guide_force` [N]. Revolute: the size of the rigid-body torque [N m] that the reducer transmits;
        the torque that accelerates the drive's own inertia does not pass it.
        """
        across = self.guide_force(q, v, a)
        load = np.sqrt(np.sum(across * across, axis=2))
        hinges = [k for k, kind in enumerate(self.robot.joint_kinds) if kind != "prismatic"]
        if hinges:
            load[:, hinges] = np.abs(self.reducer_torque(q, v, a))[:, hinges]
        return load

    def reducer_torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the force that each drive's reducer transmits (N, na) [N or N m], with its sign: the rigid bodies' force.

        The torque that accelerates the drive's own inertia does not pass it. For a hinge, `guide_load` is its size.
        """
        drive = np.array([self.robot.parameters[f"{joint}.armature"].value for joint in self.robot.actuated])
        return self.inverse_dynamics(q, v, a) - drive * a

    @abstractmethod
    def passive_rates(self, q: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        """Return how fast passive pairs turn: their names, and (N, n, 3, na) angular velocity per actuated speed.

        A hinge has its rate in the first of the three numbers and zeros in the others; a ball, or a rod's two ends that
        only turn together, the relative angular velocity as a vector. No pairs without loops.
        """

    def redundant_motion(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the motion of the drives beyond the robot's freedoms, `Robot.redundant_joints`, (N, r, na + 2).

        For each drive its speed per actuated speed (na), its speed and its acceleration [m or rad, per s and s^2].

        Raises:
            InputError: The equations are those of generated code, which has no such drives.
        """
        if self.robot.redundant_joints:
            raise InputError(
                "unsupported",
                f"{self.robot.source}: generated code is for robots with as many drives as freedoms, and "
                f"{', '.join(self.robot.redundant_joints)} is more",
            )
        return np.zeros((len(np.atleast_2d(q)), 0, self.robot.na + 2))

    @abstractmethod
    def tool_jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's velocity per actuated speed (N, 3, na), in base axes.

        Raises:
            InputError: The robot file has no frame named `tool`.
        """

    @abstractmethod
    def cart_sensitivity(self, q: np.ndarray) -> np.ndarray:
        """Return the tool's displacement (N, 3, na, 3) per displacement of each actuated joint's link, in base axes.

        The link is shifted without turning, in any direction; all other actuated joints are held and the loops close.

        Raises:
            InputError: The robot file has no frame named `tool`.
        """

    def inertia(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrix (N, na, na) at actuated positions (N, na), from the regressor at unit accelerations."""
        (q,) = self._checked(q)
        rest = np.zeros_like(q)
        weight = self.inverse_dynamics(q, rest, rest)
        columns = [self.inverse_dynamics(q, rest, rest + unit) - weight for unit in np.eye(self.robot.na)]
        return np.stack(columns, axis=2)

    def weight_gradient(self, q: np.ndarray) -> np.ndarray:
        """Return how the forces at rest (N, na, na) change with the actuated positions (N, na), by central differences."""
        (q,) = self._checked(q)
        steps = _STEP * np.concatenate([np.eye(self.robot.na), -np.eye(self.robot.na)])
        moved = (q[:, None] + steps).reshape(-1, self.robot.na)
        rest = np.zeros_like(moved)
        ahead, behind = np.moveaxis(
            self.inverse_dynamics(moved, rest, rest).reshape(len(q), 2, self.robot.na, -1), 1, 0
        )
        return (ahead - behind).swapaxes(1, 2) / (2 * _STEP)

    def gravity_turn(self, q: np.ndarray) -> np.ndarray:
        """Return how the forces at rest (N, na, 2) change per turn [rad] of gravity about each of two axes across it.

        The axes are `compute_perpendicular_axes` gravity: the base's x and y where it points along z. Forces at rest are
        linear in gravity, so
        they are those under the gravity `axis x g`.
        """
        (q,) = self._checked(q)
        rest = np.zeros_like(q)
        return np.stack([turned.inverse_dynamics(q, rest, rest) for turned in self._turned], axis=2)

    @cached_property
    def _turned(self) -> list[Self]:
        """The same mechanism under the two gravities `axis x g`."""
        gravity = np.asarray(self.robot.model.gravity.linear, float)
        return [self._under(np.cross(axis, gravity)) for axis in compute_perpendicular_axes(gravity)]

    def _under(self, gravity: np.ndarray) -> Self:
        """Return the same mechanism under another gravity (3,) [m/s^2]."""
        model = pin.Model(self.robot.model)
        model.gravity.linear = gravity
        return type(self)(replace(self.robot, model=model))

    def guide_across(self) -> np.ndarray:
        """Return two unit directions across each prismatic joint's axis (na, 2, 3), in base axes; zeros for hinges.

        They hold for guideways that are fixed to the base; a guideway on a moving link turns with the link.
        """
        model, data = self.robot.model, self.robot.model.createData()
        pin.forwardKinematics(model, data, pin.neutral(model))
        out = np.zeros((self.robot.na, 2, 3))
        for k, (name, kind) in enumerate(zip(self.robot.actuated, self.robot.joint_kinds, strict=True)):
            if kind == "prismatic":
                joint = model.getJointId(name)
                jacobian = pin.computeJointJacobian(model, data, pin.neutral(model), joint)
                out[k] = compute_perpendicular_axes(data.oMi[joint].rotation @ jacobian[:3, model.joints[joint].idx_v])
        return out

    def reachable(self, q: np.ndarray) -> bool:
        """Return whether the loops close at actuated positions `q` (na,)."""
        try:
            self.condition(np.atleast_2d(q))
        except LoopClosureError:
            return False
        return True

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the actuated forces (N, na) [N or N m] of the rigid robot at its parameters' values."""
        return self.regressor(q, v, a) @ self.robot.parameters.values

    def forward_dynamics(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Return the actuated accelerations (na,) of one sample under forces `tau` (na,)."""
        M, h = self.mass_and_bias(q, v)
        return np.linalg.solve(M, tau - h)

    def singularity_warnings(self, q: np.ndarray) -> tuple[str, ...]:
        """Return a sentence if some of these positions (N, na) are near a singularity of the loops."""
        condition = self.condition(q)
        worst = int(np.argmax(condition))
        if not condition[worst] > SINGULAR:
            return ()
        share = 100 * np.mean(condition > SINGULAR)
        place = ", ".join(f"{j} = {x:.4g}" for j, x in zip(self.robot.actuated, np.atleast_2d(q)[worst], strict=True))
        return (
            f"the mechanism is near a singularity at {place} (condition number {condition[worst]:.3g}, "
            f"{share:.2g} % of the samples above {SINGULAR:g}); forces there are not trustworthy",
        )

    def _checked(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return arrays as (N, na) floats, or raise an error with the expected shape."""
        checked = tuple(np.atleast_2d(np.asarray(x, float)) for x in arrays)
        for x in checked:
            if x.shape != checked[0].shape or x.shape[1] != self.robot.na:
                joints = ", ".join(self.robot.actuated)
                raise InputError(
                    "wrong_shape", f"expected arrays of shape (N, {self.robot.na}) for {joints}, not {x.shape}"
                )
            if not np.isfinite(x).all():
                row = int(np.argmin(np.isfinite(x).all(axis=1)))
                raise InputError(
                    "bad_sample", f"sample {row + 1} of the motion holds {x[row]}; all must be finite numbers"
                )
        return checked


def require_tool_frame(robot: Robot) -> int:
    """Return the index of the tool's frame.

    Raises:
        InputError: The robot has no such frame.
    """
    if robot.tool_frame is None:
        raise InputError("unsupported", f"{robot.source}: the robot file has no frame named tool")
    return robot.tool_frame


def compute_perpendicular_axes(direction: np.ndarray) -> np.ndarray:
    """Return two unit vectors (2, 3) across a direction (3,): the base axes most nearly perpendicular to it, orthogonalised.

    For a direction along a base axis they are the other two axes.
    """
    along = direction / np.linalg.norm(direction)
    first, second = np.eye(3)[np.sort(np.argsort(np.abs(along), kind="stable")[:2])]
    first = first - (first @ along) * along
    first = first / np.linalg.norm(first)
    second = second - (second @ along) * along - (second @ first) * first
    return np.stack([first, second / np.linalg.norm(second)])
