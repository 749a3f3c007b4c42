"""M, D and K from a black-box model: `(M s^2 + D s + K) X(s) = B U(s)`, and their validity.

The steps: the model's response in continuous time -> a conic program -> maximum likelihood with the model's own
covariance -> a status. Forces and displacements keep the user's units, so M, D, K are in force per acceleration,
velocity and displacement. References: thesis 6.3 (its form (6.14), fitted there without constraints); De Angelis, Lus,
Betti & Longman 2002.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

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
    HELD,
    LINEAR,
    OUTPUTS,
    Evidence,
    HasResiduals,
    Places,
    SecondOrder,
    build_evidence,
    build_symmetric_basis,
    count_derivatives,
    find_places,
    unpack,
)
from tau_dyn.modes.mechanical.wiring import are_driving_points_in_phase, describe_wiring
from tau_dyn.modes.state_space import StateSpace

STATUSES = ("identified", "condensed", "not_identifiable")
"""Possible status of M, D, K, best first."""
_BOTTOM, _TOP = 0.05, 0.45
"""Default band: from this part of the first resonance to this part of the sampling rate."""


@dataclass(frozen=True, eq=False)
class Mechanical:
    """M, D, K and their validity.

    Attributes:
        status: `identified`, `condensed` (a condensed model, valid in `valid_hz`) or `not_identifiable`.
        why: One sentence for the status.
        structure: M, D, K; None if not identifiable.
        stderr: Standard errors of the entries, in the same places; None if the model has no covariance.
        covariance: Covariance of the upper triangles of M, D, K, one after another (q, q), or None.
        valid_hz: Band in which they reproduce the model they came from.
        misfit: Greatest relative error of the response in that band.
        consistency: Probability of so large a misfit by chance; below 0.001 the model holds more than M, D, K.
        places: Which degree of freedom each input and output belongs to.
        hold: Course of the inputs between samples, `held` or `linear`, whichever fits better.
        sensor: Quantity that the outputs measure.
        unit: Size of their unit in SI.
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
    hold: str = HELD
    sensor: str = OUTPUTS[0]
    unit: float = 1.0

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

    def in_units_of(self, unit: float) -> Mechanical:
        """Return it with outputs whose unit has a size in SI: the same motion is a larger number in SI."""
        if unit == 1.0:
            return self
        scaled = [
            None if of is None else SecondOrder(of.M / unit, of.D / unit, of.K / unit)
            for of in (self.structure, self.stderr)
        ]
        covariance = None if self.covariance is None else self.covariance / unit**2
        return replace(self, structure=scaled[0], stderr=scaled[1], covariance=covariance, unit=unit * self.unit)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, null for missing values; the keys are those of the written result."""

        def matrices(of: SecondOrder | None) -> dict[str, Any]:
            return {name: None if of is None else getattr(of, name).tolist() for name in "MDK"}

        return {
            "status": self.status,
            **matrices(self.structure),
            "stderr": None if self.stderr is None else matrices(self.stderr),
            "valid_hz": None if self.valid_hz is None else list(self.valid_hz),
            "misfit": self.misfit,
            "consistency": self.consistency,
            "hold": self.hold,
            "sensor": self.sensor,
            "sensor_unit": self.unit,
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
    names: Sequence[str] = (),
) -> Mechanical:
    """Return M, D, K behind a model from forces to motions.

    Degrees of freedom are numbered as the outputs are; an input with no sensor at its place adds one of its own.

    Args:
        source: A sampled model, or a refined one with `model`, `theta`, `covariance`, `model_at`.
        collocated: Pairs (input, output) at one place and in one direction; None: all in order if there are as many.
        output: Quantity that the sensors measure: displacement, velocity, acceleration, or `auto` for the best fit.
        band: Frequencies to trust [Hz]; None: up to 0.9 of half the sampling rate.
        complete: False if checks show that the model misses part of the response: then at most `condensed`.
        tolerance: Relative error of the response that counts as fitting.
        names: Names of the outputs, for sentences about exchanged or reversed sensors.

    Raises:
        InputError: The pairs, the output or the band are not sound.
    """
    model = source if isinstance(source, StateSpace) else source.model
    p, m = model.D.shape
    places = find_places(p, m, collocated)
    span = band or (0.0, _TOP / model.dt)
    if not 0 <= span[0] < span[1]:
        raise InputError("invalid_value", f"the band {span[0]:g} to {span[1]:g} Hz is empty")
    if not places.pairs:
        return _refused("no collocated pair: name an input and an output at one place and in one direction")
    found, left = [], []
    told = () if output == "auto" else names  # of unknown sensors, a sign may be a quantity
    for kind in OUTPUTS if output == "auto" else (output,):
        for hold in (HELD, LINEAR):
            try:
                task = _build_task(build_evidence(source, count_derivatives(kind), hold), places, span, tolerance, told)
            except CannotAnswer as fault:
                return _refused(str(fault))
            one = _refused(task) if isinstance(task, str) else _fit_whole(task, complete)
            found.append(replace(one, hold=hold, sensor=kind))
            if isinstance(task, Task) and hold == HELD and places.n <= len(task.modes_hz):
                left.append((task, found[-1]))
    best = min(found, key=lambda one: (STATUSES.index(one.status), -(one.consistency or 0.0)))
    if best.status == "identified" or not left:
        return best
    if len(left) > 1:
        left = [min(left, key=lambda pair: fit_condensed_structure(pair[0], places.n).agreement.misfit)]
    return replace(_stand_in(left[0][0], left[0][1].why), sensor=left[0][1].sensor)


def _build_task(
    evidence: Evidence, places: Places, span: tuple[float, float], tolerance: float, names: Sequence[str]
) -> Task | str:
    """Return the input of the fit, or why no structure is worth fitting."""
    if len(evidence.at.oscillating) > places.n:
        evidence = evidence.with_peaks_only()
    modes_hz = np.abs(evidence.at.poles[evidence.at.oscillating]) / (2 * np.pi)
    modes_hz = modes_hz[(modes_hz >= span[0]) & (modes_hz <= span[1])]
    fault = _unfit(evidence, places, modes_hz, tolerance, names)
    if fault:
        return fault
    return Task(
        evidence, places, modes_hz, (max(span[0], _BOTTOM * modes_hz[0]), min(span[1], _TOP / evidence.dt)), tolerance
    )


def _fit_whole(task: Task, complete: bool) -> Mechanical:
    """Return M, D, K of as many modes as degrees of freedom, or the reason why they are not available."""
    n, modes_hz, at = task.places.n, task.modes_hz, task.evidence.at
    others = len(at.poles) + at.n_left_out - 2 * len(modes_hz)
    if not complete or others or n != len(modes_hz):
        return _refused(_why_not_whole(task.places, modes_hz, others, complete))
    return _judged(fit_full_structure(task), task, "identified", _why_whole(task))


def _refused(why: str) -> Mechanical:
    return Mechanical("not_identifiable", why)


def _unfit(evidence: Evidence, places: Places, modes_hz: np.ndarray, tolerance: float, names: Sequence[str]) -> str:
    """Return why no structure is worth fitting, or an empty string."""
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
    sound = uneven <= max(2 * tolerance, 4 * stderr)
    if sound and are_driving_points_in_phase(evidence, places):
        return ""
    remedy = describe_wiring(evidence, places, 2 * tolerance, names)
    if sound:
        return f"at one place the motion is against the force; {remedy}" if remedy else ""
    return (
        "the named pairs are not collocated, their units differ, or filters of the sensors act: at one mode the response "
        f"from one place to another and back differs by {100 * uneven:.0f} %{remedy and f'; {remedy}'}"
    )


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
    """Return a structure of the named degrees of freedom for as many of the lowest modes as it can reproduce."""
    found = _refused(reason)
    for count in range(task.places.n, 0, -1):
        found = _judged(fit_condensed_structure(task, count), task, "condensed", reason)
        if found.status == "condensed":
            return found
    return _refused(reason if found.why in reason else f"{reason}; {found.why}")


def _judged(fit: MechanicalFit, task: Task, status: str, why: str) -> Mechanical:
    """Return the result of a fit with its status."""
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
