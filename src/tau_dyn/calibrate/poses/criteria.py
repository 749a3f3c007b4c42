"""Criteria for a set of poses, from its information matrix `M` (in scales), and sets chosen by them: picked, then exchanged.

    tool           average predicted variance of the tool over the workspace, tr(M^-1 L); V-optimal, the default
    worst          the same at the worst place of the workspace; G-optimal
    determinant    det M; D-optimal (Borm & Menq 1991)
    condition      sigma_max / sigma_min of J (Driels & Pathre 1990; thesis (5.9))
    smallest       sigma_min (Nahvi et al. 1994; Williams et al. 2006)
    amplification  sigma_min^2 / sigma_max (Nahvi & Hollerbach 1996)

Every value is a logarithm, to be maximised. The thesis prints the last one inverted: (5.14) sets sigma_max^2 / sigma_min
equal to sigma_max / cond(J), which is sigma_min. The source's index is sigma_min^2 / sigma_max = sigma_min / cond(J), to be
maximised.

`pick` repeatedly adds the pose with the largest gain. `exchanged` improves a set by excursions (Mitchell 1974, DETMAX): it adds
one, two or three poses and takes as many away again, or the other way round, and keeps the better set. The criterion's gradient
selects the poses that are evaluated exactly. `leave_one_out` is the thesis' rule (5.9).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.poses.design import PoseDesign
from tau_dyn.exceptions import UnknownName

NAMES = ("tool", "worst", "determinant", "condition", "smallest", "amplification")
SMOOTH = ("tool", "determinant")
"""Criteria by which poses can be picked one after the other; the smallest singular value gives no order while several are 0."""
_SHARP = 4
"""Power by which eigenvalues near the smallest take part in its gradient; they change places as poses come and go."""

_PLACES = 200
"""Largest number of places that are searched for the worst in every step."""


class Criterion(NamedTuple):
    """A measure of information matrices.

    Attributes:
        name: Name for the user.
        value: Function of matrices (..., r, r) that returns logarithms (...); larger is better.
        gradient: Function of one matrix (r, r) that returns the value's derivative by it, up to a factor: the first-order gain of
            a pose.
    """

    name: str
    value: Callable[[np.ndarray], np.ndarray]
    gradient: Callable[[np.ndarray], np.ndarray]


def build_criterion(name: str, design: PoseDesign) -> Criterion:
    """Return a criterion by name.

    Raises:
        UnknownName: No criterion has that name.
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


PRIOR = 0.1
"""Singular value that every parameter has before any pose: known to ten times its scale; keeps few poses comparable."""
_LOOKED_AT = 24
"""Poses that are tried exactly in every step."""
_EXCURSION = 3  # poses that an exchange may add before it removes as many
_BETTER = 1e-7  # gain of the criterion that is more than rounding


class PoseExchange:
    """Candidates' information, and the steps on sets of them.

    Args:
        blocks: Every candidate's derivative in units of the noise (N, m, r).
        criterion: Criterion to be maximised.
    """

    def __init__(self, blocks: np.ndarray, criterion: Criterion) -> None:
        """Keep what every step needs."""
        self.blocks, self.criterion = blocks, criterion
        self.n, _, self.r = blocks.shape
        self._flat = np.ascontiguousarray(blocks.reshape(-1, self.r))

    def information(self, index: np.ndarray) -> np.ndarray:
        """Return a set's information matrix (r, r), with the prior."""
        part = self.blocks[index].reshape(-1, self.r)
        return part.T @ part + PRIOR**2 * np.eye(self.r)

    def value(self, index: np.ndarray) -> float:
        """Return a set's value."""
        return float(self.criterion.value(self.information(index)))

    def pick(self) -> Iterator[int]:
        """Yield candidates one after the other, each the one that helps the set so far most."""
        m, free = self.information(np.zeros(0, int)), np.ones(self.n, bool)
        while free.any():
            k, m = self._best(m, np.flatnonzero(free), +1)
            free[k] = False
            yield k

    def exchanged(self, index: np.ndarray, most: int = 500) -> np.ndarray:
        """Return a set of as many poses that no short excursion improves, in ascending order.

        Args:
            index: Start set (n,).
            most: Largest number of excursions.
        """
        chosen, length, first = np.array(index), 1, +1
        m = self.information(chosen)
        value = float(self.criterion.value(m))
        for _ in range(most):
            if length > min(_EXCURSION, self.n - len(chosen), len(chosen) - 1):
                break
            new, moved = self._excursion(chosen, m, length, first)
            better = float(self.criterion.value(moved))
            if better > value + _BETTER:
                chosen, m, value, length, first = new, moved, better, 1, +1
            elif first > 0:
                first = -1
            else:
                length, first = length + 1, +1
        return np.sort(chosen)

    def _excursion(self, chosen: np.ndarray, m: np.ndarray, length: int, first: int) -> tuple[np.ndarray, np.ndarray]:
        for sign in (first, -first):
            for _ in range(length):
                pool = np.setdiff1d(np.arange(self.n), chosen) if sign > 0 else chosen
                k, m = self._best(m, pool, sign)
                chosen = np.append(chosen, k) if sign > 0 else chosen[chosen != k]
        return chosen, self.information(chosen)  # summed again, so that rounding does not pile up

    def _best(self, m: np.ndarray, pool: np.ndarray, sign: int) -> tuple[int, np.ndarray]:
        """Return the pose of a pool to add (+1) or take away (-1), and the information afterwards."""
        flat = self._flat if len(pool) == self.n else self.blocks[pool].reshape(-1, self.r)
        first_order = np.sum((flat @ self.criterion.gradient(m)) * flat, axis=1).reshape(len(pool), -1).sum(axis=1)
        look = pool[np.argsort(-sign * first_order, kind="stable")[:_LOOKED_AT]]
        changed = m + sign * np.swapaxes(self.blocks[look], 1, 2) @ self.blocks[look]
        k = int(np.argmax(self.criterion.value(changed)))
        return int(look[k]), changed[k]


def leave_one_out(blocks: np.ndarray, n: int) -> np.ndarray:
    """Return the thesis' choice (5.9): the `n` poses without which the condition number would be largest.

    Args:
        blocks: Derivatives in units of the noise (N, m, r).
        n: Number of poses.
    """
    information = np.einsum("nir,nis->rs", blocks, blocks)
    condition = np.empty(len(blocks))
    for part in np.array_split(np.arange(len(blocks)), max(1, len(blocks) // 100)):
        s = np.linalg.eigvalsh(information - np.swapaxes(blocks[part], 1, 2) @ blocks[part])
        condition[part] = s[:, -1] / np.maximum(s[:, 0], 1e-300)
    return np.sort(np.argsort(-condition, kind="stable")[:n])
