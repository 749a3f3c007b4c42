"""What is wrong with a robot's geometry, by name: each cause's share in the chosen model, measured by taking it out again.

A cause is held at nominal, everything else is fitted anew, and both models predict poses that neither has seen. What
a refit of the rest makes up for is no finding.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.calibrate.addition_tests import find_rivals
from tau_dyn.calibrate.conventions import FoundReading
from tau_dyn.calibrate.crossvalidation import (
    CrossValidationGain,
    compare_paired,
    cross_validate,
)
from tau_dyn.calibrate.geometry import ConstrainedGeometry, Geometry, constrain_parameters
from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.model_selection import CandidateModel, Options, fit_geometry, transfer_state
from tau_dyn.calibrate.models import BETWEEN_CAMPAIGNS, Family, Spec
from tau_dyn.calibrate.outliers import MovedFrame
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.effects import CONVENTIONS, GEOMETRY_CAUSES
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.parameters import Parameter, Parameters


def fix_parameters(geometry: Geometry, what: Sequence[str]) -> Geometry | None:
    """Return the geometry with the dimensions at nominal whose names have one of these beginnings after the owner's."""
    names = [p.name for p in geometry.parameters if p.free and p.name.rpartition(".")[2].startswith(tuple(what))]
    return constrain_parameters(geometry, {}, names) if names else None


def tie_guideway_directions(geometry: Geometry) -> Geometry | None:
    """Return the geometry with guideways in one direction, each drive with its own scale."""
    owners = _rails(geometry)
    if len(owners) < 2:
        return None
    along, first, second = _axes(owners[0], geometry)
    rows = [(f"{o}.scale", {o: along}) for o in owners]
    rows += [("guideways.slope_1", dict.fromkeys(owners, first)), ("guideways.slope_2", dict.fromkeys(owners, second))]
    return _recombined(geometry, owners, rows)


def fix_drive_scales(geometry: Geometry) -> Geometry | None:
    """Return the geometry with drives of nominal scale, each guideway with its own direction."""
    owners = _rails(geometry)
    if not owners:
        return None
    rows = []
    for o in owners:
        _, first, second = _axes(o, geometry)
        rows += [(f"{o}.slope_1", {o: first}), (f"{o}.slope_2", {o: second})]
    return _recombined(geometry, owners, rows)


def _rails(geometry: Geometry) -> list[str]:
    return [n.removesuffix(".direction_x") for n in geometry.parameters.names if n.endswith(".direction_x")]


def _axes(owner: str, geometry: Geometry) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    d = np.array([geometry.parameters[f"{owner}.direction_{a}"].value for a in "xyz"])
    d = d / np.linalg.norm(d)
    _, _, vt = np.linalg.svd(d[None])
    return d, vt[1], vt[2]


def _recombined(
    geometry: Geometry, owners: Sequence[str], rows: list[tuple[str, dict[str, np.ndarray]]]
) -> ConstrainedGeometry:
    """Return the geometry with its directions replaced by a few combinations of them."""
    names = geometry.parameters.names
    directions = {f"{o}.direction_{a}" for o in owners for a in "xyz"}
    kept = [k for k, n in enumerate(names) if n not in directions]
    index = {n: k for k, n in enumerate(names)}
    matrix = np.zeros((len(names), len(kept) + len(rows)))
    matrix[kept, range(len(kept))] = 1.0
    for r, (_, parts) in enumerate(rows):
        for owner, vector in parts.items():
            for a, x in zip("xyz", vector, strict=True):
                matrix[index[f"{owner}.direction_{a}"], len(kept) + r] = x
    old = list(geometry.parameters)
    parameters = Parameters([*(old[k] for k in kept), *(Parameter(n, 0.0, "1") for n, _ in rows)])
    last = int(geometry.priority.max(initial=0))
    return ConstrainedGeometry(
        geometry, parameters, matrix, np.concatenate([geometry.priority[kept], np.full(len(rows), last, int)])
    )


_LEVEL = 0.05  # significance at which held-out poses agree with a cause that cross-validation found at 1 %
_OF_ADDITION = {
    "periodic": "transmission_error",
    "periodic2": "transmission_error",
    "piecewise": "guideway_not_straight",
    "compliant": "guideway_compliance",
    "backlash": "backlash",
    "coupling": "joint_coupling",
    "gravity": "gravity_deflection",
    "eccentric": "joint_eccentricity",
    "tool_frame": "tool_frame",
    "base_frame": "base_frame",
}
_PATTERNS = {
    "rod_length": ("length", "rods_length"),
    "joint_placement": ("origin_", "base_", "plate_", "turn_"),
    "guideway_nonparallel": ("direction_",),
    "pinion_scale": ("direction_",),
    "cart_tilt": ("drift_",),
    "transmission_error": ("error",),
    "guideway_not_straight": ("bend_",),
    "guideway_compliance": ("_compliance",),
    "backlash": ("backlash",),
    "gravity_deflection": ("gravity_compliance", "load_deflection"),
    "joint_eccentricity": ("eccentricity_",),
}


