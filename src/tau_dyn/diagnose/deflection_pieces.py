"""Logs with two encoders a joint, made ready for the deflection channel: the deflection, and the motion that effects feel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.diagnose.deflection_clock import LOAD_SPEED
from tau_dyn.diagnose.pieces import find_directions, mask_filter_edges
from tau_dyn.effects import Motion
from tau_dyn.estimate import RegressionRun
from tau_dyn.exceptions import InputError
from tau_dyn.identify import Preparation, get_measured_signals
from tau_dyn.log import Log, decimate, differentiate, lowpass
from tau_dyn.robot import Robot


@dataclass(frozen=True, eq=False)
class DeflectionSegment:
    """One even stretch of a log, at the log's rate.

    Attributes:
        log: The stretch.
        motion: Motion of the motor-side encoders of the joints that have two, with what effects feel.
        deflection: Motor side minus load side (N, n) [m or rad], less its mean.
        usable: Samples whose direction of motion is known (N, n).
        preparation: Filters.
    """

    log: Log
    motion: Motion
    deflection: np.ndarray
    usable: np.ndarray
    preparation: Preparation

    @property
    def factor(self) -> int:
        """Decimation."""
        return self.preparation.factor(self.log.rate_hz)

    def passed(self, x: np.ndarray) -> np.ndarray:
        """Return an array (N, ...) through the low-pass that both sides share, decimated (n, ...)."""
        return decimate(lowpass(x, self.preparation.force_cutoff_hz, self.log.rate_hz), self.factor)

    def run(self, W: np.ndarray) -> RegressionRun:
        """Return the baseline's regression with these columns (n, m, p)."""
        usable = mask_filter_edges(self.usable, self.preparation.force_cutoff_hz, self.log.rate_hz, self.factor)
        y, t = self.passed(self.deflection), decimate(self.log.t, self.factor)
        signals = {key: decimate(getattr(self.motion, key), self.factor) for key in ("q", "v", "a")}
        return RegressionRun(self.log.name, t, W, y, usable, W, y, signals)


def list_encoder_pairs(robot: Robot, logs: Sequence[Log]) -> tuple[str, ...]:
    """Return the joints with two encoders; the first log decides.

    Raises:
        InputError: There is none, or another log lacks `q_J`, `q_link_J` or `tau_J` of one of them.
    """
    found = tuple(j for j in robot.actuated if f"q_link_{j}" in logs[0].channels)
    if not found:
        raise InputError(
            "missing_column",
            f"{logs[0].name} has no column q_link_{robot.actuated[0]}; the deflection channel needs q_link_J [m or rad] of "
            "some joint, the position on the load side",
        )
    for log in logs:
        for signal in ("q", "tau", "q_link"):
            log.joint(signal, found)
    return found


def build_deflection_segment(joints: tuple[str, ...], log: Log, preparation: Preparation) -> DeflectionSegment:
    """Return a stretch with its deflection and the motion of the motor side."""
    read, load, force = (log.joint(key, joints) for key in ("q", "q_link", "tau"))
    for name, x in (("q_link", load), ("tau", force)):
        if not np.isfinite(x).all():
            raise InputError(
                "bad_sample",
                f"{log.name}: {name} is missing in {int(np.sum(~np.isfinite(x)))} samples; cut the log there",
            )
    q, far = (lowpass(x, preparation.position_cutoff_hz, log.rate_hz) for x in (read, load))
    v, load_speed = (differentiate(x, log.dt, accuracy=4) for x in (q, far))
    a = differentiate(v, log.dt, accuracy=4)
    threshold = preparation.speed_threshold
    sign, usable = find_directions(v, threshold)
    signals = get_measured_signals(log, joints, q, v, threshold) | {"force": force, LOAD_SPEED: load_speed}
    motion = Motion.of(joints, q, v, a, sign, t=log.t, signals=signals)
    deflection = read - load
    return DeflectionSegment(log, motion, deflection - deflection.mean(axis=0), usable, preparation)
