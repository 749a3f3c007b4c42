r"""How good a set of poses is, from its information matrix `M` (in scales); every value is a logarithm, to be made large.

    tool           average predicted variance of the tool over the workspace, tr(M^-1 L); V-optimal, the default
    worst          the same at the worst place of the workspace; G-optimal
    determinant    det M; D-optimal (Borm & Menq 1991)
    condition      sigma_max / sigma_min of J (Driels & Pathre 1990; thesis (5.9))
    smallest       sigma_min (Nahvi et al. 1994; Williams et al. 2006)
    amplification  sigma_min^2 / sigma_max (Nahvi & Hollerbach 1996)

The thesis prints the last one upside down: (5.14) sets sigma_max^2 / sigma_min equal to sigma_max / cond(J), which is
sigma_min, and asks for less than 200. The source's index is sigma_min^2 / sigma_max = sigma_min / cond(J), to be large.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.poses.design import PoseDesign
from tau_dyn.exceptions import UnknownName

NAMES = ("tool", "worst", "determinant", "condition", "smallest", "amplification")
SMOOTH = ("tool", "determinant")
"""Those by which poses can be picked one after the other; a smallest singular value tells nothing while several are 0."""
_SHARP = 4
"""Power by which eigenvalues near the smallest take part in its gradient; they change places as poses come and go."""

_PLACES = 200
"""Places at most among which the worst is looked for in every step."""


class Criterion(NamedTuple):
    """A measure of information matrices.

    Attributes:
        name: As the user calls it.
        value: From matrices (..., r, r) to logarithms (...), larger is better.
        gradient: From one matrix (r, r) to the value's derivative by it, up to a factor: what a pose adds to first
            order.
    """

    name: str
    value: Callable[[np.ndarray], np.ndarray]
    gradient: Callable[[np.ndarray], np.ndarray]


def build_criterion(name: str, design: PoseDesign) -> Criterion:
    """Return a criterion by name.

    Raises:
        UnknownName: There is none of that name.
    """
    if name == "tool":
        return _tool(design.places)
    if name == "worst":
        return _worst(design.places)
    if name == "determinant":
        return Criterion(name, lambda m: 0.5 * np.linalg.slogdet(m)[1] / m.shape[-1], np.linalg.inv)
    powers = {"condition": (0.5, 0.5), "smallest": (0.5, 0.0), "amplification": (1.0, 0.5)}
    if name not in powers:
        raise UnknownName("criterion", name, NAMES)
    return _singular(name, *powers[name])


def _tool(places: np.ndarray) -> Criterion:
    weight = np.einsum("nir,nis->rs", places, places) / len(places)

    def value(m: np.ndarray) -> np.ndarray:
        return -0.5 * np.log(np.trace(np.linalg.solve(m, np.broadcast_to(weight, m.shape)), axis1=-2, axis2=-1))

    def gradient(m: np.ndarray) -> np.ndarray:
        back = np.linalg.inv(m)
        return back @ weight @ back

    return Criterion("tool", value, gradient)


def _worst(places: np.ndarray) -> Criterion:
    places = places[:: -(-len(places) // _PLACES)]
    flat = places.reshape(-1, places.shape[2])

    def variances(back: np.ndarray) -> np.ndarray:
        return np.sum((flat @ back) * flat, axis=-1).reshape(*back.shape[:-2], len(places), -1).sum(axis=-1)

    def value(m: np.ndarray) -> np.ndarray:
        return -0.5 * np.log(variances(np.linalg.inv(m)).max(axis=-1))

    def gradient(m: np.ndarray) -> np.ndarray:
        back = np.linalg.inv(m)
        size = variances(back)
        share = (size / size.max()) ** (2 * _SHARP)
        weight = np.einsum("n,nir,nis->rs", share, places, places, optimize=True)
        return back @ weight @ back

    return Criterion("worst", value, gradient)


def _singular(name: str, low: float, high: float) -> Criterion:
    """Return `lambda_min^low / lambda_max^high` of `M`; singular values of `J` are square roots."""

    def value(m: np.ndarray) -> np.ndarray:
        s = np.linalg.eigvalsh(m)
        return low * np.log(np.maximum(s[..., 0], 1e-300)) - high * np.log(s[..., -1])

    def gradient(m: np.ndarray) -> np.ndarray:
        s, v = np.linalg.eigh(m)
        s = np.maximum(s, 1e-300)
        share = (s[0] / s) ** _SHARP
        weight = low * share / s / share.sum()
        weight[-1] -= high / s[-1]
        return (v * weight) @ v.T

    return Criterion(name, value, gradient)


def compute_observability_indices(information: np.ndarray) -> dict[str, float]:
    """Return the classical numbers of an information matrix (r, r): of `J`, condition, amplification."""
    s = np.sqrt(np.maximum(np.linalg.eigvalsh(information), 0.0))
    low, high = float(s[0]), float(s[-1])
    return {
        "smallest_singular_value": low,
        "largest_singular_value": high,
        "condition_number": high / low if low > 0 else float("inf"),
        "noise_amplification_index": low**2 / high if high > 0 else 0.0,
        "log_determinant": float(np.linalg.slogdet(information)[1]),
    }
