"""M, D and K from a black-box model: `(M s^2 + D s + K) X(s) = B U(s)`, and whether they mean anything.

The route: the model's response in continuous time -> a conic program -> maximum likelihood with the model's own covariance -> a
verdict. Forces and displacements keep the user's units, so M, D, K are in force per acceleration, velocity and displacement.
References: thesis 6.3 (its form (6.14), fitted there without constraints); De Angelis, Lus, Betti & Longman 2002.

The thesis' own route, for comparison: a model of 2p states and p outputs is brought to the states (x, x'), where its lower rows
are `-M^-1 K` and `-M^-1 D` and its input rows `M^-1 B` (after Cescon et al. 2009). Nothing makes M, D, K symmetric or definite.
Of the printed matrices: K, called positive definite there, has the eigenvalues -1588 +- 2500i. The 13.8 and 103.3 Hz of (6.15)
are `sqrt|lambda|` with D left out, and lambda is positive: those roots grow or decay and do not oscillate. With D, two of the
four poles are unstable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import eigvals

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.modes.mechanical.fit import (
    MAX_RELATIVE_STDERR,
    SIGNIFICANCE_LEVEL,
    MechanicalFit,
    Task,
    fit_condensed_structure,
    fit_full_structure,
    measure_asymmetry,
)
from tau_dyn.modes.mechanical.structure import (
    Evidence,
    HasResiduals,
    Places,
    SecondOrder,
    build_evidence,
    build_symmetric_basis,
    convert_to_continuous,
    count_derivatives,
    find_places,
    unpack,
)
from tau_dyn.modes.state_space import StateSpace

_BOTTOM, _TOP = 0.05, 0.45
"""Band that is looked at by itself: from this part of the first resonance to this part of the sampling rate."""


@dataclass(frozen=True, eq=False)
class Mechanical:
    """M, D, K and what they are worth.

    Attributes:
        status: `identified`, `condensed` (a stand-in, valid in `valid_hz`) or `not_identifiable`.
        why: One sentence for the status.
        structure: M, D, K; None where not identifiable.
        stderr: Standard errors of the entries, in the same places; None where the model came without covariance.
        covariance: Of the upper triangles of M, D, K, one after another (q, q), or None.
        valid_hz: Band in which they reproduce the model they came from.
        misfit: Greatest relative error of the response in that band.
        consistency: Probability of so large a misfit by chance; below 0.001 the model holds more than M, D, K.
        places: Which degree of freedom each input and output belongs to.
    """

    status: str
    why: str
    structure: SecondOrder | None = None
    stderr: SecondOrder | None = None
    covariance: np.ndarray | None = None
    valid_hz: tuple[float, float] | None = None
    misfit: float | None = None
    consistency: float | None = None
    places: Places | None = None

    @property
    def M(self) -> np.ndarray | None:
        """Inertia (n, n)."""
        return self.structure.M if self.structure else None

    @property
    def D(self) -> np.ndarray | None:
        """Damping (n, n)."""
        return self.structure.D if self.structure else None

    @property
    def K(self) -> np.ndarray | None:
        """Stiffness (n, n)."""
        return self.structure.K if self.structure else None

    @property
    def static_compliance(self) -> np.ndarray | None:
        """Displacement per static force, `K^{-1}` (n, n)."""
        return np.linalg.inv(self.structure.K) if self.structure else None

    @property
    def static_compliance_stderr(self) -> np.ndarray | None:
        """Its standard errors (n, n)."""
        if self.structure is None or self.covariance is None:
            return None
        C = np.linalg.inv(self.structure.K)
        change = C @ build_symmetric_basis(len(C)) @ C
        size = len(change)
        return np.sqrt(np.einsum("qij,qr,rij->ij", change, self.covariance[2 * size :, 2 * size :], change))

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, null where there is none; the keys are those of the written result."""

        def matrices(of: SecondOrder | None) -> dict[str, Any]:
            return {name: None if of is None else getattr(of, name).tolist() for name in "MDK"}

        return {
            "status": self.status,
            **matrices(self.structure),
            "stderr": None if self.stderr is None else matrices(self.stderr),
            "valid_hz": None if self.valid_hz is None else list(self.valid_hz),
            "misfit": self.misfit,
            "consistency": self.consistency,
            "why": self.why,
        }


