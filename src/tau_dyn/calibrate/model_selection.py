"""Model selection: structures from small to large, then additions that the residuals support, each by cross-validation.

A larger model is accepted only if it predicts the training poses left out of its refit significantly better, by a
paired test over poses. Held-out poses are not used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.addition_tests import find_strongest_periods, screen_additions
from tau_dyn.calibrate.crossvalidation import (
    compare_paired,
    cross_validate,
    earns_parameters,
    is_worse_in_order,
)
from tau_dyn.calibrate.fit_problem import FitState
from tau_dyn.calibrate.frames import IDENTITY, DeviceFrames
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.geometry_fit import GeometryFit, fit_geometry_to_poses
from tau_dyn.calibrate.measured import PoseErrors, PoseSet
from tau_dyn.calibrate.model_family import OF_WHOLE, Family, Spec
from tau_dyn.calibrate.unknowns import DELAY
from tau_dyn.evidence import Gain, find_out_of_range
from tau_dyn.exceptions import CannotAnswer, InputError, UnknownName
from tau_dyn.message_codes import CodedWarning
from tau_dyn.results import Brief


@dataclass(frozen=True, eq=False)
class CandidateModel(Brief):
    """A fitted model.

    Attributes:
        name: Name as on the command line.
        spec: Structure and additions.
        fit: Fit to the training poses.
        unseen: Errors at the training poses, each predicted without its fold.
    """

    name: str
    spec: Spec
    fit: GeometryFit
    unseen: PoseErrors


class RejectedAddition(NamedTuple):
    """An addition that fits the poses significantly better and has a sign or a size that no machine has.

    Attributes:
        addition: Kind of the addition.
        place: Its joint; `JOINT/OTHER` for a coupling.
        fit: The model with it.
        why: Its implausible number, as a phrase.
    """

    addition: str
    place: str
    fit: GeometryFit
    why: str


@dataclass(frozen=True, eq=False)
class SelectionStep:
    """One step of the ladder.

    Attributes:
        name: Model that was tried.
        over: Model that it was compared with.
        gain: Gain on training poses by cross-validation.
        taken: Whether it was worth its parameters.
        rejected: A significant addition that no machine has; None for all other steps.
    """

    name: str
    over: str
    gain: Gain
    taken: bool
    rejected: RejectedAddition | None = None


@dataclass(frozen=True)
class Options:
    """Options of the fits of all models.

    Attributes:
        fix: Names or patterns of parameters that are fixed.
        free: Names or patterns of parameters that are free although they are fixed by default.
        residual: Kind of residual.
        robust: Kind of weights.
        device: Whether the device's frame is unknown.
        tool: Whether the target's place is unknown.
        seed: Seed of folds and bootstrap.
        additions: Additions that every model has.
        prior: Standard deviations of the robot's lengths [m] and perhaps angles [rad]; 10 mm and 10 mrad by default.
    """

    fix: Sequence[str] = ()
    free: Sequence[str] = ()
    residual: str = "forward"
    robust: str = "none"
    device: bool = True
    tool: bool = True
    seed: int = 0
    additions: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    prior: tuple[float, ...] = ()


def fit_spec(
    family: Family,
    spec: Spec,
    poses: PoseSet,
    options: Options,
    start: GeometryFit | None = None,
    periods: dict[str, float] | None = None,
) -> GeometryFit:
    """Fit a model, starting from the fit of another model if one is given."""
    geometry = family.build(spec, periods)
    state = None
    if start is not None:
        state = transfer_state(start, geometry.parameters.names, geometry.parameters.values, poses)
    return fit_geometry(geometry, spec, poses, options, state, f"the model {spec.name_for(family.joints)}")


def fit_geometry(
    geometry: Geometry, spec: Spec, poses: PoseSet, options: Options, start: FitState | None, what: str
) -> GeometryFit:
    """Fit a geometry that was built for a model; patterns of `options` that match no parameter of it are ignored."""
    play = [f"{joint}.backlash" for joint in spec.additions.get("backlash", ())]
    play += [DELAY] if "delay" in spec.additions else []
    known = (*geometry.parameters.names, *_beside(geometry.actuated, poses))
    fix = [p for p in options.fix if _means(p, known)]
    free = [p for p in options.free if _means(p, known)]
    return fit_geometry_to_poses(
        geometry,
        poses,
        fix=fix,
        free=[*free, *play],
        residual=options.residual,
        robust=options.robust,
        device=options.device,
        tool=options.tool,
        apart=("base_frame" in spec.additions, "tool_frame" in spec.additions),
        start=start,
        prior=options.prior,
        what=what,
    )


def fit_widest(family: Family, chosen: CandidateModel, options: Options) -> GeometryFit:
    """Return the fit of the largest structure that the poses support, with the additions of a model.

    Dimensions that a smaller structure fixes are as uncertain as the robot file, and so is a frame that the poses do not separate
    from them.
    """
    for structure in reversed(family.structures):
        if structure == chosen.spec.structure:
            break
        if structure == "paths":
            continue
        try:
            return fit_spec(family, Spec(structure, chosen.spec.additions), chosen.fit.poses, options, chosen.fit)
        except (InputError, CannotAnswer):
            continue
    return chosen.fit


def fit_and_cross_validate(
    family: Family,
    spec: Spec,
    poses: PoseSet,
    options: Options,
    start: GeometryFit | None = None,
    periods: dict[str, float] | None = None,
) -> CandidateModel:
    """Fit a model and cross-validate it; arguments as in `fit_spec`."""
    fitted = fit_spec(family, spec, poses, options, start, periods)
    return CandidateModel(spec.name_for(family.joints), spec, fitted, cross_validate(fitted, options.seed))


def transfer_state(start: GeometryFit, names: Sequence[str], nominal: np.ndarray, poses: PoseSet) -> FitState | None:
    """Return a state for another model's parameters: shared names keep their values, the others start at nominal ones."""
    if start.poses.n != poses.n:
        return None
    old = dict(zip(start.geometry.parameters.names, start.theta.tolist(), strict=True))
    theta = np.array([old.get(name, value) for name, value in zip(names, nominal.tolist(), strict=True)])
    s = start.state
    return FitState(theta, s.frames, s.base, s.ok, s.slack)


