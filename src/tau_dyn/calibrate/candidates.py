"""A model fitted, with what it is and how well it predicts; the step from one to a larger one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

import numpy as np

from tau_dyn.calibrate.crossvalidation import CrossValidationGain, HeldOutErrors, cross_validate
from tau_dyn.calibrate.families import Family
from tau_dyn.calibrate.frames import AXES
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.geometry_fit import GeometryFit, fit_geometry_to_poses
from tau_dyn.calibrate.models import Spec
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.calibrate.residuals import FitState
from tau_dyn.exceptions import UnknownName


@dataclass(frozen=True, eq=False)
class CandidateModel:
    """A fitted model.

    Attributes:
        name: As on the command line.
        spec: What it frees.
        fit: To the training poses.
        unseen: Errors at training poses, each predicted without its fold.
    """

    name: str
    spec: Spec
    fit: GeometryFit
    unseen: HeldOutErrors


@dataclass(frozen=True, eq=False)
class SelectionStep:
    """One step of the ladder.

    Attributes:
        name: Model that was tried.
        over: Model that it was compared with.
        gain: On training poses by cross-validation.
        taken: Whether it was worth its parameters.
    """

    name: str
    over: str
    gain: CrossValidationGain
    taken: bool


@dataclass(frozen=True)
class Options:
    """How models are fitted.

    Attributes:
        fix: Names or patterns that stay.
        free: Names or patterns that may change although they would stay.
        residual: Kind of residual.
        robust: Kind of weights.
        device: Whether the device's frame is unknown.
        tool: Whether the target's place is unknown.
        seed: Of folds and bootstrap.
        additions: Additions that every model has.
        prior: Standard deviations of the robot's lengths [m] and perhaps angles [rad]; the usual ones unless given.
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
    """Fit a model, from where another one's fit stands if one is given."""
    geometry = family.build(spec, periods)
    state = None
    if start is not None:
        state = transfer_state(start, geometry.parameters.names, geometry.parameters.values, poses)
    return fit_geometry(geometry, spec, poses, options, state, f"the model {spec.name_for(family.joints)}")


def fit_geometry(
    geometry: Geometry, spec: Spec, poses: PoseSet, options: Options, start: FitState | None, what: str
) -> GeometryFit:
    """Fit a geometry that was built for a model; patterns of `options` that mean nothing in it are passed over."""
    play = [f"{joint}.backlash" for joint in spec.additions.get("backlash", ())]
    known = (*geometry.parameters.names, *_beside(geometry.actuated))
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


def fit_and_cross_validate(
    family: Family,
    spec: Spec,
    poses: PoseSet,
    options: Options,
    start: GeometryFit | None = None,
    periods: dict[str, float] | None = None,
) -> CandidateModel:
    """Fit a model and cross-validate it."""
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
    """Tell whether a pattern can match something in this model; dimensions that a smaller model ties are skipped silently."""
    return any(fnmatchcase(name, pattern) for name in known)


def check_patterns(family: Family, patterns: Sequence[str], model: str) -> None:
    """Refuse names and patterns that no model of this robot knows.

    Raises:
        UnknownName: Lists what there is.
    """
    specs = [Spec(structure) for structure in family.structures] + ([] if model == "auto" else [family.spec(model)])
    known = dict.fromkeys(name for spec in specs for name in family.build(spec).parameters.names)
    names = [*known, *_beside(family.joints)]
    for pattern in patterns:
        if not _means(pattern, names):
            raise UnknownName("geometry parameter", pattern, names)


def _beside(joints: Sequence[str]) -> list[str]:
    frames = [f"{owner}.{axis}" for owner in ("device", "tool") for axis in AXES]
    return [*frames, *(f"{joint}.backlash" for joint in joints)]
