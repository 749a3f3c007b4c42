"""Pieces that are too short for the filters are left out and said; the rest is used.

A zero-phase low-pass disturbs both ends of a piece, so a piece gives rows only where it is longer than both ends together. What
the rest can tell is counted in independent information: a motion of band f_b gives `2 f_b T` independent values in a time T
(Nyquist), however fast it was sampled.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, TypeVar

import numpy as np

from tau_dyn.coded_warning import CodedWarning
from tau_dyn.estimate import Regression
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify.preparation import BAND_FACTOR, Preparation
from tau_dyn.log import Log, Recording, compute_edge_samples, count, count_short_segments

CODE = "short_log"

BAND_SHARE = 0.1
"""Part of the longest piece's length from which a piece has a say in the filters; a shorter one resolves no band."""

INFORMATION_PER_PARAMETER = 2.0
"""Independent values for each of `p` base parameters below which a log is called short: fewer than `p` are left for the residual,
and standard errors are themselves off by more than `1 / sqrt(2 p)`, 9 % for the 64 of a six-axis arm."""

EXPERIMENT = "record half a minute or more without gaps, in both directions and over several speeds"


class TooShort(CannotAnswer):
    """No piece of the logs is long enough for the filters."""


class ShortSegment(Protocol):
    """A stretch without gaps, in memory or on disk."""

    @property
    def name(self) -> str:
        """Name of its log."""
        ...

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        ...

    @property
    def rate_hz(self) -> float:
        """Sampling rate [Hz]."""
        ...


AnyPiece = TypeVar("AnyPiece", bound=ShortSegment)


class Kept(NamedTuple):
    """Indices of the pieces that are long enough, and what is said of the others."""

    index: tuple[int, ...]
    warnings: tuple[str, ...]

    def of(self, pieces: Sequence[AnyPiece]) -> list[AnyPiece]:
        """Return the pieces that are kept."""
        return [pieces[k] for k in self.index]


def choose_from_long(pieces: Sequence[AnyPiece], choose: Callable[[list[AnyPiece]], Preparation]) -> Preparation:
    """Choose filters from the pieces that are long enough to show a band, and from those of any lower rate."""
    longest = max(piece.n_samples / piece.rate_hz for piece in pieces)
    long = [piece for piece in pieces if piece.n_samples / piece.rate_hz >= BAND_SHARE * longest]
    slowest_hz = min(piece.rate_hz for piece in long)
    return choose([piece for piece in pieces if piece in long or piece.rate_hz < 0.99 * slowest_hz])


def keep_long(pieces: Sequence[ShortSegment], cutoff_hz: float, factor: Callable[[float], int]) -> Kept:
    """Tell the pieces that give rows from those that are shorter than the ends that a low-pass disturbs.

    Args:
        pieces: Even stretches, of one log or of several.
        cutoff_hz: The lowest cutoff of the filters [Hz].
        factor: From a sampling rate [Hz] to the decimation.

    Raises:
        TooShort: None is long enough.
    """
    needed = [compute_min_samples(cutoff_hz, piece.rate_hz, factor(piece.rate_hz)) for piece in pieces]
    index = tuple(k for k, (piece, n) in enumerate(zip(pieces, needed, strict=True)) if piece.n_samples >= n)
    seconds = max((n / piece.rate_hz for piece, n in zip(pieces, needed, strict=True)), default=0.0)
    if not index:
        raise refuse_short(pieces, seconds)
    return Kept(index, _left_out(pieces, index, seconds))


def compute_min_samples(cutoff_hz: float, rate_hz: float, factor: int) -> int:
    """Return how many samples a piece has at least that gives a row between the ends that a low-pass disturbs."""
    return 2 * (compute_edge_samples(cutoff_hz, rate_hz) + factor) + 1


def refuse_short(pieces: Sequence[ShortSegment], needed_s: float) -> TooShort:
    """Return the refusal of logs without a piece of the length that the filters need [s]."""
    names = ", ".join(dict.fromkeys(piece.name for piece in pieces))
    longest = max((piece.n_samples / piece.rate_hz for piece in pieces), default=0.0)
    return TooShort(
        "too_little_data",
        f"no piece of {names} without a gap is long enough: the longest lasts {longest:.2g} s, and the filters that this "
        f"motion needs take {needed_s:.2g} s",
        EXPERIMENT,
    )


def _left_out(pieces: Sequence[ShortSegment], index: Sequence[int], needed_s: float) -> tuple[str, ...]:
    said = []
    for name in dict.fromkeys(piece.name for piece in pieces):
        lengths = [
            (k in index, piece.n_samples / piece.rate_hz) for k, piece in enumerate(pieces) if piece.name == name
        ]
        short = [seconds for kept, seconds in lengths if not kept]
        if short:
            said.append(
                f"{name}: {len(short)} of {count(len(lengths), 'piece')} without a gap {'is' if len(short) == 1 else 'are'} "
                f"shorter than the {needed_s:.2g} s that the filters need; {sum(short):.3g} of "
                f"{sum(seconds for _, seconds in lengths):.3g} s are left out"
            )
    return tuple(CodedWarning(CODE, sentence) for sentence in said)


def list_crumbs(logs: Sequence[Log | Recording]) -> list[str]:
    """Return warnings about pieces between gaps of too few samples for anything, which no list of pieces holds."""
    said = []
    for log in logs:
        n, seconds = count_short_segments(log) if isinstance(log, Log) else (0, 0.0)
        if n:
            sentence = f"{log.name}: {count(n, 'piece')} of fewer than 10 samples between gaps, {seconds:.3g} s in all, left out"
            said.append(CodedWarning(CODE, sentence))
    return said


def count_information(regression: Regression, band_hz: float | None = None) -> float:
    """Return how many independent values a regression holds: twice the motion's band times its usable time, over all outputs.

    Args:
        regression: The data.
        band_hz: The motion's band [Hz]; by default that from which the filters of an identification were chosen.
    """
    preparation: Preparation = regression.settings["preparation"]
    seconds = sum(float(run.usable.sum()) * _step(run.t) for run in regression.runs)
    return 2 * (band_hz or preparation.force_cutoff_hz / BAND_FACTOR) * seconds


def _step(t: np.ndarray) -> float:
    return float(t[-1] - t[0]) / (len(t) - 1) if len(t) > 1 else 0.0


def list_information_warnings(regression: Regression, rank: int, band_hz: float | None = None) -> list[str]:
    """Return a warning where the logs hold little independent information for a rank."""
    if regression.everything is not None:
        return []  # a recording larger than memory
    held = count_information(regression, band_hz)
    if held >= INFORMATION_PER_PARAMETER * rank:
        return []
    return [
        CodedWarning(
            CODE,
            f"the logs hold about {held:.0f} independent values for {rank} parameters and combinations, so intervals are "
            f"wide and themselves unsure; {EXPERIMENT}",
        )
    ]
