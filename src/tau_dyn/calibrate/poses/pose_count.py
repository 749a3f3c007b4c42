r"""How many poses are enough: where twice as many would hardly make the calibration better.

With twice the information the model's part `s` of the held-out error falls to `s / sqrt(2)` while the device's noise
`w` stays. Poses are enough where `1 - sqrt(s^2 / 2 + w^2) / sqrt(s^2 + w^2)` falls below a threshold, or where `s`
has come down to an accuracy that was asked for. Fewer than the rank needs cannot be fitted at all.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.calibrate.poses.design import PoseDesign
from tau_dyn.calibrate.poses.exchange import PoseExchange
from tau_dyn.calibrate.poses.prediction import CalibrationPrediction, predict
from tau_dyn.calibrate.start import count_required_poses

MIN_DOUBLING_GAIN = 0.03
"""Share by which twice as many poses must make the held-out error smaller to be worth it."""
_UNKNOWN = 1.0
"""Standard error, in scales, from which a parameter is as good as unknown."""


def compute_min_poses(design: PoseDesign) -> int:
    """Return the fewest poses with which the model can be fitted and its noise judged."""
    rank = design.found.rank
    if rank >= design.n * design.per_pose:  # the candidates are too few to show what more of them would tell
        rank = len(design.found.names)
    return count_required_poses(rank, design.per_pose)


def compute_doubling_gain(made: CalibrationPrediction) -> float:
    """Return the share by which twice as many poses would make the held-out error smaller."""
    noise = made.held_out**2 - made.rms**2
    return 1.0 - float(np.sqrt((0.5 * made.rms**2 + noise) / made.held_out**2))


def add_poses_until_enough(
    design: PoseDesign, search: PoseExchange, *, gain: float, target: float | None, most: int
) -> tuple[np.ndarray, list[CalibrationPrediction]]:
    """Pick poses until they are enough, and return them with the accuracy predicted on the way.

    Args:
        design: Candidates.
        search: Picks them.
        gain: Threshold of `compute_doubling_gain`.
        target: Accuracy asked for [m]; replaces the threshold.
        most: Most poses.
    """
    least, chosen, curve = compute_min_poses(design), [], []
    for k in search.pick():
        chosen.append(k)
        if len(chosen) < least:
            continue
        curve.append(predict(design, np.array(chosen)))
        if _enough(design, curve[-1], gain, target) or len(chosen) >= most:
            break
    return np.array(chosen), curve


def _enough(design: PoseDesign, made: CalibrationPrediction, gain: float, target: float | None) -> bool:
    if target is not None:
        return made.rms <= target
    return compute_doubling_gain(made) < gain and bool((made.stderr < _UNKNOWN * design.scales).all())
