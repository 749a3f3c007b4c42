"""Which samples of a log may be used: joints with a sure direction, forces that are neither at their limit nor flagged.

A gate is 1 where a sample may be used and 0 where not, with ramps between, two periods of the position filter's cutoff long: a
sharp edge would fold the acceleration's noise, large above the band of the filter that follows, into it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import convolve1d, minimum_filter1d

from tau_dyn.effects import Effect, Motion
from tau_dyn.estimate import ROUNDING, Preparation
from tau_dyn.exceptions import InputError
from tau_dyn.log import ROOM_TEMPERATURE, Log, check_jumps, find_reversals
from tau_dyn.model import COMPUTED, Model
from tau_dyn.robot import Robot


def get_measured_signals(
    log: Log, joints: tuple[str, ...], q: np.ndarray, v: np.ndarray, threshold: np.ndarray
) -> dict[str, np.ndarray]:
    """Return what a log says beyond positions and forces: temperatures, and travel since each joint's last reversal."""
    found = {"reversal": np.column_stack([compute_travel(q[:, k], v[:, k], threshold[k]) for k in range(q.shape[1])])}
    warmth = log.temperatures(joints)
    return found if warmth is None else {**found, "temperature": warmth}


def compute_travel(q: np.ndarray, v: np.ndarray, threshold: float) -> np.ndarray:
    """Return the distance (N,) since a joint last reversed, from the turning point of each stretch of one direction.

    Stretches are told apart where the speed is sure, above the threshold; where they turned lies a little before. The first one
    counts from there too, or from the first sample.
    """
    sure = np.flatnonzero(np.abs(v) > threshold)
    starts = np.concatenate([[0], find_reversals(v, threshold), [len(q)]])
    out, before = np.zeros(len(q)), 0
    for start, stop in zip(starts[:-1], starts[1:], strict=True):
        at = start if start or not sure.size else sure[0]
        heading = np.sign(v[at]) or 1.0
        turn = np.min(heading * q[before : at + 1])
        out[start:stop] = np.maximum(0.0, heading * q[start:stop] - turn)
        before = start
    return out


def refuse_missing_temperature(model: Model, log: Log, measured: Mapping[str, np.ndarray]) -> None:
    """Refuse a log without the temperatures that an effect of the model follows."""
    feeling = [effect.name for effect in model.effects if "temperature" in effect.needs]
    if not feeling:
        return
    columns = f"{ROOM_TEMPERATURE} or {', '.join(f'temp_{j}' for j in model.robot.actuated)}"
    if "temperature" not in measured:
        raise InputError(
            "missing_column", f"{log.name} has no column {columns}, which effect {feeling[0]} of the model needs"
        )
    if not np.all(np.isfinite(measured["temperature"])):
        raise InputError(
            "bad_sample", f"{log.name}: a sample of {columns}, which effect {feeling[0]} needs, is no finite number"
        )


def refuse_missing_campaign(model: Model, names: Sequence[str]) -> None:
    """Refuse fewer logs than an effect tells apart."""
    for effect in model.effects:
        number = int(effect.settings.get("number", 0))
        if "campaign" in effect.needs and number >= len(names):
            raise InputError(
                "unsupported",
                f"effect {effect.name} sets log {number + 1} apart from others, and there is only {len(names)}: give the logs "
                "in the order in which it was found, or fit the model without it",
            )


SATURATION_RATIO = 0.999
"""Share of a drive's limit from which a force counts as saturated."""


def compute_gate(log: Log, motion: Motion, model: Model, preparation: Preparation, rate: float) -> np.ndarray:
    """Return 1 where each joint's sample may be used and 0 where not (N, na), at the log's own rate."""
    threshold = preparation.speed_threshold
    shut = find_unsure_samples(motion.v, threshold)
    for effect in model.effects:
        if type(effect).other_speeds is Effect.other_speeds:
            continue
        computed = [name for name in effect.needs if name in COMPUTED]
        felt = {name: COMPUTED[name](model.mechanism, motion.q, motion.v, motion.a) for name in computed}
        for speed, indices in effect.other_speeds(replace(motion, signals={**motion.signals, **felt})):
            shut[:, indices] |= find_unsure_samples(speed, float(np.hypot.reduce(threshold[indices])))[:, None]
    shut |= find_excluded_samples(log, model.robot.actuated, model.robot.effort_limit, preparation.exclude)
    half = int(np.ceil(preparation.window_s * rate - ROUNDING))
    gate = 1.0 - widen(shut, half)
    ramp = np.hanning(2 * int(np.ceil(rate / preparation.position_cutoff_hz - ROUNDING)) + 3)
    return convolve1d(gate, ramp / ramp.sum(), axis=0, mode="nearest")


def widen(shut: np.ndarray, half: int) -> np.ndarray:
    """Return where a sample (N, na) or one at most `half` away is shut."""
    n = len(shut)
    count = np.concatenate([np.zeros((1, shut.shape[1]), int), np.cumsum(shut, axis=0)])
    i = np.arange(n)
    return count[np.minimum(i + half + 1, n)] > count[np.maximum(i - half, 0)]


def hold_closed(gate: np.ndarray, n: int) -> np.ndarray:
    """Return the least of a gate (N,) over each sample and the n before it; the -n after it for n < 0."""
    origin = n // 2 if n > 0 else -((1 - n) // 2)
    return gate if n == 0 else minimum_filter1d(gate, abs(n) + 1, mode="nearest", origin=origin)


def find_unsure_samples(speed: np.ndarray, threshold: float | np.ndarray) -> np.ndarray:
    """Return where speeds (N,) or (N, na) have no sure sign: too slow, or just reversed."""
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
