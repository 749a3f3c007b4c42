r"""Interface to the kinematics of every kind of mechanism; all code that needs poses uses this interface alone.

The tool at pose X and the actuators at q close the mechanism where `g(q, X) = 0`: the gaps `|A(q) - B(X)| - L` of a plate on
legs, for any other tree the deviation of the tool from the pose that the joints give it. With `G_x`, `G_q` and `G_p` its
derivatives by the tool's twist, by the positions and by the geometric parameters,

    V = J v,   J = -G_x^+ G_q,   dX/dp = -G_x^+ G_p.

`G_x` loses rank in a parallel (second kind) singularity, `G_q` in a serial (first kind) one: Gosselin & Angeles 1990; Merlet
2006, ch. 5 and 6. Poses are the tool's, in the world; twists are linear first, in world axes, at the tool's origin; those of a
plate that only translates have the linear half alone. Arrays have samples first.

*Commanded coordinates* are those of a tool's six coordinates that can be chosen on a mechanism. The twists that the actuators
give the tool at home span a space of r dimensions; r coordinates are taken one by one where it reaches furthest, positions
before rotations, at the place that turns move least (on a plate, the middle of its joints): six for a 6R arm, three positions
for a plate that translates, three positions and a turn for a SCARA, height and two tilts for a 3-PRS. Rotations are the
components of the rotation vector after home's orientation, in world axes (Chirikjian 2012).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, NoReturn, Self

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism.legs import Legs
from tau_dyn.mechanism.poses import (
    ForwardResult,
    InverseResult,
    InverseSolutions,
    Poses,
    check_limits,
    measure_turns,
    refuse_beyond_limits,
    require_poses,
    require_positions,
    turn_rotations,
)
from tau_dyn.parameters import Parameters
from tau_dyn.robot import Robot

_NAMES = ("x", "y", "z", "rx", "ry", "rz")
_RANK = 1e-6  # singular values relative to the largest; smaller ones count as no motion
_REACHES = 0.3  # share of a position that a space of twists must hold for it to be commanded before any rotation


@dataclass(frozen=True, eq=False)
class CommandedCoordinates:
    """The commanded coordinates of a tool.

    Attributes:
        index: Which of x, y, z, rx, ry, rz (k,).
        home: The tool's pose at home (1 sample), which gives the coordinates that are not commanded.
    """

    index: tuple[int, ...]
    home: Poses

    @property
    def names(self) -> tuple[str, ...]:
        """Names: `x y z` and `rx ry rz`."""
        return tuple(_NAMES[k] for k in self.index)

    @property
    def units(self) -> tuple[str, ...]:
        """'m' or 'rad' each."""
        return tuple("m" if k < 3 else "rad" for k in self.index)

    @property
    def by_position(self) -> bool:
        """Whether all positions that the tool can reach are commanded, without a rotation in place of one."""
        return {0, 1, 2} <= set(self.index) or not any(k > 2 for k in self.index)

    def of(self, poses: Poses) -> np.ndarray:
        """Return the commanded coordinates (N, k) [m or rad] of tool poses."""
        turn = measure_turns(poses.rotation, self.home.rotation)
        return np.concatenate([poses.position, turn], axis=1)[:, list(self.index)]

    def by_twist(self, poses: Poses) -> np.ndarray:
        """Return the commanded coordinates' rates per twist (N, k, 6): of a rotation vector the inverse left Jacobian."""
        turn = measure_turns(poses.rotation, self.home.rotation)
        half = np.linalg.norm(turn, axis=1) / 2
        K = np.cross(np.eye(3), turn[:, None, :]).transpose(0, 2, 1)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(half < 1e-4, 1 / 12, (1 - half / np.tan(half)) / (4 * half**2))
        out = np.zeros((len(turn), 6, 6))
        out[:, :3, :3], out[:, 3:, 3:] = np.eye(3), np.eye(3) - K / 2 + share[:, None, None] * (K @ K)
        return out[:, list(self.index)]

    def to_poses(self, values: np.ndarray) -> Poses:
        """Return tool poses with these coordinates (N, k); the other coordinates are those of home."""
        values = np.atleast_2d(np.asarray(values, float))
        all_six = np.zeros((len(values), 6))
        all_six[:, :3] = self.home.position
        all_six[:, list(self.index)] = values
        return Poses(all_six[:, :3], turn_rotations(all_six[:, 3:], self.home.rotation))


