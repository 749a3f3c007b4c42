"""Causes of geometry errors, by name: each cause's share in the chosen model, measured by leaving it out.

A cause is fixed at nominal, everything else is refitted, and both models predict poses that neither was fitted to. An
error that the refit of the other parameters compensates is not a finding.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from tau_dyn.calibrate.addition_tests import find_rivals
from tau_dyn.calibrate.conventions import FoundReading
from tau_dyn.calibrate.crossvalidation import compare_paired, cross_validate, earns_parameters
from tau_dyn.calibrate.geometry import ConstrainedGeometry, Geometry, constrain_parameters
from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.measured import PoseSet
from tau_dyn.calibrate.model_family import OF_WHOLE, Family, Spec
from tau_dyn.calibrate.model_selection import CandidateModel, Options, SelectionStep, fit_geometry, transfer_state
from tau_dyn.calibrate.outliers import MovedFrame
from tau_dyn.effects import CONVENTIONS, GEOMETRY_CAUSES, GEOMETRY_SENTENCES
from tau_dyn.evidence import Finding, Gain, explain_gain
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.results import format_estimate, format_list, format_percent, format_quantity


def fix_parameters(geometry: Geometry, what: Sequence[str]) -> Geometry | None:
    """Return the geometry with the dimensions at nominal whose names start with one of these prefixes after the owner's."""
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


_NO_HELD_OUT = "no held-out poses show it"
_ELSEWHERE = "the poses show the same at {} as well"
_BY_DIMENSIONS = "dimensions off the robot file explain the poses as well"
_NOT_APART = "the poses do not separate it from a move of the {}"
_OUTDONE = "an implausible law explains the poses better"
_MISSED_POSES = "the model misses the poses by far, or a frame moved between them"
_OF_ADDITION = {
    "periodic": "transmission_error",
    "periodic2": "transmission_error",
    "piecewise": "guideway_not_straight",
    "compliant": "guideway_compliance",
    "backlash": "backlash",
    "coupling": "joint_coupling",
    "gravity": "gravity_deflection",
    "elastic": "drive_compliance",
    "eccentric": "joint_eccentricity",
    "delay": "joint_delay",
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
    "drive_compliance": ("drive_compliance",),
    "backlash": ("backlash",),
    "gravity_deflection": ("gravity_compliance", "load_deflection"),
    "joint_eccentricity": ("eccentricity_",),
    "joint_delay": ("delay",),
}


_OF_STRUCTURE: dict[str, Callable[[Geometry], Geometry | None]] = {
    "rod_length": lambda geometry: fix_parameters(geometry, _PATTERNS["rod_length"]),
    "joint_placement": lambda geometry: fix_parameters(geometry, _PATTERNS["joint_placement"]),
    "guideway_nonparallel": tie_guideway_directions,
    "pinion_scale": fix_drive_scales,
    "cart_tilt": lambda geometry: fix_parameters(geometry, _PATTERNS["cart_tilt"]),
}


def _build_finding(
    cause: str,
    joints: tuple[str, ...],
    gain: Gain,
    n_numbers: int,
    why_not: str = "",
    parameters: tuple[Parameter, ...] = (),
    alike: tuple[str, ...] = (),
    dof: float = np.inf,
) -> Finding:
    """Return the finding of a cause by its gain in so many coordinates and angles; confirmed unless there is a reason why not."""
    return Finding(
        cause,
        joints,
        "suspected" if why_not else "confirmed",
        gain.compute_score(n_numbers),
        1.0 if gain.p_value is None else gain.p_value,
        parameters,
        gain,
        alike,
        GEOMETRY_CAUSES[cause],
        _describe(cause, joints, gain, alike, parameters),
        channel="pose",
        why_not_confirmed=why_not,
        is_shown=not why_not,
        dof=dof,
    )


