"""From a robot file and a measuring device to a campaign that is ready to run (thesis 5.6, Figure 5.21).

workspace -> safety distances, obstacles -> what the device sees -> choice of poses -> simulated calibration -> tour
-> files
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.measured import PoseSet
from tau_dyn.calibrate.models import get_family
from tau_dyn.calibrate.poses.camera import Camera
from tau_dyn.calibrate.poses.campaign_files import (
    CampaignProgress,
    build_new_progress,
    format_rapid_module,
    format_tour_csv,
)
from tau_dyn.calibrate.poses.choice import PoseChoice, choose_from, predict
from tau_dyn.calibrate.poses.design import build_design
from tau_dyn.calibrate.poses.devices import MeasuringDevice, UniformDevice
from tau_dyn.calibrate.poses.monte_carlo import MonteCarloCalibration, require_accuracy, simulate_calibrations
from tau_dyn.calibrate.poses.reachable import WANTED, Reachable, Safety, Visible, find_reachable, find_visible
from tau_dyn.calibrate.poses.tour import PathCheck, Tour, plan_tour
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.kinematics.workspace import PoseRequirements, build_machine
from tau_dyn.mechanism import Poses
from tau_dyn.robot import Robot

_NOISE = (1e-4, 1e-4)
_MAX_ERROR_RATIO = 0.8
"""Share of the predicted error below which another way to fit is worth a sentence."""
_PLACES = 400
"""Places of the workspace at which accuracy is judged."""


@dataclass(frozen=True, eq=False)
class CalibrationCampaign:
    """A campaign ready to run.

    Attributes:
        robot: The robot.
        device: What measures.
        reachable: Where the robot may be.
        visible: What of it the device sees.
        choice: The chosen poses and what they will give.
        rehearsal: Simulated calibrations with them.
        tour: Their order, and places on the way.
        check: Judges positions and moves.
        warnings: Sentences.
    """

    robot: Robot
    device: MeasuringDevice
    reachable: Reachable
    visible: Visible
    choice: PoseChoice
    rehearsal: MonteCarloCalibration
    tour: Tour
    check: PathCheck
    warnings: tuple[str, ...]

    def progress(self) -> CampaignProgress:
        """Return the plan as a progress file of which nothing is done."""
        return build_new_progress(self.robot.actuated, self.tour.q, self.tour.pose)

    def tool(self, q: np.ndarray) -> Poses:
        """Return where the nominal robot's tool is at positions (k, na)."""
        return self.check.poses(q)[0]

    def csv(self) -> str:
        """Return the tour as CSV."""
        return format_tour_csv(self.tour.q, self.tour.pose, self.robot.actuated)

    def rapid(self) -> str:
        """Return the tour as a RAPID module."""
        robot = self.robot
        return format_rapid_module(
            self.tour.q, self.tour.pose, self.tool(self.tour.q), robot.joint_kinds, actuated=robot.actuated
        )

    def to_dict(self) -> dict[str, Any]:
        """Return it for a JSON result."""
        return {
            "device": self.device.name,
            "reachable": self.reachable.n,
            "visible": len(self.visible.index),
            "not_visible": self.visible.reasons,
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
                {"pose": int(p) + 1, **{f"q_{j}": float(x) for j, x in zip(self.robot.actuated, row, strict=True)}}
                for p, row in zip(self.tour.pose, self.tour.q, strict=True)
            ],
        }