def fit_mechanical(
    source: StateSpace | HasResiduals | Any,
    *,
    collocated: Sequence[tuple[int, int]] | None = None,
    output: str = "displacement",
    band: tuple[float, float] | None = None,
    complete: bool = True,
    tolerance: float = 0.05,
) -> Mechanical:
    """Return M, D, K behind a model from forces to motions.

    Degrees of freedom are numbered as the outputs are; an input with no sensor at its place adds one of its own.

    Args:
        source: A sampled model under held inputs, or a refined one with `model`, `theta`, `covariance`, `model_at`.
        collocated: Pairs (input, output) at one place and in one direction; None: all in order where there are as many.
        output: What the sensors measure: displacement, velocity or acceleration.
        band: Frequencies to trust [Hz]; None: up to 0.9 of half the sampling rate.
        complete: False where checks say that the model misses part of the response: then at most `condensed`.
        tolerance: Relative error of the response that counts as fitting.

    Raises:
        InputError: The pairs, the output or the band are not sound.
    """
    model = source if isinstance(source, StateSpace) else source.model
    p, m = model.D.shape
    derivative, places = count_derivatives(output), find_places(p, m, collocated)
    span = band or (0.0, _TOP / model.dt)
    if not 0 <= span[0] < span[1]:
        raise InputError("invalid_value", f"the band {span[0]:g} to {span[1]:g} Hz is empty")
    if not places.pairs:
        return _refused("no collocated pair: name an input and an output at one place and in one direction")
    try:
        evidence = build_evidence(source, derivative)
    except CannotAnswer as fault:
        return _refused(str(fault))
    modes_hz = np.abs(evidence.at.poles[evidence.at.oscillating]) / (2 * np.pi)
    modes_hz = modes_hz[(modes_hz >= span[0]) & (modes_hz <= span[1])]
    fault = _unfit(evidence, places, modes_hz, tolerance)
    if fault:
        return _refused(fault)
    span = (max(span[0], _BOTTOM * modes_hz[0]), min(span[1], _TOP / model.dt))
    others = model.order - 2 * len(modes_hz)
    task = Task(evidence, places, modes_hz, span, tolerance)
    reason = _why_not_whole(places, modes_hz, others, complete)
    if places.n > len(modes_hz):
        return _refused(reason)
    if complete and not others and places.n == len(modes_hz):
        found = _judged(fit_full_structure(task), task, "identified", _why_whole(task))
        if found.status == "identified":
            return found
        reason = found.why
    return _stand_in(task, reason)


def _refused(why: str) -> Mechanical:
    return Mechanical("not_identifiable", why)


def _unfit(evidence: Evidence, places: Places, modes_hz: np.ndarray, tolerance: float) -> str:
    """Return why no structure is worth fitting, or nothing."""
    if not len(modes_hz):
        return "no information: the model has no resonance in the band"
    if np.any(evidence.at.poles.real > 0):
        return "the model is unstable, and no damping D >= 0 makes a structure so"
    residues = evidence.at.residues
    sizes = np.abs(residues / places.unit(residues))
    at_pairs = sizes[:, [i for _, i in places.pairs], [j for j, _ in places.pairs]].max(axis=1)
    if np.any(at_pairs < 1e-9 * sizes.max()):
        return "no information: a mode is at rest at every collocated pair"
    uneven, stderr = measure_asymmetry(evidence, places)
    if uneven > max(2 * tolerance, 4 * stderr):
        return (
            "the named pairs are not collocated, or their units differ: at one mode the response from one place to another and "
            f"back differs by {100 * uneven:.0f} %"
        )
    return ""


def _why_whole(task: Task) -> str:
    n = task.places.n
    both = len(task.places.pairs)
    why = f"{n} modes seen and {n} degrees of freedom named, {both} of them with both a force and a sensor"
    return why if task.evidence.has_covariance else f"{why}; without standard errors, as the model has none"


def _why_not_whole(places: Places, modes_hz: np.ndarray, others: int, complete: bool) -> str:
    n = len(modes_hz)
    if places.n < n:
        return f"too few sensed degrees of freedom: inputs and outputs name {places.n}, and there are {n} modes"
    if not complete:
        return "the model misses part of the response, so there are more modes than it has"
    if others:
        return f"{others} of the model's {others + 2 * n} poles are no mode in the band"
    named = f"inputs and outputs name {places.n} degrees of freedom, and only {n} modes are seen"
    return f"no information: {named}; excite more, or leave some out"


def _stand_in(task: Task, reason: str) -> Mechanical:
    """Return a structure of the named degrees of freedom for as many of the lowest modes as it can stand for."""
    found = _refused(reason)
    for count in range(task.places.n, 0, -1):
        found = _judged(fit_condensed_structure(task, count), task, "condensed", reason)
        if found.status == "condensed":
            return found
    return _refused(reason if found.why in reason else f"{reason}; {found.why}")


