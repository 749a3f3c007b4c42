r"""Poles and zeros in the s plane, with the uncertainty of the poles as ellipses.

    s = log(z) / dt,   s = -zeta w + j w sqrt(1 - zeta^2),   w = 2 pi f

The covariance of frequency and damping goes to the plane by the derivatives of the second line. Zeros are those of
the whole matrix of transfer functions (transmission zeros), the z at which [A - zI, B; C, D] loses rank.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import eigvals

from tau_dyn.modes.modal import Mode
from tau_dyn.modes.state_space import StateSpace


@dataclass(frozen=True, eq=False)
class Pole:
    """One pole, or one of a conjugate pair.

    Attributes:
        s: In the s plane, Im >= 0 [rad/s].
        covariance: Of real and imaginary part (2, 2); None where it is not known.
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
    return tuple(Pole(complex(x), _covariance(complex(x), modes)) for x in s[np.argsort(np.abs(s))])


def _covariance(s: complex, modes: tuple[Mode, ...]) -> np.ndarray | None:
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