_OF_STRUCTURE: dict[str, Callable[[Geometry], Geometry | None]] = {
    "rod_length": lambda geometry: fix_parameters(geometry, _PATTERNS["rod_length"]),
    "joint_placement": lambda geometry: fix_parameters(geometry, _PATTERNS["joint_placement"]),
    "guideway_nonparallel": tie_guideway_directions,
    "pinion_scale": fix_drive_scales,
    "cart_tilt": lambda geometry: fix_parameters(geometry, _PATTERNS["cart_tilt"]),
}


@dataclass(frozen=True, eq=False)
class CalibrationFinding:
    """A cause and what it costs.

    Attributes:
        cause: The contract's name.
        joints: Where, for causes that have places.
        status: `confirmed` where the weighted error at held-out poses falls, its interval above zero; else `suspected`.
        gain: On held-out poses, or by cross-validation where there are none.
        parameters: Names of its parameters.
        equation: What it does.
        further: Parameters that are not in the chosen model.
        indistinguishable_from: Causes that such poses do not tell from it.
    """

    cause: str
    joints: tuple[str, ...]
    status: str
    gain: CrossValidationGain
    parameters: tuple[str, ...]
    equation: str
    further: tuple[Parameter, ...] = ()
    indistinguishable_from: tuple[str, ...] = ()

    def to_dict(self, fitted: GeometryFit) -> dict[str, object]:
        """Return the finding with its parameters' values."""
        values = fitted.parameters
        rows = [
            {"name": p.name, "value": p.value, "unit": p.unit, "stderr": p.stderr}
            for p in (*values, *self.further)
            if p.name in self.parameters or p in self.further
        ]
        return {
            "cause": self.cause,
            "joints": list(self.joints),
            "status": self.status,
            "p_value": self.gain.p_value,
            "parameters": rows,
            "gain": self.gain,
            "equation": self.equation,
            "indistinguishable_from": list(self.indistinguishable_from),
        }


def as_finding(moved: MovedFrame) -> CalibrationFinding:
    """Return a move before the held-out poses as a finding; suspected where device and target are not told apart."""
    cause = f"{moved.owner}_moved"
    status = "suspected" if moved.other else "confirmed"
    return CalibrationFinding(cause, (), status, moved.gain, (), GEOMETRY_CAUSES[cause], moved.move)


def as_reading_findings(found: FoundReading, seed: int) -> tuple[CalibrationFinding, ...]:
    """Return the conventions of a pose file as findings; those of a file without a stated convention are none."""
    gain, whole = found.compute_gain(seed), {change.cause for change in found.reading}
    alike = [tuple(c.cause for c in reading if c.cause) for reading in found.alike]
    others = tuple(dict.fromkeys("+".join(causes) for causes in alike if causes and set(causes) != whole))
    return tuple(
        CalibrationFinding(c.cause, c.joints, "confirmed", gain, (), GEOMETRY_CAUSES[c.cause], (), others)
        for c in found.reading
        if c.cause
    )


def find_causes(
    family: Family, chosen: CandidateModel, holdout: PoseSet | None, options: Options
) -> tuple[CalibrationFinding, ...]:
    """Return the causes in a chosen model, costliest first."""
    findings = []
    for cause, joints, geometry, spec in _leave_out_causes(family, chosen):
        try:
            smaller = _fitted(chosen, geometry, spec, options)
            by_folds = compare_paired(cross_validate(smaller, options.seed), chosen.unseen, options.seed)
        except (InputError, CannotAnswer):
            continue
        if not by_folds.is_significant:
            continue
        gain, agrees = by_folds, False
        if holdout is not None:
            gain = compare_paired(smaller.errors(holdout), chosen.fit.errors(holdout), options.seed)
            agrees = gain.p_value < _LEVEL and gain.ci95[0] > 0
        names, status = _parameters(cause, joints, chosen.fit), "confirmed" if agrees else "suspected"
        alike = _list_alike(family, cause, joints)
        if agrees:
            rivals = _list_rivals(family, chosen, cause, joints, smaller, spec)
            alike = tuple(dict.fromkeys((*alike, *(_OF_ADDITION[addition] for addition, _ in rivals))))
            status = "suspected" if any(place != "/".join(joints) for _, place in rivals) else status
        findings.append(CalibrationFinding(cause, joints, status, gain, names, GEOMETRY_CAUSES[cause], (), alike))
    return tuple(sorted(findings, key=lambda f: -f.gain.percent))


