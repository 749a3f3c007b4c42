"""Predictions and measurements -> errors by channel, and the interval of a difference.

    error = 100 |F (y - y_hat)| / |F y|     forces,      F the low-pass at 20 Hz
    error = rms(q - q_hat) [mrad]           positions
    error = 100 |y - y_hat| / |y - mean y|  outputs of vibration sets

Vibration models simulate freely from the initial state that fits the held-out part best, estimated here for every tool from its
`A` and `C`: the measure of the published figures. `forecast` is the error from the end of the training data on, without it.

A set's error is the mean over its channels. The interval of a difference of two tools comes from a bootstrap of blocks of 0.5 s,
in vibration sets of a twentieth of the samples; both tools' errors are drawn from the same blocks (Kuensch 1989).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from comparison_parts.case import Case
from comparison_parts.samples import FORCE_HZ, Held, smooth

BLOCK_S, VIBRATION_BLOCKS, DRAWS = 0.5, 20, 2000


@dataclass(frozen=True, eq=False)
class Judged:
    """Held-out sums by block (n_blocks, channels): squares of the residual and of what it is measured against, and samples."""

    residual: np.ndarray
    size: np.ndarray
    count: np.ndarray
    relative: bool

    def to_dict(self) -> dict[str, Any]:
        """Return errors by channel and the sums, for the file of results."""
        sums = {
            key: [[float(f"{v:.6g}") for v in line] for line in x]
            for key, x in (("residual", self.residual), ("size", self.size))
        }
        return {
            "errors": self.errors().tolist(),
            "sums": sums | {"count": self.count.astype(int).tolist(), "relative": self.relative},
        }

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> Judged:
        """Return what a row of the file holds."""
        return cls(*(np.array(row["sums"][key]) for key in ("residual", "size", "count")), row["sums"]["relative"])

    def errors(self, drawn: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return each channel's error (channels,) over some of the blocks."""
        left = self.residual[drawn].sum(axis=0)
        if self.relative:
            return 100 * np.sqrt(left / self.size[drawn].sum(axis=0))
        return 1e3 * np.sqrt(left / self.count[drawn].sum(axis=0))


def judge(case: Case, held: list[Held], predicted: list[np.ndarray]) -> Judged:
    """Compare predictions (N, n) with held-out targets, stretch by stretch.

    Raises:
        ValueError: A prediction is of other samples, or holds no number somewhere.
    """
    if [x.target.shape for x in held] != [x.shape for x in predicted]:
        raise ValueError("the prediction is of other samples")
    if not all(np.all(np.isfinite(x)) for x in predicted):
        raise ValueError("the prediction holds no number somewhere")
    mean = np.concatenate([x.target for x in held]).mean(axis=0) if case.kind == "vibration" else 0.0
    total, blocks = sum(len(x.t) for x in held), []
    for x, p in zip(held, predicted, strict=True):
        y, rate = x.target, (len(x.t) - 1) / (x.t[-1] - x.t[0])
        if case.kind == "force":
            y, p = (smooth(z, min(FORCE_HZ, rate / 10), rate) for z in (y, p))
        length = max(1, total // VIBRATION_BLOCKS if case.kind == "vibration" else round(BLOCK_S * rate))
        sums = (x.counts * (y - p) ** 2, x.counts * (y - mean) ** 2, x.counts)
        blocks += [np.array([z[k : k + length].sum(axis=0) for z in sums]) for k in range(0, len(y), length)]
    left, size, count = np.array([b for b in blocks if b[2].any()]).transpose(1, 0, 2)
    return Judged(left, size, count, case.kind != "servo")


def start_freely(target: np.ndarray, predicted: np.ndarray, free: Mapping[str, Any]) -> np.ndarray:
    """Return a linear model's outputs (N, p) from the initial state that fits best (least squares, outputs by their size)."""
    A, C = (np.array(free[key]) for key in "AC")
    responses, scale = [C], target.std(axis=0)
    for _ in range(len(target) - 1):
        responses.append(responses[-1] @ A)
    gamma = np.array(responses)
    rows, rest = (gamma / scale[:, None]).reshape(-1, len(A)), ((target - predicted) / scale).ravel()
    return predicted + gamma @ np.linalg.lstsq(rows, rest, rcond=1e-10)[0]


def compare(ours: Judged, other: Judged, seed: int) -> tuple[float, float, float]:
    """Return our error minus the other's, and the 95 % interval of that."""
    rng, n = np.random.default_rng(seed), len(ours.count)
    draws = rng.integers(0, n, (DRAWS, n))
    spread = [ours.errors(d).mean() - other.errors(d).mean() for d in draws]
    low, high = np.quantile(spread, (0.025, 0.975))
    return float(ours.errors().mean() - other.errors().mean()), float(low), float(high)
