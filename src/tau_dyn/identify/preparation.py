"""How a log is filtered and masked, chosen from what the log itself shows.

One rule for every log, no constant in physical units:

1. the motion band f_b of each axis against its encoder's noise (`log/band.py`), the widest axis counting;
2. forces and columns are low-passed at f_w = min(5 f_b, f_noise, 0.16 f_s): wide enough to keep the friction's edges, not so wide
   that acceleration noise, which sits in the columns, exceeds 1e-4 of the acceleration's power and biases the fit;
3. positions are low-passed at f_q = min(8 f_w, 0.4 f_s): whatever it smears at a reversal is over long before f_w is;
4. decimation to 2.5 f_w, just above what the filter passes;
5. an axis' sign is unsure where its speed is below ten times its own velocity noise (encoder noise through filter and
   differentiation) or reverses; samples within two periods of f_q, the first filter's memory, are gated out there. After one
   period its ringing is still 4 % of the step in friction, which biased Coulomb friction by two standard errors in 100 s of L1
   at 1 kHz (`experiments/recovery.py`).

How the answer moves with each factor on EMPS and TX40 stands in `experiments/preparation_sensitivity.py`: little with the
first four; with the gate's width, TX40's Coulomb friction by up to 4 %, as its friction is not quite the law at low speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.log import Log, compute_noise_gain, estimate_encoder_noise, find_motion_band
from tau_dyn.robot import Robot

BAND_FACTOR = 5.0  # low-pass of forces over the motion's band edge
POSITION_FACTOR = 8.0  # low-pass of positions over that of forces
RATE_FACTOR = 2.5  # rate kept after decimation over the low-pass; 2 is the sampling theorem
NOISE_FACTOR = 10.0  # speed in standard deviations of its noise, from which its sign is known
MIN_RATE_HZ = 5.0
"""A log sampled more slowly shows no dynamics; mostly its clock is not in seconds."""

ROUNDING = 1e-6
"""Samples; a clock's rounding must not turn five samples into six."""

MIN_SEGMENT_SAMPLES = 10
"""Samples of the shortest stretch; fewer have neither a noise nor a band."""

MEMORY = 2.0
"""Half-width of what the first filter makes of a step, in periods of its cutoff; 0.3 % of the step is left after it."""


@dataclass(frozen=True, eq=False)
class Preparation:
    """Filters and masks between a log and its regression.

    Attributes:
        position_cutoff_hz: Zero-phase low-pass on positions before differentiation [Hz].
        force_cutoff_hz: The one low-pass on forces and on every column [Hz].
        rate_hz: Rate after decimation, at least [Hz].
        speed_threshold: Slowest speed of each joint with a sure sign (na,) [m/s or rad/s].
        window_s: Time gated out on both sides of slow, reversing or excluded samples [s].
        exclude: Columns whose nonzero samples are left out.
    """

    position_cutoff_hz: float
    force_cutoff_hz: float
    rate_hz: float
    speed_threshold: np.ndarray
    window_s: float
    exclude: tuple[str, ...] = ()

    def factor(self, rate_hz: float) -> int:
        """Return the whole number by which a log of this rate is decimated."""
        return max(1, int(rate_hz / self.rate_hz + ROUNDING))

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        out = asdict(self)
        return out | {"speed_threshold": self.speed_threshold.tolist(), "exclude": list(self.exclude)}


def choose_preparation(
    robot: Robot,
    logs: Sequence[Log],
    exclude: tuple[str, ...] = (),
) -> Preparation:
    """Choose filters and masks for logs that will be fitted together.

    Args:
        robot: Gives the actuated joints.
        logs: Even stretches.
        exclude: Columns whose nonzero samples are left out.

    Raises:
        CannotAnswer: No joint moves above its encoder's noise.
    """
    short = min(logs, key=lambda log: log.n_samples)
    if short.n_samples < MIN_SEGMENT_SAMPLES:
        raise InputError(
            "too_little_data",
            f"{short.name} has {short.n_samples} samples in a row; {MIN_SEGMENT_SAMPLES} are needed to say anything",
        )
    rate = min(log.rate_hz for log in logs)
    if rate < MIN_RATE_HZ:
        raise InputError(
            "wrong_unit", f"{logs[0].name} is sampled at {rate:.3g} Hz; t must be in s (does it stand in ms or us?)"
        )
    bands = [find_motion_band(log.joint("q", robot.actuated), log.rate_hz) for log in logs]
    edge = max(float(band.edge_hz.max()) for band in bands)
    if edge <= 0:
        raise CannotAnswer(
            "poor_excitation",
            f"no joint moves above its encoder's noise in {', '.join(log.name for log in logs)}",
            f"move {', '.join(robot.actuated)} in both directions, over several speeds, for a minute or more",
        )
    moving = [band.noise_edge_hz[band.edge_hz > 0] for band in bands]
    noise_edge = min((float(x.min()) for x in moving if x.size), default=rate)
    force_cutoff = max(min(BAND_FACTOR * edge, noise_edge, 0.16 * rate), edge)
    position_cutoff = min(POSITION_FACTOR * force_cutoff, 0.4 * rate)
    noise = [
        estimate_encoder_noise(log.joint("q", robot.actuated)) * compute_noise_gain(log.rate_hz, position_cutoff)
        for log in logs
    ]
    return Preparation(
        position_cutoff,
        force_cutoff,
        RATE_FACTOR * force_cutoff,
        NOISE_FACTOR * np.max(noise, axis=0),
        MEMORY / position_cutoff,
        exclude,
    )