def choose_commanded(twists: np.ndarray, home: Poses, length: float) -> CommandedCoordinates:
    """Choose coordinates at home.

    Args:
        twists: Per actuated speed (6, na), linear first, of the point about which rotations are separated from shifts.
        home: The tool's pose (1 sample).
        length: Weight of a rotation relative to a shift [m].
    """
    scaled = twists * np.array([1.0, 1.0, 1.0, length, length, length])[:, None]
    u, s, _ = np.linalg.svd(scaled, full_matrices=False)
    left = u[:, : int(np.sum(s > _RANK * s[0]))]
    chosen: list[int] = []
    for _ in range(left.shape[1]):
        reach = np.linalg.norm(left, axis=1)
        k = int(np.argmax(np.round(reach[:3], 6)))
        if reach[k] < _REACHES:
            k = int(np.argmax(np.round(reach, 6)))
        chosen.append(k)
        way = left[k] / reach[k]
        left = left - np.outer(left @ way, way)
    return CommandedCoordinates(tuple(sorted(chosen)), home)


class Singularity(NamedTuple):
    """Distance from a singularity, each (N,): 1 is the largest possible, 0 is at the singularity.

    Attributes:
        parallel: Smallest singular value of `G_x` by the largest, angles taken at the plate's radius (root mean square of |B|):
            the actuators lose hold of the plate. For a tree, the same of its loops.
        serial: The same of `G_q`, each column by the fastest point that its actuator moves: an actuator does not move the
            plate. For a tree, the same of its tool's Jacobian.
    """

    parallel: np.ndarray
    serial: np.ndarray


