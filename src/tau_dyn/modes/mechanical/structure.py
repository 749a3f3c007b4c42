"""A mass-damper-spring structure, its driven and sensed degrees of freedom, and the evidence in a sampled model.

    M q'' + D q' + K q = f,      X(s) = (M s^2 + D s + K)^{-1} B U(s)

(thesis (6.14), which is printed uninverted). Every output names a degree of freedom. An input collocated with an output pushes
the same one; any other input pushes one of its own, which no sensor watches. Modes are known at all of them once one pair is
collocated, because the residue of mode i is `psi_sensed psi_driven'` with one and the same `psi`.

With inputs held over a step, each mode of `x_{k+1} = z x_k + b u_k` is `x' = lambda x + b lambda / (z - 1) u` with
`lambda = log(z) / dt`, exactly. A force that is a straight line between samples acts through both ends of a step: with
`beta = b lambda^2 dt / (z - 1)^2` it drives `x' = lambda x + beta u`, and the sampled states are those less `g u`,
`g = beta (z - 1 - lambda dt) / (lambda^2 dt)`, so that the direct part is less by `C g`. One sampled model thus
represents two structures, one of which fits.

Uncertainty is passed on as a factor `F` with `F F'` the covariance of the response at chosen points; the result does
not depend on the parametrisation of the model. References: De Angelis, Lus, Betti & Longman 2002; Ewins 2000, 2.8.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from scipy.linalg import expm

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.modes.state_space import MAX_RESONANT_DAMPING, StateSpace

OUTPUTS = ("displacement", "velocity", "acceleration")
"""Quantities that a sensor may measure; the index is the order of the time derivative."""


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """A structure of n degrees of freedom, in units of force and displacement.

    Attributes:
        M: Inertia (n, n).
        D: Damping (n, n).
        K: Stiffness (n, n).
    """

    M: np.ndarray
    D: np.ndarray
    K: np.ndarray

    def compliance(self, s: np.ndarray) -> np.ndarray:
        """Return `(M s^2 + D s + K)^{-1}` (F, n, n) at complex frequencies s (F,) [rad/s]."""
        s = np.asarray(s)[:, None, None]
        return np.linalg.inv(self.M * s**2 + self.D * s + self.K)

    def system_matrix(self) -> np.ndarray:
        """Return the matrix (2n, 2n) of the states (q, q')."""
        n = len(self.M)
        below = -np.linalg.solve(self.M, np.hstack([self.K, self.D]))
        return np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), below])

    def poles(self) -> np.ndarray:
        """Return the 2n poles [rad/s], slowest first."""
        poles = np.linalg.eigvals(self.system_matrix())
        return poles[np.argsort(np.abs(poles), kind="stable")]

    def sampled(
        self, dt: float, driven: Sequence[int], sensed: Sequence[int], output: str = "displacement"
    ) -> StateSpace:
        """Return the structure as a sampled model whose inputs are held over each step; exact.

        Args:
            dt: Sampling step [s].
            driven: Degree of freedom that each input pushes.
            sensed: Degree of freedom that each output watches.
            output: One of `OUTPUTS`.
        """
        n, m = len(self.M), len(driven)
        A, force = self.system_matrix(), np.linalg.solve(self.M, np.eye(n)[:, list(driven)])
        step = expm(dt * np.block([[A, np.vstack([np.zeros((n, m)), force])], [np.zeros((m, 2 * n + m))]]))
        rows = np.vstack([np.eye(2 * n), A[n:]])[count_derivatives(output) * n :][list(sensed)]
        through = force[list(sensed)] if output == "acceleration" else np.zeros((len(sensed), m))
        gain = np.zeros((2 * n, len(sensed)))
        return StateSpace(step[: 2 * n, : 2 * n], step[: 2 * n, 2 * n :], rows, through, gain, dt)


def count_derivatives(output: str) -> int:
    """Return how often an output is differentiated: 0, 1 or 2.

    Raises:
        InputError: It is not one of `OUTPUTS`.
    """
    if output not in OUTPUTS:
        raise InputError("invalid_value", f"output '{output}' is not known; it is one of {', '.join(OUTPUTS)}")
    return OUTPUTS.index(output)


