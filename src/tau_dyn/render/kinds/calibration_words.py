"""A calibration, and the plan of one, in sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf, isnan
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.calibrate import Calibration, CandidateModel
from tau_dyn.calibrate.poses import CalibrationCampaign, CameraPlacement, compute_doubling_gain, compute_min_poses
from tau_dyn.render.presentation import BADGES
from tau_dyn.results import Level, Verdict, count, format_list, format_number, format_quantity, format_with_uncertainty

NAMES = {
    "frames": "robot file",
    "ideal": "parallel guideways",
    "nonparallel": "guideways not parallel",
    "complete": "every rod and joint",
    "paths": "a path for every rod",
}
"""Names of structures."""

ADDED = {
    "periodic": "cyclic error",
    "periodic2": "second cyclic error",
    "piecewise": "straightness error",
    "compliant": "cart and drive compliance",
    "backlash": "backlash",
    "coupling": "joint coupling",
    "gravity": "gravity deflection",
    "elastic": "drive compliance",
    "eccentric": "joint eccentricity",
    "delay": "joints read earlier or later than the tool",
    "tool_frame": "the target moved between campaigns",
    "base_frame": "the base moved between campaigns",
}
"""Names of additions."""

MEASURED_KINDS = {
    "pose": "position",
    "hand_eye": "pose, by a camera on the tool",
    "distance": "distance from a point",
    "hole": "pin in a hole",
    "plane": "plane touched",
    "sphere": "ball touched",
    "angle": "angle of a passive joint",
    "travel": "travel of a passive joint",
}
"""Names of the quantities that devices and fixtures measure."""

_EXPLAINED = 1.5
"""Times the predicted error above which the model lacks an effect."""


def format_length(value: float) -> str:
    """Return a small length, such as `17.4 µm`."""
    return format_quantity(value, "m")


def format_angle(value: float) -> str:
    """Return a small angle in mrad or µrad."""
    return format_quantity(value, "rad")


def format_p_value(p: float) -> str:
    """Return a p-value with two digits."""
    return "< 0.001" if p < 1e-3 else format_number(p, 2)


def describe_headline(found: Calibration) -> str:
    """Return the headline."""
    before, after = found.errors(found.models[0]).position_size, found.errors(found.chosen).position_size
    text = f"The calibrated robot is {format_length(after.mean)} off on average"
    if found.at().of_encoders.all():
        text = f"The calibrated robot misses the encoders of its passive joints by arcs of {format_length(after.mean)} on average"
    if found.chosen is not found.models[0]:
        text += f", {format_length(before.mean)} before"
    turned = found.errors(found.chosen).orientation_size
    if turned is not None and found.fit.geometry.orients:
        start = found.errors(found.models[0]).orientation_size
        text += f"; turned by {format_angle(turned.mean)}" + (
            f", {format_angle(start.mean)} before" if start is not None else ""
        )
    return text + "."


def describe_verdict(found: Calibration) -> Verdict:
    """Return the verdict on the use of the geometry."""
    errors, expected = found.errors(found.chosen), found.predicted_error()
    reached, turned = errors.position_size.rms, errors.orientation_size
    if not found.fit.converged:
        return _judge("poor", "The fit did not converge; do not use it.")
    if found.misses_poses:
        also = "" if turned is None else f" and {format_angle(turned.rms)}"
        return _judge(
            "poor",
            f"Do not use it: the held-out RMS error is {format_length(reached)}{also}, while the poses spread over "
            f"{format_length(found.poses.spread)}. Check units, joint columns, and whether frames were moved.",
        )
    if len(found.models) == 1 and found.chosen.name == "frames":
        return _judge(
            "care",
            f"Held-out RMS error {format_length(reached)} of the robot file as it is; no larger model was fitted.",
        )
    if found.chosen is found.models[0]:
        return _judge("care", "No larger model has a smaller held-out error than the robot file.")
    if expected is None:
        return _judge(
            "care",
            f"Held-out RMS error {format_length(reached)}. The measurement noise is not known, so neither is whether the model "
            f"lacks an effect: give --accuracy, columns x_tool_stderr .., or measure some poses several times, or several "
            "targets at each.",
        )
    noise, angle = found.measured.orientation, found.errors(found.chosen).orientation_size
    if noise is not None and angle is not None and angle.rms > _EXPLAINED * np.sqrt(3) * noise:
        return _judge(
            "care",
            f"Held-out RMS orientation error {format_angle(angle.rms)}, expected from noise "
            f"{format_angle(np.sqrt(3) * noise)}: the model lacks an effect.",
        )
    if reached > _EXPLAINED * expected:
        return _judge(
            "care",
            f"Held-out RMS error {format_length(reached)}, expected from noise {format_length(expected)}: the model "
            "lacks an effect.",
        )
    return _judge(
        "good", f"Held-out RMS error {format_length(reached)}, as expected from noise ({format_length(expected)})."
    )


def _judge(level: Level, sentence: str) -> Verdict:
    return Verdict(level, sentence, BADGES[level])


def describe_inputs(found: Calibration) -> str:
    """Return a summary of the inputs."""
    what = "position and orientation" if found.poses.rotation is not None else "position"
    judged = {
        "given": f"evaluated on {count(_n(found), 'held-out pose')}",
        "split": f"evaluated on {count(_n(found), 'pose')} held out at random",
        "cross-validated": "evaluated by cross-validation (too few poses to hold out)",
    }[found.split]
    residual = found.fit.noise
    seen = (
        f"; residual {format_length(residual[0])} a coordinate"
        + (f" and {format_angle(residual[1])}" if len(residual) > 1 else "")
        if found.fit.kind == "forward"
        else ""
    )
    return f"{count(found.poses.n, 'pose')}, {what}, {judged}; model {found.chosen.name}{seen}."


def describe_model(model: CandidateModel, before: CandidateModel | None) -> tuple[str, str]:
    """Return a step's name, and its additions in words."""
    if before is None:
        return NAMES[model.spec.structure], "device and target placed"
    if model.spec.structure != before.spec.structure:
        return NAMES[model.spec.structure], f"{count(model.fit.n_estimated, 'parameter')}"
    added = [
        (a, [j for j in own if j not in before.spec.additions.get(a, ())]) for a, own in model.spec.additions.items()
    ]
    said = [f"{ADDED[a]}" + (f" {format_list(j)}" if j and j != ["all"] else "") for a, j in added if j]
    return f"+ {format_list(said)}", f"{count(model.fit.n_estimated, 'parameter')}"


