r"""Detection of changes in a residual, with direction and time: a generalised likelihood ratio with a given false-alarm rate.

For each block b of 2 s of motion, the white residual e and the white columns X of a few directions (friction of each joint, a
payload, ...) give the score and the information

    s_b = X_b' (e_b - X_b theta_0),     G_b = X_b' X_b

with `theta_0` of a reference, that is of blocks of the normal state: a model error there counts as normal. A change of
direction d since block k is tested by

    T_d(k, n) = (sum_k^n s_bd)^2 / (phi_d (G_dd + g' G_0^-1 g)),     g = row d of G = sum_k^n G_b

`g' G_0^-1 g` is the uncertainty of the reference itself, `phi_d` the scatter of the reference's scores in units of G. So no
exact noise model is needed, and without a change `sqrt(T)` is Student's t with the reference's degrees of freedom. Each new
block tests D directions over L lengths from 2 s to an hour. With N = 1800 blocks an hour, the threshold h follows from the
rate r [1/h] by Bonferroni,  2 P(t > h) = r / (N D L);  the expected number of false alarms is at most r an hour, averaged
over references. A simultaneous change of several numbers, such as the mass and the centre of a body, is named by their joint
statistic minus the penalty of Schwarz' criterion for each number beyond the first. The time of a change is the change-point
with the likelihood interval of Hansen 2000. Reference: Lorden 1971; Basseville & Nikiforov 1993, 5 and 8; Hansen 2000, Sample
splitting and threshold estimation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from tau_dyn.evidence import MIN_2LOGL_DIFFERENCE

BLOCK_S = 2.0
"""Length of a block [s]: longer than a residual's memory, a fraction of the minute in which a change is to be named."""
BLOCKS_PER_HOUR = 3600 / BLOCK_S
FALSE_ALARMS_PER_HOUR = 1e-4
"""Expected false alarms: one in ten thousand hours of motion, which is about a year."""
LENGTHS = np.unique(np.round(np.geomspace(1, BLOCKS_PER_HOUR, 20)).astype(int))
"""Numbers of blocks over which a change is tested: from one to those of an hour, each about 1.5 times the one before."""
CONFIRMING_BLOCKS = 5
"""Blocks after a detection that take part in the name, the size and the time of a change: 10 s separate similar causes."""
CHANGE_POINT_95 = 7.35
"""Fall of the likelihood ratio that contains 95 % of true change-points: -2 log(1 - sqrt(0.95)) (Hansen 2000)."""


@dataclass(frozen=True, eq=False)
class BlockScore:
    """One block's score and information at `theta = 0`.

    Attributes:
        t: Its first and last time [s].
        log: Log to which it belongs.
        z: `X' e` (D,).
        G: `X' X` (D, D).
    """

    t: tuple[float, float]
    log: str
    z: np.ndarray
    G: np.ndarray