def build_symmetric_basis(n: int) -> np.ndarray:
    """Return the symmetric matrices (n(n+1)/2, n, n) with ones at one place of the upper triangle and its mirror."""
    rows, columns = np.triu_indices(n)
    basis = np.zeros((len(rows), n, n))
    basis[range(len(rows)), rows, columns] = 1.0
    basis[range(len(rows)), columns, rows] = 1.0
    return basis


def pack(structure: SecondOrder) -> np.ndarray:
    """Return the upper triangles of M, D and K as one vector (3n(n+1)/2,)."""
    upper = np.triu_indices(len(structure.M))
    return np.concatenate([structure.M[upper], structure.D[upper], structure.K[upper]])


def unpack(x: np.ndarray, n: int) -> SecondOrder:
    """Return the structure whose upper triangles are `x`."""
    M, D, K = np.tensordot(x.reshape(3, -1), build_symmetric_basis(n), axes=1)
    return SecondOrder(M, D, K)


@dataclass(frozen=True)
class Places:
    """Places of sensors and forces.

    Attributes:
        sensed: Degree of freedom of each output.
        driven: Degree of freedom of each input.
    """

    sensed: tuple[int, ...]
    driven: tuple[int, ...]

    @property
    def n(self) -> int:
        """Number of degrees of freedom named by any input or output."""
        return len({*self.sensed, *self.driven})

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Collocated pairs (input, output)."""
        return [(j, self.sensed.index(dof)) for j, dof in enumerate(self.driven) if dof in self.sensed]

    def select(self, compliance: np.ndarray) -> np.ndarray:
        """Return the measured part (F, p, m) of a full compliance (F, n, n)."""
        return compliance[:, list(self.sensed)][:, :, list(self.driven)]

    def scale(self, response: np.ndarray) -> np.ndarray:
        """Return a typical size of motion per root of work (n,), which gives metres and radians equal weight.

        Args:
            response: Displacement over force (F, p, m).
        """
        size = np.median(np.abs(response), axis=0)
        size = np.maximum(size, 1e-9 * size.max(initial=1e-280))
        scale = np.zeros(self.n)
        for j, i in self.pairs:
            scale[self.sensed[i]] = np.sqrt(size[i, j])
        j, i = max(self.pairs, key=lambda pair: size[pair[1], pair[0]])
        reference = np.sqrt(size[i, j])
        for row, dof in enumerate(self.sensed):
            scale[dof] = scale[dof] or size[row, j] / reference
        for column, dof in enumerate(self.driven):
            scale[dof] = scale[dof] or size[i, column] / reference
        return scale

    def unit(self, response: np.ndarray) -> np.ndarray:
        """Return the typical size (p, m) of each entry of a response (F, p, m), the product of its two ends' scales."""
        scale = self.scale(response)
        return np.outer(scale[list(self.sensed)], scale[list(self.driven)])

    @property
    def square(self) -> Places:
        """A sensor and a force at every degree of freedom."""
        return Places(tuple(range(self.n)), tuple(range(self.n)))

    def complete(self, residues: np.ndarray) -> np.ndarray:
        """Return mode shapes psi (modes, n), with `psi psi'` the residues (modes, p, m), signs free."""
        U, S, Vh = np.linalg.svd(residues)
        left, right = U[:, :, 0], S[:, :1] * Vh[:, 0]
        # the two factors share a complex scale; for a collocated pair they are the same number
        rows, columns = [i for _, i in self.pairs], [j for j, _ in self.pairs]
        ratio = np.sum(left[:, rows].conj() * right[:, columns], axis=1)
        seen = np.sum(np.abs(left[:, rows]) ** 2, axis=1)
        # a mode that no collocated pair sees has no scale; any will do, for it leaves no information either
        known = np.abs(ratio) > 1e-12 * np.sqrt(seen) * S[:, 0]
        root = np.sqrt(np.where(known, ratio, S[:, 0] + 1e-280) / np.where(known, seen, 1.0))[:, None]
        shapes = np.zeros((len(residues), self.n), complex)
        shapes[:, list(self.driven)] = right / root
        shapes[:, list(self.sensed)] = left * root
        return shapes


