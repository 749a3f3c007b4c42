"""Force inside a robot with more drives than freedoms: a constant preload of each redundant drive.

With `B = [1; B_r]` the speeds of all n drives per actuated speed, `N = [-B_r'; 1]` spans the forces that move nothing.
Measured forces without friction split into a share of the generalised forces and preloads `p` of the redundant drives:

    tau = B (B'B)^-1 Q + N p,    p = (N'N)^-1 N' tau = (1 + B_r B_r')^-1 (tau_r - B_r tau_a).

A drive with preload p_i pushes p_i against the others, which balance it. Masses have no part in p: rigid-body forces are taken as
shared by least squares, which depends on the units if slides and hinges are mixed. Friction that the identification determined is
subtracted with its covariance. Coulomb and viscous friction of drives whose friction it determined in combination only, as of
two motors on one cart, is estimated here, the same in both directions; a constant offset between such drives counts as preload.
Forces inside a real robot vary, by errors of its geometry and the stiffness of its drives: the preload is their mean, and their
deviation from it is reported. Reference: Mueller 2005, on internal preload of redundantly actuated robots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.effects import (
    REDUNDANT,
    Armature,
    DisplacementEffect,
    JointMotion,
    JointwiseEffect,
    Motion,
    RedundantArmature,
    SymmetricFriction,
    read_redundant_motion,
)
from tau_dyn.estimate import Estimate, Preparation, Regression, RegressionRun, solve_least_squares
from tau_dyn.identify.regression import MIN_SHARE, prepare_segment
from tau_dyn.log import Log, decimate, lowpass
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.results import Z95

ASSUMED = (
    "Rigid-body forces are shared by least squares over all drives; the rest, without friction, is the preload. A constant "
    "offset between drives whose friction is identifiable in combination only counts as preload"
)


@dataclass(frozen=True, eq=False)
class InternalForce:
    """Preloads of redundant drives.

    Attributes:
        preloads: `<joint>.preload` of each redundant drive [N or N m]; `stderr` None if the data do not separate it.
        deviations: Standard deviation of each preload around its constant over the used samples (r,) [N or N m], noise included.
    """

    preloads: Parameters
    deviations: np.ndarray

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's rows, and what is assumed."""
        rows = []
        for p, deviation in zip(self.preloads, self.deviations, strict=True):
            interval = None if p.stderr is None else [p.value - Z95 * p.stderr, p.value + Z95 * p.stderr]
            row = {"name": p.name, "value": p.value, "unit": p.unit, "stderr": p.stderr, "ci95": interval}
            rows.append(row | {"deviation": float(deviation)})
        return {"preloads": rows, "assumed": ASSUMED}


class _Friction(NamedTuple):
    """Friction that an estimate determined: `values + root z` with independent `z` of unit variance.

    Attributes:
        names: Its parameters (k).
        values: Their values (k,).
        root: Square root of their covariance (k, k).
        combined: Drives with friction that is identified in combination only.
    """

    names: tuple[str, ...]
    values: np.ndarray
    root: np.ndarray
    combined: tuple[str, ...]


def estimate_internal_force(model: Model, estimate: Estimate, pieces: Sequence[Log]) -> InternalForce | None:
    """Return the preloads of redundant drives; None for a robot without such drives, or if the logs' rows are on disk.

    Args:
        model: The model at its identified values.
        estimate: The identification's estimate.
        pieces: Even stretches of the logs, with forces projected as by `complete_positions`.

    Raises:
        CannotAnswer: The logs hold too few samples.
    """
    robot, preparation = model.robot, estimate.regression.preparation
    if not robot.redundant_joints or not pieces:
        return None
    known = _get_known_friction(model, estimate)
    preloads = [
        Parameter(f"{joint}.preload", 0.0, unit)
        for joint, unit in zip(robot.redundant_joints, robot.redundant_units, strict=True)
    ]
    uncertain = [Parameter(f"friction.{k}", 0.0, "1", prior_stderr=1.0) for k in range(len(known.names))]
    again = SymmetricFriction(known.combined, ("N",) * len(known.combined)).parameters
    unknown = Parameters([*preloads, *uncertain, *(replace(p, lower=-np.inf) for p in again)])
    runs = [_build_run(model, piece, preparation, unknown, known) for piece in pieces]
    outputs = robot.redundant_joints, robot.redundant_units
    found = solve_least_squares(Regression(unknown, *outputs, tuple(r for r in runs if r is not None), preparation))
    return InternalForce(found.parameters.select(p.name for p in preloads), found.sigma)


