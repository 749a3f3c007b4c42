"""Keep an estimate physical: the nearest admissible parameters, in the metric of the data.

    minimise  || R (theta_B + K theta_D - beta) ||^2 + eps || (theta - theta_nominal) / scale ||^2
    subject to  lower <= theta <= upper,   J = [[ 1/2 tr(I) 1 - I,  m c ], [ (m c)',  m ]]  >=  0   of every body

The two Coulomb values of a joint are bounded by their sum alone, which is at least zero: a constant offset of the force sensor
adds to one and takes from the other. `J` is the pseudo-inertia, `I` about the joint frame's origin: it is positive semidefinite
if and only if some distribution of positive mass has these ten numbers. A conic program (cvxpy, clarabel). The second term
chooses the vector nearest the robot file among those that fit the data equally; `eps` is too small to move the combinations that
the data determine.
Reference: Sousa & Cortesao 2014; Wensing, Kim & Slotine 2018.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.estimate.base_parameters import BaseParameters
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.parameters import Parameters

_IXX, _IXY, _IYY, _IXZ, _IYZ, _IZZ = range(4, 10)


@dataclass(frozen=True, eq=False)
class InertialBody:
    """One body, with the map to its ten inertial parameters `pi = map @ parameters`.

    Attributes:
        name: Link name.
        parameters: Names of its parameters (k,).
        map: (10, k).
    """

    name: str
    parameters: tuple[str, ...]
    map: np.ndarray


@dataclass(frozen=True, eq=False)
class PhysicalConstraints:
    """Bodies whose inertial parameters must be physically consistent.

    Attributes:
        bodies: The bodies.
        rotors: Fixed drive inertias that no data separate from the bodies'. A rotor turns about its joint alone, faster than the
            body that carries it, so its inertia in a body may be more than any mass distribution has.
    """

    bodies: tuple[InertialBody, ...]
    rotors: tuple[str, ...] = ()


def pseudo_inertia(pi: np.ndarray) -> np.ndarray:
    """Return the pseudo-inertia (4, 4) of ten inertial numbers (10,), Pinocchio's order, about the joint origin."""
    return np.tensordot(np.asarray(pi, float), PSEUDO_INERTIA_BASIS, axes=1)


def _basis() -> np.ndarray:
    basis = np.zeros((10, 4, 4))
    basis[0, 3, 3] = 1.0
    for k in range(3):
        basis[1 + k, k, 3] = basis[1 + k, 3, k] = 1.0
    for k, index in enumerate((_IXX, _IYY, _IZZ)):
        basis[index, :3, :3] = np.eye(3) / 2
        basis[index, k, k] -= 1.0
    for (i, j), index in (((0, 1), _IXY), ((0, 2), _IXZ), ((1, 2), _IYZ)):
        basis[index, i, j] = basis[index, j, i] = -1.0
    return basis


PSEUDO_INERTIA_BASIS = _basis()
"""`d J / d pi` (10, 4, 4): the pseudo-inertia is linear in the ten numbers."""


_EPS = (1e-4, 1e-2)
"""Pull towards the robot file: the smallest with a solvable program is used. On TX40, 1e-4 moves no base parameter by 0.03 of its
standard error, while with 1e-6 link masses drift to 55 kg and the solver stops early."""
_UNITS = (1.0, 1e-2, 1e-4, 1e-6)
"""Units of the cost, tried until the solver succeeds: data almost without noise make costs of 1e14, at which it fails."""
_MAX_CHI2_RISE = 1e-2
"""Rise of chi-square above which physics has moved combinations that the data determine; the solver is more accurate."""
_MAX_ITERATIONS = 12
"""Largest number of repetitions from the last solution, if a file that is wrong by orders of magnitude (placeholders, grams,
millimetres) moved it by its pull or its scale; physics alone gives the same rise again, and the first solution is kept."""
_MAX_CHI2_RISE_RATIO = 0.8
"""Ratio of the rises of chi-square below which another iteration counts as an improvement."""
_EDGE = 1e-6
"""Distance from a bound, as a share of a parameter's typical size, within which the parameter is at its bound."""


@dataclass(frozen=True)
class ConstrainedParameters:
    """Admissible parameters, and those that a constraint holds away from their plain estimate (name -> plain value)."""

    parameters: Parameters
    moved: Mapping[str, float]


