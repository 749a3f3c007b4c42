r"""Resonances of a model: undamped natural frequency |s| / 2 pi and damping ratio -Re s / |s|, with standard errors.

s = log(lambda) / dt; standard errors by the delta method from the covariance of Re and Im of lambda.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.modes.modal_form import ModalForm, build_layout, build_modal_form
from tau_dyn.modes.state_space import StateSpace

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