def plan_campaign(
    robot: Robot,
    device: MeasuringDevice | None = None,
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
        device: Camera or tracker; by default one that sees everything with 0.1 mm and 0.1 mrad of noise.
        n: Number of poses, or `auto`.
        model: What is to be calibrated, as `calibrate` names it; by default all dimensions.
        criterion: As in `choose_poses`.
        demands: Obstacles, limits, collisions.
        safety: Margins on top.
        required: Accuracy asked for, root mean square over the workspace [m].
        known: Frames that are known: `device`, `tool`.
        weighted: Whether the fit will weigh every pose by the device's covariance there (`refine`) instead of all
            alike.
        fix: Names or patterns of parameters that stay.
        free: Names or patterns freed on top.
        candidates: About how many poses to choose from.
        runs: Simulated calibrations.
        seed: Of everything random.
        progress: Told what is being done.

    Raises:
        InputError: Something given is at fault.
        CannotAnswer: No pose can be reached or seen, or the calibration would not be accurate enough; says what would
            help.
    """
    demands = demands if demands is not None else PoseRequirements()
    machine = build_machine(robot)
    geometry = build_geometry(robot, model)
    device = _device_for(geometry, device)
    reach = find_reachable(machine, demands, safety, wanted=candidates, seed=seed, progress=progress)
    reach = _predictable(reach, geometry)
    progress("looking for poses in sight")
    visible = find_visible(device, reach, demands.surroundings, machine if demands.collisions else None)
    progress("choosing poses")
    index = visible.index
    noise = device.covariance(reach.tool.take(index))
    design = build_design(
        geometry,
        reach.q[index],
        noise if device.turned else noise[:, :3, :3],
        frames=device.frames,
        workspace=_thinned(reach.q, seed),
        fix=fix,
        free=free,
        device="device" not in known,
        tool="tool" not in known,
        weighted=weighted,
    )
    choice = choose_from(design, n, criterion=criterion, target=required, seed=seed)
    said = _weighing(choice)
    rehearsal = simulate_calibrations(
        choice, device, runs=runs, seed=seed, fix=fix, free=free, known=known, progress=progress
    )
    require_accuracy(choice, rehearsal, required)
    progress("ordering poses")
    tour = _tour(choice, robot, reach)
    warnings = (*reach.warnings, *choice.warnings, *said, *_left_out(tour))
    return CalibrationCampaign(robot, device, reach, visible, choice, rehearsal, tour, reach.check, warnings)


def build_geometry(robot: Robot, model: str | None = None) -> Geometry:
    """Return what is to be calibrated of a robot: a named model, or all its dimensions.

    Raises:
        UnknownName: No such model.
    """
    home = PoseSet(robot.home[None], np.zeros((1, 3)))
    family = get_family(robot, home)
    largest = "complete" if "complete" in family.structures else family.structures[-1]
    return family.build(family.spec(model if model is not None else largest))


def _device_for(geometry: Geometry, device: MeasuringDevice | None) -> MeasuringDevice:
    """Return the device given, or one that sees everything; a camera that sees one orientation alone is told so."""
    if device is None:
        return UniformDevice(_NOISE if geometry.orients else _NOISE[:1])
    if isinstance(device, Camera) and not geometry.orients:
        return replace(device, steady=True)  # all pictures show one orientation
    return device


def _tour(choice: PoseChoice, robot: Robot, reach: Reachable) -> Tour:
    """Return the chosen poses in order.

    Raises:
        CannotAnswer: No free move leads from home to any of them.
    """
    tour = plan_tour(choice.q, robot.home, reach.check, reach.q)
    if not (tour.pose >= 0).any():
        raise CannotAnswer(
            "no_solution",
            f"no move from home to any of the chosen poses is free ({next(iter(tour.left_out.values()), 'blocked')})",
            "fewer obstacles around home",
        )
    return tour


def _predictable(reach: Reachable, geometry: Geometry) -> Reachable:
    """Return the poses that the geometry finds as well: it starts from the nominal robot's home and may lose some."""
    found = geometry.forward(geometry.parameters.values, reach.q)
    away = np.linalg.norm(np.where(found.ok[:, None], found.poses.position, np.inf) - reach.tool.position, axis=1)
    good = np.flatnonzero(found.ok & (away < 1e-6))
    if not len(good):
        raise CannotAnswer(
            "no_solution",
            "the model to be calibrated reaches none of the poses",
            "another model, or a robot file that agrees with it",
        )
    return Reachable(reach.q[good], reach.tool.take(good), reach.check, reach.warnings)


def _thinned(q: np.ndarray, seed: int) -> np.ndarray:
    if len(q) <= _PLACES:
        return q
    return q[np.sort(np.random.default_rng(seed).choice(len(q), _PLACES, replace=False))]


def _weighing(choice: PoseChoice) -> tuple[str, ...]:
    """Return what weighing poses by the device's covariance would bring, where it is worth a sentence."""
    if choice.design.weighted:
        return ()
    better = predict(replace(choice.design, weighted=True), choice.index).rms
    if better > _MAX_ERROR_RATIO * choice.predicted.rms:
        return ()
    return (
        f"the device measures unevenly: a fit that weighs poses by its covariance (`--weighted`, `refine`) would bring "
        f"{1e3 * better:.3g} mm instead of {1e3 * choice.predicted.rms:.3g} mm",
    )


def _left_out(tour: Tour) -> tuple[str, ...]:
    if not tour.left_out:
        return ()
    named = ", ".join(f"{k + 1} ({why})" for k, why in list(tour.left_out.items())[:5])
    return (f"no free move leads to {len(tour.left_out)} of the chosen poses, which are left out: {named}",)
