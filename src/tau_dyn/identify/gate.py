"""Which samples of a log may be used: joints with a sure direction, forces that are neither at their limit nor flagged.

A gate is 1 where a sample may be used and 0 where not, with ramps between, two periods of the position filter's cutoff long: a
sharp edge would fold the acceleration's noise, large above the band of the filter that follows, into it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import convolve1d, minimum_filter1d

from tau_dyn.effects import Effect, Motion
from tau_dyn.exceptions import InputError
from tau_dyn.identify.preparation import ROUNDING, Preparation
from tau_dyn.log import Log, check_jumps
from tau_dyn.model import COMPUTED, Model
from tau_dyn.robot import Robot

SATURATION_RATIO = 0.999
"""Share of a drive's limit from which a force counts as saturated."""


def compute_gate(log: Log, motion: Motion, model: Model, preparation: Preparation, rate: float) -> np.ndarray:
    """Return 1 where each joint's sample may be used and 0 where not (N, na), at the log's own rate."""
    threshold = preparation.speed_threshold
    shut = np.column_stack([_unsure(motion.v[:, k], threshold[k]) for k in range(len(threshold))])
    for effect in model.effects:
        if type(effect).other_speeds is Effect.other_speeds:
            continue
        computed = [name for name in effect.needs if name in COMPUTED]
        felt = {name: COMPUTED[name](model.mechanism, motion.q, motion.v, motion.a) for name in computed}
        for speed, indices in effect.other_speeds(replace(motion, signals={**motion.signals, **felt})):
            shut[:, indices] |= _unsure(speed, float(np.hypot.reduce(threshold[indices])))[:, None]
    shut |= find_excluded_samples(log, model.robot.actuated, model.robot.effort_limit, preparation.exclude)
    half = int(np.ceil(preparation.window_s * rate - ROUNDING))
    gate = 1.0 - _widened(shut, half)
    ramp = np.hanning(2 * int(np.ceil(rate / preparation.position_cutoff_hz - ROUNDING)) + 3)
    return convolve1d(gate, ramp / ramp.sum(), axis=0, mode="nearest")


def _widened(shut: np.ndarray, half: int) -> np.ndarray:
    """Return where a sample (N, na) or one at most `half` away is shut."""
    n = len(shut)
    count = np.concatenate([np.zeros((1, shut.shape[1]), int), np.cumsum(shut, axis=0)])
    i = np.arange(n)
    return count[np.minimum(i + half + 1, n)] > count[np.maximum(i - half, 0)]


def hold_closed(gate: np.ndarray, n: int) -> np.ndarray:
    """Return the least of a gate (N,) over each sample and the n before it; the -n after it for n < 0."""
    origin = n // 2 if n > 0 else -((1 - n) // 2)
    return gate if n == 0 else minimum_filter1d(gate, abs(n) + 1, mode="nearest", origin=origin)


def _unsure(speed: np.ndarray, threshold: float) -> np.ndarray:
    """Return where a speed (N,) has no sure sign: too slow, or just reversed."""
    unsure = np.abs(speed) <= threshold  # a joint at rest has no sign, even without noise
    unsure[1:] |= np.sign(speed[1:]) != np.sign(speed[:-1])
    return unsure


def find_excluded_samples(
    log: Log, joints: tuple[str, ...], effort_limit: np.ndarray, columns: tuple[str, ...]
) -> np.ndarray:
    """Return saturated samples and those a column flags with anything but zero (N, na)."""
    bad = np.abs(log.joint("tau", joints)) >= SATURATION_RATIO * effort_limit
    for column in columns:
        if column not in log.channels:
            raise InputError("missing_column", f"{log.name} has no column {column} to exclude samples by")
        bad |= (log.channels[column] != 0)[:, None]
    return bad


def refuse_jumps(log: Log, robot: Robot, columns: tuple[str, ...]) -> None:
    """Refuse positions that no joint can follow, as filters would make motion of them; samples that a column flags may jump.

    Raises:
        InputError: A joint's position jumps.
    """
    left_out = np.zeros(log.n_samples, bool)
    for column in columns:
        left_out |= log.channels.get(column, left_out) != 0
    for joint, kind, fastest in zip(robot.actuated, robot.joint_kinds, robot.velocity_limit, strict=True):
        found = check_jumps(log, joint, revolute=kind != "prismatic", fastest=float(fastest), left_out=left_out)
        if found is not None:
            raise InputError("bad_sample", f"{found.sentence} {found.remedy}")
