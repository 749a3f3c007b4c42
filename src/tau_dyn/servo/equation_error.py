"""Equation error, a screen and a start: the torque that the law makes of command and position against the robot's own.

Where the servo saturates or its law is incomplete it is biased, so that output error follows (`fit.py`).
Reference: Ljung 1999, 7.2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.log import lowpass
from tau_dyn.servo.records import MOTION_HZ, InertialSpace, LoopRecord
from tau_dyn.servo.unknowns import JOINT_UNITS, compute_stiffness
from tau_dyn.simulate import ServoLaw

DELAYS_S = np.arange(0.0, 0.0601, 0.0025)
"""Command delays that the screen tries [s]: none to three periods of a 50 Hz bus."""

MOVING = 0.03
"""Speed from which a joint's friction has a direction [rad/s]: twice what a step of a 12 bit encoder makes at 20 ms."""

MAX_DIRECTIONS = 40
"""Directions of the inertial numbers that are estimated at most; an arm of six joints has some 36."""

MIN_INFORMATION = 1e-5
"""Information of a direction, with prior knowledge as 1, from which it is estimated. It is small: what a log hardly
shows may stand for something else, as gravity at a joint that barely turns for a constant torque."""

INFORMATION_S = 0.02
"""Time between the samples that directions are chosen by [s]: a fourth of a period of the motion's low-pass."""


@dataclass(frozen=True, eq=False)
class EquationError:
    """The screen: what the rebuilt torque says.

    Attributes:
        values: Start values of kinds (na,).
        residual: Torque that remains, record by record (N, na) [N m]; NaN where a joint rests.
        sigma: Its rms (na,) [N m].
    """

    values: Mapping[str, np.ndarray]
    residual: Sequence[np.ndarray]
    sigma: np.ndarray


def delay_command(command: np.ndarray, dt: float, delay: float) -> np.ndarray:
    """Return held commands (N, na) as a delay [s] later shows them at the samples, averaged over the sample before."""
    n = len(command)
    total = np.concatenate([np.zeros((1, command.shape[1])), np.cumsum(command, axis=0)])
    at = np.clip(np.arange(n + 1) - 0.5 - delay / dt, 0, n)
    summed = np.stack([np.interp(at, np.arange(n + 1), column) for column in total.T], axis=1)
    shown = np.diff(summed, axis=0)
    early = np.diff(at) < 1
    shown[early] = command[0]
    return shown


def screen_equation_error(
    law: ServoLaw, space: InertialSpace, records: Sequence[LoopRecord], estimate_gain: bool
) -> EquationError:
    """Return the best delay, friction and drive inertia of each joint by the rebuilt torque, bodies as the file has them."""
    na = len(law.joints)
    values = {key: np.array(law.values[key]) for key in ("position_gain", "command_delay")}
    values |= {key: np.zeros(na) for key in JOINT_UNITS}
    residual, sigma = [np.full(r.q.shape, np.nan) for r in records], np.zeros(na)
    mechanism = space.build_mechanism()
    moved = [mechanism.inverse_dynamics(*r.motion) for r in records]
    for j in range(na):
        best = None
        for delay in [float(law.values["command_delay"][j])] if law.values["command_delay"][j] > 0 else DELAYS_S:
            rows = [
                _build_rows(law, r, tau[:, j], j, float(delay), estimate_gain)
                for r, tau in zip(records, moved, strict=True)
            ]
            y, X = np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
            if len(y) < 10 * X.shape[1]:
                continue
            norm = np.linalg.norm(X, axis=0) + 1e-12
            beta = np.linalg.lstsq(X / norm, y, rcond=None)[0] / norm
            rms = float(np.std(y - X @ beta))
            if best is None or rms < best[0]:
                best = (rms, delay, beta, rows)
        stiff = float(compute_stiffness(law.values)[j])
        if best is None:
            values["coulomb"][j] = 0.01 * stiff
            sigma[j] = 0.01 * stiff
            continue
        rms, delay, beta, rows = best
        values["command_delay"][j] = delay
        scale = 1.0
        if estimate_gain:  # the rows are of positions: 1 / gain times torque
            share = beta[4] if beta[4] > 0 else np.nan
            scale = 1.0 / share
            values["position_gain"][j] = scale / law.values["force_per_unit"][j]
        values["coulomb"][j], values["viscous"][j] = (max(0.0, scale * b) for b in beta[:2])
        values["offset"][j], values["armature"][j] = scale * beta[2], max(1e-4, scale * beta[3])
        sigma[j] = rms * (scale if np.isfinite(scale) else 1.0)
        for k, (y, X, where) in enumerate(rows):
            residual[k][where, j] = (y - X @ beta) * (scale if np.isfinite(scale) else 1.0)
    if estimate_gain:
        values = _fill_gains(values, law)
    return EquationError(values, residual, np.where(np.isfinite(sigma) & (sigma > 0), sigma, 1.0))


