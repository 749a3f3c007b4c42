"""Kinematic calibration: from measured poses to a geometry with uncertainty, the model they bear, and what each step gained."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from tau_dyn.calibrate.addition_tests import UnitCoupling, find_strongest_periods, find_unit_coupling
from tau_dyn.calibrate.causes import CalibrationFinding, as_finding, find_causes
from tau_dyn.calibrate.crossvalidation import compare_paired
from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.model_selection import (
    CandidateModel,
    Options,
    SelectionStep,
    check_patterns,
    fit_and_cross_validate,
    fit_spec,
    select_model,
)
from tau_dyn.calibrate.models import Family, Spec, get_family
from tau_dyn.calibrate.outliers import (
    check_spread,
    describe_outliers,
    drop_duplicate_poses,
    find_moved_frames,
    find_outliers,
)
from tau_dyn.calibrate.pose_errors import estimate_measurement_noise
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.calibrate.result import Calibration
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.robot import Robot

_ENOUGH_TO_SPLIT = 40  # poses; with fewer, a held-out part is too small for an rms error
_HELD_OUT = 0.25  # share of the poses
_MAX_RELATIVE_MISFIT = 0.05
"""What a fit misses, over how far the poses spread, above which the two do not belong together."""
_MAX_OUTLIER_SHARE = 0.2  # share of the poses above which they are no outliers but another situation
_LOOKS_FOR_OUTLIERS = 3  # fits, each without the outliers of the one before it


def calibrate(
    robot: Robot,
    poses: PoseSet,
    holdout: PoseSet | None = None,
    model: str = "auto",
    *,
    fix: Sequence[str] = (),
    free: Sequence[str] = (),
    residual: str = "forward",
    robust: str = "none",
    device: bool = True,
    tool: bool = True,
    accuracy: tuple[float, ...] = (),
    prior: tuple[float, ...] = (),
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> Calibration:
    """Find a robot's geometry from measured poses.

    Args:
        robot: The robot with its nominal dimensions.
        poses: Measured poses to fit.
        holdout: Measured poses used for nothing but the final errors; without them a quarter of many poses is held out.
        model: `auto`, or a model's name, such as `nonparallel` or `complete+periodic:cart2`.
        fix: Names or patterns of parameters that stay nominal.
        free: Names or patterns that may change although they would stay.
        residual: `forward`, `closure` or `inverse`.
        robust: Weights against bad poses: `none`, `huber` or `biweight`; gross outliers are left out in any case.
        device: Whether the measuring device's frame is unknown.
        tool: Whether the target's place on the tool is unknown.
        accuracy: Standard errors of a measured coordinate [m] and perhaps of an orientation about an axis [rad], against which
            the held-out error is judged; by default from the poses' columns of standard errors, or from repeated poses.
        prior: How exactly the robot is taken to be built to its file, one standard deviation of lengths [m] and perhaps angles
            [rad]; 10 mm and 10 mrad unless given.
        seed: Of folds, splits and bootstrap.
        progress: Told what is being done.

    Raises:
        InputError: Poses that cannot be used; says why.
        CannotAnswer: Poses in one plane, or a robot that cannot reach them.
    """
    options = Options(tuple(fix), tuple(free), residual, robust, device, tool, seed, prior=tuple(prior))
    poses, warnings = drop_duplicate_poses(poses)
    measured = estimate_measurement_noise(poses, accuracy)
    if holdout is not None:
        holdout = _number_alike(poses, holdout)
    family = get_family(robot, poses)
    asked = Spec("") if model == "auto" else family.spec(model)  # an unknown name is told before anything long starts
    check_patterns(family, (*fix, *free), model)
    _spread(family, poses)
    coupling = find_unit_coupling(family, poses)
    if coupling and "coupling" not in asked.additions:
        warnings = (*warnings, _describe_coupling(poses, coupling, model))
        options = replace(options, additions={"coupling": (coupling.name,)} if model == "auto" else {})
    progress("looking for outliers")
    poses, holdout, named = _without_outliers(family, poses, holdout, options, None if model == "auto" else model)
    poses, holdout, split = _split(poses, holdout, seed)
    family = get_family(robot, poses)
    taken, steps, more = _models(family, poses, model, options, progress)
    progress("looking for causes")
    moved = find_moved_frames(taken[-1].fit, holdout) if holdout is not None and split == "given" else []
    still = holdout
    for one in moved:
        still = one.undo(still) if still is not None else None
    findings = (*find_causes(family, taken[-1], still, options), *(as_finding(one) for one in moved))
    sentences = (*poses.warnings, *warnings, *named, *more, *(one.describe() for one in moved), *_doubts(taken[-1].fit))
    found = Calibration(
        robot,
        poses,
        holdout,
        split,
        tuple(taken),
        tuple(steps),
        findings,
        tuple(dict.fromkeys(sentences)),
        seed,
        measured,
    )
    misses = replace(found, holdout=still).misses_poses
    return replace(found, findings=_suspect_all(findings)) if misses else found


def _suspect_all(findings: tuple[CalibrationFinding, ...]) -> tuple[CalibrationFinding, ...]:
    """Return findings of a model that misses its poses by far: none is confirmed but moves before the held-out poses."""
    return tuple(f if f.cause.endswith("_moved") else replace(f, status="suspected") for f in findings)


def _describe_coupling(poses: PoseSet, coupling: UnitCoupling, model: str) -> str:
    """Return what a coupling that stands out means, and what to do."""
    joint, other = re.split("=-?", coupling.name)
    sign = "-" if "=-" in coupling.name else "+"
    taken = "it is part of every model" if model == "auto" else f"add it to the model: {model}+coupling:{coupling.name}"
    return (
        f"{poses.source}: {joint} seems to count the motion of {other} too ({joint} {sign} {other}): with that the robot file "
        f"misses the positions by {1e3 * coupling.error:.3g} mm, without by {1e3 * coupling.without:.3g} mm, with the next best "
        f"coupling by {1e3 * coupling.next_best:.3g} mm; {taken}"
    )


def _models(
    family: Family, poses: PoseSet, model: str, options: Options, progress: Callable[[str], None]
) -> tuple[list[CandidateModel], list[SelectionStep], tuple[str, ...]]:
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
    """Return starting periods of the cyclic errors that a model asks for, from the residuals of the model without them."""
    joints = spec.additions.get("periodic", ())
    if not joints:
        return {}
    plain = Spec(spec.structure, {a: j for a, j in spec.additions.items() if a != "periodic"})
    return find_strongest_periods(fit_spec(family, plain, poses, options), family, joints)


def _spread(family: Family, poses: PoseSet) -> None:
    geometry = family.build(Spec("frames"))
    rng = np.random.default_rng(0)
    low, high = poses.q.min(axis=0), poses.q.max(axis=0)
    middle, width = 0.5 * (low + high), np.maximum(high - low, 0.1)
    q = middle + width * (rng.random((64, poses.na)) - 0.5)
    check_spread(poses, geometry.forward(geometry.parameters.values, q))


def _without_outliers(
    family: Family, poses: PoseSet, holdout: PoseSet | None, options: Options, model: str | None
) -> tuple[PoseSet, PoseSet | None, tuple[str, ...]]:
    said: list[str] = []
    fitted = None
    for _ in range(_LOOKS_FOR_OUTLIERS):
        fitted = _robust(family, poses, options, model)
        bad = find_outliers(fitted)
        if not len(bad):
            break
        if len(bad) > _MAX_OUTLIER_SHARE * poses.n:
            said.append(
                f"{poses.source}: {len(bad)} of {poses.n} poses are far from what fits the others; nothing was left out, "
                "for so many are no outliers: were frames moved in between, or is the robot another one?"
            )
            break
        said.append(describe_outliers(poses, fitted, bad))
        poses = poses.take(np.setdiff1d(np.arange(poses.n), bad))
    if holdout is not None and fitted is not None:
        bad = _held_outliers(fitted, holdout)
        if len(bad) > _MAX_OUTLIER_SHARE * holdout.n:
            said.append(
                f"{holdout.source}: {len(bad)} of {holdout.n} held-out poses are far from the fitted model; nothing was left "
                "out, for so many are no outliers: were the device or the target moved, or is the robot another one?"
            )
        elif len(bad):
            names = ", ".join(holdout.names[k] for k in bad[:5])
            said.append(
                f"{len(bad)} held-out pose{'s' if len(bad) > 1 else ''} left out as gross outliers: {names}; measure again"
            )
            holdout = holdout.take(np.setdiff1d(np.arange(holdout.n), bad))
    return poses, holdout, tuple(said)


def _held_outliers(fitted: GeometryFit, holdout: PoseSet) -> np.ndarray:
    usual = float(np.nanpercentile(fitted.errors(fitted.poses).distance, 90))
    return np.flatnonzero(~(fitted.errors(holdout).distance < 20 * max(usual, 3 * fitted.noise[0])))


def _robust(family: Family, poses: PoseSet, options: Options, model: str | None) -> GeometryFit:
    """Return a robust fit of the largest structure that the poses bear.

    Raises:
        InputError: They bear none; or CannotAnswer, as the smallest one says.
    """
    robust = replace(options, robust="biweight")
    specs = [family.spec(model)] if model and model != "auto" else []
    coupled = {a: own for a, own in specs[0].additions.items() if a == "coupling"} if specs else {}
    specs += [Spec(s) for s in reversed(family.structures) if s != "paths"]
    fault: Exception | None = None
    for spec in specs:
        try:
            return fit_spec(family, Spec(spec.structure, {**options.additions, **coupled}), poses, robust)
        except (InputError, CannotAnswer) as error:
            fault = error
    assert fault is not None
    raise fault


def _split(poses: PoseSet, holdout: PoseSet | None, seed: int) -> tuple[PoseSet, PoseSet | None, str]:
    """Return training and held-out poses, and how they came about."""
    if holdout is not None:
        return poses, holdout, "given"
    if poses.n < _ENOUGH_TO_SPLIT:
        return poses, None, "cross-validated"
    configuration = poses.configuration
    n = int(configuration.max()) + 1
    order = np.random.default_rng(seed).permutation(n)
    held = np.flatnonzero(np.isin(configuration, order[: int(round(_HELD_OUT * n))]))
    return poses.take(np.setdiff1d(np.arange(poses.n), held)), poses.take(held), "split"


def _number_alike(poses: PoseSet, holdout: PoseSet) -> PoseSet:
    """Return held-out poses with the training poses' numbering of campaigns and targets."""
    campaign = _renumber(holdout, "campaign", holdout.campaign, holdout.campaigns, poses.campaigns)
    target = _renumber(holdout, "target", holdout.target, holdout.targets, poses.targets)
    return replace(holdout, campaign=campaign, campaigns=poses.campaigns, target=target, targets=poses.targets)


