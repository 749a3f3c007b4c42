"""The normal state of a robot, learned from blocks of white residuals, and the sizes of changes from it.

Equations are in `change_detection.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

_WIDE = 100.0  # times a typical size: no change is drawn towards zero, and one that the data do not show stays finite
_MIN_NEW_SHARE = 1e-6  # of a direction's information that others leave; less is the same change


@dataclass(frozen=True, eq=False)
class BlockScore:
    """One block's score and information at `theta = 0`.

    Attributes:
        t: Its first and last time [s].
        log: Log to which it belongs.
        z: `X' e` (D,).
        G: `X' X` (D, D).
        power: `e' e`.
        rows: Number of rows.
    """

    t: tuple[float, float]
    log: str
    z: np.ndarray
    G: np.ndarray
    power: float
    rows: int


def compute_power(block: BlockScore, theta: np.ndarray) -> float:
    """Return the squared white residual of a block with directions of sizes (D,)."""
    return float(block.power - 2 * theta @ block.z + theta @ block.G @ theta)


class JointEstimate(NamedTuple):
    """Directions that change together: sizes, standard errors and their freedom (k,), statistic, squared residual taken away."""

    sizes: np.ndarray
    stderr: np.ndarray
    dof: np.ndarray
    statistic: float
    power: float


@dataclass(frozen=True, eq=False)
class NormalState:
    """The normal state, learned from a reference.

    Attributes:
        theta: Offset of each direction (D,).
        inverse: Inverse of its information, priors included (D, D).
        left: Scores of its blocks (B, D).
        expected: Their covariance in units of the information (B, D, D).
        dof: Degrees of freedom of the scatter of a direction to which all blocks contribute.
        noise: Mean square of its white residual.
        wide: Standard deviation of each direction's size before any data (D,).
    """

    theta: np.ndarray
    inverse: np.ndarray
    left: np.ndarray
    expected: np.ndarray
    dof: float
    noise: float
    wide: np.ndarray

    @classmethod
    def of(cls, blocks: Sequence[BlockScore], sizes: np.ndarray) -> NormalState:
        """Learn from blocks; `sizes` (D,) are typical amounts of the directions, for those that the blocks do not determine."""
        z, G = np.array([b.z for b in blocks]), np.array([b.G for b in blocks])
        inverse = np.linalg.inv(G.sum(axis=0) + np.diag(1 / sizes**2))
        theta = inverse @ z.sum(axis=0)
        left = z - G @ theta
        expected = G - G @ inverse @ G
        leverage = np.einsum("bdd->d", expected) / np.maximum(np.einsum("bdd->d", G), 1e-300)
        dof = max(2.0, len(blocks) * float(np.min(leverage)))
        power = sum(compute_power(b, theta) for b in blocks)
        noise = power / max(sum(b.rows for b in blocks), 1)
        return cls(theta, inverse, left, expected, dof, noise, _WIDE * sizes)

    @cached_property
    def phi(self) -> np.ndarray:
        """Scatter of the scores in units of their information (D,)."""
        return self.compute_scatter(np.eye(len(self.theta)))[0]

    def compute_scatter(self, of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the scatter (k,) of combinations `of` (k, D) of the scores in units of their information, and its freedom (k,).

        Few blocks may hold most of the information about a combination; its degrees of freedom are then few (Satterthwaite 1946).
        """
        expected = np.einsum("kd,bde,ke->bk", of, self.expected, of)
        total = np.maximum(expected.sum(axis=0), 1e-300)
        phi = np.sum((self.left @ of.T) ** 2, axis=0) / total
        dof = np.minimum(total**2 / np.maximum(np.sum(expected**2, axis=0), 1e-300), self.dof)
        return np.where(phi > 0, phi, 1.0), np.maximum(dof, 2.0)

    def compute_statistics(self, s: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return the statistics (.., D) of summed scores (.., D) and information (.., D, D)."""
        known = np.einsum("...dd->...d", G)
        unsure = np.einsum("...de,ef,...df->...d", G, self.inverse, G)
        variance = self.phi * (known + unsure)
        return np.where(known > 0, s**2 / np.maximum(variance, 1e-300), 0.0)

    def estimate(self, s: np.ndarray, G: np.ndarray, members: Sequence[int]) -> JointEstimate:
        """Return the sizes (k,) of directions that change together, their standard errors (k,) and their statistic."""
        mine = list(members)
        prior = np.diag(1 / self.wide[mine] ** 2)
        inverse = np.linalg.inv(G[np.ix_(mine, mine)] + prior)
        of = np.zeros((len(mine), len(s)))
        of[:, mine] = inverse
        spread = self._compute_variance(G, of) + np.diag(inverse @ prior @ inverse)
        dof = self.compute_scatter(of)[1]
        scatter = np.sqrt(self.phi[mine])
        variance = np.outer(scatter, scatter) * (G + G @ self.inverse @ G)[np.ix_(mine, mine)]
        statistic = float(s[mine] @ np.linalg.pinv(variance, hermitian=True) @ s[mine])
        return JointEstimate(inverse @ s[mine], np.sqrt(spread), dof, statistic, float(s[mine] @ inverse @ s[mine]))

    def test_further(self, s: np.ndarray, G: np.ndarray, members: Sequence[int]) -> np.ndarray:
        """Return the statistic (D,) of each direction where others change already; zero for those and what they explain."""
        mine = list(members)
        if not mine:
            return self.compute_statistics(s, G)
        without = np.eye(len(s))
        without[:, mine] -= G[:, mine] @ np.linalg.inv(G[np.ix_(mine, mine)] + np.diag(1 / self.wide[mine] ** 2))
        known = np.diag(without @ G @ without.T)
        variance = self._compute_variance(G, without)
        new = (known > _MIN_NEW_SHARE * np.diag(G)) & ~np.isin(range(len(s)), mine)
        return np.where(new, (without @ s) ** 2 / np.maximum(variance, 1e-300), 0.0)

    def _compute_variance(self, G: np.ndarray, of: np.ndarray) -> np.ndarray:
        """Return the variance (k,) of combinations `of` (k, D) of the summed scores."""
        return self.compute_scatter(of)[0] * np.diag(of @ (G + G @ self.inverse @ G) @ of.T)
