"""Modes, poles and zeros of a model with standard errors, side by side with those of other models.

    s = log(lambda) / dt = -zeta w + j w sqrt(1 - zeta^2),   w = 2 pi f

Standard errors of frequency and damping follow from the covariance of Re and Im of lambda by the delta method. Zeros are those
of the whole matrix of transfer functions (transmission zeros), the z at which [A - zI, B; C, D] loses rank.

In the stabilisation diagram a resonance of the structure appears at nearly the same frequency and damping in every
model that is large enough; modes that fit noise change from order to order. A mode is `stable` if the model of the next
lower order has a mode within their joint uncertainty (and at least 1 % in frequency and 20 % in damping, as is usual),
`frequency` if only the frequency agrees, and `new` otherwise (van der Auweraer & Peeters 2004).

The covariance of an estimate assumes that its model contains the truth. If another defensible model of the same data (a
neighbouring order that simulates as well; the other method if feedback cannot be excluded) differs in a mode by d,

    s^2 = s_0^2 + max(0, d^2 - 4 |s_1^2 - s_0^2|)

with s_1 the other's standard error: if both models contain the truth, the difference has the variance s_1^2 - s_0^2
(Hausman 1978), and no term is added in 95 % of cases. The excess is model error and is added in full.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import eigvals

from tau_dyn.modes.modal_form import ModalForm, build_layout, build_modal_form
from tau_dyn.modes.state_space import MAX_RESONANT_DAMPING, StateSpace

MODE_EQUALITY_TOLERANCE = 0.05  # relative difference in frequency up to which modes of two models are one and the same
Z95 = 1.959964  # two-sided 95 % point of the normal distribution


@dataclass(frozen=True, eq=False)
class Mode:
    """One resonance.

    Attributes:
        frequency_hz: Undamped natural frequency [Hz].
        damping_ratio: Damping over critical damping.
        frequency_stderr: Standard error [Hz]; nan if not known.
        damping_stderr: Standard error; nan if not known.
        shape: Outputs of the mode (p,) complex, the largest of them 1, in the record's own units.
        correlation: Correlation between the errors of frequency and damping; nan if not known.
    """

    frequency_hz: float
    damping_ratio: float
    frequency_stderr: float
    damping_stderr: float
    shape: np.ndarray
    correlation: float

    def to_dict(self, outputs: Sequence[str]) -> dict[str, Any]:
        """Return it for the JSON result, its shape by output."""
        f, z, sf, sz = self.frequency_hz, self.damping_ratio, self.frequency_stderr, self.damping_stderr
        return {
            "frequency_hz": f,
            "damping_ratio": z,
            "frequency_stderr": sf,
            "damping_stderr": sz,
            "frequency_ci95": _interval(f, sf),
            "damping_ci95": _interval(z, sz),
            "shape": {
                name: {"re": float(np.real(c)), "im": float(np.imag(c))}
                for name, c in zip(outputs, self.shape, strict=True)
            },
        }


def find_resonances(model: StateSpace, covariance: np.ndarray | None = None) -> tuple[Mode, ...]:
    """Return the resonances (pairs of poles whose response has a peak) of a model, lowest frequency first.

    Args:
        model: The model. Real poles, and those whose damping ratio may reach 0.71, are no resonances and are left out:
            sensor filters and slow drifts have such poles.
        covariance: Covariance of the full vector of its `build_modal_form` (`Layout`); None if not known.
    """
    form = build_modal_form(model)
    found = []
    for k, where in zip(np.flatnonzero(form.oscillates), build_layout(form).pole[form.oscillates], strict=True):
        spread = np.full((2, 2), np.nan) if covariance is None else covariance[np.ix_(where, where)]
        mode = _mode(form, int(k), spread)
        if mode.damping_ratio + 2 * np.nan_to_num(mode.damping_stderr) < MAX_RESONANT_DAMPING:
            found.append(mode)
    return tuple(sorted(found, key=lambda mode: mode.frequency_hz))


def compute_frequency_and_damping(pole: complex, dt: float) -> np.ndarray:
    """Return frequency [Hz] and damping ratio (2,) of a sampled pole."""
    s = np.log(pole) / dt
    return np.array([abs(s) / (2 * np.pi), -s.real / abs(s)])


def _mode(form: ModalForm, k: int, spread: np.ndarray) -> Mode:
    pole = complex(form.poles[k])
    f, zeta = compute_frequency_and_damping(pole, form.dt)
    slope = _slopes(pole, form.dt)
    both = slope @ spread @ slope.T
    errors = np.sqrt(np.diag(both))
    correlation = both[0, 1] / errors.prod() if errors.all() else np.nan
    return Mode(float(f), float(zeta), float(errors[0]), float(errors[1]), form.c[:, k], float(correlation))


def _slopes(pole: complex, dt: float) -> np.ndarray:
    """Derivatives (2, 2) of frequency and damping with respect to Re and Im of the pole."""
    s = np.log(pole) / dt
    out = np.empty((2, 2))
    for column, turn in enumerate((1.0, 1j)):
        ds = turn / (pole * dt)
        size = (s.real * ds.real + s.imag * ds.imag) / abs(s)
        out[:, column] = size / (2 * np.pi), -ds.real / abs(s) + s.real * size / abs(s) ** 2
    return out


def _interval(value: float, stderr: float) -> list[float] | None:
    return [value - Z95 * stderr, value + Z95 * stderr] if np.isfinite(stderr) else None


def widen_modes(modes: Sequence[Mode], pairs: Sequence[tuple[Sequence[Mode], Sequence[Mode]]]) -> tuple[Mode, ...]:
    """Return modes with standard errors that cover the differences between other models.

    Args:
        modes: Modes with their own standard errors.
        pairs: Modes of two models of the same data, such as those of two orders.
    """
    return tuple(_widen(mode, pairs) for mode in modes)


def _widen(mode: Mode, pairs: Sequence[tuple[Sequence[Mode], Sequence[Mode]]]) -> Mode:
    extra = np.zeros(2)
    for one, other in pairs:
        a, b = _nearest_mode(mode, one), _nearest_mode(mode, other)
        if a is not None and b is not None:
            extra = np.maximum(extra, _excess(a, b))
    if not extra.any():
        return mode
    s = np.sqrt(np.array([mode.frequency_stderr, mode.damping_stderr]) ** 2 + extra)
    kept = mode.frequency_stderr * mode.damping_stderr / max(float(s.prod()), 1e-300)
    return replace(
        mode, frequency_stderr=float(s[0]), damping_stderr=float(s[1]), correlation=float(mode.correlation * kept)
    )


def _nearest_mode(mode: Mode, others: Sequence[Mode]) -> Mode | None:
    """Return the corresponding mode of another model; `None` if it has no such mode."""
    close = [m for m in others if abs(m.frequency_hz - mode.frequency_hz) < MODE_EQUALITY_TOLERANCE * mode.frequency_hz]
    close = [m for m in close if m.damping_ratio < 10 * max(mode.damping_ratio, 1e-4)]
    return min(close, key=lambda m: abs(m.frequency_hz - mode.frequency_hz), default=None)


def _excess(a: Mode, b: Mode) -> np.ndarray:
    """Return the part of the squared differences (2,) in frequency and damping that chance does not explain."""
    d = np.array([a.frequency_hz - b.frequency_hz, a.damping_ratio - b.damping_ratio])
    s = np.array([[m.frequency_stderr, m.damping_stderr] for m in (a, b)])
    s = np.nan_to_num(s)
    return np.maximum(d**2 - 4 * np.maximum(np.abs(s[1] ** 2 - s[0] ** 2), 0.1 * np.max(s, axis=0) ** 2), 0.0)


@dataclass(frozen=True, eq=False)
class Pole:
    """One pole, or one of a conjugate pair.

    Attributes:
        s: Position in the s plane, Im >= 0 [rad/s].
        covariance: Covariance of real and imaginary part (2, 2); None if not known.
    """

    s: complex
    covariance: np.ndarray | None = None

    @property
    def oscillates(self) -> bool:
        """Whether it is one of a pair."""
        return self.s.imag > 0

    def to_dict(self) -> dict[str, Any]:
        """Return it for the JSON result."""
        covariance = None if self.covariance is None else self.covariance.tolist()
        return {"re": self.s.real, "im": self.s.imag, "covariance": covariance}


def list_poles(model: StateSpace, modes: tuple[Mode, ...]) -> tuple[Pole, ...]:
    """Return the poles with Im >= 0, slowest first; those of a mode with standard errors carry a covariance."""
    z = model.poles().astype(complex)
    s = np.log(np.where(z == 0, 1e-300, z)) / model.dt
    s = s[s.imag >= -1e-9 * np.abs(s)]
    s = np.where(np.abs(s.imag) <= 1e-9 * np.abs(s), s.real + 0j, s)
    return tuple(Pole(complex(x), _locate_covariance(complex(x), modes)) for x in s[np.argsort(np.abs(s))])


def _locate_covariance(s: complex, modes: tuple[Mode, ...]) -> np.ndarray | None:
    near = [m for m in modes if abs(2 * np.pi * m.frequency_hz - abs(s)) < 1e-6 * abs(s) and s.imag > 0]
    near = [m for m in near if abs(m.damping_ratio + s.real / abs(s)) < 1e-6 and np.isfinite(m.frequency_stderr)]
    if not near:
        return None
    mode = near[0]
    w, zeta = 2 * np.pi * mode.frequency_hz, mode.damping_ratio
    root = np.sqrt(max(1 - zeta**2, 1e-12))
    jacobian = np.array([[-2 * np.pi * zeta, -w], [2 * np.pi * root, -w * zeta / root]])
    sf, sz = mode.frequency_stderr, mode.damping_stderr
    mixed = mode.correlation * sf * sz
    return jacobian @ np.array([[sf**2, mixed], [mixed, sz**2]]) @ jacobian.T


def list_zeros(model: StateSpace) -> np.ndarray:
    """Return the finite transmission zeros in the s plane [rad/s], Im >= 0; empty unless outputs and inputs are as many.

    Zeros far beyond the Nyquist frequency are those that sampling adds, and are left out.
    """
    n, (p, m) = model.order, model.D.shape
    if p != m or n == 0:
        return np.zeros(0, complex)
    scale_y, scale_u = (np.linalg.norm(x, axis=a, keepdims=True) for x, a in ((model.C, 1), (model.B, 0)))
    C, B = model.C / np.maximum(scale_y, 1e-300), model.B / np.maximum(scale_u, 1e-300)
    D = model.D / np.maximum(scale_y, 1e-300) / np.maximum(scale_u, 1e-300)
    pencil, shift = np.block([[model.A, B], [C, D]]), np.zeros((n + p, n + p))
    shift[:n, :n] = np.eye(n)
    z = np.asarray(eigvals(pencil, shift))
    z = z[np.isfinite(z) & (np.abs(z) > 0.05) & (np.abs(z) < 4)]
    s = np.log(z) / model.dt
    s = s[(s.imag >= -1e-9 * np.abs(s)) & (np.abs(s.imag) < 0.98 * np.pi / model.dt)]
    return s[np.argsort(np.abs(s))]


# relative difference of a stable mode's frequency from order to order (Peeters & De Roeck 1999)
FREQUENCY_TOLERANCE = 0.01
DAMPING_TOLERANCE = 0.20  # relative difference of a stable mode's damping from order to order (Peeters & De Roeck 1999)
SIGMAS = 2.0  # joint standard errors within which two orders' modes agree
OVERDAMPED = 0.7  # modes with more damping ring less than one period; the diagram leaves them out


@dataclass(frozen=True)
class StabilityPoint:
    """One mode of one order.

    Attributes:
        order: Number of states of its model.
        frequency_hz: Undamped natural frequency [Hz].
        damping_ratio: Damping over critical damping.
        frequency_stderr: Standard error [Hz]; nan if unknown.
        damping_stderr: Standard error; nan if unknown.
        kind: `stable`, `frequency` or `new`.
    """

    order: int
    frequency_hz: float
    damping_ratio: float
    frequency_stderr: float
    damping_stderr: float
    kind: str


def build_stabilisation_diagram(modes: Mapping[int, Sequence[Mode]]) -> tuple[StabilityPoint, ...]:
    """Return the diagram.

    Args:
        modes: Modes by order of their model.
    """
    points: list[StabilityPoint] = []
    before: Sequence[Mode] = ()
    for order in sorted(modes):
        here = [m for m in modes[order] if m.damping_ratio < OVERDAMPED]
        points += [
            StabilityPoint(
                order, m.frequency_hz, m.damping_ratio, m.frequency_stderr, m.damping_stderr, _kind(m, before)
            )
            for m in here
        ]
        before = here
    return tuple(points)


def _kind(mode: Mode, before: Sequence[Mode]) -> str:
    close = [m for m in before if _near(mode.frequency_hz, mode.frequency_stderr, m.frequency_hz, m.frequency_stderr)]
    if not close:
        return "new"
    return "stable" if any(_damped_alike(mode, m) for m in close) else "frequency"


def _near(f: float, sf: float, g: float, sg: float) -> bool:
    joint = SIGMAS * float(np.nan_to_num(np.hypot(sf, sg)))
    return abs(f - g) <= max(FREQUENCY_TOLERANCE * g, min(joint, 0.05 * g))


def _damped_alike(a: Mode, b: Mode) -> bool:
    joint = SIGMAS * float(np.nan_to_num(np.hypot(a.damping_stderr, b.damping_stderr)))
    gap = abs(a.damping_ratio - b.damping_ratio)
    return gap <= max(DAMPING_TOLERANCE * abs(b.damping_ratio), min(joint, 0.5 * abs(b.damping_ratio)))
