"""Warnings about the doubtful parts of an estimate, and models that the data cannot distinguish."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from scipy.stats import chi2

from tau_dyn.estimate import MAX_RELATIVE_STDERR, Estimate, Regression, find_determined_combinations
from tau_dyn.evidence import MAX_HELD_OUT_RATIO, describe_foreign_joints
from tau_dyn.identify.result import ForceErrors, list_poorly_determined
from tau_dyn.message_codes import CodedWarning
from tau_dyn.parameters import Parameters
from tau_dyn.robot import INERTIAL

MAX_RESTING_SHARE = 0.5
"""Share of samples at rest above which a joint counts as resting most of the time."""


def compute_rest_shares(regression: Regression) -> np.ndarray:
    """Return the share of samples at which each joint (na,) is slower than the slowest speed of a sure sign."""
    v = np.concatenate([run.signals["v"] for run in regression.runs])
    return np.mean(np.abs(v) < regression.preparation.speed_threshold, axis=0)


def list_resting_warnings(regression: Regression, joints: Sequence[str] | None = None) -> list[str]:
    """Return one warning that names the joints at rest most of the time, of all outputs or of those given."""
    if not any(len(run.t) for run in regression.runs):
        return []
    resting = {
        j: x
        for j, x in zip(regression.outputs, compute_rest_shares(regression), strict=True)
        if x > MAX_RESTING_SHARE and (joints is None or j in joints)
    }
    if not resting:
        return []
    named = ", ".join(f"{joint} ({100 * share:.0f} %)" for joint, share in resting.items())
    return [
        CodedWarning(
            "rests_mostly",
            f"{named} rest{'s' if len(resting) == 1 else ''} most of the time; errors and friction there are of the moving "
            "samples only, so look at the errors over all samples too",
        )
    ]


_ILL_CONDITIONED = 200.0  # condition number; beyond, errors of the columns show in the estimates
_CORRELATED = 0.99  # correlation from which two estimates are named together
_OBJECTS = 3.0
"""Distance [standard errors] outside the physical set beyond which the data contradict it; smaller distances are noise."""

_MAX_INERTIA_RATIO = 30.0
"""Factor between identified and nominal inertia beyond which units are doubted; a robot file may be wrong by much less."""


def list_estimate_warnings(
    estimate: Estimate,
    sizes: Mapping[str, float] = MappingProxyType({}),
    prior: Mapping[str, float] = MappingProxyType({}),
) -> list[str]:
    """Return a sentence for each thing about the estimate that a reader must know before using it.

    Args:
        estimate: The fit.
        sizes: Sizes of the bodies' parameters, by name; see `BodyPrior`.
        prior: Their standard deviations before the logs, by name.
    """
    return [
        *_moved(estimate),
        *_at_bound(estimate),
        *_unseen(estimate),
        *_undetermined(estimate, sizes),
        *_conditioning(estimate, prior),
    ]


def list_unjudged_joint_warnings(train: ForceErrors, holdout: ForceErrors | None) -> list[str]:
    """Return a warning for joints without any unmasked sample: their errors of zero carry no information."""
    why = "all are next to rests, reversals, gaps or forces at the drive's limit"
    found = []
    if train.unjudged:
        found.append(
            f"no sample of {', '.join(train.unjudged)} can be fitted ({why}); its parameters follow from the other joints"
        )
    if holdout is not None and (rest := [joint for joint in holdout.unjudged if joint not in train.unjudged]):
        found.append(
            f"no held-out sample of {', '.join(rest)} can be used ({why}); its held-out error is unknown, not zero"
        )
    return found


def list_held_out_warnings(train: ForceErrors, holdout: ForceErrors | None, overfit: float = 1.0) -> list[str]:
    """Return a warning if held-out logs are predicted so much worse that they probably belong to another machine.

    Args:
        train: Errors of the training logs.
        holdout: Errors of the held-out logs.
        overfit: Ratio of both that the number of parameters explains.
    """
    if holdout is None:
        return []
    pairs = zip(train.joints, train.rms, holdout.rms, strict=True)
    ratios = {joint: held / trained for joint, trained, held in pairs if trained > 0}
    return describe_foreign_joints([(joint, x) for joint, x in ratios.items() if x > MAX_HELD_OUT_RATIO * overfit])


def list_inertia_scale_warnings(estimate: Estimate, nominal: Parameters) -> list[str]:
    """Return a warning if masses and inertias differ by orders of magnitude from the robot file: mostly a unit is wrong."""
    base = estimate.base
    before, names = base.combine(nominal.select(base.names).values), [base.names[k] for k in base.kept]
    inertial = np.array([name.rpartition(".")[2] in INERTIAL for name in names], bool)
    seen = inertial & (estimate.stderr < MAX_RELATIVE_STDERR * np.abs(estimate.beta)) & (before != 0)
    if not seen.any():
        return []
    ratio = np.abs(estimate.beta[seen] / before[seen])
    typical = float(np.exp(np.median(np.log(ratio))))
    if 1 / _MAX_INERTIA_RATIO < typical < _MAX_INERTIA_RATIO:
        return []
    k = np.flatnonzero(seen)[np.argmin(np.abs(np.log(ratio / typical)))]
    such = f"{names[k]} with {estimate.beta[k]:.3g} instead of {before[k]:.3g} {estimate.parameters[names[k]].unit}"
    sentence = (
        f"masses and inertias are about {typical:.2g} times those of the robot file, such as {such}; check the units of t [s], "
        "q [m or rad] and tau [N or N m], and the file's"
    )
    return [CodedWarning("scale_wrong", sentence)]


_RESISTS = ("coulomb", "viscous", "coulomb_pos", "coulomb_neg", "viscous_pos", "viscous_neg")
"""Friction parameters, which oppose motion."""


def list_equivalent_models(estimate: Estimate, joints: tuple[str, ...]) -> tuple[str, ...]:
    """Return the models that fit exactly as well as the one reported."""
    found = []
    for joint in joints:
        names = [f"{joint}.{q}" for q in ("coulomb_pos", "coulomb_neg", "viscous_pos", "viscous_neg")]
        if not all(n in estimate.parameters for n in names):
            continue
        fc_pos, fc_neg, fv_pos, fv_neg = (estimate.parameters[n] for n in names)
        if all(p.stderr is None or 2 * p.stderr > abs(p.value) for p in (fc_pos, fc_neg)):  # no friction is determined
            continue
        both = np.hypot(fv_pos.stderr or 0.0, fv_neg.stderr or 0.0)
        one_viscous = both > 0 and abs(fv_pos.value - fv_neg.value) < 2 * both
        mean, half = (fc_pos.value + fc_neg.value) / 2, (fc_pos.value - fc_neg.value) / 2
        unit = fc_pos.unit
        text = f"{joint}: Coulomb friction {fc_pos.value:.4g} / {fc_neg.value:.4g} {unit} is the same as {mean:.4g} {unit} in "
        text += f"both directions with a constant offset of {half:+.3g} {unit}; force logs cannot separate the two"
        if one_viscous:
            text += "; one viscous coefficient is sufficient"
        found.append(text)
    return tuple(found)


def _moved(estimate: Estimate) -> list[str]:
    """Return warnings about values that the constraints moved significantly away from the data."""
    bodies = [name.removesuffix(" inertia") for name in estimate.moved if name.endswith(" inertia")]
    found = _held_by_physics(estimate, bodies) if bodies else []
    found += list_friction_sign_warnings(estimate)
    for name, plain in estimate.moved.items():
        if name.endswith(" inertia"):
            continue
        if _excess(estimate, name, plain) < _OBJECTS:
            continue
        terms = [estimate.parameters[term] for term in name.split(" + ")]
        value, unit = sum(p.value for p in terms), terms[0].unit
        sentence = (
            f"{name}: the unconstrained estimate {plain:.4g} {unit} is more than {_OBJECTS:g} standard errors outside its "
            f"bounds; the nearest consistent estimate is {value:.4g} {unit} and changes other values "
            "(the model lacks a force, or the excitation is poor)"
        )
        found.append(CodedWarning("not_physical", sentence))
    return found


def _excess(estimate: Estimate, name: str, plain: float) -> float:
    """Return the distance of a plain estimate outside its bounds [standard errors]; 0 if it is not determined alone."""
    terms = name.split(" + ")
    rows = [k for k, kept in enumerate(estimate.base.kept) if estimate.base.names[kept] in terms]
    if len(rows) < len(terms) or not np.all(estimate.stderr[rows] > 0):
        return 0.0
    if len(terms) > 1:  # a sum of Coulomb values, at least zero
        return -plain / float(np.sqrt(max(estimate.cov[np.ix_(rows, rows)].sum(), 1e-300)))
    p = estimate.parameters[name]
    return max(p.lower - plain, plain - p.upper) / float(estimate.stderr[rows[0]])


def list_friction_sign_warnings(estimate: Estimate) -> list[CodedWarning]:
    """Return a sentence for each joint whose estimated friction is negative.

    Causes: a reversed sign of a force or a position, the column of another joint, or a controller that subtracts more friction
    than there is.
    """
    found = []
    for joint in estimate.regression.outputs:
        friction = [n for n in estimate.base.names if n.rsplit(".", 1)[0] == joint and n.rsplit(".", 1)[1] in _RESISTS]
        moved = [n for n in estimate.moved if n.startswith(f"{joint}.") and not n.endswith(" inertia")]
        beyond = [n for n in moved if _excess(estimate, n, estimate.moved[n]) > _OBJECTS]
        pushing = [term for name in beyond for term in name.split(" + ") if term in friction]
        if len(pushing) >= max(2, len(friction) / 2):
            sentence = (
                f"{joint}: estimated friction is negative; check the sign of tau_{joint} (what the actuator "
                f"applies along q_{joint}), that q_{joint} and tau_{joint} are this joint's columns, and whether the controller "
                "has already subtracted friction from the force"
            )
            found.append(CodedWarning("sign_reversed", sentence))
    return found


def _held_by_physics(estimate: Estimate, bodies: list[str]) -> list[str]:
    """Return a warning about bodies whose physical consistency contradicts the data.

    The true parameters are physical, and their squared distance from the plain estimate follows chi-square. The nearest physical
    estimate is closer still. A distance beyond the 99.9 % quantile therefore contradicts the model; sound logs exceed it in at
    most 0.1 % of cases.
    """
    moved = estimate.beta - estimate.beta_plain
    stderr = np.where(estimate.stderr > 0, estimate.stderr, np.inf)
    shift = np.abs(moved) / stderr
    worst = int(np.argmax(shift))
    widened = estimate.cov + np.diag(np.maximum(estimate.stderr**2 - np.diag(estimate.cov), 0.0))
    distance = float(moved @ np.linalg.lstsq(widened, moved, rcond=None)[0])
    if shift[worst] < _OBJECTS or distance < chi2.ppf(0.999, len(moved)):
        return []
    sentence = (
        f"the unconstrained estimate is not physically consistent at {', '.join(bodies)}; the reported estimate is the nearest "
        f"consistent one. {estimate.base.names[estimate.base.kept[worst]]} changes most, by {shift[worst]:.2g} standard errors "
        "(the model lacks a force, or the noise is underestimated)"
    )
    return [CodedWarning("not_physical", sentence)]


def _at_bound(estimate: Estimate) -> list[str]:
    moved = {term for name in estimate.moved for term in name.split(" + ")}
    at = [
        p.name
        for p in estimate.parameters
        if p.free and estimate.parameters.is_at_bound(p.name) and p.stderr is not None and p.name not in moved
    ]
    return [f"at a bound: {', '.join(at)}"] if at else []


def _unseen(estimate: Estimate) -> list[str]:
    """Return a warning about parameters that the robot could show but this motion does not excite, with a remedy."""
    structural = estimate.structural
    if structural is None:
        return []
    lost = [n for n in estimate.base.names if estimate.identifiable(n) and estimate.parameters[n].stderr is None]
    if not lost:
        return []
    joints = sorted({n.rsplit(".", 1)[0] for n in lost if n.rsplit(".", 1)[0] in estimate.regression.outputs})
    remedy = f"move {', '.join(joints)}" if joints else "accelerate all joints independently of each other"
    return [f"not excited, nominal value kept: {', '.join(lost)}; to identify them, {remedy}"]


def _undetermined(estimate: Estimate, sizes: Mapping[str, float]) -> list[str]:
    weak = list_poorly_determined(estimate, sizes)
    if not weak:
        return []
    listed = ", ".join(
        f"{n} = {estimate.parameters[n].value:.3g} +- {estimate.parameters[n].stderr:.2g} {estimate.parameters[n].unit}"
        for n in weak[:8]
    )
    more = f" and {len(weak) - 8} more" if len(weak) > 8 else ""
    return [f"poorly determined (standard error above 30 %): {listed}{more}"]


def _conditioning(estimate: Estimate, prior: Mapping[str, float]) -> list[str]:
    found = []
    if estimate.cond > _ILL_CONDITIONED:
        found.append(
            f"the regression is ill-conditioned (condition number {estimate.cond:.3g}); estimates are sensitive to noise"
        )
    correlation = np.abs(np.triu(estimate.correlation, 1))
    determined = find_determined_combinations(estimate, prior)
    if determined is not None and np.any(correlation > _CORRELATED):
        lost = estimate.base.rank - determined.base.rank
        found.append(
            f"{lost} of {estimate.base.rank} base parameters are known no better than from the robot file; the other "
            f"{determined.base.rank} combinations are determined and are listed with their values"
        )
        return found
    for i, j in np.argwhere(correlation > _CORRELATED)[:5]:
        a, b = estimate.expression(int(i)), estimate.expression(int(j))
        found.append(f"{a} and {b} are correlated by {estimate.correlation[i, j]:+.3f}; use only their combination")
    return found
