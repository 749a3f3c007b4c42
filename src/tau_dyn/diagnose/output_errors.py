"""How far models are from measurements that were used for nothing else, one by one and from each to the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class WholeErrors:
    """Errors without masks: reversals and rests included.

    Attributes:
        rms: Residual rms of each output (m,) [unit of the output].
        relative_error_percent: `100 norm(residual) / norm(measured)` over all outputs.
    """

    rms: np.ndarray
    relative_error_percent: float


@dataclass(frozen=True, eq=False)
class OutputErrors:
    """How far a model is from measurements that were used for nothing else.

    Attributes:
        outputs: What was measured: joints' forces, joints' deflections, or the tool's axes.
        rms: Residual rms of each output (m,) [unit of the output].
        ci95: Its 95 % interval (m, 2), from blocks.
        relative_error_percent: `100 norm(residual) / norm(measured)` over all outputs.
        relative_ci95: Its 95 % interval, from blocks.
        all_samples: Rms of each output and relative error of the same stretches without masks; None where not known.
        used_shares: Share of these stretches' samples that the masks leave, for each output; empty where not known.
    """

    outputs: tuple[str, ...]
    rms: np.ndarray
    ci95: np.ndarray
    relative_error_percent: float
    relative_ci95: tuple[float, float] = (float("nan"), float("nan"))
    all_samples: WholeErrors | None = None
    used_shares: tuple[float, ...] = ()

    @property
    def used_share(self) -> float:
        """Share of the samples of all outputs that the masks leave; all of them where nothing else is known."""
        return float(np.mean(self.used_shares)) if self.used_shares else 1.0

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        out = {
            "rms_per_joint": dict(zip(self.outputs, map(float, self.rms), strict=True)),
            "relative_error_percent": self.relative_error_percent,
            "relative_ci95": list(self.relative_ci95),
        }
        if self.all_samples is not None:
            out |= {
                "used_share": self.used_share,
                "used_share_per_joint": dict(zip(self.outputs, self.used_shares, strict=True)),
                "all_samples": {
                    "rms_per_joint": dict(zip(self.outputs, map(float, self.all_samples.rms), strict=True)),
                    "relative_error_percent": self.all_samples.relative_error_percent,
                },
            }
        return out


@dataclass(frozen=True, eq=False)
class Step:
    """One bar of the waterfall: `nominal`, `refitted`, a cause with its joints, or `noise_floor`."""

    step: str
    errors: OutputErrors

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        ci95 = dict(zip(self.errors.outputs, self.errors.ci95.tolist(), strict=True))
        return {"step": self.step, **self.errors.to_dict(), "ci95": ci95}


@dataclass(frozen=True)
class Gain:
    """What a cause is worth on data used for nothing else: rms over its outputs before and after, and their ratio."""

    rms_before: float
    rms_after: float
    reduction_percent: float
    ci95: tuple[float, float]

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        rows = {"rms_before": self.rms_before, "rms_after": self.rms_after}
        return {**rows, "reduction_percent": self.reduction_percent, "ci95": list(self.ci95)}