def _describe(
    cause: str, joints: tuple[str, ...], gain: Gain, alike: tuple[str, ...], parameters: tuple[Parameter, ...]
) -> str:
    """Return a finding as a sentence."""
    sentence = GEOMETRY_SENTENCES[cause]
    if cause == "joint_delay" and parameters:
        (delay,) = parameters
        side = "before" if delay.value > 0 else "after"
        time = format_estimate(replace(delay, value=abs(delay.value)))
        sentence = f"The joints were read {time} {side} the tool was measured"
    where = f" ({format_list(joints)})" if joints else ""
    others = [GEOMETRY_SENTENCES[other] for other in alike if other != cause]
    named = [f"{text[0].lower()}{text[1:]}" for text in others] + ["the same elsewhere"] * (cause in alike)
    where += f", or {format_list(named)}" if named else ""
    if not np.isfinite(gain.rms_before):
        return f"{sentence}{where}: {format_quantity(gain.rms_after, 'm')} rms with it; without it the poses are out of reach."
    with_it, without = (format_quantity(x, "m") for x in (gain.rms_after, gain.rms_before))
    if gain.orientation_rms_after is not None and gain.orientation_rms_before is not None:
        with_it += f" and {format_quantity(gain.orientation_rms_after, 'rad')}"
        without += f" and {format_quantity(gain.orientation_rms_before, 'rad')}"
    word, sign = ("less", 1) if gain.reduction_percent >= 0 else ("more", -1)
    low, high = (format_percent(x) for x in sorted(sign * x for x in gain.ci95))
    share = f"{format_percent(abs(gain.reduction_percent))} {word}, 95 % interval [{low}, {high}]"
    return f"{sentence}{where}: {with_it} rms with it, {without} without ({share})."


def as_finding(moved: MovedFrame) -> Finding:
    """Return a move before the held-out poses as a finding; suspected if device and target cannot be distinguished."""
    n_numbers = int(moved.own.sum()) * (3 if moved.gain.orientation_rms_after is None else 6)
    why_not = _NOT_APART.format(moved.other) if moved.other else ""
    return _build_finding(f"{moved.owner}_moved", (), moved.gain, n_numbers, why_not, moved.move)


def as_reading_findings(found: FoundReading, seed: int) -> tuple[Finding, ...]:
    """Return the conventions of a pose file as findings; a convention that the file does not state is no finding."""
    gain, whole = found.compute_gain(seed), {change.cause for change in found.reading}
    alike = [tuple(c.cause for c in reading if c.cause) for reading in found.alike]
    others = tuple(dict.fromkeys("+".join(causes) for causes in alike if causes and set(causes) != whole))
    n_numbers = found.meant.n_numbers
    return tuple(_build_finding(c.cause, c.joints, gain, n_numbers, alike=others) for c in found.reading if c.cause)


def find_causes(
    family: Family, chosen: CandidateModel, holdout: PoseSet | None, options: Options
) -> tuple[Finding, ...]:
    """Return the causes in a chosen model, costliest first; confirmed ones lower the error at held-out poses."""
    findings = []
    for cause, joints, geometry, spec in _leave_out_causes(family, chosen):
        try:
            smaller = _fitted(chosen, geometry, spec, options)
            gain = compare_paired(cross_validate(smaller, options.seed), chosen.unseen, options.seed)
        except (InputError, CannotAnswer):
            continue
        if not earns_parameters(gain):
            continue
        score, why_not = gain.compute_score(chosen.fit.n_numbers), _NO_HELD_OUT
        if holdout is not None:
            gain = compare_paired(smaller.errors(holdout), chosen.fit.errors(holdout), options.seed)
            why_not = explain_gain(gain)
        alike = _list_alike(family, cause, joints)
        if not why_not:
            rivals = _list_rivals(family, chosen, cause, joints, smaller, spec)
            by_dimensions = any(addition == "structure" for addition, _ in rivals)
            rivals = [(addition, place) for addition, place in rivals if addition != "structure"]
            alike = tuple(dict.fromkeys((*alike, *(_OF_ADDITION[addition] for addition, _ in rivals))))
            places = [place for _, place in rivals if place not in (*_list_places(cause, joints), "all")]
            why_not = _ELSEWHERE.format(format_list(places)) if places else _BY_DIMENSIONS if by_dimensions else ""
        shown = holdout is not None and not explain_gain(gain)
        numbers, dof = _parameters(cause, joints, chosen.fit), chosen.fit.dof
        one = _build_finding(cause, joints, gain, 0, why_not, numbers, alike, dof)
        findings.append(replace(one, score=score, is_shown=shown))
    return tuple(sorted(findings, key=lambda f: -f.gain.reduction_percent if f.gain else 0.0))


def build_rejected_findings(steps: Sequence[SelectionStep]) -> tuple[Finding, ...]:
    """Return the additions that fit the poses significantly better and that no machine has."""
    found = []
    for step in steps:
        if (one := step.rejected) is not None:
            cause, joints = _OF_ADDITION[one.addition], _split_place(one.place)
            numbers, size = _parameters(cause, joints, one.fit), one.fit.n_numbers
            found.append(_build_finding(cause, joints, step.gain, size, one.why, numbers, dof=one.fit.dof))
    return tuple(found)