class Kinematics(ABC):
    """Geometry of one robot.

    Attributes:
        robot: The robot.
        equations: Kind of the equations, for code generation: "sliding plate", "free plate" or "tree".
        translates: Whether the tool keeps its rotation; twists then have three rows.
        legs: Plate and legs if the robot has them, else None.
        geometry: Geometric parameters at this geometry's values; units m, rad, 1.
    """

    robot: Robot
    translates: bool
    geometry: Parameters

    @property
    @abstractmethod
    def equations(self) -> str:
        """Kind of the equations that are solved."""

    @property
    def legs(self) -> Legs | None:
        """Plate and legs, or None."""
        return None

    # configurations and poses

    def forward(self, q: np.ndarray, *, start: Poses | None = None) -> ForwardResult:
        """Return where the tool is at actuated positions.

        Args:
            q: Actuated positions (N, na) [m or rad].
            start: Poses of the tool (N, or 1 for all) from which to search, for another assembly mode than home's; a
                translating plate takes the side of it, a tree ignores it.

        Returns:
            Poses, nan with a reason if there is no pose. A pose depends on its own `q` (and start) alone, not on other samples.

        Raises:
            InputError: Arrays of the wrong shape.
            LoopClosureError: The robot cannot be closed even at home.
        """
        q = require_positions(self.robot, q)
        if start is not None:
            start = require_poses(start)
            if len(start.position) not in (1, len(q)):
                raise InputError(
                    "wrong_shape", f"start must hold one pose or {len(q)}, one a sample, not {len(start.position)}"
                )
        return self._forward(q, start)

    @abstractmethod
    def _forward(self, q: np.ndarray, start: Poses | None) -> ForwardResult: ...

    def both_forward(self, q: np.ndarray) -> np.ndarray:
        """Return both tool positions (N, 2, 3) [m] of a translating plate, home's first; nan where the spheres do not meet.

        Raises:
            InputError: The plate does not translate only; `assembly` finds the modes of a free plate.
        """
        raise InputError("unsupported", f"{self.robot.source}: two closed solutions are for plates that translate only")

    @abstractmethod
    def full_positions(self, q: np.ndarray) -> np.ndarray:
        """Return the positions (N, nv) [m or rad] of all joints at actuated ones (N, na); nan where the loops do not close."""

    # inverse

    def inverse(
        self,
        poses: Poses,
        *,
        configuration: Sequence[int] | np.ndarray | None = None,
        start: np.ndarray | None = None,
        limits: bool = True,
    ) -> InverseResult:
        """Return the actuated positions that put the tool at poses.

        Args:
            poses: Poses of the tool (N).
            configuration: One of `configurations`, a sign for each chain; by default home's.
            start: Positions (N or 1, na) from which to search, where a chain has no closed form, by default home. Where actuators
                can move without the tool (a telescopic arm, a serial arm with a joint to spare), the positions nearest to
                it are taken, where the search for them comes to rest. It does not choose the configuration; `follow_path` does.
            limits: Whether positions outside the file's joint limits are refused.

        Raises:
            InputError: Arrays of the wrong shape, an unknown configuration, or joint limits that are the wrong way round.
        """
        poses = require_poses(poses)
        start = None if start is None else self._starts(start, len(poses.position))
        if limits:
            check_limits(self.robot)
        return refuse_beyond_limits(self.robot, self._inverse(poses, configuration, start, limits), limits)

    @abstractmethod
    def _inverse(
        self, poses: Poses, configuration: Sequence[int] | np.ndarray | None, start: np.ndarray | None, limits: bool
    ) -> InverseResult: ...

    def solutions(self, poses: Poses) -> InverseSolutions:
        """Return all positions that put the tool at poses, whatever their limits, and whether they are proved to be all.

        Legs in closed form: rows as `configurations`. Six turning joints in a chain: all, by elimination, nearest to home first.
        Chains of several actuators under rods and other trees: the solutions found from many starts.
        """
        return self._solutions(require_poses(poses))

    @abstractmethod
    def _solutions(self, poses: Poses) -> InverseSolutions: ...

    @property
    def configurations(self) -> np.ndarray:
        """Configurations by name (n, chains): -1 or 1 of a chain with two solutions, 1 of a leg, 0 by Newton.

        Raises:
            InputError: The robot has no rods.
        """
        self._refuse_without_legs("so it has no named configurations")

    @property
    def home_configuration(self) -> np.ndarray:
        """Home's configuration (chains,)."""
        self._refuse_without_legs("so it has no named configurations")

    def nearest_configuration(self, poses: Poses, q: np.ndarray) -> np.ndarray:
        """Return the configuration (chains,) that has positions (na,) at or near a pose (1 sample)."""
        self._refuse_without_legs("so it has no named configurations")

    @cached_property
    def commanded(self) -> CommandedCoordinates:
        """The commanded coordinates of the tool, from the degrees of freedom that it has at home.

        Raises:
            InputError: Its motion at home is not known, as at a singularity of the loops.
        """
        home = self.forward(self.robot.home[None]).poses
        twists, length = self._twists_at_home()
        if not np.isfinite(twists).all():
            raise InputError("unsupported", f"{self.robot.source}: the tool's motion at home is not known")
        return choose_commanded(twists, home, length)

    @abstractmethod
    def _twists_at_home(self) -> tuple[np.ndarray, float]:
        """Return twists per actuated speed (6, na) of the point that rotations move least, and the weight of a rotation [m]."""

    # closure and its derivatives

    @abstractmethod
    def with_geometry(self, parameters: Parameters) -> Self:
        """Return the mechanism at other values of some or all geometric parameters.

        Raises:
            UnknownName: A parameter that this geometry does not have.
        """

    @abstractmethod
    def closure(self, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return `g(q, X)` (N, n) [m or rad], zero where the mechanism closes at `q` (N, na) and the tool's poses (N)."""

    @abstractmethod
    def closure_by_pose(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return `G_x` (N, n, 6 or 3) at poses of the tool, by default those of forward kinematics."""

    @abstractmethod
    def closure_by_q(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return `G_q` (N, n, na)."""

    @abstractmethod
    def closure_by_geometry(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return `G_p` (N, n, p), columns as `geometry`."""

    @abstractmethod
    def jacobian(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return `J`: the tool's twist per actuated velocity.

        Args:
            q: Actuated positions (N, na).
            poses: Poses of the tool there (N); by default those of forward kinematics. A tree takes its own.

        Returns:
            (N, 6, na), linear first; (N, 3, na) for a plate that only translates. nan without a pose.
        """

    @abstractmethod
    def pose_by_geometry(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per geometric parameter (N, 6 or 3, p), the mechanism kept closed."""

    @abstractmethod
    def acceleration_bias(self, q: np.ndarray, v: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's acceleration (N, 6 or 3) at actuated velocities `v` (N, na) and no acceleration there: `dJ/dt v`."""

    @abstractmethod
    def singularity(self, q: np.ndarray, poses: Poses | None = None) -> Singularity:
        """Return how near the mechanism is to singularities of both kinds."""

    def poses_at(self, q: np.ndarray, poses: Poses | None) -> Poses:
        """Return the tool's poses at positions (N, na): those given, checked, or those of forward kinematics."""
        if poses is None:
            return self.forward(q).poses
        poses = require_poses(poses)
        if len(poses.position) != len(q):
            raise InputError(
                "wrong_shape", f"as many poses as positions are needed, not {len(poses.position)} and {len(q)}"
            )
        return poses

    def _starts(self, start: np.ndarray, n: int) -> np.ndarray:
        start = require_positions(self.robot, start)
        if len(start) not in (1, n):
            raise InputError(
                "wrong_shape", f"start must hold one row of positions or {n}, one a pose, not {len(start)}"
            )
        return np.repeat(start, n, axis=0) if len(start) != n else start

    def _velocities(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q, v = require_positions(self.robot, q), require_positions(self.robot, v)
        if len(v) != len(q):
            raise InputError("wrong_shape", f"as many velocities as positions are needed, not {len(v)} and {len(q)}")
        return q, v

    def _refuse_without_legs(self, so: str) -> NoReturn:
        raise InputError("unsupported", f"{self.robot.source}: has no rods, {so}")