def _means(pattern: str, known: Sequence[str]) -> bool:
    """Return whether a pattern can match something in this model; dimensions that a smaller model ties are skipped silently."""
    return any(fnmatchcase(name, pattern) for name in known)


def check_patterns(family: Family, patterns: Sequence[str], model: str) -> None:
    """Refuse names and patterns that match no parameter of this robot's models.

    Raises:
        UnknownName: No parameter matches; the message lists all names.
    """
    specs = [Spec(structure) for structure in family.structures] + ([] if model == "auto" else [family.spec(model)])
    known = dict.fromkeys(name for spec in specs for name in family.build(spec).parameters.names)
    names = [*known, *_beside(family.joints, family.poses)]
    for pattern in patterns:
        if not _means(pattern, names):
            raise UnknownName("geometry parameter", pattern, names)


def _beside(joints: Sequence[str], poses: PoseSet) -> list[str]:
    """Return the names of the unknowns outside a geometry: frames of devices and targets, offsets and radii, backlash, delay."""
    frames = DeviceFrames((IDENTITY,), (IDENTITY,), ("pose",), (0.0,)).apart(1, len(poses.targets))
    devices = replace(frames, device=(IDENTITY,) * len(poses.frame_kinds), kinds=poses.frame_kinds)
    devices = replace(devices, lengths=(0.0,) * len(poses.frame_kinds))
    return [*(p.name for p in devices.parameters()), *(f"{joint}.backlash" for joint in joints), DELAY]


_MAX_ADDITIONS = 12  # steps of the forward selection; bounds its time
_MAX_CONSECUTIVE_FAILURES = 3  # additions tried at a step before the selection ends