@dataclass(frozen=True)
class DetectedChange:
    """A detected change.

    Attributes:
        direction: Index of the direction.
        since_t: Most likely time of the change [s].
        since_log: Log of that time.
        since_ci95: 95 % interval of the time [s], within the log in which the change was detected.
        detected_t: Time of the detection [s].
        detected_log: Log of the detection.
        size: Change in the direction's unit.
        stderr: Standard error of the size.
        ci95: 95 % interval of the size (Student's t).
        statistic: Likelihood ratio of the change.
        false_alarms_per_hour: Expected number of false alarms with a statistic as large.
        twins: Directions that explain it as well.
    """

    direction: int
    since_t: float
    since_log: str
    since_ci95: tuple[float, float]
    detected_t: float
    detected_log: str
    size: float
    stderr: float
    ci95: tuple[float, float]
    statistic: float
    false_alarms_per_hour: float
    twins: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class NormalState:
    """The normal state, learned from a reference.

    Attributes:
        theta: Offset of each direction (D,).
        inverse: Inverse of its information, priors included (D, D).
        phi: Scatter of its scores in units of their information (D,).
        dof: Degrees of freedom of that scatter.
    """

    theta: np.ndarray
    inverse: np.ndarray
    phi: np.ndarray
    dof: float

    @classmethod
    def of(cls, blocks: Sequence[BlockScore], sizes: np.ndarray) -> NormalState:
        """Learn from blocks; `sizes` (D,) are typical amounts of the directions, for those that the blocks do not determine."""
        z, G = np.array([b.z for b in blocks]), np.array([b.G for b in blocks])
        inverse = np.linalg.inv(G.sum(axis=0) + np.diag(1 / sizes**2))
        theta = inverse @ z.sum(axis=0)
        left = z - G @ theta
        expected = np.einsum("bdd->bd", G) - np.einsum("bde,ef,bdf->bd", G, inverse, G)
        phi = np.sum(left**2, axis=0) / np.maximum(expected.sum(axis=0), 1e-300)
        leverage = expected.sum(axis=0) / np.maximum(np.einsum("bdd->d", G), 1e-300)
        return cls(theta, inverse, np.where(phi > 0, phi, 1.0), max(2.0, len(blocks) * float(np.min(leverage))))

    def compute_statistics(self, s: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return the statistics (.., D) of summed scores (.., D) and information (.., D, D)."""
        known = np.einsum("...dd->...d", G)
        unsure = np.einsum("...de,ef,...df->...d", G, self.inverse, G)
        variance = self.phi * (known + unsure)
        return np.where(known > 0, s**2 / np.maximum(variance, 1e-300), 0.0)

    def estimate_sizes(self, s: np.ndarray, G: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the sizes (D,) by summed scores, each direction taken alone, and their standard errors (D,)."""
        known = np.maximum(np.diag(G), 1e-300)
        unsure = np.einsum("de,ef,df->d", G, self.inverse, G)
        return s / known, np.sqrt(self.phi * (known + unsure)) / known

    def compute_joint_statistic(
        self, s: np.ndarray, G: np.ndarray, members: Sequence[int]
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the statistic of directions that change together, their sizes (k,) and standard errors (k,)."""
        mine = list(members)
        scatter = np.sqrt(np.outer(self.phi[mine], self.phi[mine]))
        known = G[np.ix_(mine, mine)]
        variance = scatter * (known + G[mine] @ self.inverse @ G[mine].T)
        inverse = np.linalg.pinv(known)
        statistic = float(s[mine] @ np.linalg.pinv(variance) @ s[mine])
        return statistic, inverse @ s[mine], np.sqrt(np.diag(inverse @ variance @ inverse))


@dataclass(eq=False)
class ChangeDetector:
    """Takes blocks one by one, learns the normal state from the first ones, and detects changes with their time.

    Attributes:
        sizes: Typical amounts of the directions (D,).
        reference_blocks: Blocks from which the normal state is learned, at the beginning and after each alarm.
        rate: False alarms per hour.
        together: Directions that one change may affect at once, first the one that names it; empty without such directions.
        changes: The changes found.
        trace: Time, log and the largest statistic's root over the threshold of each block.
        normal: The normal state; None while it is learned.
    """

    sizes: np.ndarray
    reference_blocks: int
    rate: float = FALSE_ALARMS_PER_HOUR
    together: tuple[int, ...] = ()
    changes: list[DetectedChange] = field(default_factory=list)
    trace: list[tuple[float, str, float]] = field(default_factory=list)
    normal: NormalState | None = None
    _learning: list[BlockScore] = field(default_factory=list)
    _blocks: list[BlockScore] = field(default_factory=list)
    _s: np.ndarray = field(default_factory=lambda: np.zeros((1, 0)))
    _G: np.ndarray = field(default_factory=lambda: np.zeros((1, 0, 0)))
    _detected: int | None = None

    @property
    def n_tests(self) -> int:
        """Tests at each block."""
        return len(self.sizes) * len(LENGTHS)

    @property
    def threshold(self) -> float:
        """Root of the statistic above which a change is detected; infinite while the normal state is learned."""
        if self.normal is None:
            return np.inf
        return float(stats.t.isf(self.rate / (2 * BLOCKS_PER_HOUR * self.n_tests), self.normal.dof))

    def add(self, block: BlockScore) -> None:
        """Take in the next block."""
        if self.normal is None:
            self._learning.append(block)
            if len(self._learning) >= self.reference_blocks:
                self._start(NormalState.of(self._learning, self.sizes))
            return
        self._append(block, self.normal)
        if self._detected is not None:
            if len(self._blocks) > self._detected + CONFIRMING_BLOCKS:
                self.settle()
            return
        n = len(self._blocks)
        lengths = LENGTHS[n >= LENGTHS]
        T = self.normal.compute_statistics(self._s[n] - self._s[n - lengths], self._G[n] - self._G[n - lengths])
        ratio = float(np.sqrt(T.max())) / self.threshold
        self.trace.append((block.t[1], block.log, ratio))
        if ratio > 1:
            self._detected = n - 1
        elif n > 2 * LENGTHS[-1]:
            self._forget()

    def settle(self) -> None:
        """Name a detected change that is still open, and learn again; call it also when the blocks end."""
        if self._detected is None or self.normal is None:
            return
        self.changes.append(self._describe(self.normal, self._detected))
        self.normal, self._learning, self._detected = None, [], None

    def _start(self, normal: NormalState) -> None:
        D = len(self.sizes)
        self.normal, self._blocks, self._s, self._G = normal, [], np.zeros((1, D)), np.zeros((1, D, D))

    def _append(self, block: BlockScore, normal: NormalState) -> None:
        n = len(self._blocks)
        if n + 1 >= len(self._s):  # room for twice as many sums
            self._s = np.concatenate([self._s, np.zeros((n + 64, self._s.shape[1]))])
            self._G = np.concatenate([self._G, np.zeros((n + 64, *self._G.shape[1:]))])
        self._blocks.append(block)
        self._s[n + 1] = self._s[n] + block.z - block.G @ normal.theta
        self._G[n + 1] = self._G[n] + block.G

    def _forget(self) -> None:
        """Drop sums that are older than any length."""
        cut = len(self._blocks) - int(LENGTHS[-1])
        self._blocks = self._blocks[cut:]
        self._s, self._G = self._s[cut:] - self._s[cut], self._G[cut:] - self._G[cut]

    def _describe(self, normal: NormalState, detected: int) -> DetectedChange:
        n = len(self._blocks)
        first = max(0, detected + 1 - int(LENGTHS[-1]))
        starts = np.arange(first, detected + 1)
        s, G = self._s[n] - self._s[starts], self._G[n] - self._G[starts]
        T = normal.compute_statistics(s, G)
        whole = self._join_statistics(T, normal, s, G)
        k, d = (int(x) for x in np.unravel_index(int(np.argmax(T)), T.shape))
        near = np.flatnonzero(T[:, d] > T[k, d] - CHANGE_POINT_95)
        sizes, errors = normal.estimate_sizes(s[k], G[k])
        if whole[k] and d == self.together[0]:
            _, joint_sizes, joint_errors = normal.compute_joint_statistic(s[k], G[k], self.together)
            sizes[d], errors[d] = joint_sizes[0], joint_errors[0]
        half = float(stats.t.isf(0.025, normal.dof)) * float(errors[d])
        begin, end = (self._blocks[first + int(x)] for x in (near[0], near[-1]))
        at, found = self._blocks[first + k], self._blocks[detected]
        chance = BLOCKS_PER_HOUR * self.n_tests * 2 * float(stats.t.sf(np.sqrt(T[k, d]), normal.dof))
        twins = [int(x) for x in np.flatnonzero(T.max(axis=0) > T[k, d] - MIN_2LOGL_DIFFERENCE) if x != d]
        early = begin.t[0] if begin.log == at.log else at.t[0]
        late = end.t[1] if end.log == at.log else at.t[1]
        return DetectedChange(
            d, at.t[0], at.log, (early, late), found.t[1], found.log, float(sizes[d]), float(errors[d]),
            (float(sizes[d]) - half, float(sizes[d]) + half), float(T[k, d]), chance, tuple(twins),
        )  # fmt: skip

    def _join_statistics(self, T: np.ndarray, normal: NormalState, s: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Replace the statistic of the first of the joint directions in T (K, D) by that of all of them, if that is larger.

        Returns:
            Whether it is larger, for each start (K,).
        """
        whole = np.zeros(len(T), bool)
        if not self.together:
            return whole
        first, *others = self.together
        price = len(others) * np.log(np.arange(len(T), 0, -1) + 1.0)
        joint = (
            np.array([normal.compute_joint_statistic(a, b, self.together)[0] for a, b in zip(s, G, strict=True)])
            - price
        )
        whole = joint > T[:, first]
        T[:, first] = np.maximum(T[:, first], joint)
        T[:, others] = 0.0
        return whole