def _renumber(
    holdout: PoseSet, kind: str, number: np.ndarray, names: tuple[str, ...], known: tuple[str, ...]
) -> np.ndarray:
    """Return numbers (N,) of names as they stand among the known ones; one name alone is the same one under any name."""
    if len(known) == 1 and len(names) == 1:
        return number
    for name in names:
        if name not in known:
            raise InputError(
                "mismatch",
                f"{holdout.source}: {kind} {name} is not among the training poses' {kind}s ({', '.join(known)}), "
                "so where it is is unknown",
            )
    return np.array([known.index(name) for name in names])[number]


def _doubts(fitted: GeometryFit) -> tuple[str, ...]:
    said = []
    if not fitted.converged:
        said.append("the fit did not converge; its last values are given")
    missed = int((~fitted.state.ok).sum())
    if missed:
        said.append(f"{missed} poses are out of the fitted model's reach and were not used")
    place = fitted.poses.position
    off, wide = fitted.noise[0], float(np.sqrt(np.mean(np.sum((place - place.mean(axis=0)) ** 2, axis=1))))
    if fitted.kind == "forward" and off > _MAX_RELATIVE_MISFIT * wide:
        said.append(
            f"the robot misses its own poses by {off:.2g} m, while they spread over {wide:.2g} m; were two joints' or two axes' "
            "columns exchanged, or is this another robot's file?"
        )
    return tuple(said)