def select_model(
    family: Family, poses: PoseSet, options: Options, progress: Callable[[str], None] = lambda step: None
) -> tuple[list[CandidateModel], list[SelectionStep], tuple[str, ...]]:
    """Return the models of the ladder, the last one chosen, all steps that were tried, and warnings.

    Raises:
        InputError: Too few poses for the smallest model.
    """
    taken, steps, warnings = _structures(family, poses, options, progress)
    added, tried = _additions(family, poses, options, taken[-1], progress)
    late = [a for a in ("delay",) if a in (*taken, *added)[-1].spec.additions and a not in options.additions]
    kept, dropped = _drop_needless(
        family, poses, options, [*taken, *added], late
    )  # an effect of a joint may explain it
    return kept, [*steps, *tried, *dropped], warnings


def _structures(
    family: Family, poses: PoseSet, options: Options, progress: Callable[[str], None]
) -> tuple[list[CandidateModel], list[SelectionStep], tuple[str, ...]]:
    taken: list[CandidateModel] = []
    steps: list[SelectionStep] = []
    warnings: list[str] = []
    moved: dict[str, tuple[str, ...]] = {}
    structures = _list_structures(family, options.additions)
    for k, spec in enumerate(structures, start=1):
        structure = Spec(spec.structure, {**spec.additions, **moved})
        progress(f"fitting model {k} of {len(structures)}: {structure.name_for(family.joints)}")
        try:
            candidate = fit_and_cross_validate(family, structure, poses, options)
        except (InputError, CannotAnswer) as fault:
            if not taken:
                raise
            warnings.append(str(fault))
            break
        if taken:
            gain = compare_paired(taken[-1].unseen, candidate.unseen, options.seed)
            steps.append(SelectionStep(candidate.name, taken[-1].name, gain, earns_parameters(gain)))
            if not earns_parameters(gain):
                continue
        moved = {a: own for a, own in candidate.spec.additions.items() if a in OF_WHOLE}
        taken.append(candidate)
    kept, dropped = _drop_needless(family, poses, options, taken, [a for a in moved if a not in options.additions])
    return kept, [*steps, *dropped], tuple(warnings)


def _drop_needless(
    family: Family, poses: PoseSet, options: Options, taken: list[CandidateModel], moved: Sequence[str]
) -> tuple[list[CandidateModel], list[SelectionStep]]:
    """Return the models without the campaign frames and the delay that do not improve the largest model, and the steps.

    A separate frame may compensate an error that dimensions of a later model, or another frame, explain.
    """
    steps: list[SelectionStep] = []
    for addition in moved:
        last = taken[-1]
        alone = Spec(last.spec.structure, {a: own for a, own in last.spec.additions.items() if a != addition})
        if alone == taken[0].spec:
            continue
        try:
            candidate = fit_and_cross_validate(family, alone, poses, options)
        except (InputError, CannotAnswer):
            continue
        gain = compare_paired(candidate.unseen, last.unseen, options.seed)
        steps.append(SelectionStep(last.name, candidate.name, gain, earns_parameters(gain)))
        if not earns_parameters(gain):
            taken = [*(one for one in taken if addition not in one.spec.additions), candidate]
    return taken, steps


def _list_structures(family: Family, always: Mapping[str, tuple[str, ...]]) -> list[Spec]:
    """Return the structures: first the robot file unchanged, then those with the additions that every model has.

    Frames that moved between campaigns and a delay come before larger structures: their effects look like geometry errors.
    """
    first, *rest = family.structures
    moved = [{a: family.can_have(a)} for a in OF_WHOLE if family.can_have(a)]
    with_always = [Spec(first, {**always, **own}) for own in ([{}] if always else []) + moved]
    return [Spec(first), *with_always, *(Spec(s, dict(always)) for s in rest)]


