"""Result of `tau-dyn accuracy`: a map or a list of poses, by every method, and the poses where the simple bounds fail."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.accuracy.device import Device
from tau_dyn.kinematics.accuracy.error_bounds import ErrorBounds
from tau_dyn.kinematics.accuracy.section import Grid
from tau_dyn.kinematics.accuracy.shells import compute_half_edges
from tau_dyn.kinematics.accuracy.study import (
    METHODS,
    Accuracy,
    Growth,
    build_device,
    compute_positioning_errors,
    scale_errors,
)
from tau_dyn.kinematics.accuracy.worst_case import draw
from tau_dyn.kinematics.assumptions import Guideway, Orientation, Parallelism
from tau_dyn.mechanism import Kinematics, Poses, get_robot
from tau_dyn.results import Shown, to_plain
from tau_dyn.robot import Robot

CLOUD = 600
"""Random errors drawn for the picture of the error body."""


@dataclass(frozen=True, eq=False)
class Body:
    """Possible positions of the tool at one pose.

    Attributes:
        pose: Number of the pose.
        cloud: Displacements by random errors (K, 3) [m].
        corners: Corners of the first-order body of rods with independent errors (8, 3) [m]; empty for other robots.
        worst: The exact worst displacement (3,) [m]; its opposite is nearly as bad.
    """

    pose: int
    cloud: np.ndarray
    corners: np.ndarray
    worst: np.ndarray


@dataclass(frozen=True, eq=False)
class Measured:
    """Checks of the modelling assumptions on measured points (thesis 4.2)."""

    guideways: list[Guideway] = field(default_factory=list)
    parallel: list[Parallelism] = field(default_factory=list)
    loads: list[dict[str, Any]] = field(default_factory=list)
    orientation: Orientation | None = None

    @property
    def sentences(self) -> list[str]:
        """All verdicts."""
        said = [
            *(g.sentence for g in self.guideways),
            *(p.sentence for p in self.parallel),
            *(x["sentence"] for x in self.loads),
        ]
        return [*said, self.orientation.sentence] if self.orientation is not None else said

    def to_dict(self) -> dict[str, Any]:
        """Return its content in a result file."""
        checks = {"guideways": self.guideways, "parallelism": self.parallel, "loads": self.loads}
        return to_plain({**checks, "orientation": self.orientation})


class MethodSummary(NamedTuple):
    """One method over all poses: sizes in metres, the worst pose's number, poses without an answer."""

    least: float
    median: float
    most: float
    worst_pose: int
    unanswered: int


@dataclass(frozen=True, eq=False)
class AccuracyResult(Shown):
    """Complete result of `tau-dyn accuracy`.

    Attributes:
        robot: The robot.
        accuracy: Errors at all poses; None if only measurements were checked.
        grid: The section's grid; None for a list of poses.
        growth: Enlarged errors at the worst pose; None without `exact`.
        bodies: Error bodies, at the pose nearest home and at the worst pose.
        measured: Checks of measured points.
        from_measured: Whether the errors come from those measurements.
    """

    robot: Robot
    accuracy: Accuracy | None
    grid: Grid | None
    growth: Growth | None
    bodies: tuple[Body, ...]
    measured: Measured
    from_measured: bool = False

    def summary(self, method: str) -> MethodSummary:
        """Return one method over all poses."""
        assert self.accuracy is not None
        x = self.accuracy.largest[method]
        there = np.isfinite(x)
        if not there.any():
            return MethodSummary(np.nan, np.nan, np.nan, 0, len(x))
        low, middle, high = np.quantile(x[there], [0.0, 0.5, 1.0])
        return MethodSummary(float(low), float(middle), float(high), int(np.nanargmax(x)), int((~there).sum()))

    @property
    def lost(self) -> np.ndarray:
        """Poses (N,) at which some errors leave the robot without a pose on its branch."""
        a = self.accuracy
        return ~np.isfinite(a.largest["exact"]) if a is not None and "exact" in a.largest else np.zeros(0, bool)

    def to_dict(self) -> dict[str, Any]:
        """Return the part of the JSON result that belongs to the command."""
        out: dict[str, Any] = {
            "robot": self.robot.source,
            "measured": self.measured.to_dict(),
            "verdicts": self.measured.sentences,
        }
        a = self.accuracy
        if a is None:
            return out
        return out | {
            "errors": a.errors.to_dict(), "errors_from_measured": self.from_measured, "n_poses": len(a.q), "samples": a.samples,
            "section": None if self.grid is None else _section(self.grid),
            "methods": {m: self._method(m) for m in a.largest}, "left_out": a.left_out,
            "orientation": {m: {"median": float(np.nanmedian(x)), "max": float(np.nanmax(x))} for m, x in a.turned.items()},
            "linear_fails": self._fails(), "growth": None if self.growth is None else self._growth(),
            "map": self._map(),
        }  # fmt: skip

    def _method(self, method: str) -> dict[str, Any]:
        a, s = self.accuracy, self.summary(method)
        assert a is not None
        pose = {"q": a.q[s.worst_pose], "tool": a.position[s.worst_pose]}
        out = {"min": s.least, "median": s.median, "max": s.most, "worst_pose": pose, "unanswered": s.unanswered}
        if method == "montecarlo":
            out |= {"within_95_percent": {"median": float(np.nanmedian(a.usual)), "max": float(np.nanmax(a.usual))}}
        return out

    def _fails(self) -> dict[str, Any] | None:
        """Return how far the bounds are from the exact worst case, over all poses."""
        a = self.accuracy
        if a is None or "exact" not in a.largest:
            return None
        out: dict[str, Any] = {"no_pose_within_errors": int(self.lost.sum())}
        for m in a.largest:
            if m == "exact" or not np.isfinite(a.off(m)).any():
                continue
            off = a.off(m)
            worst = int(np.nanargmax(np.abs(off)))
            out[m] = {"least": float(np.nanmin(off)), "most": float(np.nanmax(off)), "median": float(np.nanmedian(off)),
                      "worst_pose": {"q": a.q[worst], "tool": a.position[worst]}}  # fmt: skip
        return out

    def _growth(self) -> dict[str, Any]:
        g = self.growth
        assert g is not None
        held = {m: {"within_1_percent": g.holds_to(m, 0.01), "within_10_percent": g.holds_to(m, 0.1)}
                for m in g.largest if m in ("linear", "parallelepiped", "ellipsoid")}  # fmt: skip
        return {"factors": g.factors, "largest": g.largest, "holds_to_factor": held}

    def _map(self) -> dict[str, Any] | None:
        if self.grid is None or self.accuracy is None:
            return None
        return {"u": self.grid.u, "v": self.grid.v} | {
            m: self.grid.on_grid(x) for m, x in self.accuracy.largest.items()
        }


