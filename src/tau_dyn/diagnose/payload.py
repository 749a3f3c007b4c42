r"""The change of base parameters by one body at the end of a robot, one force scale or one wrong mass, and its cause.

    d = beta - E pi_0 ~ N(B x, S),     S = cov(beta) + E P E'

with `beta` the base parameters of a fit, `E` their combinations, `pi_0` trusted values with covariance `P` (of an accurate
robot file; `robot/body_prior.py`). Each explanation has columns `B` and amplitudes `x`, estimated by generalised least squares
(Aitken 1936):

- payload: the ten inertial numbers of a rigid body fixed to the last link, about that link's joint frame;
- link mass: one link's mass, alone or with its whole inertia in proportion;
- force scale: the force of one joint times a factor, as far as a refit of the log's own motion attributes it to bodies;
- drive gain: all forces times one factor, so all base parameters.

The explanation with the least misfit for its number of amplitudes is taken, if it explains nearly all of the difference, and is
distinguished from a rough file, in which each body k has a wrong density, `d ~ N(0, S + sum_k (s_k E pi_k) (s_k E pi_k)')`.
Reference: Khalil, Gautier & Lemoine 2007 (identification of the payload inertial parameters).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.linalg import solve_triangular

from tau_dyn.estimate import Estimate, InertialBody, PhysicalConstraints
from tau_dyn.evidence import DIFFERENCE_LEVEL, MIN_2LOGL_DIFFERENCE, MIN_LEFT_P_VALUE
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import INERTIAL, NOT_GIVEN, BodyPrior, LinkInertia, Robot, find_end_link

MIN_EXPLAINED_SHARE = 0.95
"""Or share of the squared difference that it explains: errors of the fit beyond its covariance remain."""
PENALTY = 4.0
"""Penalty of an amplitude in units of twice the log-likelihood: a significance level of 5 %."""
MIN_AMPLITUDE_Z = 4.0
"""Least deviation of the mass or the factor, in standard errors."""
_RELATIVE_RANK = 1e-9
"""Part of the largest eigenvalue of an explanation's information below which a direction of its amplitudes is not
identifiable."""
_MIN_EFFECT = 1e-8
"""Size of a column, relative to the largest parameter's, below which it is rounding: a column absorbed by a drive's inertia."""


@dataclass(frozen=True, eq=False)
class BaseParameterDifference:
    """Inertial base parameters of a fit compared with trusted values.

    Attributes:
        d: Fit minus trusted (r,).
        S: Covariance of both together, if the robot file is accurate (r, r).
        S_rough: The same if it is rough (r, r): every body is wrong as a whole; None if the trusted values were identified.
        combine: Base parameters per unit of each parameter (r, p).
        names: Parameters' names (p,).
        estimate: The fit.
        select: Matrix that forms them from the fit's base parameters (r, all).
        trusted: Trusted values by name.
    """

    d: np.ndarray
    S: np.ndarray
    S_rough: np.ndarray | None
    combine: np.ndarray
    names: tuple[str, ...]
    estimate: Estimate
    select: np.ndarray
    trusted: Parameters

    @property
    def misfit(self) -> float:
        """Squared difference in units of its covariance."""
        return float(self.d @ np.linalg.solve(self.S, self.d))

    @property
    def rough_misfit(self) -> float:
        """Misfit of a rough file, comparable with `misfit`: both are twice a negative log-likelihood minus the same constant."""
        if self.S_rough is None:
            return np.inf
        rough, accurate = np.linalg.slogdet(self.S_rough)[1], np.linalg.slogdet(self.S)[1]
        return float(self.d @ np.linalg.solve(self.S_rough, self.d) + rough - accurate)

    @property
    def force_share(self) -> float:
        """Rms of the force of the difference after a refit of all other parameters, divided by that of the measured force."""
        estimate = self.estimate
        triangle = np.linalg.qr(estimate.stack_rows(), mode="r")
        least = np.linalg.lstsq(solve_triangular(triangle, self.select.T, trans=1).T, self.d)[0]
        measured = [(run.y / estimate.sigma)[run.usable] for run in estimate.regression.runs]
        return float(np.linalg.norm(least) / np.linalg.norm(np.concatenate(measured)))


@dataclass(frozen=True, eq=False)
class Explanation:
    """One cause of a difference.

    Attributes:
        cause: Its name.
        place: Link or joint, empty for all.
        amplitudes: Estimates (k,).
        cov: Their covariance (k, k); infinite variances if the data do not determine them.
        left: Remaining squared difference.
        rank: Number of identifiable amplitudes.
        dof: Number of base parameters minus `rank`.
        p: p-value of the explained part, corrected for the number of causes tried.
        twins: Indistinguishable causes, which explain as much.
        places: Other links or joints at which the same cause explains as much.
    """

    cause: str
    place: str
    amplitudes: np.ndarray
    cov: np.ndarray
    left: float
    rank: int
    dof: int
    p: float = 1.0
    twins: tuple[str, ...] = ()
    places: tuple[str, ...] = ()

    @property
    def penalised(self) -> float:
        """Misfit plus penalty."""
        return self.left + PENALTY * self.rank

    def p_value(self, whole: float, n_tried: int) -> float:
        """Return the p-value of the part of a squared difference that it explains, as one of several (Bonferroni)."""
        return min(1.0, n_tried * float(stats.chi2.sf(whole - self.left, self.rank)))

    def explains(self, whole: float) -> bool:
        """Return whether it explains all of a squared difference, or nearly all."""
        all_of_it = self.dof > 0 and float(stats.chi2.sf(self.left, self.dof)) > MIN_LEFT_P_VALUE
        sure = abs(self.amplitudes[0]) > MIN_AMPLITUDE_Z * float(np.sqrt(self.cov[0, 0]))
        possible = self.cause != "payload" or self.amplitudes[0] > 0
        return sure and possible and (all_of_it or self.left < (1 - MIN_EXPLAINED_SHARE) * whole)


def compare_with_trusted(robot: Robot, trusted: Parameters, estimate: Estimate) -> BaseParameterDifference:
    """Return the difference between the bodies of a fit and their trusted values.

    If the trusted values were themselves identified (they have standard errors), their combinations are assumed to be known as
    well as this fit's: a model file keeps no covariance. Otherwise their uncertainty is that of `BodyPrior`, and directions
    that an unknown drive inertia can explain are left out.
    """
    base = estimate.base
    bodies = {n for n in robot.parameters.names if not n.endswith(".gravity_mass")}
    E = np.zeros((base.rank, len(base.names)))
    E[range(base.rank), base.kept] = 1.0
    E[:, base.dropped] = base.K
    inertial = np.array([name in bodies for name in base.names])
    rows = np.flatnonzero(inertial[base.kept] & ~(E[:, ~inertial] != 0).any(axis=1))
    identified = any(trusted[n].stderr is not None for n in base.names if n in bodies)
    names = estimate.regression.parameters.names
    drives = [] if identified else [f"{j}.armature" for j in robot.actuated]
    unknown = [
        names.index(n) for n in drives if trusted[n].origin == NOT_GIVEN or trusted[n].origin.startswith("within")
    ]
    refits = [estimate.refit([run.W[:, :, k] for run in estimate.regression.runs])[rows] for k in unknown]
    select = _complement(refits, len(rows))
    select = select @ np.eye(base.rank)[rows]
    E = select @ E
    values = _values(trusted, base.names)
    own = estimate.stderr / np.sqrt(np.maximum(np.diag(estimate.cov), 1e-300))
    cov = select @ (estimate.cov * np.outer(own, own)) @ select.T
    S, S_rough = 2 * cov, None
    if not identified:
        prior = BodyPrior.of(robot, trusted)
        stderr = np.array([prior.accurate.get(name, 0.0) for name in base.names])
        S = cov + (E * stderr**2) @ E.T
        S_rough = S + _scale_bodies(robot, prior, base.names, E * values)
    return BaseParameterDifference(
        select @ estimate.beta_plain - E @ values, S, S_rough, E, base.names, estimate, select, trusted
    )


def find_explanation(robot: Robot, difference: BaseParameterDifference) -> Explanation | None:
    """Return the significant explanation of a difference, with its indistinguishable causes, or None."""
    if not len(difference.d):
        return None
    found = [one for row in _candidates(robot, difference) if (one := _fit(difference, *row)) is not None]
    whole = difference.misfit
    fit = [one for one in found if one.explains(whole) and one.p_value(whole, len(found)) < DIFFERENCE_LEVEL]
    best = min(fit, key=lambda one: one.penalised, default=None)
    if best is None or best.penalised + MIN_2LOGL_DIFFERENCE >= difference.rough_misfit:
        return None
    alike = [one for one in fit if one.penalised < best.penalised + MIN_2LOGL_DIFFERENCE]
    near = [one.cause for one in alike if one.cause != best.cause]
    places = dict.fromkeys(one.place for one in alike if one.cause == best.cause and one.place != best.place)
    from_file = all(difference.trusted[n].stderr is None for n in robot.parameters.names if n in difference.trusted)
    heavier = best.cause == "payload" and from_file
    extra = ["link_mass"] if heavier or best.cause == "drive_gain" else []  # a factor of all masses scales all forces
    twins = tuple(dict.fromkeys([*near, *extra]))
    return replace(best, p=best.p_value(whole, len(found)), twins=twins, places=tuple(places))


def compute_body_properties(pi: np.ndarray, R: np.ndarray | None = None, p: np.ndarray | None = None) -> np.ndarray:
    """Return mass, centre and inertia about the centre of ten inertial numbers (10,), in another frame of the body.

    Args:
        pi: Mass, first moments, inertia about the origin (10,) [kg, kg m, kg m^2], Pinocchio's order.
        R: Axes of the other frame, as columns (3, 3); by default the same.
        p: Its origin (3,) [m]; by default the same.

    Returns:
        Mass [kg], centre x y z [m], `ixx ixy iyy ixz iyz izz` about the centre [kg m^2] (10,).
    """
    R, p = np.eye(3) if R is None else R, np.zeros(3) if p is None else p
    mass, centre = pi[0], pi[1:4] / pi[0]
    ixx, ixy, iyy, ixz, iyz, izz = pi[4:]
    about_origin = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    inertia = R.T @ (about_origin - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))) @ R
    return np.array([mass, *(R.T @ (centre - p)), *inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])


def differentiate_body_properties(
    pi: np.ndarray, R: np.ndarray | None = None, p: np.ndarray | None = None
) -> np.ndarray:
    """Return the derivative (10, 10) of `compute_body_properties` by the ten numbers, by complex steps."""
    steps = 1e-30j * np.eye(10)
    return np.column_stack([compute_body_properties(pi + step, R, p).imag / 1e-30 for step in steps])


class BodyEstimate(NamedTuple):
    """A body's properties as `compute_body_properties` lists them (10,), their standard errors, and which are known."""

    values: np.ndarray
    stderr: np.ndarray
    known: np.ndarray