def _list_alike(family: Family, cause: str, joints: tuple[str, ...]) -> tuple[str, ...]:
    """Return causes that no pose tells from one: the weight of a joint's own link goes round with it like an eccentricity."""
    carries = cause == "joint_eccentricity" and joints[0] in family.can_have("gravity")
    return ("gravity_deflection",) if carries else ()


def _list_rivals(
    family: Family, chosen: CandidateModel, cause: str, joints: tuple[str, ...], smaller: GeometryFit, spec: Spec
) -> tuple[tuple[str, str], ...]:
    """Return additions and their places that explain these poses as well as a cause; one at its own joint leaves that named."""
    place = "/".join(joints)
    own = [a for a, places in chosen.spec.additions.items() if place in places and _OF_ADDITION[a] == cause]
    if not own or own[0] not in family.screened or smaller.kind != "forward":
        return ()
    return find_rivals(smaller, family, spec, own[0], place)


def _leave_out_causes(family: Family, chosen: CandidateModel) -> list[tuple[str, tuple[str, ...], Geometry, Spec]]:
    """Return every cause of the model with the geometry that leaves it out."""
    out: list[tuple[str, tuple[str, ...], Geometry, Spec]] = []
    if chosen.spec.structure != "frames":
        for cause, held in _OF_STRUCTURE.items():
            if cause == "guideway_nonparallel" and chosen.spec.structure == "ideal":
                continue
            geometry = held(chosen.fit.geometry)
            if geometry is not None:
                out.append((cause, (), geometry, chosen.spec))
    for addition, joints in chosen.spec.additions.items():
        for joint in joints:
            left = {a: tuple(j for j in own if (a, j) != (addition, joint)) for a, own in chosen.spec.additions.items()}
            spec = Spec(chosen.spec.structure, {a: own for a, own in left.items() if own})
            where = () if joint == "all" else tuple(re.split("/|=-|=", joint))
            out.append((_OF_ADDITION[addition], where, family.build(spec, _periods(chosen.fit)), spec))
    return out


def _periods(fitted: GeometryFit) -> dict[str, float]:
    found = {}
    for p in fitted.parameters:
        joint, _, what = p.name.partition(".")
        if what in ("error_period", "error2_period"):
            found[joint + what.removeprefix("error").removesuffix("_period")] = p.value
    return found


def _fitted(chosen: CandidateModel, geometry: Geometry, spec: Spec, options: Options) -> GeometryFit:
    names, nominal = geometry.parameters.names, geometry.parameters.values
    start = transfer_state(chosen.fit, names, nominal, chosen.fit.poses)
    if start is not None:
        frames, slack = start.frames, start.slack.copy()
        kept = [geometry.actuated.index(j) for j in spec.additions.get("backlash", ())]
        slack[np.setdiff1d(np.arange(len(slack)), kept)] = 0.0
        if "base_frame" not in spec.additions:
            frames = replace(frames, device=frames.device[:1])
        if "tool_frame" not in spec.additions:
            frames = replace(frames, tool=frames.tool[: len(chosen.fit.poses.targets)])
        start = start._replace(frames=frames, slack=slack)
    return fit_geometry(geometry, spec, chosen.fit.poses, options, start, "this model")


def _parameters(cause: str, joints: tuple[str, ...], fitted: GeometryFit) -> tuple[str, ...]:
    names = [p.name for p in fitted.parameters if p.stderr is not None]
    if cause in ("tool_frame", "base_frame"):
        owner = "tool" if cause == "tool_frame" else "device"
        return tuple(n for n in names if n.startswith(owner))
    if cause == "joint_coupling":
        return (f"{joints[0]}.coupling_{joints[1]}",)
    what = _PATTERNS[cause]
    found = [n for n in names if any(w in n.partition(".")[2] for w in what) and not n.startswith(("device", "tool"))]
    return tuple(n for n in found if not joints or n.partition(".")[0] in joints)


def suspect_laws(findings: tuple[CalibrationFinding, ...]) -> tuple[CalibrationFinding, ...]:
    """Return findings with the laws of joints and drives suspected: another law explains the poses better."""
    laws = {cause for addition, cause in _OF_ADDITION.items() if addition not in BETWEEN_CAMPAIGNS}
    return tuple(replace(f, status="suspected") if f.cause in laws else f for f in findings)


def suspect_all(findings: tuple[CalibrationFinding, ...]) -> tuple[CalibrationFinding, ...]:
    """Return findings of a model that misses its poses by far: none is confirmed but conventions and moves between files."""
    sure = ("device_moved", "target_moved", *CONVENTIONS)
    return tuple(f if f.cause in sure else replace(f, status="suspected") for f in findings)