def _section(grid: Grid) -> dict[str, Any]:
    axes = "xyz"
    a, b = grid.section.others
    return {"axis": axes[grid.section.axis], "value": grid.section.value, axes[a]: [grid.u[0], grid.u[-1]],
            axes[b]: [grid.v[0], grid.v[-1]], "reached_share": float(grid.ok.mean())}  # fmt: skip


def study_accuracy(
    robot: Robot | Kinematics,
    errors: ErrorBounds,
    q: np.ndarray,
    tool: Poses,
    *,
    grid: Grid | None = None,
    methods: Sequence[str] = METHODS,
    samples: int = 300,
    seed: int = 0,
    measured: Measured | None = None,
    from_measured: bool = False,
    progress: Callable[[str], None] = lambda step: None,
) -> AccuracyResult:
    """Return the tool's errors at poses, with everything that a report shows.

    Args:
        robot: The robot, or its kinematics.
        errors: Bounds of the errors.
        q: Actuated positions (N, na); those of the reached points of `grid`, if it is given.
        tool: Poses of the tool there.
        grid: Grid to which the poses belong.
        methods: Names out of `METHODS`.
        samples: Random draws per pose.
        seed: Seed of all random numbers.
        measured: Checks to include in the result.
        from_measured: Whether `errors` come from these checks.
        progress: Called with the current step.
    """
    if not len(q):
        raise InputError("missing_input", "there are no poses to look at")
    device = build_device(robot, errors)
    found = compute_positioning_errors(
        device, errors, q, tool, methods=methods, samples=samples, seed=seed, progress=progress
    )
    progress("errors enlarged, error bodies")
    size = found.largest[found.best_method]
    worst = int(np.nanargmax(size)) if np.isfinite(size).any() else 0
    home = int(np.argmin(np.linalg.norm(q - get_robot(robot).home, axis=1)))
    at = tool.take(slice(worst, worst + 1))
    compared = [m for m in found.largest if m != "montecarlo"]
    growth = scale_errors(robot, errors, q[worst], at, compared) if "exact" in compared and len(compared) > 1 else None
    bodies = tuple(_body(device, found, q, tool, k, seed) for k in dict.fromkeys((home, worst)))
    return AccuracyResult(get_robot(robot), found, grid, growth, bodies, measured or Measured(), from_measured)


def _body(device: Device, found: Accuracy, q: np.ndarray, tool: Poses, k: int, seed: int) -> Body:
    state = device.state(q[k : k + 1], tool.take(slice(k, k + 1)))
    e = draw(device.balls, device.m, (CLOUD,), np.random.default_rng(seed))
    cloud = device.closed(state.take(np.zeros(CLOUD, int)), e).shift
    worst = np.full(3, np.nan)
    if found.worst.shape[1]:
        worst = device.closed(state, found.worst[k : k + 1]).shift[0]
    corners = np.empty((0, 3))
    if found.faces.shape[1] and device.legs is not None:
        signs = np.array([(a, b, c) for a in (1, -1) for b in (1, -1) for c in (1, -1)], float)
        corners = signs @ compute_half_edges(device.legs, state)[0].T
    return Body(k, cloud[np.isfinite(cloud).all(axis=1)], corners, worst)
