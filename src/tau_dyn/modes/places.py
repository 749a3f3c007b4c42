r"""Which degree of freedom each input pushes and each output watches, and where reciprocity completes what was not measured.

Every output names a degree of freedom. An input collocated with an output pushes the same one; any other input pushes one of its
own, which no sensor watches. Modes are known at all of them once one pair is collocated, because the residue of mode i is
`psi_sensed psi_driven'` with one and the same `psi`. References: De Angelis, Lus, Betti & Longman 2002; Ewins 2000, 2.8.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError


@dataclass(frozen=True)
class Places:
    """Places of sensors and forces.

    Attributes:
        sensed: Degree of freedom of each output.
        driven: Degree of freedom of each input.
    """

    sensed: tuple[int, ...]
    driven: tuple[int, ...]

    @property
    def n(self) -> int:
        """Number of degrees of freedom named by any input or output."""
        return len({*self.sensed, *self.driven})

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Collocated pairs (input, output)."""
        return [(j, self.sensed.index(dof)) for j, dof in enumerate(self.driven) if dof in self.sensed]

    def select(self, compliance: np.ndarray) -> np.ndarray:
        """Return what is measured (F, p, m) of a full compliance (F, n, n)."""
        return compliance[:, list(self.sensed)][:, :, list(self.driven)]

    def scale(self, response: np.ndarray) -> np.ndarray:
        """Return a typical size of motion per root of work (n,), so that degrees in metres and in radians weigh alike.

        Args:
            response: Displacement over force (F, p, m).
        """
        size = np.median(np.abs(response), axis=0)
        size = np.maximum(size, 1e-9 * size.max(initial=1e-280))
        scale = np.zeros(self.n)
        for j, i in self.pairs:
            scale[self.sensed[i]] = np.sqrt(size[i, j])
        j, i = max(self.pairs, key=lambda pair: size[pair[1], pair[0]])
        reference = np.sqrt(size[i, j])
        for row, dof in enumerate(self.sensed):
            scale[dof] = scale[dof] or size[row, j] / reference
        for column, dof in enumerate(self.driven):
            scale[dof] = scale[dof] or size[i, column] / reference
        return scale

    def unit(self, response: np.ndarray) -> np.ndarray:
        """Return the typical size (p, m) of each entry of a response (F, p, m), the product of its two ends' scales."""
        scale = self.scale(response)
        return np.outer(scale[list(self.sensed)], scale[list(self.driven)])

    @property
    def square(self) -> Places:
        """A sensor and a force at every degree of freedom."""
        return Places(tuple(range(self.n)), tuple(range(self.n)))

    def complete(self, residues: np.ndarray) -> np.ndarray:
        """Return mode shapes psi (modes, n), with `psi psi'` the residues (modes, p, m), signs free."""
        U, S, Vh = np.linalg.svd(residues)
        left, right = U[:, :, 0], S[:, :1] * Vh[:, 0]
        # the two factors share a complex scale; where a pair is collocated they are the same number
        rows, columns = [i for _, i in self.pairs], [j for j, _ in self.pairs]
        ratio = np.sum(left[:, rows].conj() * right[:, columns], axis=1)
        seen = np.sum(np.abs(left[:, rows]) ** 2, axis=1)
        # a mode that no collocated pair sees has no scale; any will do, for it leaves no information either
        known = np.abs(ratio) > 1e-12 * np.sqrt(seen) * S[:, 0]
        root = np.sqrt(np.where(known, ratio, S[:, 0] + 1e-280) / np.where(known, seen, 1.0))[:, None]
        shapes = np.zeros((len(residues), self.n), complex)
        shapes[:, list(self.driven)] = right / root
        shapes[:, list(self.sensed)] = left * root
        return shapes


def find_places(p: int, m: int, collocated: Sequence[tuple[int, int]] | None) -> Places:
    """Return the places of p outputs and m inputs.

    Args:
        p: Number of outputs.
        m: Number of inputs.
        collocated: Pairs (input, output) at one degree of freedom; None: all in order where p equals m, else none.

    Raises:
        InputError: A pair names an input or output that does not exist, or one twice.
    """
    pairs = [(k, k) for k in range(p)] if collocated is None and p == m else list(collocated or ())
    for side, size, used in (("input", m, [j for j, _ in pairs]), ("output", p, [i for _, i in pairs])):
        if any(not 0 <= k < size for k in used):
            raise InputError(
                "invalid_value",
                f"a collocated pair names {side} {max(used, key=abs)}; there are {size}, counted from 0",
            )
        if len(set(used)) < len(used):
            raise InputError("duplicate_name", f"a collocated pair names the same {side} twice")
    at, free = dict(pairs), iter(range(p, p + m))
    return Places(tuple(range(p)), tuple(at[j] if j in at else next(free) for j in range(m)))
