"""How far a model is from measured forces, by joint: rms and relative error, over the samples a fit uses and over all."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.estimate import Regression, SufficientStatistics


@dataclass(frozen=True, eq=False)
class ForceErrors:
    """Errors of predicted forces on some logs.

    Attributes:
        joints: Actuated joints.
        rms: Residual rms of each joint over the used samples (na,) [N or N m].
        relative_error_percent: `100 norm(residual) / norm(tau)` over the used samples of all joints.
        per_joint_percent: The same for each joint (na,).
        all_samples: The same three numbers without masks; None inside itself.
        unjudged: Joints of which the masks leave no sample; their zeros say nothing.
        used_share: Share of the samples that the masks leave.
        used_shares: The same for each joint; empty inside `all_samples`.
    """

    joints: tuple[str, ...]
    rms: np.ndarray
    relative_error_percent: float
    per_joint_percent: np.ndarray
    used_share: float
    all_samples: ForceErrors | None
    unjudged: tuple[str, ...] = ()
    used_shares: tuple[float, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        rows = zip(self.joints, self.rms, self.per_joint_percent, strict=True)
        out: dict[str, Any] = {
            "relative_error_percent": self.relative_error_percent,
            "per_joint": {j: {"rms": float(r), "relative_error_percent": float(p)} for j, r, p in rows},
        }
        if self.all_samples is not None:
            out |= {
                "used_share": self.used_share,
                "used_share_per_joint": dict(zip(self.joints, self.used_shares, strict=False)),
                "all_samples": self.all_samples.to_dict(),
            }
        return out


def build_force_errors(regression: Regression, theta: np.ndarray) -> ForceErrors:
    """Return the errors of a full parameter vector (p,) on a regression's data."""
    used, every = regression.totals(), regression.totals(whole=True)
    whole = _errors(regression.outputs, every, theta, 1.0, None)
    found = _errors(regression.outputs, used, theta, regression.used_share, whole)
    return replace(found, used_shares=tuple(map(float, used.count / np.maximum(every.count, 1))))


def _errors(
    joints: tuple[str, ...], totals: SufficientStatistics, theta: np.ndarray, share: float, whole: ForceErrors | None
) -> ForceErrors:
    squares, power = totals.squares(theta), totals.power()
    return ForceErrors(
        joints,
        np.sqrt(squares / np.maximum(totals.count, 1)),
        _percent(squares.sum(), power.sum()),
        np.array([_percent(s, p) for s, p in zip(squares, power, strict=True)]),
        share,
        whole,
        tuple(joint for joint, n in zip(joints, totals.count, strict=True) if not n),
    )


def _percent(squares: float, power: float) -> float:
    return float(100 * np.sqrt(squares / power)) if power > 0 else 0.0
