r"""What a sampled model says of the structure behind it: poles and residues in continuous time, with their uncertainty.

The inputs are held over a step, so each mode of `x_{k+1} = z x_k + b u_k` is `x' = lambda x + b lambda / (z - 1) u` with
`lambda = log(z) / dt`, exactly. Uncertainty travels as a factor `F` with `F F'` the covariance of the response at chosen points;
nothing depends on which parameters the model was written in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.modes.places import Places
from tau_dyn.modes.state_space import StateSpace

STEP = 1e-2
"""Step of the central differences, in standard errors."""


class HasResiduals(Protocol):
    """What a refined model must offer."""

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
    """

    poles: np.ndarray
    left: np.ndarray
    right: np.ndarray
    through: np.ndarray
    derivative: int = 0

    def response(self, s: np.ndarray) -> np.ndarray:
        """Return displacement over input (F, p, m) at complex frequencies s (F,) [rad/s]."""
        terms = self.right / (s[:, None] - self.poles)[:, :, None]
        return (self.left @ terms + self.through) / s[:, None, None] ** self.derivative

    @property
    def oscillating(self) -> np.ndarray:
        """Indices of one pole of each complex pair, slowest first."""
        upper = np.flatnonzero(self.poles.imag > 1e-9 * np.abs(self.poles))
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


def convert_to_continuous(model: StateSpace, derivative: int = 0) -> Continuous:
    """Return the continuous-time model whose held inputs give the sampled one; its delay is left out.

    Raises:
        CannotAnswer: A pole lies where no continuous-time system puts one.
    """
    z, V = np.linalg.eig(model.A)
    z = z.astype(complex)
    if np.any((np.abs(z.imag) < 1e-12) & (z.real <= 0)):
        raise CannotAnswer(
            "not_identifiable",
            "a pole of the model lies at or beyond half the sampling rate",
            "choose another order, or sample faster than twice the highest resonance",
        )
    poles = np.log(z) / model.dt
    still = np.abs(z - 1) < 1e-12
    hold = np.where(still, 1 / model.dt, poles / np.where(still, 1, z - 1))
    return Continuous(poles, model.C @ V, hold[:, None] * np.linalg.solve(V, model.B), model.D, derivative)


@dataclass(frozen=True, eq=False)
class Evidence:
    """A model and what its parameters' covariance says of its response.

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

    def completed(self, places: Places) -> Evidence:
        """Return what the oscillating modes say of every pair of named degrees of freedom."""
        near = tuple((up.completed(places), down.completed(places)) for up, down in self.nearby)
        return Evidence(self.at.completed(places), near, self.dt)


def build_evidence(source: StateSpace | HasResiduals | Any, derivative: int = 0) -> Evidence:
    """Return the evidence in a model, refined (with covariance) or not.

    Args:
        source: A `StateSpace`, or anything with `model`, `theta`, `covariance` and `model_at`.
        derivative: How often its outputs are differentiated.

    Raises:
        CannotAnswer: A pole lies where no continuous-time system puts one.
    """
    if isinstance(source, StateSpace):
        return Evidence(convert_to_continuous(source, derivative), (), source.dt)
    steps = _steps(source.theta, source.covariance, source.model_at)
    near = tuple((convert_to_continuous(up, derivative), convert_to_continuous(down, derivative)) for up, down in steps)
    return Evidence(convert_to_continuous(source.model, derivative), near, source.model.dt)


def _steps(theta: np.ndarray, covariance: np.ndarray, model_at: Callable[[np.ndarray], StateSpace]):
    """Yield the models along the principal directions of the correlation; directions known exactly are left out."""
    known = np.isfinite(np.diag(covariance))  # modes that cannot be told apart have none
    covariance = np.where(np.outer(known, known), covariance, 0.0)
    size = np.sqrt(np.maximum(np.diag(covariance), 0))
    unit = np.where(size > 0, size, 1)
    value, vector = np.linalg.eigh(covariance / np.outer(unit, unit))
    for k in np.flatnonzero(value > 1e-13 * value[-1]):
        step = STEP * unit * vector[:, k] * np.sqrt(value[k])
        yield model_at(theta + step), model_at(theta - step)