def estimate_body(estimate: Estimate, names: Sequence[str], R: np.ndarray, p: np.ndarray) -> BodyEstimate:
    """Return mass, centre and inertia of a body with their standard errors.

    Args:
        estimate: A solved regression.
        names: Its ten parameters there.
        R: Axes of the frame wanted, as columns in the joint's frame (3, 3).
        p: Its origin (3,) [m].
    """
    base = estimate.base
    kept = [base.names[k] for k in base.kept]
    place = {name: k for k, name in enumerate(kept) if base.alone[base.kept[k]]}
    pi, rows = estimate.parameters.select(names).values, np.zeros((10, base.rank))
    for k, name in enumerate(names):
        if name in place:
            rows[k, place[name]] = 1.0
    seen = np.array([name in place for name in names])
    at = pi if pi[0] > 0 else np.array([1.0, *np.zeros(9)])  # without a mass the centre is undefined
    values, slopes = compute_body_properties(at, R, p), differentiate_body_properties(at, R, p)
    needs = np.abs(slopes) > 1e-12 * np.abs(slopes).max()
    known = ~np.any(needs & ~seen, axis=1) & np.array([True, *[bool(pi[0] > 0)] * 9])
    errors = [estimate.stderr_of(slope @ rows) if ok else np.nan for slope, ok in zip(slopes, known, strict=True)]
    values[0] = pi[0]
    return BodyEstimate(values, np.array(errors), known)


