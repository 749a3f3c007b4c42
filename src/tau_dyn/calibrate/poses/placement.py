"""Place and direction of a camera with the smallest predicted error of the calibrated robot (thesis 5.5, 5.6).

The derivatives of all poses in reach are computed once. A camera at another place measures the same numbers in other axes, with
another covariance `S_k`, of the poses that it sees whole, within angle and distance, past obstacles and robot. Its value is the
predicted error `tr(P L)` of the poses that `choose_from` takes of these, over the whole workspace: parts that it does not see
count by extrapolation, with the criterion's prior of ten scales where a direction is not seen at all. Places are spread by a
Sobol sequence, each looks at targets that face it, and the best are improved by random steps that become smaller. The thesis'
rules are here for comparison: the largest share of the workspace in view, and the largest plate in the picture with all of it in
view. Sight of several places is Jorgensen et al. 2018, simulation-based optimisation of camera placement; the criterion is
V-optimality.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pinocchio as pin
from scipy.stats import qmc

from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.poses.camera import Camera, build_camera_frame, format_camera_file
from tau_dyn.calibrate.poses.choice import choose_from, compute_min_poses, require_numbers
from tau_dyn.calibrate.poses.criteria import PRIOR, PoseExchange, build_criterion
from tau_dyn.calibrate.poses.design import PoseDesign, build_design
from tau_dyn.calibrate.poses.devices import SEEN, transform_to_base
from tau_dyn.calibrate.poses.reachable import Reachable, find_occlusions
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.kinematics import Box, Obstacle, Surroundings
from tau_dyn.kinematics.workspace import PoseRequirements, WorkspaceModel

Goal = Literal["error", "view", "plate"]
"""Quantity to be optimised: the predicted error, the share of poses in view, or the plate's size with as many poses in view."""

CLEARANCE = 0.15
"""[m] Least distance of the robot and the target from the camera's place: half a camera with its mount and lens."""
_CAMERA_M = 0.1  # [m] side of the cube that moves keep clear of
_DRAWN_POWER = 7  # binary logarithm of the places tried
_REFINED = 5  # of them are improved
_STEPS = 40  # steps of each
_SPREAD = (0.25, 0.01)
"""First and last standard deviation of a step, as a share of the ranges and of the workspace's size."""
_LOOKED_AT = 600
"""Number of poses in reach that the search uses; the final choice uses all."""
_NOISE = (1e-4, 1e-4)  # [m], [rad] of the design before a camera's covariance is known
_DIGITS = 3  # places and directions are rounded to millimetres, as a file states them and a person measures them


class CameraView(NamedTuple):
    """The part of the poses in reach that a camera sees.

    Attributes:
        seen: Number of poses in sight.
        share: Their share of all in reach.
        plate: Share of the picture that the plate fills, the median of the poses in sight; nan if no pose is in sight.
        rms: Predicted root mean square error of the tool over the workspace [m]; nan if too few poses are in sight.
    """

    seen: int
    share: float
    plate: float
    rms: float

    def to_dict(self) -> dict[str, float | int | None]:
        """Return it for a JSON result."""
        plate, rms = (None if np.isnan(value) else float(value) for value in (self.plate, self.rms))
        return {"seen": self.seen, "share": self.share, "plate_share": plate, "predicted_rms": rms}