def _list_alike(family: Family, cause: str, joints: tuple[str, ...]) -> tuple[str, ...]:
    """Return the indistinguishable causes of a cause: the weight of a joint's own link turns with it like an eccentricity."""
    carries = cause == "joint_eccentricity" and joints[0] in family.can_have("gravity")
    return ("gravity_deflection",) if carries else ()


def _list_rivals(
    family: Family, chosen: CandidateModel, cause: str, joints: tuple[str, ...], smaller: GeometryFit, spec: Spec
) -> tuple[tuple[str, str], ...]:
    """Return additions and their places that explain these poses as well as a cause; one at its own joint keeps the place."""
    places = _list_places(cause, joints)
    own = [a for a, at in chosen.spec.additions.items() if set(places) <= set(at) and _OF_ADDITION[a] == cause]
    if not own or own[0] not in family.screened or smaller.kind != "forward":
        return ()
    return find_rivals(smaller, family, spec, own[0], places)


def _list_places(cause: str, joints: tuple[str, ...]) -> tuple[str, ...]:
    """Return the places of a cause's addition: elastic drives are several places, a coupling is one at two joints."""
    return joints if cause == "drive_compliance" else ("/".join(joints) or "all",)


def _leave_out_causes(family: Family, chosen: CandidateModel) -> list[tuple[str, tuple[str, ...], Geometry, Spec]]:
    """Return every cause of the model with the geometry without it.

    Elastic drives are left out together: they carry the same load, so that the others would explain the deflection of one.
    """
    out: list[tuple[str, tuple[str, ...], Geometry, Spec]] = []
    if chosen.spec.structure != "frames":
        for cause, held in _OF_STRUCTURE.items():
            if cause == "guideway_nonparallel" and chosen.spec.structure == "ideal":
                continue
            geometry = held(chosen.fit.geometry)
            if geometry is not None:
                out.append((cause, (), geometry, chosen.spec))
    for addition, joints in chosen.spec.additions.items():
        cause = _OF_ADDITION[addition]
        for places in [joints] if addition == "elastic" else [(joint,) for joint in joints]:
            kept = tuple(joint for joint in joints if joint not in places)
            spec = Spec(
                chosen.spec.structure, {a: own for a, own in {**chosen.spec.additions, addition: kept}.items() if own}
            )
            moved = tuple(joint for place in places for joint in _split_place(place))
            out.append((cause, moved, family.build(spec, _periods(chosen.fit)), spec))
    return out


def _split_place(place: str) -> tuple[str, ...]:
    """Return the joints of an addition's place."""
    return () if place == "all" else tuple(re.split("/|=-|=", place))


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
        kept += [len(slack) - 1] if "delay" in spec.additions else []
        slack[np.setdiff1d(np.arange(len(slack)), kept)] = 0.0
        if "base_frame" not in spec.additions:
            frames = frames.first(len(chosen.fit.poses.frame_kinds))
        if "tool_frame" not in spec.additions:
            frames = replace(frames, tool=frames.tool[: len(chosen.fit.poses.targets)])
        start = start._replace(frames=frames, slack=slack)
    return fit_geometry(geometry, spec, chosen.fit.poses, options, start, "this model")


def _parameters(cause: str, joints: tuple[str, ...], fitted: GeometryFit) -> tuple[Parameter, ...]:
    """Return the estimated numbers of a cause."""
    known = [p for p in fitted.parameters if p.stderr is not None]
    if cause in ("tool_frame", "base_frame"):
        owner = "tool" if cause == "tool_frame" else "device"
        return tuple(p for p in known if p.name.startswith(owner))
    if cause == "joint_coupling":
        return tuple(p for p in known if p.name == f"{joints[0]}.coupling_{joints[1]}")
    found = [p for p in known if any(w in p.name.partition(".")[2] for w in _PATTERNS[cause])]
    own = [p for p in found if not joints or p.name.partition(".")[0] in joints]
    return tuple(p for p in own if not p.name.startswith(("device", "tool")))


def suspect_laws(findings: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Return findings with the laws of joints and drives suspected: another law explains the poses better."""
    laws = {cause for addition, cause in _OF_ADDITION.items() if addition not in OF_WHOLE}
    return tuple(f.reject(_OUTDONE) if f.cause in laws else f for f in findings)


def suspect_all(findings: tuple[Finding, ...]) -> tuple[Finding, ...]:
    """Return the findings of a model with large errors: only conventions and moves between files stay confirmed."""
    sure = ("device_moved", "target_moved", *CONVENTIONS)
    return tuple(f if f.cause in sure else f.reject(_MISSED_POSES) for f in findings)