def _n(found: Calibration) -> int:
    return 0 if found.holdout is None else found.holdout.n


def describe_plan(plan: CalibrationCampaign) -> str:
    """Return the answer in one sentence."""
    made = plan.choice.predicted
    turned = "" if isnan(made.turn) else f" and {format_angle(made.turn)}"
    return (
        f"{made.poses} poses: predicted RMS error {format_length(made.rms)}{turned} over the workspace, standard "
        f"deviation {format_length(made.scatter)}; as many random poses {format_length(plan.choice.at_random)}"
    )


def describe_plan_inputs(plan: CalibrationCampaign) -> str:
    """Return a summary of the plan's inputs."""
    rank, least = plan.choice.design.found.rank, compute_min_poses(plan.choice.design)
    known = f"{rank} identifiable parameters, at least {least} poses"
    if not plan.choice.design.poses.shows_frames:
        rows = [f"{row['name']} {row['chosen']} of {row['candidates']}" for row in plan.count_by_device()]
        return f"poses of {format_list(rows)} candidates; {known}"
    seen = f"{len(plan.visible.index)} of {plan.reachable.n} poses in reach are seen by the {plan.device.name}"
    if "hand_eye" in plan.choice.design.poses.kinds:
        seen = f"{plan.reachable.n} poses in reach, turned to the pattern, give {len(plan.visible.index)} that show it"
    why = f" (mostly not: {next(iter(plan.visible.reasons))})" if plan.visible.reasons else ""
    return f"{seen}{why}; {known}"


def describe_placement(found: CameraPlacement) -> str:
    """Return sentences about the camera's planned pose, its view from there, and its view from the given pose."""
    place, given = found.camera.pose.translation, found.given
    towards = "direction as given"
    if found.look_at is not None:
        towards = f"looking at {_format_point(found.look_at)} m"
    before = f"as given {given.seen} in view"
    if given.seen:
        before += f", plate {100 * given.plate:.2g} %"
    before += ", too few to calibrate" if isnan(given.rms) else f", {format_length(given.rms)}"
    return (
        f"camera at {_format_point(place)} m, {towards}: {found.chosen.seen} poses in view "
        f"({100 * found.chosen.share:.0f} %), plate {100 * found.chosen.plate:.2g} % of the picture, predicted RMS error "
        f"{format_length(found.chosen.rms)} with {found.n} poses; {before}"
    )


def _format_point(point: np.ndarray) -> str:
    return f"({', '.join(f'{x:.3f}' for x in point)})"


def describe_rehearsal(plan: CalibrationCampaign) -> str:
    """Return sentences about the results of simulated calibrations, and about the tour."""
    tried, tour = plan.rehearsal, plan.tour
    rows = tried.to_dict()["position_rms"]
    ways = int((tour.pose < 0).sum())
    return (
        f"simulated: {format_length(rows['nominal'])} before, {format_length(tried.achieved)} after "
        f"({len(tried.after)} robots); twice as many poses would lower held-out errors by "
        f"{100 * compute_doubling_gain(plan.choice.predicted):.0f} %; tour of "
        f"{len(tour.q)} places" + (f", {ways} of them on the way" if ways else "")
    )


class DriveStiffness(NamedTuple):
    """Stiffness of a drive, the inverse of its compliance.

    Attributes:
        joint: The drive's joint.
        stiffness: [N/m or N m/rad].
        stderr: Standard error, to first order.
        ci95: 95 % interval, that of the compliance inverted; its upper end is infinite if the compliance may be zero.
        unit: Unit of the stiffness.
        compliance: Compliance with its standard error and unit, in words.
    """

    joint: str
    stiffness: float
    stderr: float
    ci95: tuple[float, float]
    unit: str
    compliance: str


def list_stiffness(rows: Sequence[Mapping[str, Any]]) -> list[DriveStiffness]:
    """Return the stiffness of each drive whose compliance is above zero, from the rows of a fit's parameters."""
    found = []
    for row in rows:
        joint, _, what = str(row["name"]).rpartition(".")
        c, stderr, ci95 = row["value"], row["stderr"], row["ci95"]
        if what == "drive_compliance" and c > 0 and stderr and ci95:
            low, high = ci95
            length, _, force = str(row["unit"]).partition("/")
            said = format_with_uncertainty(c, stderr, str(row["unit"]))
            interval = (1 / high, 1 / low if low > 0 else inf)
            found.append(DriveStiffness(joint, 1 / c, stderr / c**2, interval, f"{force.strip('()')}/{length}", said))
    return found