PAYLOAD = "payload"
_UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)


def list_load_names(label: str = "") -> tuple[str, ...]:
    """Return the names of the ten inertial numbers of a body at the tool, for the logs with a label or for all."""
    return tuple(f"{PAYLOAD}.{quantity}{f'@{label}' if label else ''}" for quantity in INERTIAL)


def build_load_parameters(label: str = "", known: np.ndarray | None = None) -> Parameters:
    """Return the ten inertial numbers of a body at the tool, in the joint frame of its link.

    Args:
        label: The logs that carry it; empty for all logs with columns.
        known: Fixed values (10,); None for a free body of nonnegative mass.
    """
    values = np.zeros(len(INERTIAL)) if known is None else known
    rows = zip(list_load_names(label), values, _UNITS, INERTIAL, strict=True)
    return Parameters(
        Parameter(
            name,
            float(value),
            unit,
            lower=0.0 if quantity == "mass" and known is None else -np.inf,
            free=known is None,
            origin=PAYLOAD,
        )
        for name, value, unit, quantity in rows
    )


def constrain_loads(physics: PhysicalConstraints, labels: Sequence[str]) -> PhysicalConstraints:
    """Return constraints under which bodies at the tool, one for each label, are physically consistent as well."""
    bodies = [InertialBody(f"{PAYLOAD}@{label}", list_load_names(label), np.eye(len(INERTIAL))) for label in labels]
    return PhysicalConstraints((*physics.bodies, *bodies), physics.rotors)


