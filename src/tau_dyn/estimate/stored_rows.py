"""Rows of a regression on disk, written once and read back in order: what a covariance needs where memory does not hold it.

A temporary file that no name leads to; it is gone when nobody uses it any more. Columns of zeros are not written.
"""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Iterator, Sequence

import numpy as np

from tau_dyn.estimate.regression import RegressionRows


class StoredRows:
    """Pieces of runs, each run's in order.

    Attributes:
        n_columns: Columns of all rows.
    """

    def __init__(self, n_columns: int) -> None:
        """Open a file with nothing in it."""
        self.n_columns = n_columns
        self._file = tempfile.TemporaryFile(prefix="tau_dyn_")
        weakref.finalize(self, self._file.close)
        self._places: list[list[int]] = []

    def begin(self) -> None:
        """Say that what comes next is another run."""
        self._places.append([])

    def add(self, rows: RegressionRows) -> None:
        """Write a piece of the run that was begun last."""
        self._file.seek(0, 2)
        self._places[-1].append(self._file.tell())
        for array in (rows.t, rows.usable, rows.y):
            np.save(self._file, array)
        for k in range(rows.y.shape[1]):
            touching = np.flatnonzero(rows.W[:, k].any(axis=0))
            np.save(self._file, touching)
            np.save(self._file, rows.W[:, k, touching])

    @property
    def runs(self) -> Sequence[Sequence[RegressionRows]]:
        """Every run as its pieces, read when they are asked for."""
        return tuple(_Run(self, places) for places in self._places)

    def read(self, place: int) -> RegressionRows:
        """Return the piece at a place in the file."""
        self._file.seek(place)
        t, usable, y = (np.load(self._file) for _ in range(3))
        W = np.zeros((*y.shape, self.n_columns))
        for k in range(y.shape[1]):
            touching = np.load(self._file)
            W[:, k, touching] = np.load(self._file)
        return RegressionRows(t, W, y, usable)


class _Run(Sequence[RegressionRows]):
    """One run's pieces."""

    def __init__(self, stored: StoredRows, places: list[int]) -> None:
        self._stored, self._places = stored, places

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index):
        return self._stored.read(self._places[index])

    def __iter__(self) -> Iterator[RegressionRows]:
        return (self._stored.read(place) for place in self._places)
