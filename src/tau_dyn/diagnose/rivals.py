"""What is left of a cause's force when a rival is fitted in its place, from Gram matrices alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.diagnose.candidate_scan import find_nonnegative
from tau_dyn.diagnose.null_model import MIN_UNABSORBED_SHARE, compute_score_statistics
from tau_dyn.effects import Effect
from tau_dyn.parameters import Parameters

_RANK = 1e-10  # ratio of eigenvalues; less is rounding


@dataclass(frozen=True, eq=False)
class SchurComplement:
    """What is left of columns beside those refitted anyway: `G` (n, n), and the columns' own squares `raw` (n,)."""

    G: np.ndarray
    raw: np.ndarray

    @classmethod
    def of(cls, total: np.ndarray, p: int) -> SchurComplement:
        """Project the first p columns out of a Gram matrix."""
        raw = np.diag(total)[p:].copy()
        norm = np.sqrt(np.maximum(np.diag(total), 1e-300))
        scaled = total / norm[:, None] / norm
        values, vectors = np.linalg.eigh(scaled[:p, :p])
        keep = values > _RANK * max(values.max(initial=0.0), 1e-300)
        across = (vectors[:, keep] / np.sqrt(values[keep])).T @ scaled[:p, p:]
        left = (scaled[p:, p:] - across.T @ across) * norm[p:, None] * norm[p:]
        return cls(left, raw)

    def without(self, columns: np.ndarray) -> SchurComplement:
        """Project further columns out."""
        inverse = np.linalg.pinv(self.G[np.ix_(columns, columns)], rcond=MIN_UNABSORBED_SHARE, hermitian=True)
        across = self.G[:, columns]
        return replace(self, G=self.G - across @ inverse @ across.T)


@dataclass(frozen=True, eq=False)
class AlternativeCause:
    """A cause in place of another: its effects on each group of joints, one for each setting, and where their columns are."""

    groups: tuple[tuple[Effect, ...], ...]
    columns: tuple[tuple[np.ndarray, ...], ...]

    def best(self, schur: SchurComplement, x: int) -> tuple[float, list[tuple[Effect, np.ndarray]]]:
        """Return what the rival leaves of column x at its best settings, and which they are, with amplitudes.

        Groups are taken one by one, the one that explains most first; a joint belongs to one group only.
        """
        chosen: list[tuple[Effect, np.ndarray]] = []
        open_groups = list(range(len(self.groups)))
        while open_groups and schur.G[x, x] > 0:
            T, k, setting = max(self._explained(schur, x, k) for k in open_groups)
            if T <= 0:
                break
            effect, columns = self.groups[k][setting], self.columns[k][setting]
            chosen.append((effect, columns))
            rest = schur.G[x, x] - T
            schur = schur.without(columns)
            schur.G[x, x] = max(rest, schur.G[x, x])  # amplitudes that must not be negative leave more
            open_groups = [j for j in open_groups if not set(self.groups[j][0].joints) & set(effect.joints)]
        return max(float(schur.G[x, x]), 0.0), chosen

    def _explained(self, schur: SchurComplement, x: int, k: int) -> tuple[float, int, int]:
        """Return the most that a group explains, the group, and the setting; settings may differ in their columns' number."""
        best = (0.0, k, 0)
        sizes = np.array([len(c) for c in self.columns[k]])
        for size in np.unique(sizes):
            same = np.flatnonzero(sizes == size)
            index = np.array([self.columns[k][j] for j in same])
            s, G = schur.G[index, x][:, :, None], schur.G[index[:, :, None], index[:, None, :]]
            T = compute_score_statistics(s, G, schur.raw[index], find_nonnegative(self.groups[k][same[0]]))[:, 0]
            best = max(best, (float(T.max()), k, int(same[np.argmax(T)])))
        return best


def compute_imitating_amplitudes(
    schur: SchurComplement, x: int, chosen: Sequence[tuple[Effect, np.ndarray]]
) -> Parameters:
    """Return the values at which chosen effects imitate column x best; none is negative that must not be."""
    columns = np.concatenate([c for _, c in chosen])
    G = schur.G[np.ix_(columns, columns)]
    value = np.linalg.pinv(G, rcond=MIN_UNABSORBED_SHARE, hermitian=True) @ schur.G[columns, x]
    parameters = [p for effect, _ in chosen for p in effect.parameters]
    found = [replace(p, value=float(max(v, p.lower))) for p, v in zip(parameters, value, strict=True)]
    return Parameters(found)