def find_payload_frame(robot: Robot, body: LinkInertia) -> tuple[str, np.ndarray, np.ndarray]:
    """Return the frame in which a payload is given, as axes and origin in the joint's frame: the tool if it is on the link."""
    tool = robot.tool_frame
    if tool is not None and int(robot.model.frames[tool].parentJoint) == body.joint_id:
        at = robot.model.frames[tool].placement
        return str(robot.model.frames[tool].name), np.array(at.rotation), np.array(at.translation)
    return body.link, np.eye(3), np.zeros(3)


def is_identified(robot: Robot, trusted: Parameters) -> bool:
    """Return whether the values of a robot's bodies were identified before, with standard errors."""
    bodies = {name for link in robot.links for name in link.names}
    return any(p.stderr is not None for p in trusted if p.name in bodies)


def compute_payload_parameters(explanation: Explanation, joint: str) -> tuple[Parameter, ...]:
    """Return a payload's mass and its centre in the frame of the last joint, with standard errors."""
    cov = explanation.cov
    m = float(explanation.amplitudes[0])
    rows = [Parameter("payload.mass", m, "kg", stderr=_error(cov[0, 0]), origin="payload")]
    if len(explanation.amplitudes) == 10:
        values = compute_body_properties(explanation.amplitudes)
        slopes = differentiate_body_properties(explanation.amplitudes)[:, :4]
        for k, axis in enumerate("xyz", start=1):
            error = _error(float(slopes[k] @ cov[:4, :4] @ slopes[k])) if np.isfinite(cov[:4, :4]).all() else None
            name = f"payload.centre_{axis}"
            rows.append(Parameter(name, float(values[k]), "m", stderr=error, origin=f"in the frame of {joint}"))
    return tuple(rows)


def _candidates(robot: Robot, difference: BaseParameterDifference) -> list[tuple[str, str, np.ndarray]]:
    found: list[tuple[str, str, np.ndarray]] = []
    last = find_end_link(robot)
    if last is not None:
        found.append(("payload", last.link, _columns(difference, last)))
    pi = _values(difference.trusted, difference.names)
    for link in robot.links:
        columns = _columns(difference, link)
        found.append(("link_mass", link.link, columns[:, :1]))
        scaled = np.array([n.startswith(f"{link.link}.") for n in difference.names])
        mass = difference.trusted[f"{link.link}.mass"].value if f"{link.link}.mass" in difference.trusted else 0.0
        if mass > 0:
            found.append(("link_mass", link.link, (difference.combine @ np.where(scaled, pi, 0.0) / mass)[:, None]))
    whole = difference.combine @ pi
    if robot.na > 1:
        found.append(("drive_gain", "", whole[:, None]))
    if robot.base_coordinates:
        return found  # an equation holds the forces of several joints
    scales = [_force_scale(difference, k) for k in range(robot.na)]
    found += [("force_scale", joint, column[:, None]) for joint, column in zip(robot.actuated, scales, strict=True)]
    return found