def find_places(p: int, m: int, collocated: Sequence[tuple[int, int]] | None) -> Places:
    """Return the places of p outputs and m inputs.

    Args:
        p: Number of outputs.
        m: Number of inputs.
        collocated: Pairs (input, output) at one degree of freedom; None: all in order if p equals m, else no pairs.

    Raises:
        InputError: A pair names an input or output that does not exist, or one twice.
    """
    pairs = [(k, k) for k in range(p)] if collocated is None and p == m else list(collocated or ())
    for side, size, used in (("input", m, [j for j, _ in pairs]), ("output", p, [i for _, i in pairs])):
        if any(not 0 <= k < size for k in used):
            raise InputError(
                "invalid_value",
                f"a collocated pair names {side} {max(used, key=abs)}; there are {size}, counted from 0",
            )
        if len(set(used)) < len(used):
            raise InputError("duplicate_name", f"a collocated pair names the same {side} twice")
    at, free = dict(pairs), iter(range(p, p + m))
    return Places(tuple(range(p)), tuple(at[j] if j in at else next(free) for j in range(m)))


STEP = 1e-2  # step of the central differences, in standard errors


class HasResiduals(Protocol):
    """Interface of a refined model."""

    model: StateSpace
    theta: np.ndarray
    covariance: np.ndarray

    def model_at(self, theta: np.ndarray) -> StateSpace:
        """Return the model of other parameters."""
        ...


@dataclass(frozen=True, eq=False)
class Continuous:
    """A model in continuous time, one term a pole.

    Attributes:
        poles: (n,) [rad/s].
        left: Outputs per modal state (p, n).
        right: Modal states per input (n, m).
        through: Direct part (p, m).
        derivative: How often the outputs are differentiated; `response` undoes it.
        only_peaks: Whether pairs of poles without a peak, such as those of a sensor's filter, count as no modes.
        n_left_out: Poles that no continuous-time system has, taken at rest into the direct part.
    """

    poles: np.ndarray
    left: np.ndarray
    right: np.ndarray
    through: np.ndarray
    derivative: int = 0
    only_peaks: bool = False
    n_left_out: int = 0

    def response(self, s: np.ndarray) -> np.ndarray:
        """Return displacement over input (F, p, m) at complex frequencies s (F,) [rad/s]."""
        terms = self.right / (s[:, None] - self.poles)[:, :, None]
        return (self.left @ terms + self.through) / s[:, None, None] ** self.derivative

    @property
    def oscillating(self) -> np.ndarray:
        """Indices of one pole of each complex pair, slowest first."""
        oscillates = self.poles.imag > 1e-9 * np.abs(self.poles)
        if self.only_peaks:
            oscillates &= -self.poles.real < MAX_RESONANT_DAMPING * np.abs(self.poles)
        upper = np.flatnonzero(oscillates)
        return upper[np.argsort(np.abs(self.poles[upper]), kind="stable")]

    @property
    def residues(self) -> np.ndarray:
        """Residues (modes, p, m) of displacement over input at the oscillating poles."""
        k = self.oscillating
        found = self.left.T[k][:, :, None] * self.right[k][:, None, :]
        return found / self.poles[k][:, None, None] ** self.derivative

    def completed(self, places: Places) -> Continuous:
        """Return the oscillating modes from a force at every named degree of freedom to every one, by reciprocity."""
        k = self.oscillating
        shapes = places.complete(self.residues)
        poles, left = np.concatenate([self.poles[k], self.poles[k].conj()]), np.vstack([shapes, shapes.conj()])
        return Continuous(poles, left.T, left, np.zeros((places.n, places.n)))


HELD, LINEAR = "held", "linear"
"""Course of an input between samples: held constant, or a straight line."""


