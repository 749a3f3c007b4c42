r"""Resonances of a model: undamped natural frequency |s| / 2 pi and damping ratio -Re s / |s|, with standard errors.

s = log(lambda) / dt; standard errors by the delta method from the covariance of Re and Im of lambda.

The covariance of an estimate assumes that its model holds the truth. Where another defensible model of the same data (a
neighbouring order that simulates as well; the other method where feedback cannot be excluded) puts a mode elsewhere by d,

    s^2 = s_0^2 + max(0, d^2 - 4 |s_1^2 - s_0^2|)

with s_1 the other's standard error: if both models hold the truth, the difference has the variance s_1^2 - s_0^2 (Hausman
1978), and nothing is added in 95 % of cases. What lies beyond is model error and counts in full.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.modes.modal_form import ModalForm, build_layout, build_modal_form
from tau_dyn.modes.state_space import StateSpace

MODE_EQUALITY_TOLERANCE = 0.05
"""Relative difference in frequency up to which modes of two models are one and the same."""
Z95 = 1.959964  # two-sided 95 % point of the normal distribution


@dataclass(frozen=True, eq=False)
class Mode:
    """One resonance.

    Attributes:
        frequency_hz: Undamped natural frequency [Hz].
        damping_ratio: Part of critical damping.
        frequency_stderr: Standard error [Hz]; nan where not known.
        damping_stderr: Standard error; nan where not known.
        shape: Outputs of the mode (p,) complex, the largest of them 1, in the record's own units.
        correlation: Between the errors of frequency and damping; nan where not known.
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
    """Return the resonances (complex pairs of poles) of a model, lowest frequency first.

    Args:
        model: The model. Real poles are no resonances and are left out.
        covariance: Covariance of the full vector of its `build_modal_form` (`Layout`); None where not known.
    """
    form = build_modal_form(model)
    found = []
    for k in np.flatnonzero(form.oscillates):
        spread = np.full((2, 2), np.nan) if covariance is None else compute_pole_covariance(form, covariance, int(k))
        found.append(_mode(form, int(k), spread))
    return tuple(sorted(found, key=lambda mode: mode.frequency_hz))


def compute_pole_covariance(form: ModalForm, covariance: np.ndarray, mode: int) -> np.ndarray:
    """Return the covariance (2, 2) of Re and Im of a mode's pole."""
    where = build_layout(form).pole(mode)
    return covariance[where, where]


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
    """Return the mode of another model that is the same one; None where there is none."""
    close = [m for m in others if abs(m.frequency_hz - mode.frequency_hz) < MODE_EQUALITY_TOLERANCE * mode.frequency_hz]
    close = [m for m in close if m.damping_ratio < 10 * max(mode.damping_ratio, 1e-4)]
    return min(close, key=lambda m: abs(m.frequency_hz - mode.frequency_hz), default=None)


def _excess(a: Mode, b: Mode) -> np.ndarray:
    """Return what of the squared differences (2,) in frequency and damping chance does not explain."""
    d = np.array([a.frequency_hz - b.frequency_hz, a.damping_ratio - b.damping_ratio])
    s = np.array([[m.frequency_stderr, m.damping_stderr] for m in (a, b)])
    s = np.nan_to_num(s)
    return np.maximum(d**2 - 4 * np.maximum(np.abs(s[1] ** 2 - s[0] ** 2), 0.1 * np.max(s, axis=0) ** 2), 0.0)