@dataclass(frozen=True, eq=False)
class CameraPlacement:
    """Chosen place of a camera.

    Attributes:
        camera: The camera there.
        look_at: The point (3,) [m] that it looks at, None if it stays as given.
        given: View of the camera as the file has it.
        chosen: View from the chosen place.
        n: Number of poses that the predicted errors refer to.
        tried: Places and directions tried.
        turned_only: Whether the place was given and the direction alone chosen.
    """

    camera: Camera
    look_at: np.ndarray | None
    given: CameraView
    chosen: CameraView
    n: int
    tried: int
    turned_only: bool

    @property
    def stays(self) -> bool:
        """Whether the camera stays at its place, turned or not."""
        return self.turned_only or self.look_at is None

    def build_obstacle(self) -> Obstacle:
        """Return the camera as an obstacle of the robot's moves."""
        return Obstacle(
            "camera",
            Box((_CAMERA_M, _CAMERA_M, _CAMERA_M)),
            pin.SE3(self.camera.pose.rotation, self.camera.pose.translation),
        )

    def format_file(self, path: str | Path) -> str:
        """Return the camera's file (given at `path`) with the chosen place."""
        return format_camera_file(path, self.camera.pose.translation, self.look_at)

    def to_dict(self) -> dict[str, Any]:
        """Return it for a JSON result."""
        return {
            "position": self.camera.pose.translation.tolist(),
            "direction": self.camera.pose.rotation[:, 2].tolist(),
            "direction_only": self.turned_only,
            "poses": self.n,
            "tried": self.tried,
            "given": self.given.to_dict(),
            "chosen": self.chosen.to_dict(),
        }


