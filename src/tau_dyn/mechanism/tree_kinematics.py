"""Kinematics of any tree with loops: a serial arm, a plate with joints of its own, a planar mechanism, a wrist on a plate.

Its closure is the tool's deviation from where the joints put it, so `G_x = -1` and `G_q = J`. At the robot file's dimensions
`tree_pose.py` places the tool and `tree_inverse.py` inverts; at others `tree_geometry/closure.py` closes the loops.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism.frames import compute_frames, multiply_by_rotation, transform_point
from tau_dyn.mechanism.kinematics import Kinematics, Singularity
from tau_dyn.mechanism.loop_arrays import ClosedLoops
from tau_dyn.mechanism.poses import (
    NOT_A_NUMBER,
    OK,
    OUT_OF_REACH,
    ForwardResult,
    InverseResult,
    InverseSolutions,
    Poses,
    measure_turns,
    require_positions,
)
from tau_dyn.mechanism.small_systems import measure_rank_distance
from tau_dyn.mechanism.tree_geometry import (
    ClosedConfigurations,
    Knob,
    TreeClosure,
    TreeNumbers,
    TreeShape,
    build_rows,
    compute_dimensions_at,
    compute_open_rates,
    get_shape,
    propagate_passive,
    propagate_twists,
)
from tau_dyn.mechanism.tree_inverse import find_tree_solutions, solve_tree_inverse
from tau_dyn.mechanism.tree_pose import TreeNewton, TreePose
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import Robot

_ROUNDING = 1e-10
"""[m or rad, per m or rad] rounding in a column that is zero."""
_UNSEEN = 1e-7
"""Size of a column relative to the largest of its unit below which a parameter does not reach the tool."""


class TreeDimensions:
    """A tree at any values of its geometric parameters.

    Attributes:
        shape: The robot's tree and its parameters.
        parameters: Parameters of the robot file; those without effect on the tool are not free.
        knobs: Effect of each parameter.
    """

    def __init__(self, shape: TreeShape) -> None:
        """List the parameters and look near home which of them reach the tool."""
        rows = build_rows(shape)
        self.shape, self.knobs = shape, tuple(row.knob for row in rows)
        self.loops = TreeClosure(shape)
        self.parameters = Parameters([row.parameter for row in rows])
        self.parameters = Parameters(self._without_unseen())

    def numbers(self, values: np.ndarray) -> TreeNumbers:
        """Return the tree at the parameters' values (p,)."""
        return compute_dimensions_at(self.shape, self.knobs, values, self.parameters.values)

    def forward(self, numbers: TreeNumbers, q: np.ndarray) -> tuple[Poses, ClosedConfigurations]:
        """Return the tool's poses at `q` (N, na), nan where the loops do not close, and the closures."""
        closed, tool = self.loops.close(numbers, q), self.shape.tool
        at = compute_frames(numbers.joints, closed.x)
        position = transform_point(at, tool.joint, numbers.tool).T
        rotation = np.moveaxis(multiply_by_rotation(at.rotation[tool.joint], tool.axes), 2, 0).copy()
        position[~closed.ok] = rotation[~closed.ok] = np.nan
        return Poses(position, rotation), closed

    def twists(self, numbers: TreeNumbers, q: np.ndarray, knobs: Sequence[Knob]) -> tuple[np.ndarray, np.ndarray]:
        """Return the tool's twist per parameter (N, 6, p) and per actuated joint (N, 6, na), loops kept closed."""
        closed = self.loops.close(numbers, q)
        at = compute_frames(numbers.joints, closed.x)
        found = compute_open_rates(self.shape, numbers, knobs, at, closed.x, q.T)
        by_parameter, by_joint = propagate_twists(self.shape, found, closed.inverse, numbers.gain)
        by_parameter[~closed.ok] = by_joint[~closed.ok] = np.nan
        return by_parameter, by_joint

    def passive_rates(
        self, numbers: TreeNumbers, q: np.ndarray, knobs: Sequence[Knob], rows: Sequence[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how passive joints move per parameter (N, k, p) and per actuated joint (N, k, na), loops kept closed.

        Args:
            numbers: The tree.
            q: Actuated positions (N, na).
            knobs: The parameters.
            rows: Which of `shape.passive` (k,).
        """
        closed = self.loops.close(numbers, q)
        at = compute_frames(numbers.joints, closed.x)
        found = compute_open_rates(self.shape, numbers, knobs, at, closed.x, q.T)
        by_parameter, by_joint = (
            rates[:, rows] for rates in propagate_passive(self.shape, found, closed.inverse, numbers.gain)
        )
        by_parameter[~closed.ok] = by_joint[~closed.ok] = np.nan
        return by_parameter, by_joint

    def _without_unseen(self) -> list[Parameter]:
        """Return the parameters with those fixed that do not reach the tool near home."""
        robot = self.shape.robot
        reach = np.where(np.isfinite(robot.upper - robot.lower), 0.3 * (robot.upper - robot.lower), 0.6)
        spread = np.random.default_rng(0).uniform(-0.5, 0.5, (12, robot.na)) * np.minimum(reach, 0.6)
        numbers = self.numbers(self.parameters.values)
        columns = self.twists(numbers, robot.home + spread, self.knobs)[0]
        columns = columns[np.isfinite(columns).all(axis=(1, 2))].reshape(-1, len(self.knobs))
        size = np.abs(columns).max(axis=0, initial=0.0)
        out = []
        for p, mine in zip(self.parameters, size, strict=True):
            alike = max(
                (s for other, s in zip(self.parameters, size, strict=True) if other.unit == p.unit), default=0.0
            )
            unseen = len(columns) > 0 and mine < max(_UNSEEN * alike, _ROUNDING)
            out.append(replace(p, free=False, origin="robot file; does not reach the tool") if unseen else p)
        return out


class TreeKinematics(Kinematics):
    """Kinematics of one tree; see `Kinematics` for its methods."""

    translates = False

    def __init__(self, robot: Robot) -> None:
        """Prepare for a robot with a tool frame.

        Raises:
            InputError: It has no tool frame, or a joint of several freedoms.
            LoopClosureError: Its loops cannot be closed at home.
        """
        self.robot = robot
        self.engine = TreePose(robot)
        self._changed: tuple[Parameters, TreeNumbers] | None = None

    @property
    def equations(self) -> str:
        """Always "tree"."""
        return "tree"

    @cached_property
    def inverse_engine(self) -> TreeNewton:
        """Solver of the inverse kinematics."""
        return TreeNewton(self.engine)

    @cached_property
    def dimensions(self) -> TreeDimensions:
        """The tree with its dimensions as parameters."""
        return TreeDimensions(get_shape(self.robot))

    @property
    def geometry(self) -> Parameters:  # type: ignore[override]
        """Geometric parameters: joint placements, offsets, lengths, loop points."""
        return self.dimensions.parameters if self._changed is None else self._changed[0]

    def with_geometry(self, parameters: Parameters) -> TreeKinematics:
        """Return the tree at other dimensions; its inverse kinematics stay those of the robot file, and are refused."""
        for name in parameters.names:
            if name not in self.geometry:
                raise UnknownName("geometry parameter", name, self.geometry.names)
        changed = self.geometry.update({p.name: {"value": p.value} for p in parameters})
        moved = TreeKinematics.__new__(TreeKinematics)
        moved.__dict__.update(self.__dict__, dimensions=self.dimensions)
        moved._changed = changed, self.dimensions.numbers(changed.values)
        return moved

    def _forward(self, q: np.ndarray, start: Poses | None) -> ForwardResult:
        if self._changed is None:
            poses, code = self.engine.forward(q, start)
            return ForwardResult(poses, poses, code)
        code = np.where(np.isfinite(q).all(axis=1), OK, NOT_A_NUMBER).astype(np.int8)
        sound = code == OK
        poses = Poses(np.full((len(q), 3), np.nan), np.full((len(q), 3, 3), np.nan))
        found, closed = self.dimensions.forward(self._changed[1], q[sound])
        poses.position[sound], poses.rotation[sound] = found
        code[sound] = np.where(closed.ok, OK, OUT_OF_REACH)
        return ForwardResult(poses, poses, code)

    def full_positions(self, q: np.ndarray) -> np.ndarray:
        """Return the positions of all joints (N, nv); see `Kinematics.full_positions`."""
        q = require_positions(self.robot, q)
        if self._changed is None:
            return self.engine.full_positions(q)
        return self.dimensions.loops.close(self._changed[1], q).x.T

    def _inverse(
        self, poses: Poses, configuration: Sequence[int] | np.ndarray | None, start: np.ndarray | None, limits: bool
    ) -> InverseResult:
        if configuration is not None:
            raise InputError(
                "unsupported",
                f"{self.robot.source}: has no rods, so it has no named configurations; give a start instead",
            )
        self._require_nominal()
        return solve_tree_inverse(self.inverse_engine, poses, start, limits)

    def _solutions(self, poses: Poses) -> InverseSolutions:
        self._require_nominal()
        return find_tree_solutions(self.inverse_engine, poses)

    def _require_nominal(self) -> None:
        if self._changed is not None:
            raise InputError(
                "unsupported", f"{self.robot.source}: inverse kinematics of a tree are those of its file's dimensions"
            )

    def _twists_at_home(self) -> tuple[np.ndarray, float]:
        home = self.robot.home[None]
        J = self.jacobian(home)[0]
        speed, turn = np.linalg.norm(J[:3], axis=0), np.linalg.norm(J[3:], axis=0)
        turns = turn > _ROUNDING * np.max(turn, initial=1.0)
        levers = speed[turns] / turn[turns]
        return J, float(np.sqrt(np.mean(levers**2))) if levers.any() else 1.0

    def closure(self, q: np.ndarray, poses: Poses) -> np.ndarray:
        """Return the tool's position [m] and rotation vector [rad] by the joints, relative to these poses (N, 6)."""
        q = require_positions(self.robot, q)
        here, poses = self.forward(q).poses, self.poses_at(q, poses)
        turn = measure_turns(here.rotation, poses.rotation)
        return np.concatenate([here.position - poses.position, turn], axis=1)

    def closure_by_pose(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return `-1` (N, 6, 6)."""
        return np.repeat(-np.eye(6)[None], len(require_positions(self.robot, q)), axis=0)

    def closure_by_q(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per actuated velocity (N, 6, na)."""
        return self.jacobian(q)

    def closure_by_geometry(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per geometric parameter (N, 6, p)."""
        return self.pose_by_geometry(q)

    def jacobian(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per actuated velocity (N, 6, na); see `Kinematics.jacobian`."""
        q = require_positions(self.robot, q)
        if self._changed is not None:
            return self.dimensions.twists(self._changed[1], q, ())[1]
        out = np.full((len(q), 6, q.shape[1]), np.nan)
        for index, closed in self._closed(q):
            out[index] = self.engine.jacobian(closed)
        return out

    def pose_by_geometry(self, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per geometric parameter (N, 6, p), loops kept closed."""
        numbers = self.dimensions.numbers(self.geometry.values) if self._changed is None else self._changed[1]
        return self.dimensions.twists(numbers, require_positions(self.robot, q), self.dimensions.knobs)[0]

    def acceleration_bias(self, q: np.ndarray, v: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's acceleration (N, 6) without actuated acceleration; see `Kinematics.acceleration_bias`."""
        self._require_nominal()
        q, v = self._velocities(q, v)
        out = np.full((len(q), 6), np.nan)
        for index, closed in self._closed(q):
            out[index] = self.engine.acceleration(closed, v[index])
        return out

    def singularity(self, q: np.ndarray, poses: Poses | None = None) -> Singularity:
        """Return how near the tree is to singularities, by its loops and by its tool's Jacobian."""
        self._require_nominal()
        q = require_positions(self.robot, q)
        parallel, serial = np.full(len(q), np.nan), np.full(len(q), np.nan)
        for index, closed in self._closed(q):
            loops = self.robot.loops
            parallel[index] = measure_rank_distance(self.engine.loops.jacobian(closed.at)) if loops else 1.0
            serial[index] = measure_rank_distance(self.engine.jacobian(closed))
        return Singularity(parallel, serial)

    def _closed(self, q: np.ndarray) -> Iterator[tuple[np.ndarray, ClosedLoops]]:
        yield from self.engine.closed(q, np.flatnonzero(np.isfinite(q).all(axis=1)))
