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
statistic minus the penalty of Schwarz' criterion for each number beyond the first. Several changes at once, such as a tool and
an encoder's zero, are found one after another by the score that the others leave. The time of a change is the change-point
with the likelihood interval of Hansen 2000, and the block before it, inside which it may lie. Reference: Lorden 1971;
Basseville & Nikiforov 1993, 5 and 8; Hansen 2000, Sample splitting and threshold estimation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from tau_dyn.evidence import MIN_2LOGL_DIFFERENCE
from tau_dyn.monitor.normal_state import BlockScore, NormalState, compute_power

BLOCK_S = 2.0
"""Length of a block [s]: longer than a residual's memory, a fraction of the minute in which a change is to be named."""
BLOCKS_PER_HOUR = 3600 / BLOCK_S
FALSE_ALARMS_PER_HOUR = 1e-4
"""Expected false alarms: one in ten thousand hours of motion, which is about a year."""
LENGTHS = np.unique(np.round(np.geomspace(1, BLOCKS_PER_HOUR, 20)).astype(int))
"""Numbers of blocks over which a change is tested: from one to those of an hour, each about 1.5 times the one before."""
CONFIRMING_BLOCKS = 5
"""Blocks after a detection that take part in the name, the size and the time of a change: 10 s separate similar causes."""
_MAX_LEFT_SHARE = 0.5
"""Share of what one change leaves beyond the noise; where all directions together leave more, none of them is its cause."""
CHANGE_POINT_95 = 7.35
"""Fall of the likelihood ratio that contains 95 % of true change-points: -2 log(1 - sqrt(0.95)) (Hansen 2000)."""


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
        simultaneous: Directions that changed at the same time.
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
    simultaneous: tuple[int, ...] = ()


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
        self.changes += self._describe(self.normal, self._detected)
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

    def _describe(self, normal: NormalState, detected: int) -> list[DetectedChange]:
        """Return what changed, the change with the most evidence first, and when."""
        n = len(self._blocks)
        first = max(0, detected + 1 - int(LENGTHS[-1]))
        starts = np.arange(first, detected + 1)
        s, G = self._s[n] - self._s[starts], self._G[n] - self._G[starts]
        T = normal.compute_statistics(s, G)
        whole = self._join_statistics(T, normal, s, G)
        k, d = (int(x) for x in np.unravel_index(int(np.argmax(T)), T.shape))
        near = np.flatnonzero(T[:, d] > T[k, d] - CHANGE_POINT_95)
        together = self.together if whole[k] or d not in self.together else ()
        at = self._blocks[first + k]
        inside = first + k > 0 and self._blocks[first + k - 1].log == at.log and first + k < n - 1
        whole_blocks = first + k + inside  # the change may lie inside the first block since then
        s, G = self._s[n] - self._s[whole_blocks], self._G[n] - self._G[whole_blocks]
        since = _Since(normal, s, G, self._blocks[whole_blocks:], together, self.together[1:], T.max(axis=0))
        found = self._blocks[detected]
        begin, end = (self._blocks[max(0, first + int(x))] for x in (near[0] - 1, near[-1]))
        early = begin.t[0] if begin.log == at.log else at.t[0]
        late = end.t[1] if end.log == at.log else at.t[1]
        changes = []
        for change in since.list_changes(d, self.threshold**2):
            statistic, size, stderr, dof, twins = since.measure(change)
            half = float(stats.t.isf(0.025, dof)) * stderr
            chance = BLOCKS_PER_HOUR * self.n_tests * 2 * float(stats.t.sf(np.sqrt(statistic), normal.dof))
            changes.append(
                DetectedChange(
                    change, at.t[0], at.log, (early, late), found.t[1], found.log, size, stderr,
                    (size - half, size + half), statistic, chance, twins, tuple(x for x in since.changes if x != change),
                )
            )  # fmt: skip
        return changes

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
        joint = np.array([normal.estimate(a, b, self.together).statistic for a, b in zip(s, G, strict=True)]) - price
        whole = joint > T[:, first]
        T[:, first] = np.maximum(T[:, first], joint)
        T[:, others] = 0.0
        return whole