def _fill_gains(values: dict[str, np.ndarray], law: ServoLaw) -> dict[str, np.ndarray]:
    """Return the values with gains that no gravity showed taken from the other joints, and friction with them."""
    gain = values["position_gain"]
    known = np.isfinite(gain) & (gain > 0.05) & (gain < 1e4)
    usual = float(np.median(gain[known])) if known.any() else 5.0
    for j in np.flatnonzero(~known | (gain > 5 * usual) | (gain < usual / 5)):
        gain[j] = usual
        stiff = usual * law.values["force_per_unit"][j]
        values["coulomb"][j], values["viscous"][j] = 0.01 * stiff, 0.07 * stiff
        values["offset"][j], values["armature"][j] = 0.0, 1e-3 * stiff
    return values


def _build_rows(
    law: ServoLaw, r: LoopRecord, moved: np.ndarray, j: int, delay: float, estimate_gain: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return torque, columns (sign, speed, one, acceleration) and mask of one joint where it moves and its motor is on."""
    rate, (q, v, a) = 1 / r.dt, r.motion
    goal = delay_command(r.command[:, j : j + 1], r.dt, delay)[:, 0]
    goal = lowpass(goal, MOTION_HZ, rate) if rate > 2.5 * MOTION_HZ else goal
    error = goal - q[:, j]
    where = r.used & (np.abs(v[:, j]) > MOVING) & (r.enabled > 0)
    edge = round(0.3 * rate)
    where[:edge], where[-edge:] = False, False
    columns = [np.sign(v[:, j]), v[:, j], np.ones(len(v)), a[:, j]]
    if estimate_gain:
        return error[where], np.stack([*columns, moved], axis=1)[where], where
    entries = r.entries
    u = _rebuild_output(r, j, goal, error)
    tau = entries["force_per_unit"][j] * (u * r.supply - entries["back_emf"][j] * v[:, j])
    return (tau - moved)[where], np.stack(columns, axis=1)[where], where


def _rebuild_output(r: LoopRecord, j: int, goal: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the law's output (N,) along the measured motion."""
    p, v = {key: x[j] for key, x in r.entries.items()}, r.motion[1][:, j]
    u, gain = goal, p["integral_gain"]
    if r.told == "position":
        goal, u = error, p["position_gain"] * error - p["derivative_gain"] * v
    if r.told in ("position", "speed"):
        if p["speed_gain"] > 0:
            goal, gain = np.clip(u, -p["speed_limit"], p["speed_limit"]) - v, p["speed_integral_gain"]
            u = p["speed_gain"] * goal
        u = u + np.clip(gain * np.cumsum(goal) * r.dt, -p["limit"], p["limit"])
    return np.clip(u, -p["limit"], p["limit"])


def choose_directions(space: InertialSpace, records: Sequence[LoopRecord], screen: EquationError) -> InertialSpace:
    """Return the space with the directions of which the logs know more than the robot file."""
    p = len(space.nominal)
    information = np.zeros((p, p))
    for r in records:
        every = max(1, int(INFORMATION_S / r.dt + 1e-9))
        some = np.flatnonzero(r.used & (r.enabled > 0))[::every]
        if len(some) < 10:
            continue
        Y = space.model.mechanism.regressor(*(x[some] for x in r.motion)) * space.prior
        worth = max(1.0, 0.5 / r.dt) / every  # samples that one independent residual is worth, at half a second
        for j in range(r.q.shape[1]):
            X = np.ascontiguousarray(Y[:, j])
            information += X.T @ X / (screen.sigma[j] ** 2 * worth)
    values, vectors = np.linalg.eigh(information)
    order = np.argsort(values)[::-1][:MAX_DIRECTIONS]
    kept = [k for k in order if values[k] > MIN_INFORMATION]
    return replace(space, directions=space.prior[:, None] * vectors[:, kept])