def convert_to_continuous(model: StateSpace, derivative: int = 0, hold: str = HELD) -> Continuous:
    """Return the continuous-time model that gives the sampled one; its delay is left out.

    Args:
        model: The sampled model.
        derivative: How often its outputs are differentiated.
        hold: Course of the inputs between samples: `held` or `linear`.

    Raises:
        CannotAnswer: No pole has a counterpart in continuous time.
    """
    z, V = np.linalg.eig(model.A)
    z, left, right = z.astype(complex), model.C @ V, np.linalg.solve(V.astype(complex), model.B)
    none = (np.abs(z.imag) < 1e-12) & (z.real <= 0)
    direct = model.D + np.real((left[:, none] / (1 - z[none])) @ right[none])
    z, left, right = z[~none], left[:, ~none], right[~none]
    if not len(z):
        raise CannotAnswer(
            "not_identifiable",
            "every pole of the model is at or beyond half the sampling rate",
            "choose another order, or sample faster than twice the highest resonance",
        )
    poles, dt = np.log(z) / model.dt, model.dt
    still = np.abs(z - 1) < 1e-12
    step = np.where(still, dt, (z - 1) / np.where(still, 1, poles))  # integral of a mode's decay over a sample
    if hold == HELD:
        return Continuous(poles, left, right / step[:, None], direct, derivative, n_left_out=int(none.sum()))
    right = right * (dt / step**2)[:, None]
    ahead = np.where(still, dt / 2, (step - dt) / np.where(still, 1, poles * dt))
    through = direct - np.real((left * ahead) @ right)
    return Continuous(poles, left, right, through, derivative, n_left_out=int(none.sum()))


@dataclass(frozen=True, eq=False)
class Evidence:
    """A model and the uncertainty of its response that follows from the covariance of its parameters.

    Attributes:
        at: The model in continuous time.
        nearby: Models one small step up and down every independent direction of the parameters, or empty.
        dt: Sampling step [s].
    """

    at: Continuous
    nearby: tuple[tuple[Continuous, Continuous], ...]
    dt: float

    @property
    def has_covariance(self) -> bool:
        """Whether standard errors can be given."""
        return bool(self.nearby)

    def factor(self, s: np.ndarray) -> np.ndarray:
        """Return the factor (F p m, r), complex, of the response's covariance at s (F,)."""
        columns = [(up.response(s) - down.response(s)).ravel() / (2 * STEP) for up, down in self.nearby]
        return np.column_stack(columns)

    def with_peaks_only(self) -> Evidence:
        """Return the evidence in which pairs of poles without a peak are no modes."""
        near = tuple((replace(up, only_peaks=True), replace(down, only_peaks=True)) for up, down in self.nearby)
        return Evidence(replace(self.at, only_peaks=True), near, self.dt)

    def completed(self, places: Places) -> Evidence:
        """Return the response of the oscillating modes between every pair of named degrees of freedom."""
        near = tuple((up.completed(places), down.completed(places)) for up, down in self.nearby)
        return Evidence(self.at.completed(places), near, self.dt)


def build_evidence(source: StateSpace | HasResiduals | Any, derivative: int = 0, hold: str = HELD) -> Evidence:
    """Return the evidence in a model, refined (with covariance) or not.

    Args:
        source: A `StateSpace`, or anything with `model`, `theta`, `covariance` and `model_at`.
        derivative: How often its outputs are differentiated.
        hold: Course of the inputs between samples: `held` or `linear`.

    Raises:
        CannotAnswer: A pole has no counterpart in continuous time.
    """
    if isinstance(source, StateSpace):
        return Evidence(convert_to_continuous(source, derivative, hold), (), source.dt)
    steps = _steps(source.theta, source.covariance, source.model_at)
    near = tuple(
        (convert_to_continuous(up, derivative, hold), convert_to_continuous(down, derivative, hold))
        for up, down in steps
    )
    return Evidence(convert_to_continuous(source.model, derivative, hold), near, source.model.dt)


def _steps(theta: np.ndarray, covariance: np.ndarray, model_at: Callable[[np.ndarray], StateSpace]):
    """Yield the models along the principal directions of the correlation; directions known exactly are left out."""
    known = np.isfinite(np.diag(covariance))  # modes that cannot be distinguished have nan
    covariance = np.where(np.outer(known, known), covariance, 0.0)
    size = np.sqrt(np.maximum(np.diag(covariance), 0))
    unit = np.where(size > 0, size, 1)
    value, vector = np.linalg.eigh(covariance / np.outer(unit, unit))
    for k in np.flatnonzero(value > 1e-13 * value[-1]):
        step = STEP * unit * vector[:, k] * np.sqrt(value[k])
        yield model_at(theta + step), model_at(theta - step)
