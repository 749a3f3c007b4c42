"""What a vibration test recorded: inputs and outputs on one even clock.

A `Record` is one unbroken stretch of one log; records are never joined across their ends. Inputs and outputs are plain columns
of the log, in the log's own units.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.log import Log, describe_missing_column, resample_segments


@dataclass(frozen=True, eq=False)
class Record:
    """One stretch of inputs and outputs.

    Attributes:
        u: Inputs (N, m); `m` may be 0 where only a response was measured.
        y: Outputs (N, p).
        dt: Sampling step [s].
        inputs: Names of the inputs.
        outputs: Names of the outputs.
        name: The log it came from.
        reference: What a feedback loop was asked for (N, r), where it was logged; None where not.
    """

    u: np.ndarray
    y: np.ndarray
    dt: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    name: str = ""
    reference: np.ndarray | None = None

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(self.y)

    def window(self, part: slice) -> Record:
        """Return a stretch of it."""
        reference = None if self.reference is None else self.reference[part]
        return replace(self, u=self.u[part], y=self.y[part], reference=reference)

    def aligned(self, delay: int) -> Record:
        """Return it with the inputs acting `delay` samples later; the samples whose input is unknown are left out."""
        if delay == 0:
            return self
        if not 0 < delay < self.n_samples:
            raise InputError(
                "invalid_value",
                f"a delay of {delay} samples does not fit into {self.name or 'a record'} of {self.n_samples}",
            )
        reference = None if self.reference is None else self.reference[:-delay]
        return replace(self, u=self.u[:-delay], y=self.y[delay:], reference=reference)

    def scaled(self, scales: Scales) -> Record:
        """Return it with every column divided by its scale."""
        return replace(self, u=self.u / scales.u, y=self.y / scales.y)


@dataclass(frozen=True, eq=False)
class Scales:
    """Root mean squares of the columns, so that unlike units weigh alike inside the engines.

    Attributes:
        u: Inputs (m,).
        y: Outputs (p,).
    """

    u: np.ndarray
    y: np.ndarray

    @classmethod
    def of(cls, records: Sequence[Record]) -> Scales:
        """Measure records; a column of zeros counts as one of ones."""
        check_alike(records)

        def size(columns: Sequence[np.ndarray]) -> np.ndarray:
            squares = sum(np.einsum("ij,ij->j", part, part) for part in columns)
            mean = np.sqrt(squares / sum(map(len, columns)))
            return np.where(mean > 0, mean, 1.0)

        return cls(size([record.u for record in records]), size([record.y for record in records]))


def truncate_records(records: Sequence[Record], longest: int, least: int = 40) -> list[Record]:
    """Return the beginnings of records, so many samples in all, and none shorter than `least` where it has them."""
    share = min(1.0, longest / sum(r.n_samples for r in records))
    return [r.window(slice(0, max(least, round(share * r.n_samples)))) for r in records]


def check_alike(records: Sequence[Record]) -> None:
    """Refuse records that one model cannot explain together.

    Raises:
        InputError: There is none, they differ in step or columns, or hold numbers that are not finite.
    """
    if not records:
        raise InputError("missing_input", "there is no record to identify from")
    first = records[0]
    for record in records:
        if abs(record.dt / first.dt - 1) > 1e-6:
            raise InputError(
                "time_stamps",
                f"records differ in sampling step: {first.dt:g} s and {record.dt:g} s; resample them alike",
            )
        if record.u.shape[1] != first.u.shape[1] or record.y.shape[1] != first.y.shape[1]:
            raise InputError("mismatch", "records differ in their number of inputs or outputs")
        if not (np.isfinite(record.u).all() and np.isfinite(record.y).all()):
            raise InputError(
                "bad_sample", f"{record.name or 'a record'} holds numbers that are not finite; cut it there"
            )


def build_records(
    log: Log, inputs: Sequence[str], outputs: Sequence[str], references: Sequence[str] = ()
) -> list[Record]:
    """Return a log's unbroken stretches as records.

    Args:
        log: The log.
        inputs: Columns that excite.
        outputs: Columns that respond.
        references: Columns that a feedback loop was asked to follow.

    Raises:
        InputError: A column is missing, named twice, or never changes.
    """
    names = [*inputs, *outputs, *references]
    for name in names:
        if name not in log.channels:
            raise InputError("missing_column", describe_missing_column(log.name, name, tuple(log.channels)))
    for name in [*inputs, *outputs]:
        if names.count(name) > 1:
            raise InputError("duplicate_name", f"column '{name}' is named twice; each is an input or an output")
        if np.ptp(log.channels[name]) == 0:
            raise InputError("poor_excitation", f"{log.name}: column '{name}' never changes")

    def stacked(piece: Log, columns: Iterable[str]) -> np.ndarray:
        return np.column_stack([np.zeros((piece.n_samples, 0)), *(piece.channels[name] for name in columns)])

    return [
        Record(
            stacked(piece, inputs),
            stacked(piece, outputs),
            piece.dt,
            tuple(inputs),
            tuple(outputs),
            piece.name,
            stacked(piece, references) if references else None,
        )
        for piece in resample_segments(log)
    ]