@dataclass(frozen=True, eq=False)
class CameraSite:
    """Data that determine a camera's place.

    Attributes:
        camera: As given, with the ranges of its place.
        reach: Poses of the robot.
        around: Obstacles.
        machine: The robot, whose own solids may hide the target or meet the camera; None leaves them out.
        design: Information of all poses in reach, measured by the camera as given.
        bones: Both ends (2, K, 3) [m] of lines from joint to joint at these poses.
    """

    camera: Camera
    reach: Reachable
    around: Surroundings
    machine: WorkspaceModel | None
    design: PoseDesign
    bones: np.ndarray

    def take(self, index: np.ndarray) -> CameraSite:
        """Return the site with some of the poses (n,)."""
        reach = replace(self.reach, q=self.reach.q[index], tool=self.reach.tool.take(index))
        return replace(self, reach=reach, design=_take_poses(self.design, index))

    def find_seen(self, camera: Camera) -> tuple[np.ndarray, dict[str, int]]:
        """Return the poses in reach (n,) that a camera sees, and the reasons why others are not seen, with their number."""
        why = camera.reasons(self.reach.tool)
        left = np.flatnonzero(why == SEEN)
        tool, q = self.reach.tool.take(left), self.reach.q[left]
        why[left] = find_occlusions(camera, tool, q, self.around, self.machine)
        return np.flatnonzero(why == SEEN), dict(Counter(why[why != SEEN].tolist()))

    def build_design(self, camera: Camera, seen: np.ndarray) -> PoseDesign:
        """Return the information of the poses in sight (n,) for a camera at another place, in the given camera's axes."""
        part = _take_poses(self.design, seen)
        turn = self.camera.pose.rotation.T @ camera.pose.rotation
        m = part.noise.shape[1]
        both = np.kron(np.eye(m // 3), turn)
        return replace(part, noise=both @ camera.covariance(part.tool)[:, :m, :m] @ both.T)

    def is_free(self, place: np.ndarray) -> bool:
        """Return whether a place (3,) is free for a camera: outside obstacles, and the robot does not come near."""
        blocking = (o for o in self.around.obstacles if o.blocks == "robot")
        if any(o.distance(place[None])[0] < 0 for o in blocking):
            return False
        marks = self.camera.marks(self.reach.tool).reshape(-1, 3)
        if (
            min(
                _measure_distances(marks, marks, place).min(),
                _measure_distances(self.bones[0], self.bones[1], place).min(),
            )
            < CLEARANCE
        ):
            return False
        solids = [] if self.machine is None else self.machine.solids(self.reach.q, self.reach.tool)
        point = np.broadcast_to(place, (self.reach.n, 1, 3))
        return all(float(solid.distance(point).min()) >= CLEARANCE for solid in solids)


def build_camera_site(
    camera: Camera,
    geometry: Geometry,
    reach: Reachable,
    demands: PoseRequirements,
    *,
    workspace: np.ndarray,
    **known: Any,
) -> CameraSite:
    """Return the data that determine a camera's place.

    Args:
        camera: As given.
        geometry: Mechanism at its nominal parameters.
        reach: Poses of the robot.
        demands: Obstacles, and whether the robot's own solids count.
        workspace: Positions (M, na) where accuracy counts.
        **known: Arguments of `build_design`: fix, free, device, tool, weighted.
    """
    noise = _NOISE if camera.turned else _NOISE[:1]
    design = build_design(geometry, reach.q, noise, frames=camera.frames, workspace=workspace, **known)
    machine = reach.check.machine
    used = machine if demands.collisions else None
    return CameraSite(camera, reach, demands.surroundings, used, design, list_bones(machine, reach.q))


def _take_poses(design: PoseDesign, index: np.ndarray) -> PoseDesign:
    return replace(
        design,
        poses=design.poses.take(index),
        tool=design.tool.take(index),
        slopes=design.slopes[index],
        noise=design.noise[index],
    )


def list_bones(machine: WorkspaceModel, q: np.ndarray) -> np.ndarray:
    """Return both ends (2, K, 3) [m] of lines from joint to joint at positions (N, na).

    Robot files often draw links in meshes, which are not read. Where rods are drawn, or joints have several coordinates, the
    list holds the base's origin alone.
    """
    model = machine.robot.model
    ends = [(np.zeros(3), np.zeros(3))]
    if machine.rods is None and model.nq == model.nv:
        data = model.createData()
        for full in machine.kinematics.full_positions(q):
            pin.forwardKinematics(model, data, full)
            at = [data.oMi[j].translation.copy() for j in range(model.njoints)]
            ends += [(at[model.parents[j]], at[j]) for j in range(1, model.njoints)]
    return np.array(ends).transpose(1, 0, 2)


def _measure_distances(start: np.ndarray, end: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the distance (K,) [m] of a point (3,) from lines between points (K, 3)."""
    along = end - start
    square = np.maximum(np.sum(along**2, axis=1), 1e-12)
    share = np.clip(np.sum((point - start) * along, axis=1) / square, 0.0, 1.0)
    return np.linalg.norm(start + share[:, None] * along - point, axis=1)


def predict_rms(design: PoseDesign, index: np.ndarray) -> float:
    """Return the predicted error [m] over the workspace of a fit to some of the candidates, with the criterion's prior."""
    p = design.covariance(index, prior=PRIOR)
    return float(
        np.sqrt(np.einsum("nir,rs,nis->", design.places, p, design.places, optimize=True) / len(design.places))
    )


def compute_plate_share(camera: Camera, seen: np.ndarray, site: CameraSite) -> float:
    """Return the share of the picture that the plate's outline fills, the median over poses in sight (n,)."""
    at = camera.frames.measured(site.reach.tool.take(seen), np.zeros(len(seen), int))
    corners = at.position[:, None] + np.einsum("nij,kj->nki", at.rotation, camera.pattern.outline[[0, 1, 3, 2]])
    u, v = np.moveaxis(camera.project(corners), -1, 0)
    area = 0.5 * np.abs(np.sum(u * np.roll(v, -1, axis=1) - v * np.roll(u, -1, axis=1), axis=1))
    return float(np.median(area)) / (camera.image[0] * camera.image[1]) if len(seen) else float("nan")


def place_camera(
    site: CameraSite,
    n: int | Literal["auto"] = "auto",
    *,
    goal: Goal = "error",
    criterion: str = "tool",
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> CameraPlacement:
    """Choose a camera's place within its ranges, and its direction.

    Args:
        site: Camera, poses, obstacles.
        n: Number of poses that will be measured; with `auto`, places are compared with three times the fewest.
        goal: Quantity to be optimised.
        criterion: Criterion by which poses are chosen, as in `choose_poses`.
        seed: Seed of the search.
        progress: Called with a description of each step.

    Raises:
        InputError: Neither place nor direction of the camera is to be chosen, or too few poses are asked for.
        CannotAnswer: No place sees enough poses; the message names the most frequent reason.
    """
    if site.camera.places is None:
        raise InputError(
            "missing_input", "no property of the camera is to be chosen; state it with `choose` in its file"
        )
    require_numbers(site.design, n)
    least = compute_min_poses(site.design)
    count = 3 * least if n == "auto" else n
    rng = np.random.default_rng(seed)
    few = site.take(np.sort(rng.choice(site.reach.n, min(_LOOKED_AT, site.reach.n), replace=False)))
    search = _Search(few, min(2 * least, count), goal, rng)
    found = search.run(progress)
    progress("comparing places")
    given = _judge(site, site.camera, count, criterion)
    found = [stand for stand in found if search.fixed or site.is_free(stand[0])]
    views = [_judge(site, _stand(site.camera, *stand), count, criterion) for stand in found]
    enough = [k for k, view in enumerate(views) if view.seen >= count]
    as_given = goal == "error" and given.seen >= count and search.holds(site.camera.pose.translation)
    if not enough and not as_given:
        raise _build_refusal(search, max([given, *views], key=lambda view: view.seen), count)
    best = max(enough, key=lambda k: _rank(views[k], goal)) if enough else -1
    if as_given and (best < 0 or _rank(views[best], goal) <= _rank(given, goal)):
        camera, view, look_at = site.camera, given, None
    else:
        camera, view, look_at = _stand(site.camera, *found[best]), views[best], found[best][1]
    return CameraPlacement(replace(camera, places=None), look_at, given, view, count, search.tried, search.fixed)


def _stand(camera: Camera, place: np.ndarray, look_at: np.ndarray) -> Camera:
    """Return a camera placed at a point and directed at another."""
    return replace(camera, pose=build_camera_frame(place, look_at, np.array(camera.up)))


def _rank(view: CameraView, goal: Goal) -> float:
    """Return how good a view is; larger is better."""
    if goal == "error":
        return -view.rms if np.isfinite(view.rms) else -np.inf
    if goal == "view" or not view.seen:
        return view.share
    return round(view.share, 2) + 0.01 * view.plate  # with as many poses in view, the larger plate


def _judge(site: CameraSite, camera: Camera, n: int, criterion: str) -> CameraView:
    """Return a camera's view, with the predicted error of `n` of the poses in sight if there are so many."""
    seen, _ = site.find_seen(camera)
    rms = float("nan")
    if len(seen) >= n:
        design = site.build_design(camera, seen)
        rms = predict_rms(design, choose_from(design, n, criterion=criterion).index)
    return CameraView(len(seen), len(seen) / site.reach.n, compute_plate_share(camera, seen, site), rms)


def _judge_quickly(site: CameraSite, camera: Camera, n: int, goal: Goal) -> tuple[CameraView, dict[str, int]]:
    """Return the same with up to `n` poses picked one after the other, and why other poses are not seen."""
    seen, reasons = site.find_seen(camera)
    rms = float("nan")
    if len(seen) and goal == "error":
        design = site.build_design(camera, seen)
        picks = PoseExchange(design.whitened(), build_criterion("tool", design)).pick()
        rms = predict_rms(design, np.array([k for k, _ in zip(picks, range(n), strict=False)]))
    plate = compute_plate_share(camera, seen, site)
    return CameraView(len(seen), len(seen) / site.reach.n, plate, rms), reasons


class _Search:
    """Places and directions tried at a site, each rounded as a file states it.

    Args:
        site: Camera, and the poses that are looked at.
        n: Number of poses that a predicted error refers to.
        goal: Quantity to be optimised.
        rng: Random generator of the places.
    """

    def __init__(self, site: CameraSite, n: int, goal: Goal, rng: np.random.Generator) -> None:
        """Keep the ranges and the targets."""
        assert site.camera.places is not None
        self.site, self.n, self.rng = site, n, rng
        self.goal: Goal = goal
        self.low, self.high = site.camera.places.T
        self.target = transform_to_base(site.camera.frames, site.reach.tool)
        self.size = np.ptp(self.target.position, axis=0)
        self.fixed = bool((self.low == self.high).all())
        self.tried, self.reasons = 0, Counter[str]()

    def run(self, progress: Callable[[str], None]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the best places and points looked at (3,), (3,), the improved ones."""
        progress("trying places of the camera")
        stands = sorted(((self.value(*s), k, s) for k, s in enumerate(self.draw())), key=lambda row: -row[0])
        found = []
        good = [row for row in stands[:_REFINED] if np.isfinite(row[0])]
        for k, (value, _, stand) in enumerate(good, start=1):
            progress(f"improving place {k} of {len(good)}")
            found.append(self.improve(value, stand))
        return found

    def draw(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield places spread over the ranges; half look at the middle of the targets that face them, half at one target."""
        even = qmc.Sobol(3, scramble=False).random_base2(_DRAWN_POWER)
        for k, share in enumerate((even + self.rng.random(3)) % 1.0):  # Cranley & Patterson 1976
            place = self.round(self.low + share * (self.high - self.low))
            facing = self.target.position[self.facing(place)]
            facing = facing if len(facing) else self.target.position
            look_at = facing.mean(axis=0) if k % 2 == 0 else facing[self.rng.integers(len(facing))]
            yield place, np.round(look_at, _DIGITS)

    def facing(self, place: np.ndarray) -> np.ndarray:
        """Return which targets (N,) face a place within the camera's angle and distances."""
        camera, line = self.site.camera, place - self.target.position
        away = np.linalg.norm(line, axis=1)
        cosine = np.einsum("ni,ni->n", self.target.rotation[:, :, 2], line) / np.maximum(away, 1e-9)
        return (cosine > np.cos(camera.incidence)) & (away > camera.distance[0]) & (away < camera.distance[1])

    def round(self, place: np.ndarray) -> np.ndarray:
        """Return a place in mm, or at the ranges' ends where these are finer."""
        return np.clip(np.round(place, _DIGITS), self.low, self.high)

    def holds(self, place: np.ndarray) -> bool:
        """Return whether a place is within the ranges."""
        return bool(((place >= self.low) & (place <= self.high)).all())

    def improve(self, value: float, stand: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return a place and a point looked at after random steps, each kept if it is better."""
        for step in np.geomspace(*_SPREAD, _STEPS):
            place = self.round(stand[0] + step * (self.high - self.low) * self.rng.standard_normal(3))
            look_at = np.round(stand[1] + step * self.size * self.rng.standard_normal(3), _DIGITS)
            trial = self.value(place, look_at)
            if trial > value:
                value, stand = trial, (place, look_at)
        return stand

    def value(self, place: np.ndarray, look_at: np.ndarray) -> float:
        """Return how good a place and a direction are, minus infinity if a camera cannot be placed so."""
        self.tried += 1
        if not self.is_free(place):
            self.reasons["in an obstacle or in the robot's way"] += self.site.reach.n
            return -np.inf
        try:
            camera = _stand(self.site.camera, place, look_at)
        except InputError:  # it would look along `up`
            return -np.inf
        view, reasons = _judge_quickly(self.site, camera, self.n, self.goal)
        self.reasons.update(reasons)
        return _rank(view, self.goal)

    def is_free(self, place: np.ndarray) -> bool:
        """Return whether a place is free for the camera; its given place counts as free if the place is fixed."""
        return self.fixed or self.site.is_free(place)


def _build_refusal(search: _Search, best: CameraView, n: int) -> CannotAnswer:
    """Return why no place is good enough."""
    why = f" (mostly: {search.reasons.most_common(1)[0][0]})" if search.reasons else ""
    what = "direction" if search.fixed else "place and direction"
    seen = (
        f"none of the {search.site.reach.n} poses"
        if not best.seen
        else f"{best.seen} poses at most, not the {n} needed,"
    )
    return CannotAnswer(
        "not_visible",
        f"the camera sees {seen} from any {what} of the {search.tried} tried{why}",
        "wider ranges of its place, a wider lens, or a pattern on another side of the tool",
    )