def solve_consistent(
    parameters: Parameters, base: BaseParameters, beta: np.ndarray, R: np.ndarray, physics: PhysicalConstraints | None
) -> ConstrainedParameters:
    """Return the admissible parameters nearest to base estimates `beta` (r,).

    Args:
        parameters: All parameters with bounds; fixed ones stay.
        base: Base parameters of the free columns.
        beta: Plain base estimates (r,).
        R: Triangular factor (r, r) with `R' R = W' W` of the weighted rows, so that an active bound acts as a fixed value.
        physics: Bodies to keep physical; None for bounds alone.
    """
    plain = parameters.with_values(_plain_values(parameters, base, beta))
    bodies = [b for b in (physics.bodies if physics else ()) if len(b.parameters) > 1]
    if _within_bounds(plain) and all(_is_physical(b, plain) for b in bodies):
        return ConstrainedParameters(plain, {})
    theta = _program(parameters, base, beta, R, bodies)
    rise = float(np.sum((R @ (base.combine(theta) - beta)) ** 2))
    for _ in range(_MAX_ITERATIONS):
        if rise <= _MAX_CHI2_RISE:
            break
        near = parameters.with_values(dict(zip(base.names, theta, strict=True)))
        try:
            again = _program(near, base, beta, R, bodies)
        except InputError:
            break
        if (left := float(np.sum((R @ (base.combine(again) - beta)) ** 2))) > _MAX_CHI2_RISE_RATIO * rise:
            break
        theta, rise = again, left
    solved = parameters.with_values(dict(zip(base.names, theta, strict=True)))
    physical = _made_physical(solved, plain, bodies) if rise > _MAX_CHI2_RISE else {}
    return ConstrainedParameters(solved, _out_of_bounds(plain, base) | physical)


def _plain_values(parameters: Parameters, base: BaseParameters, beta: np.ndarray) -> dict[str, float]:
    """Return values with the same prediction as `beta`, with the dropped parameters unchanged."""
    theta = parameters.select(base.names).values
    theta[base.kept] = beta - base.K @ theta[base.dropped]
    return dict(zip(base.names, theta, strict=True))


def _within_bounds(parameters: Parameters) -> bool:
    inside = all(p.lower <= p.value <= p.upper for p in parameters if p.free)
    return inside and all(_add(parameters, pair) >= 0.0 for pair in _list_free_sums(parameters))


def _list_free_sums(parameters: Parameters) -> list[tuple[str, str]]:
    """Return the sums of Coulomb values that a fit may change."""
    return [pair for pair in parameters.friction_sums if any(parameters[name].free for name in pair)]


def _add(parameters: Parameters, names: Iterable[str]) -> float:
    return sum(parameters[name].value for name in names)


def _smallest(body: InertialBody, parameters: Parameters) -> tuple[float, float]:
    """Return the smallest eigenvalue of a body's pseudo-inertia, and its trace."""
    J = pseudo_inertia(body.map @ parameters.select(body.parameters).values)
    return float(np.linalg.eigvalsh(J)[0]), float(np.trace(J))


def _is_physical(body: InertialBody, parameters: Parameters) -> bool:
    least, trace = _smallest(body, parameters)
    return least >= -1e-12 * abs(trace)  # a point mass is physical


def _program(
    parameters: Parameters, base: BaseParameters, beta: np.ndarray, R: np.ndarray, bodies: list[InertialBody]
) -> np.ndarray:
    import cvxpy as cp  # slow to import, and most fits never need it

    free = parameters.select(base.names)
    nominal = free.values
    scale = _scale(free, base, beta)
    x = cp.Variable(len(free))  # in units of `scale`
    theta = cp.multiply(scale, x)
    combine = np.zeros((base.rank, len(free)))
    combine[range(base.rank), base.kept] = 1.0
    combine[:, base.dropped] = base.K
    misfit = (R @ combine * scale) @ x - R @ beta
    lower, upper = np.array([p.lower for p in free]), np.array([p.upper for p in free])
    constraints = _within(x, lower / scale, upper / scale)
    position = {name: k for k, name in enumerate(base.names)}
    sums = [pair for pair in _list_free_sums(parameters) if any(name in position for name in pair)]
    constraints += [_sum_of(pair, parameters, position, theta) >= 0 for pair in sums]
    for body in bodies:
        constraints.append(_pseudo_inertia_of(body, parameters, position, theta) >> 0)
    # combinations that the data do not determine keep their value; others are pulled by far less than their own uncertainty
    _minimise(cp.sum_squares(misfit), cp.sum_squares(x - nominal / scale), constraints, bodies, x)
    solution = np.clip(scale * x.value, lower, upper)
    for edge in (lower, upper):  # an interior-point solver stops just short of an edge
        solution = np.where(np.abs(solution - edge) < _EDGE * scale, edge, solution)
    for pair in sums:
        known = {name: solution[position[name]] if name in position else parameters[name].value for name in pair}
        last = position[next(name for name in reversed(pair) if name in position)]
        if sum(known.values()) < _EDGE * scale[last]:
            solution[last] -= sum(known.values())
    return solution