def _additions(
    family: Family,
    poses: PoseSet,
    options: Options,
    start: CandidateModel,
    progress: Callable[[str], None],
) -> tuple[list[CandidateModel], list[SelectionStep]]:
    """Return the models with one addition after another, from the first model on, and all steps that were tried."""
    now, taken, steps = start, [], []
    periods: dict[str, float] = {}
    refused: set[tuple[str, tuple[str, ...]]] = set()
    for _ in range(_MAX_ADDITIONS):
        hints = [h for h in screen_additions(now.fit, family, now.spec) if (h.addition, h.joints) not in refused]
        before = now
        tested = hints[:_MAX_CONSECUTIVE_FAILURES]
        for k, hint in enumerate(tested, start=1):
            progress(f"trying {k} of {len(tested)}: {hint.addition} at {', '.join(hint.joints)}")
            label = "2" if hint.addition == "periodic2" else ""
            tried = periods | ({hint.joints[0] + label: hint.period} if hint.period else {})
            try:
                candidate = fit_and_cross_validate(
                    family, now.spec.plus(hint.addition, hint.joints), poses, options, now.fit, tried
                )
            except (InputError, CannotAnswer):
                refused.add((hint.addition, hint.joints))
                continue
            gain = compare_paired(now.unseen, candidate.unseen, options.seed)
            better, odd = earns_parameters(gain), find_implausible_law(candidate.fit)
            good = better and not odd and not is_worse_in_order(now.fit, candidate.fit)
            rejected = RejectedAddition(hint.addition, hint.joints[0], candidate.fit, odd) if better and odd else None
            steps.append(SelectionStep(candidate.name, now.name, gain, good, rejected))
            if good:
                taken.append(candidate)
                now, periods = candidate, tried
                break
            refused.add((hint.addition, hint.joints))
        if now is before:
            break
    return taken, steps


_MAX_ECCENTRICITY_RAD = 5e-3
"""Largest plausible amplitude of a joint's error with one period a turn: an encoder disc of 20 mm radius 0.1 mm off its axis."""


def describe_implausible(steps: Sequence[SelectionStep]) -> tuple[str, ...]:
    """Return a sentence if a model with implausible values fits the poses better than the selected one."""
    odd = [step for step in steps if step.rejected]
    taken = {step.over: step.gain.reduction_percent for step in steps if step.taken}
    odd = [step for step in odd if step.gain.reduction_percent > taken.get(step.over, 0.0)]
    if not odd:
        return ()
    best = max(odd, key=lambda step: step.gain.reduction_percent)
    sentence = (
        f"{best.name} takes away {best.gain.reduction_percent:.0f} % of the error, yet with a joint that rises against its load "
        "or turns further off its axis than machines do; it is not taken, and effects in its place are suspected only: check "
        "the direction of gravity and the masses in the robot file, and joints that the poses' controller corrects itself"
    )
    return (CodedWarning("implausible_effect", sentence),)


def find_implausible_law(fitted: GeometryFit) -> str:
    """Return a phrase on the first negative compliance or implausibly large eccentricity; an empty string otherwise."""
    laws = [p for p in fitted.parameters if p.stderr is not None]
    yielding = [replace(p, lower=0.0, upper=np.inf) for p in laws if p.name.endswith("_compliance")]
    turning = [
        replace(p, lower=-_MAX_ECCENTRICITY_RAD, upper=_MAX_ECCENTRICITY_RAD)
        for p in laws
        if ".eccentricity_" in p.name
    ]
    return find_out_of_range([*yielding, *turning])


def fit_models(
    family: Family, poses: PoseSet, model: str, options: Options, progress: Callable[[str], None]
) -> tuple[list[CandidateModel], list[SelectionStep], tuple[str, ...]]:
    """Return the ladder of models up to the one asked for or chosen, the steps that were tried, and warnings."""
    if model == "auto":
        return select_model(family, poses, options, progress)
    progress(f"fitting {model}")
    nominal = fit_and_cross_validate(family, Spec("frames"), poses, options)
    spec = family.spec(model)
    periods = _searched_periods(family, spec, poses, options)
    asked = fit_and_cross_validate(family, spec, poses, options, periods=periods)
    if asked.spec == nominal.spec or asked.name == nominal.name:
        return [asked], [], ()
    gain = compare_paired(nominal.unseen, asked.unseen, options.seed)
    return [nominal, asked], [SelectionStep(asked.name, nominal.name, gain, True)], ()


def _searched_periods(family: Family, spec: Spec, poses: PoseSet, options: Options) -> dict[str, float]:
    """Return starting periods of the cyclic errors of a model, from the residuals of the model without them."""
    joints = spec.additions.get("periodic", ())
    if not joints:
        return {}
    plain = Spec(spec.structure, {a: j for a, j in spec.additions.items() if a != "periodic"})
    return find_strongest_periods(fit_spec(family, plain, poses, options), family, joints)