@dataclass(eq=False)
class _Since:
    """What changed since one block, if several directions may have changed at once.

    Attributes:
        normal: The normal state.
        s: Summed scores (D,).
        G: Summed information (D, D).
        blocks: The blocks since.
        together: Directions of one body, its mass first; empty where the mass alone explains it.
        parts: Directions that are not named alone.
        alone: Largest statistic of each direction (D,), each taken alone, over all starts.
        changes: The directions that changed.
    """

    normal: NormalState
    s: np.ndarray
    G: np.ndarray
    blocks: Sequence[BlockScore]
    together: tuple[int, ...]
    parts: tuple[int, ...]
    alone: np.ndarray
    changes: list[int] = field(default_factory=list)

    def list_changes(self, first: int, threshold: float) -> list[int]:
        """Return the directions that changed at once, from the one with the largest statistic.

        Further ones count if their statistic, those before in the model, exceeds the threshold, and if the directions together
        explain most of what the first one leaves; an effect without a direction gets no name.
        """
        self.changes = [first]
        left = self._compute_excess(self._list_members(self.changes))
        if self._compute_excess(range(len(self.s))) > _MAX_LEFT_SHARE * left:
            return self.changes
        while (T := self._test_further(self.changes)).max() > threshold:
            self.changes.append(int(np.argmax(T)))
        for change in tuple(self.changes):
            others = [x for x in self.changes if x != change]
            if others and self._test_further(others)[change] <= threshold:
                self.changes = others
        return self.changes

    def measure(self, change: int) -> tuple[float, float, float, float, tuple[int, ...]]:
        """Return statistic, size, standard error, degrees of freedom and equivalent directions of one change.

        The other changes are in the model. The statistic that the other directions still add, as by the force of a payload at a
        wrong zero, may belong to any of them: a direction is equivalent if its statistic is smaller by no more, and the standard
        error grows as if each direction had an equal share.
        """
        others = [x for x in self.changes if x != change]
        T = self._test_further(others) if others else self.alone
        unexplained, noise = self._compute_unexplained()
        twins = np.flatnonzero(T > T[change] - MIN_2LOGL_DIFFERENCE - unexplained)
        members = self._list_members(self.changes)
        found, k = self.normal.estimate(self.s, self.G, members), members.index(change)
        size, stderr = float(found.sizes[k]), float(found.stderr[k] * np.sqrt(noise + unexplained / len(self.s)))
        return float(T[change]), size, stderr, float(found.dof[k]), tuple(int(x) for x in twins if x != change)

    def _compute_unexplained(self) -> tuple[float, float]:
        """Return what the other directions would explain beyond two standard deviations of chance, and the noise since then.

        Both are over the noise of the reference; the noise counts as no lower than that.
        """
        members = self._list_members(self.changes)
        every, these = (self.normal.estimate(self.s, self.G, some).power for some in (range(len(self.s)), members))
        others = len(self.s) - len(members)
        power = sum(compute_power(block, self.normal.theta) for block in self.blocks)
        noise = max((power - every) / (self.normal.noise * sum(block.rows for block in self.blocks)), 1.0)
        return max((every - these) / self.normal.noise - others - 2 * np.sqrt(2 * others), 0.0), noise

    def _list_members(self, changes: Sequence[int]) -> list[int]:
        """Return the directions of changes, a body's in full."""
        return [m for x in changes for m in (self.together if x in self.together[:1] else (x,))]

    def _test_further(self, changes: Sequence[int]) -> np.ndarray:
        T = self.normal.test_further(self.s, self.G, self._list_members(changes))
        T[list(self.parts)] = 0.0
        return T

    def _compute_excess(self, members: Sequence[int]) -> float:
        """Return the squared residual beyond the reference's noise, with directions that change."""
        power = sum(compute_power(block, self.normal.theta) for block in self.blocks)
        noise = self.normal.noise * sum(block.rows for block in self.blocks)
        return max(power - self.normal.estimate(self.s, self.G, members).power - noise, 0.0)