def _get_known_friction(model: Model, estimate: Estimate) -> _Friction:
    """Return the drives' friction that an estimate determined; all of a drive's own is left out if some of it is combined."""
    friction = [p for effect in _list_friction(model) for p in effect.parameters]
    found = [
        estimate.parameters[p.name] if p.name in estimate.parameters else p for p in friction
    ]  # p: a value per log
    combined = dict.fromkeys(p.name.rpartition(".")[0] for p in found if p.stderr is None and p.free)
    known = [p for p in found if p.stderr is not None and p.name.rpartition(".")[0] not in combined]
    rows = [estimate.base.names[column] for column in estimate.base.kept]
    index = [rows.index(p.name) for p in known]
    scale = np.array([p.stderr for p in known]) / np.sqrt(np.diag(estimate.cov)[index])
    values, vectors = np.linalg.eigh(estimate.cov[np.ix_(index, index)] * np.outer(scale, scale))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return _Friction(tuple(p.name for p in known), np.array([p.value for p in known]), root, tuple(combined))


def _list_friction(model: Model) -> list[JointwiseEffect]:
    """Return the effects that act on drives by their own motion, without rotors, which share rigid-body forces."""
    return [
        effect
        for effect in model.effects
        if isinstance(effect, JointwiseEffect)
        and not isinstance(effect, DisplacementEffect | Armature | RedundantArmature)
    ]


def _compute_friction_columns(model: Model, motion: Motion) -> dict[str, np.ndarray]:
    """Return the force of each drive (N, n) per unit of each friction parameter, and of Coulomb and viscous friction, by name."""
    _, followers = read_redundant_motion(motion)
    drives = [*(JointMotion.of(motion, k) for k in range(len(motion.joints))), *followers]
    index = {joint: k for k, joint in enumerate((*motion.joints, *model.robot.redundant_joints))}
    plain = SymmetricFriction(index, ("N",) * len(index))
    found = {}
    for effect in (plain, *_list_friction(model)):
        for joint in effect.joints:
            made = effect.per_joint(drives[index[joint]])
            for (quantity, _), x in zip(effect.terms, made, strict=True):
                column = np.zeros((len(x), len(index)))
                column[:, index[joint]] = x
                found[f"{joint}.{quantity}{effect.label}"] = column
    return found


def _build_run(
    model: Model, piece: Log, preparation: Preparation, unknown: Parameters, known: _Friction
) -> RegressionRun | None:
    """Return the regression of the preloads on one even stretch; None if no sample is left."""
    robot = model.robot
    prepared = prepare_segment(model, piece, preparation, needs=(REDUNDANT,))
    motion = prepared.motion
    rates = motion.signal(REDUNDANT)[:, :, : robot.na]
    own = lowpass(piece.joint("tau", robot.redundant_joints), preparation.position_cutoff_hz, piece.rate_hz)
    single = prepared.force - np.einsum("nra,nr->na", rates, own)
    both = np.eye(rates.shape[1]) + rates @ rates.swapaxes(1, 2)
    inside = np.linalg.solve(both, np.concatenate([-rates, np.broadcast_to(np.eye(len(own.T)), both.shape)], axis=2))
    measured = np.einsum("nrk,nk->nr", inside, np.concatenate([single, own], axis=1))
    made = {k: np.einsum("nrk,nk->nr", inside, x) for k, x in _compute_friction_columns(model, motion).items()}
    of_known = np.stack([made[name] for name in known.names], axis=2) if known.names else np.zeros((*measured.shape, 0))
    measured = measured - of_known @ known.values
    preloads = np.broadcast_to(np.eye(len(own.T)), (*measured.shape, len(own.T)))
    rest = [made[name][:, :, None] for name in unknown.names[len(own.T) + len(known.names) :]]
    columns = np.concatenate([preloads, of_known @ known.root, *rest], axis=2)
    gate = np.repeat(prepared.gate.min(axis=1, keepdims=True), len(own.T), axis=1)
    share = prepared.passed(gate)
    usable = (share > MIN_SHARE) & prepared.usable.all(axis=1, keepdims=True)
    if not usable.any():
        return None
    segment = replace(prepared, force=measured, gate=gate, usable=usable, weight=np.where(usable, share, 1.0))
    return RegressionRun(
        piece.name,
        decimate(piece.t, prepared.factor),
        segment.columns(columns),
        prepared.passed(gate * measured) / segment.weight,
        usable,
        segment.columns(columns, gated=False),
        prepared.passed(measured),
    )
