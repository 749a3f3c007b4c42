"""Channels of a position that the encoders do not measure: that of the tool, or of the load side of a joint.

Both are a measured position minus its prediction from the encoders; both pass the same low-pass, unless they are static poses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from tau_dyn.diagnose.preparation import compute_border_gap_s
from tau_dyn.effects import Effect, Motion, Scene
from tau_dyn.estimate import RegressionRun
from tau_dyn.evidence import (
    Channel,
    build_scene,
    find_shared_signals,
    refuse_scarce,
    split_by_blocks,
)
from tau_dyn.log import Log, compute_edge_samples, decimate, lowpass_and_decimate
from tau_dyn.parameters import Parameters

POSE_S = 1.0
"""Static poses count one by one, independent of the time between them: each represents this duration [s]."""


@dataclass(frozen=True, eq=False)
class MeasuredSegment:
    """One even stretch of a log, or its static poses, with a position that the encoders do not measure.

    Attributes:
        log: The stretch.
        motion: Motion of the encoders at the log's rate, with the signals that effects need.
        measured: Measured outputs (N, m) [m or rad].
        predicted: The same from the encoders alone (N, m).
        usable: Samples that are used (N,) or (N, m).
        cutoff_hz: Low-pass on both sides [Hz]; None for poses.
        factor: Decimation.
    """

    log: Log
    motion: Motion
    measured: np.ndarray
    predicted: np.ndarray
    usable: np.ndarray
    cutoff_hz: float | None
    factor: int

    def passed(self, x: np.ndarray) -> np.ndarray:
        """Return an array (N, ...) in the form used by the fit (n, ...): low-passed and decimated."""
        if self.cutoff_hz is None:
            return x
        return lowpass_and_decimate(x, self.cutoff_hz, self.log.rate_hz, self.factor)

    @property
    def t(self) -> np.ndarray:
        """Time of the fit's samples (n,) [s]."""
        return POSE_S * np.arange(len(self.measured)) if self.cutoff_hz is None else decimate(self.log.t, self.factor)

    def run(self, W: np.ndarray) -> RegressionRun:
        """Return the baseline's regression with these columns (n, m, p)."""
        y, usable = self.passed(self.measured - self.predicted), self.usable
        if self.cutoff_hz is not None:
            usable = mask_filter_edges(usable, self.cutoff_hz, self.log.rate_hz, self.factor)
        usable = np.broadcast_to(usable.reshape(len(y), -1), y.shape)
        signals = {key: decimate(getattr(self.motion, key), self.factor) for key in ("q", "v", "a")}
        return RegressionRun(self.log.name, self.t, W, y, usable, W, y, signals)


@dataclass(frozen=True, eq=False)
class MeasuredChannel(Channel):
    """Measured positions minus their prediction from the encoders.

    Attributes:
        pieces: The stretches.
    """

    pieces: tuple[MeasuredSegment, ...]


Kind = TypeVar("Kind", bound=MeasuredChannel)


def cut_stretches(
    train: Sequence[Log], held: Sequence[Log], cut: Callable[[Log], Sequence[Log]]
) -> tuple[list[Log], list[bool]]:
    """Return the stretches of the training logs, then of the held-out logs, and whether each belongs to a held-out log."""
    found = [(piece, out) for logs, out in ((train, False), (held, True)) for log in logs for piece in cut(log)]
    return [piece for piece, _ in found], [out for _, out in found]


def build_measured_scene(
    joints: tuple[str, ...], units: tuple[str, ...], pieces: Sequence[MeasuredSegment], slow: np.ndarray, seen: str
) -> Scene:
    """Return the range of the pieces' motions together; `seen` is the signal that names the measurement."""
    motions = [piece.motion for piece in pieces]
    return build_scene(
        motions,
        joints,
        units,
        slow=slow,
        cutoff_hz=next((p.cutoff_hz for p in pieces if p.cutoff_hz is not None), np.inf),
        duration=sum(float(p.t[-1] - p.t[0]) for p in pieces),
        signals=find_shared_signals(motions) | {seen},
    )


def build_measured_channel(
    kind: type[Kind],
    name: str,
    outputs: tuple[str, ...],
    units: tuple[str, ...],
    baseline: tuple[Parameters, Sequence[np.ndarray]],
    scene: Scene,
    causes: Sequence[type[Effect]],
    pieces: Sequence[MeasuredSegment],
    held: Sequence[bool],
    *,
    per_parameter: int,
    refusal: tuple[str, str, str],
) -> Kind:
    """Divide pieces into the three parts of a channel of a kind.

    Args:
        kind: The channel's class.
        name: Its name.
        outputs: The measured quantities (m).
        units: Units of the outputs.
        baseline: Parameters of the baseline and their columns (n, m, p) of each piece.
        scene: The range of the motion.
        causes: Effects that may be found.
        pieces: The stretches.
        held: Whether each belongs to a held-out log.
        per_parameter: Usable values that each part needs for each parameter of the baseline.
        refusal: The missing data, the data that there are, and the experiment to make, if a part has fewer.

    Raises:
        CannotAnswer: Too few measurements for three parts.
    """
    parameters, columns = baseline
    runs = tuple(piece.run(W) for piece, W in zip(pieces, columns, strict=True))
    gaps = (compute_border_gap_s(p.cutoff_hz, p.log.rate_hz) for p in pieces if p.cutoff_hz is not None)
    parts = split_by_blocks(runs, held, next(gaps, 0.0))
    channel = kind(name, outputs, units, parameters, runs, parts, scene, tuple(causes), tuple(pieces))
    refuse_scarce(channel, (per_parameter * len(parameters),) * 3, *refusal)
    return channel


def find_directions(v: np.ndarray, threshold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the direction of the last certain motion, and the samples from which on there was one.

    Args:
        v: Speeds (N, na) [m/s or rad/s].
        threshold: Slowest speed with a certain sign (na,).

    Returns:
        -1 or 1 (N, na), before a joint's first certain motion the direction of that motion, 0 if it never moves; and whether a
        certain motion came before (N, na).
    """
    sides = [_direction(v[:, k], float(threshold[k])) for k in range(v.shape[1])]
    return np.column_stack([sign for sign, _ in sides]), np.column_stack([known for _, known in sides])


def _direction(v: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    sure = np.flatnonzero(np.abs(v) >= threshold)
    if not len(sure):
        return np.zeros_like(v), np.zeros(len(v), bool)
    last = np.searchsorted(sure, np.arange(len(v)), side="right") - 1
    return np.sign(v[sure[np.maximum(last, 0)]]), last >= 0


def mask_filter_edges(mask: np.ndarray, cutoff_hz: float, rate_hz: float, factor: int) -> np.ndarray:
    """Return the mask of usable samples, without those at both ends that the low-pass disturbs.

    Args:
        mask: Samples (N, ...) at the log's rate.
        cutoff_hz: The low-pass [Hz].
        rate_hz: Rate of the log [Hz].
        factor: Decimation.

    Returns:
        Samples (n, ...) after decimation.
    """
    inner = mask[::factor].copy()
    edge = int(np.ceil(compute_edge_samples(cutoff_hz, rate_hz) / factor))
    inner[:edge] = inner[len(inner) - edge :] = False
    return inner