def _sum_of(pair: Iterable[str], parameters: Parameters, position: Mapping[str, int], theta: Any) -> Any:
    """Return the sum of some parameters as an expression of the program's variables."""
    return sum(theta[position[name]] if name in position else parameters[name].value for name in pair)


def _within(x: Any, lower: np.ndarray, upper: np.ndarray) -> list[Any]:
    """Return the constraints that finite bounds make."""
    low, high = np.isfinite(lower), np.isfinite(upper)
    return [*([x[low] >= lower[low]] if low.any() else []), *([x[high] <= upper[high]] if high.any() else [])]


def _minimise(misfit: Any, pull: Any, constraints: list[Any], bodies: list[InertialBody], x: Any) -> None:
    """Solve the program with the smallest pull at which it is solvable; `x` then holds the solution."""
    import cvxpy as cp

    for unit, eps in ((unit, eps) for unit in _UNITS for eps in _EPS):
        if unit != _UNITS[0] and x.value is not None:
            break
        problem = cp.Problem(cp.Minimize(unit * misfit + unit * eps * pull), constraints)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an inaccurate solution shows in the status
            try:
                problem.solve(solver=cp.CLARABEL, ignore_dpp=True)
            except cp.SolverError:
                continue
        if problem.status == cp.OPTIMAL:
            break
    if x.value is None and not bodies:  # bounds alone always leave room
        raise CannotAnswer(
            "too_little_data",
            f"{x.size} parameters are too many for so short or dull a log",
            "record 10 s or more of varied motion of all joints",
        )
    if x.value is None:
        listed = ", ".join(body.name for body in bodies) or "the bounds"
        raise InputError(
            "infeasible",
            f"no admissible parameters exist ({problem.status}): fixed or bounded values contradict each other or the physics of "
            f"{listed}",
        )


def _pseudo_inertia_of(body: InertialBody, parameters: Parameters, position: dict[str, int], theta: Any) -> Any:
    """Return a body's pseudo-inertia (4, 4) as an expression of the program's variables."""
    import cvxpy as cp

    total, columns = np.zeros((4, 4)), np.zeros((16, theta.size))
    for name, column in zip(body.parameters, body.map.T, strict=True):
        J = np.tensordot(column, PSEUDO_INERTIA_BASIS, axes=1)
        if name in position:
            columns[:, position[name]] = J.ravel()
        else:
            total = total + parameters[name].value * J
    return (
        cp.reshape(columns @ theta, (4, 4), order="F") + total
    )  # one product, not a sum that cvxpy processes term by term


def _scale(free: Parameters, base: BaseParameters, beta: np.ndarray) -> np.ndarray:
    """Return a typical size of each parameter, so that the program is well scaled."""
    size = np.abs(free.values)
    size[base.kept] = np.maximum(size[base.kept], np.abs(beta))
    typical = np.median(size[size > 0]) if np.any(size > 0) else 1.0
    return np.where(size > 1e-3 * typical, size, 1e-3 * typical)


def _out_of_bounds(plain: Parameters, base: BaseParameters) -> dict[str, float]:
    """Return the parameters whose plain estimates are outside their bounds, with plain values."""
    seen = [plain[name] for name, alone in zip(base.names, base.alone, strict=True) if alone]
    names = {p.name for p in seen}
    sums = {" + ".join(pair): _add(plain, pair) for pair in plain.friction_sums if names.issuperset(pair)}
    found = {p.name: p.value for p in seen if not p.lower <= p.value <= p.upper}
    return found | {name: value for name, value in sums.items() if value < 0.0}


def _made_physical(solved: Parameters, plain: Parameters, bodies: list[InertialBody]) -> dict[str, float]:
    """Return the bodies on the limit of consistency whose plain estimate is beyond it, with its smallest eigenvalue."""
    moved = {}
    for body in bodies:
        least, trace = _smallest(body, solved)
        if least < 1e-6 * max(trace, 1e-12) and not _is_physical(body, plain):
            moved[f"{body.name} inertia"] = _smallest(body, plain)[0]
    return moved