def _judged(fit: MechanicalFit, task: Task, status: str, why: str) -> Mechanical:
    """Return the result a fit deserves."""
    n, worst = task.places.n, "M" if fit.unknown["M"] > fit.unknown["K"] else "K"
    if not np.isfinite(fit.unknown[worst]):
        return _refused(f"no information: some direction of {worst} leaves no trace in the response")
    if fit.unknown[worst] > MAX_RELATIVE_STDERR:
        known = 100 * fit.unknown[worst]
        return _refused(f"no information: the standard error of {worst} reaches {known:.0f} % in some direction")
    if fit.agreement.valid_hz is None and status == "condensed":
        return _refused(f"no structure of {n} degrees of freedom stands for them from rest to even the first")
    if fit.agreement.valid_hz is None:
        off = 100 * fit.agreement.misfit
        return _refused(f"no structure of {n} degrees of freedom fits the modes (off by {off:.0f} %)")
    if status == "identified" and fit.consistency is not None and fit.consistency < SIGNIFICANCE_LEVEL:
        chance = f"their misfit has the probability {fit.consistency:.0e}"
        return _refused(f"the model holds more than a structure of {n} degrees of freedom can: {chance}")
    stderr = None if fit.covariance is None else unpack(np.sqrt(np.diag(fit.covariance)), task.places.n)
    band, misfit = fit.agreement.valid_hz, fit.agreement.misfit
    return Mechanical(status, why, fit.structure, stderr, fit.covariance, band, misfit, fit.consistency, task.places)


PRINTED = SecondOrder(
    np.array([[0.0278, -0.0331], [-0.1759, 0.3086]]),
    np.array([[3.7432, -4.7826], [-9.7408, -3.4976]]),
    1e3 * np.array([[-3.7326, -1.5671], [6.9209, 0.5560]]),
)
"""M, D and K as printed in the thesis, 6.3, from the vision measurements with cart 3 moving; units are not stated."""


@dataclass(frozen=True, eq=False)
class Character:
    """What matrices M, D, K amount to.

    Attributes:
        stiffness_eigenvalues: Of K (n,).
        undamped_roots: lambda of `det(M lambda + K) = 0` (n,) [1/s^2]; a structure has them real and negative.
        undamped_hz: `sqrt|lambda| / 2 pi` (n,), whether or not that is an oscillation.
        poles: Of `M s^2 + D s + K` (2n,) [rad/s].
        asymmetry: Part of M, D and K (3,) that is skew, as a ratio of norms.
        lowest: Least eigenvalue of the symmetric parts of M, D and K (3,), by their norms.
    """

    stiffness_eigenvalues: np.ndarray
    undamped_roots: np.ndarray
    undamped_hz: np.ndarray
    poles: np.ndarray
    asymmetry: np.ndarray
    lowest: np.ndarray

    @property
    def n_unstable(self) -> int:
        """Number of poles in the right half plane."""
        return int(np.sum(self.poles.real > 0))

    @property
    def physical(self) -> bool:
        """Whether M and K are symmetric and positive definite and D symmetric and not negative."""
        return bool(np.all(self.asymmetry < 1e-9) and np.all(self.lowest[[0, 2]] > 0) and self.lowest[1] >= 0)


def judge_character(structure: SecondOrder) -> Character:
    """Return what matrices M, D, K amount to."""
    roots = np.asarray(eigvals(-structure.K, structure.M))
    roots = roots[np.argsort(np.abs(roots))]
    parts = (structure.M, structure.D, structure.K)
    skew = [np.linalg.norm(part - part.T) / 2 / np.linalg.norm(part) for part in parts]
    lowest = [np.linalg.eigvalsh((part + part.T) / 2)[0] / np.linalg.norm(part) for part in parts]
    hz = np.sqrt(np.abs(roots)) / (2 * np.pi)
    return Character(
        np.linalg.eigvals(structure.K), roots, hz, structure.poles(), np.array(skew), np.array(lowest)
    )  # fmt: skip


def solve_unconstrained(model: StateSpace, output: str = "displacement") -> SecondOrder:
    """Return M, D, K of a model by change of states alone, one input at each output's place.

    Args:
        model: Of order 2p, with p outputs and p inputs.
        output: What the outputs measure.

    Raises:
        CannotAnswer: The model is not square, not of order 2p, or its outputs and their rates do not span its states.
    """
    p, m = model.D.shape
    if m != p:
        raise CannotAnswer(
            "not_identifiable",
            f"{m} inputs and {p} outputs leave M open: only M^-1 B can be read off",
            "give as many inputs as outputs, in the same order",
        )
    if model.order != 2 * p:
        raise CannotAnswer(
            "not_identifiable",
            f"the states (x, x') of {p} outputs are {2 * p}, and the model has {model.order}",
            "choose that order",
        )
    found = convert_to_continuous(model)
    left = found.left / found.poles ** count_derivatives(output)
    states = np.vstack([left, left * found.poles])
    if np.linalg.cond(states) > 1e12 * np.abs(found.poles).max():
        raise CannotAnswer(
            "not_identifiable", "the outputs and their rates do not span the model's states", "sense other places"
        )
    lower = ((left * found.poles**2) @ np.linalg.inv(states)).real
    M = np.linalg.inv(((left * found.poles) @ found.right).real)
    return SecondOrder(M, -M @ lower[:, p:], -M @ lower[:, :p])