def _values(parameters: Parameters, names: Sequence[str]) -> np.ndarray:
    """Return parameters' values (p,), zero for missing ones of effects."""
    return np.array([parameters[n].value if n in parameters else 0.0 for n in names])


def _columns(difference: BaseParameterDifference, link: LinkInertia) -> np.ndarray:
    """Return the base parameters (r, n) per unit of a link's own numbers: all ten, or its mass alone."""
    places = [difference.names.index(n) if n in difference.names else None for n in link.names]
    columns = [np.zeros(len(difference.d)) if k is None else difference.combine[:, k] for k in places]
    return np.column_stack(columns)


def _force_scale(difference: BaseParameterDifference, joint: int) -> np.ndarray:
    """Return the change of a refit by one joint's predicted force (r,): base parameters per unit of its factor minus one."""
    estimate = difference.estimate
    names = estimate.regression.parameters.names
    theta = np.where(np.isin(names, estimate.base.names), estimate.theta, 0.0)
    weight = np.arange(len(estimate.sigma)) == joint
    return difference.select @ estimate.refit([(run.W @ theta) * weight for run in estimate.regression.runs])


def _complement(directions: Sequence[np.ndarray], n: int) -> np.ndarray:
    """Return an orthonormal basis (n - u, n), as rows, of the complement of u independent directions (n,)."""
    if not directions:
        return np.eye(n)
    scaled = [x / np.linalg.norm(x) for x in directions if np.linalg.norm(x) > 0]
    values, vectors = np.linalg.eigh(sum((np.outer(x, x) for x in scaled), np.zeros((n, n))))
    return vectors[:, values < _RELATIVE_RANK * max(float(values.max(initial=0.0)), 1e-300)].T


def _fit(difference: BaseParameterDifference, cause: str, place: str, B: np.ndarray) -> Explanation | None:
    """Return an explanation's amplitudes by generalised least squares; None if it has no effect."""
    norm = np.linalg.norm(B, axis=0)
    if not norm[0] > _MIN_EFFECT * np.linalg.norm(difference.combine, axis=0).max():
        return None
    unit = np.where(norm > 0, norm, 1.0)
    C = np.linalg.solve(difference.S, B / unit)
    information = (B / unit).T @ C
    values, vectors = np.linalg.eigh(information)
    seen = values > _RELATIVE_RANK * values.max()
    inverse = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T
    x = inverse @ (C.T @ difference.d)
    blind = (vectors[:, ~seen] ** 2).sum(axis=1) > 0.01
    cov = inverse / np.outer(unit, unit)
    cov[blind, blind] = np.inf
    e = difference.d - B / unit @ x
    rank = int(seen.sum())
    return Explanation(cause, place, x / unit, cov, float(e @ np.linalg.solve(difference.S, e)), rank, len(e) - rank)


def _scale_bodies(robot: Robot, prior: BodyPrior, names: Sequence[str], forces: np.ndarray) -> np.ndarray:
    """Return the covariance (r, r) of base parameters if every body is wrong as a whole, each by a share of its mass.

    Args:
        robot: The robot.
        prior: Prior of its bodies.
        names: Parameters' names (p,).
        forces: Contribution of each parameter to the base parameters (r, p).
    """
    shares = {
        link.link: prior.rough[f"{link.link}.mass"] / prior.size[f"{link.link}.mass"]
        for link in robot.links
        if f"{link.link}.mass" in prior.rough
    }
    bodies = [
        share * forces[:, [name.rpartition(".")[0] == link for name in names]].sum(axis=1)
        for link, share in shares.items()
    ]
    return sum((np.outer(one, one) for one in bodies), np.zeros((len(forces),) * 2))


def _error(variance: float) -> float | None:
    return float(np.sqrt(variance)) if np.isfinite(variance) and variance > 0 else None
