"""Planning of a calibration campaign from a robot file and a measuring device (thesis 5.6, Figure 5.21).

workspace -> safety distances, obstacles -> poses in sight or in touch -> choice of poses -> simulated calibration -> tour
-> files
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.measured import ENCODERS, TOUCHES, PoseSet
from tau_dyn.calibrate.models import get_family
from tau_dyn.calibrate.poses.aim import find_aimed
from tau_dyn.calibrate.poses.camera import Camera, ToolCamera
from tau_dyn.calibrate.poses.campaign_files import (
    CampaignProgress,
    build_new_progress,
    format_rapid_module,
    format_tour_csv,
)
from tau_dyn.calibrate.poses.choice import PoseChoice, choose_from, predict
from tau_dyn.calibrate.poses.design import build_design
from tau_dyn.calibrate.poses.devices import MeasuringDevice, UniformDevice
from tau_dyn.calibrate.poses.fixtures import Fixture, FixtureSet, find_touches
from tau_dyn.calibrate.poses.monte_carlo import MonteCarloCalibration, require_accuracy, simulate_calibrations
from tau_dyn.calibrate.poses.placement import CameraPlacement, build_camera_site, place_camera
from tau_dyn.calibrate.poses.reachable import (
    WANTED,
    MeasurablePoses,
    Reachable,
    Safety,
    Visible,
    find_reachable,
    find_visible,
)
from tau_dyn.calibrate.poses.tour import PathCheck, Tour, approach_poses, plan_tour
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.kinematics.workspace import PoseRequirements, build_machine
from tau_dyn.mechanism import Poses
from tau_dyn.robot import Robot

_NOISE = (1e-4, 1e-4)
_MAX_ERROR_RATIO = 0.8
"""Share of the predicted error below which another way to fit is worth a sentence."""
_MIN_CHOICE = 2.0
"""Candidates in view for each pose measured, below which a chosen camera place deserves more candidates."""
_PLACES = 400
"""Places of the workspace at which accuracy is evaluated."""


@dataclass(frozen=True, eq=False)
class CalibrationCampaign:
    """A campaign ready to run.

    Attributes:
        robot: The robot.
        device: Measuring device or fixtures.
        reachable: Poses that the robot may take.
        visible: Poses of these that the device sees, or that lead to a touch.
        choice: The chosen poses and their predicted accuracy.
        rehearsal: Simulated calibrations with them.
        tour: The order of the poses, and places on the way.
        check: Check of positions and moves.
        warnings: Sentences.
        placement: Chosen place of the camera, None if neither place nor direction was to be chosen.
    """

    robot: Robot
    device: MeasuringDevice | FixtureSet
    reachable: Reachable
    visible: Visible
    choice: PoseChoice
    rehearsal: MonteCarloCalibration
    tour: Tour
    check: PathCheck
    warnings: tuple[str, ...]
    placement: CameraPlacement | None = None

    @property
    def cells(self) -> tuple[dict[str, str], ...]:
        """Cells of a measurement file that name the device or fixture at each place of the tour; empty on the way."""
        if not isinstance(self.device, FixtureSet):
            return ()
        known = self.device.get_cells(self.choice.poses)
        return tuple(known[k] if k >= 0 else {} for k in self.tour.pose)

    def count_by_device(self) -> list[dict[str, Any]]:
        """Return the name and kind of each device or fixture, and its candidates and chosen poses."""
        every, chosen = self.choice.design.poses, self.choice.poses
        names = every.devices if isinstance(self.device, FixtureSet) else (self.device.name,)
        return [
            {
                "name": name,
                "kind": kind,
                "candidates": int((every.device == k).sum()),
                "chosen": int((chosen.device == k).sum()),
            }
            for k, (name, kind) in enumerate(zip(names, every.kinds, strict=True))
        ]

    def progress(self) -> CampaignProgress:
        """Return the plan as a progress file in which every place is open."""
        return build_new_progress(self.robot.actuated, self.tour.q, self.tour.pose, self.cells)

    def tool(self, q: np.ndarray) -> Poses:
        """Return the nominal robot's tool poses at positions (k, na)."""
        return self.check.poses(q)[0]

    def csv(self) -> str:
        """Return the tour as CSV."""
        return format_tour_csv(self.tour.q, self.tour.pose, self.robot.actuated, self.cells)

    def rapid(self) -> str:
        """Return the tour as a RAPID module."""
        robot = self.robot
        return format_rapid_module(
            self.tour.q,
            self.tour.pose,
            self.tool(self.tour.q),
            robot.joint_kinds,
            actuated=robot.actuated,
            cells=self.cells,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return it for a JSON result."""
        return {
            "device": self.device.name,
            "devices": self.count_by_device(),
            "reachable": self.reachable.n,
            "visible": len(self.visible.index),
            "not_visible": self.visible.reasons,
            **({"placement": self.placement.to_dict()} if self.placement else {}),
            **self.choice.to_dict(),
            "rehearsal": self.rehearsal.to_dict(),
            "tour": {
                "places": len(self.tour.q),
                "on_the_way": int((self.tour.pose < 0).sum()),
                "length": self.tour.length,
                "length_as_listed": self.tour.as_given,
                "left_out": [{"pose": k + 1, "why": why} for k, why in self.tour.left_out.items()],
            },
            "poses": [
                {
                    "pose": int(p) + 1,
                    **{f"q_{j}": float(x) for j, x in zip(self.robot.actuated, row, strict=True)},
                    **cells,
                }
                for p, row, cells in zip(
                    self.tour.pose, self.tour.q, self.cells or ({},) * len(self.tour.q), strict=True
                )
            ],
        }


def plan_campaign(
    robot: Robot,
    device: MeasuringDevice | FixtureSet | None = None,
    n: int | Literal["auto"] = "auto",
    *,
    model: str | None = None,
    criterion: str = "tool",
    demands: PoseRequirements | None = None,
    safety: Safety | None = None,
    required: float | None = None,
    known: Sequence[str] = (),
    weighted: bool = False,
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    candidates: int = WANTED,
    runs: int = 3,
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> CalibrationCampaign:
    """Plan a calibration: which poses, in which order, and how accurate it will be.

    Args:
        robot: The robot at its dimensions as far as they are known.
        device: Camera, tracker or fixtures; by default one that sees everything with 0.1 mm and 0.1 mrad of noise.
        n: Number of poses, or `auto`.
        model: Calibration model, as `calibrate` names it; by default all dimensions.
        criterion: As in `choose_poses`.
        demands: Obstacles, limits, collisions.
        safety: Additional margins.
        required: Required accuracy, root mean square over the workspace [m].
        known: Frames that are known: `device`, `tool`.
        weighted: Whether the fit will weigh every pose by the device's covariance there (`refine`) instead of all equally.
        fix: Names or patterns of parameters that stay.
        free: Names or patterns of parameters freed in addition.
        candidates: Approximate number of poses to choose from.
        runs: Simulated calibrations.
        seed: Seed of all random numbers.
        progress: Called with a description of each step.

    Raises:
        InputError: An argument is invalid.
        CannotAnswer: No pose can be reached or seen, or the calibration would not be accurate enough; the message names a remedy.
    """
    demands = demands if demands is not None else PoseRequirements()
    safety = safety if safety is not None else Safety()
    machine = build_machine(robot)
    device = device.find_joints(robot) if isinstance(device, FixtureSet) else device
    geometry = build_geometry(robot, model, encoders=isinstance(device, FixtureSet) and device.has_encoders)
    device = _device_for(geometry, device)
    reach = find_reachable(machine, demands, safety, wanted=candidates, seed=seed, progress=progress)
    reach = _predictable(reach, geometry)
    fitted: dict[str, Any] = {
        "workspace": _thinned(reach.q, seed),
        "fix": fix,
        "free": free,
        "device": "device" not in known,
        "tool": "tool" not in known,
        "weighted": weighted,
    }
    placement = None
    if isinstance(device, Camera) and device.places is not None:
        site = build_camera_site(device, geometry, reach, demands, **fitted)
        placement = place_camera(site, n, criterion=criterion, seed=seed, progress=progress)
        device = placement.camera
    devices: Sequence[MeasuringDevice] = device.fixtures if isinstance(device, FixtureSet) else (device,)
    fixtures = [one for one in devices if isinstance(one, Fixture)]
    touched = {fixture.obstacle for fixture in fixtures if fixture.kind in TOUCHES}
    check = PathCheck(machine, safety.apply(demands, touched)) if touched else reach.check
    if placement is not None and not placement.stays:
        around = demands.surroundings
        walls = replace(around, obstacles=(*around.obstacles, placement.build_obstacle()))
        check = PathCheck(machine, safety.apply(replace(demands, surroundings=walls)))
    parts = []
    for one in devices:
        progress(f"looking for poses that {one.name} measures")
        parts.append(_find_candidates(one, geometry, reach, check, demands, safety, seed))
    number, start = (
        np.repeat(np.arange(len(parts)), [len(p.q) for p in parts]),
        np.concatenate([p.start for p in parts]),
    )
    q = np.concatenate([p.q for p in parts])
    progress("choosing poses")
    design = build_design(
        geometry,
        device.build_pose_set(q, number)
        if isinstance(device, FixtureSet)
        else PoseSet(q, np.zeros((len(q), 3)), kinds=(device.kind,)),
        np.concatenate([p.noise for p in parts]),
        frames=device.frames,
        **fitted,
    )
    choice = choose_from(design, n, criterion=criterion, target=required, seed=seed)
    said = _weighing(choice)
    rehearsal = simulate_calibrations(
        choice, device, runs=runs, seed=seed, fix=fix, free=free, known=known, progress=progress
    )
    require_accuracy(choice, rehearsal, required)
    progress("ordering poses")
    tour = _tour(choice, start[choice.index], robot, reach, check)
    visible = Visible(np.concatenate([p.index for p in parts]), _name_reasons(fixtures, parts))
    few = _few_in_view(visible, choice) if placement is not None else ()
    warnings = (*reach.warnings, *choice.warnings, *said, *few, *_restarted(rehearsal), *_left_out(tour))
    return CalibrationCampaign(robot, device, reach, visible, choice, rehearsal, tour, check, warnings, placement)


def _find_candidates(
    device: MeasuringDevice,
    geometry: Geometry,
    reach: Reachable,
    check: PathCheck,
    demands: PoseRequirements,
    safety: Safety,
    seed: int,
) -> MeasurablePoses:
    """Return the poses that one device sees, or at which the target touches a fixture."""
    around = demands.surroundings
    if isinstance(device, Fixture):
        others = tuple(o for o in around.obstacles if o.name != device.obstacle)
        around = replace(around, obstacles=others)
        if device.kind in ENCODERS:
            every = np.arange(reach.n)
            return MeasurablePoses(reach.q, reach.q, reach.tool, device.covariance(reach.tool), every, {})
        if device.kind in TOUCHES:
            own = safety.apply(replace(demands, surroundings=around))
            return find_touches(device, geometry, reach, check, own, safety)
    machine = check.machine if demands.collisions else None
    if isinstance(device, ToolCamera):
        return find_aimed(device, geometry, reach, around, machine, safety, seed)
    visible = find_visible(device, reach, around, machine)
    q, tool = reach.q[visible.index], reach.tool.take(visible.index)
    noise = device.covariance(tool)
    return MeasurablePoses(q, q, tool, noise if device.turned else noise[:, :3, :3], visible.index, visible.reasons)


def _name_reasons(fixtures: Sequence[Fixture], parts: Sequence[MeasurablePoses]) -> dict[str, int]:
    """Return the reasons why candidates are excluded; with several fixtures each reason has the fixture's name."""
    if not fixtures:
        return parts[0].reasons
    return {
        f"{one.name}: {why}": n for one, part in zip(fixtures, parts, strict=True) for why, n in part.reasons.items()
    }


def build_geometry(robot: Robot, model: str | None = None, *, encoders: bool = False) -> Geometry:
    """Return the geometry to be calibrated: a named model, or all dimensions of the robot; with encoders a tree with loops.

    Raises:
        UnknownName: No such model.
    """
    home = PoseSet(robot.home[None], np.zeros((1, 3)), kinds=ENCODERS[:1] if encoders else ("pose",))
    family = get_family(robot, home)
    largest = "complete" if "complete" in family.structures else family.structures[-1]
    return family.build(family.spec(model if model is not None else largest))


def _device_for(geometry: Geometry, device: MeasuringDevice | FixtureSet | None) -> MeasuringDevice | FixtureSet:
    """Return the device given, or one that sees everything; a camera that sees one orientation alone is set `steady`.

    Raises:
        InputError: A camera is on a tool that does not turn.
    """
    if device is None:
        return UniformDevice(_NOISE if geometry.orients else _NOISE[:1])
    if isinstance(device, ToolCamera) and not geometry.orients:
        raise InputError(
            "unsupported",
            "a camera on the tool needs a tool that turns; mount the camera next to the robot, the pattern on the tool",
        )
    if isinstance(device, Camera) and not geometry.orients:
        return replace(device, steady=True)  # all pictures show one orientation
    return device


def _tour(choice: PoseChoice, start: np.ndarray, robot: Robot, reach: Reachable, check: PathCheck) -> Tour:
    """Return the chosen poses in order, each approached from its start (n, na) and left the same way.

    Raises:
        CannotAnswer: No free move leads from home to any of them.
    """
    tour = plan_tour(start, robot.home, check, reach.q)
    if not (tour.pose >= 0).any():
        raise CannotAnswer(
            "no_solution",
            f"no move from home to any of the chosen poses is free ({next(iter(tour.left_out.values()), 'blocked')})",
            "fewer obstacles around home",
        )
    return approach_poses(tour, choice.q, check.travel)


def _predictable(reach: Reachable, geometry: Geometry) -> Reachable:
    """Return the poses that the geometry solves as well: its solver starts from the nominal robot's home and may lose some."""
    found = geometry.forward(geometry.parameters.values, reach.q)
    away = np.linalg.norm(np.where(found.ok[:, None], found.poses.position, np.inf) - reach.tool.position, axis=1)
    good = np.flatnonzero(found.ok & (away < 1e-6))
    if not len(good):
        raise CannotAnswer(
            "no_solution",
            "the model to be calibrated reaches no pose",
            "another model, or a robot file that agrees with it",
        )
    return Reachable(reach.q[good], reach.tool.take(good), reach.check, reach.warnings)


def _thinned(q: np.ndarray, seed: int) -> np.ndarray:
    if len(q) <= _PLACES:
        return q
    return q[np.sort(np.random.default_rng(seed).choice(len(q), _PLACES, replace=False))]


def _weighing(choice: PoseChoice) -> tuple[str, ...]:
    """Return a sentence on the benefit of weighing poses by the device's covariance, if it is large enough."""
    if choice.design.weighted:
        return ()
    better = predict(replace(choice.design, weighted=True), choice.index).rms
    if better > _MAX_ERROR_RATIO * choice.predicted.rms:
        return ()
    return (
        f"the device measures unevenly: a fit that weighs poses by its covariance (`--weighted`, `refine`) would bring "
        f"{1e3 * better:.3g} mm instead of {1e3 * choice.predicted.rms:.3g} mm",
    )


def _few_in_view(visible: Visible, choice: PoseChoice) -> tuple[str, ...]:
    """Return a sentence if the camera sees so small a part of the workspace that few candidates are left."""
    if len(visible.index) > _MIN_CHOICE * choice.n:
        return ()
    return (
        f"from its chosen place the camera sees {len(visible.index)} candidates, of which {choice.n} are measured; more "
        "`--candidates` give more to choose from there",
    )


def _restarted(rehearsal: MonteCarloCalibration) -> tuple[str, ...]:
    if not rehearsal.restarted:
        return ()
    runs = len(rehearsal.after) + len(rehearsal.failures)
    return (
        f"{rehearsal.restarted} of {runs} simulated calibrations of robots that are off by 10 mm and 10 mrad took a fixture for "
        "one elsewhere until they started at its planned place; a robot file exact to a few millimetres, or a larger ball, "
        "avoids that",
    )


def _left_out(tour: Tour) -> tuple[str, ...]:
    if not tour.left_out:
        return ()
    named = ", ".join(f"{k + 1} ({why})" for k, why in list(tour.left_out.items())[:5])
    return (f"no free move leads to {len(tour.left_out)} of the chosen poses, which are left out: {named}",)
