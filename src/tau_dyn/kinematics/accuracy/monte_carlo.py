"""Errors drawn at random within their bounds, and the constraints solved for each draw."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.kinematics.accuracy.rod_device import State
from tau_dyn.kinematics.accuracy.worst_case import Device

BLOCK = 20_000
"""Poses solved at once."""


class Draws(NamedTuple):
    """What random errors do at each pose, in metres; `turn_` in radians.

    Attributes:
        largest: Largest displacement drawn (N,).
        usual: The displacement that 95 % of the draws stay below (N,).
        mean: (N,).
        turn_largest: Largest change of orientation drawn (N,) [rad].
        lost: Share of the draws for which the robot has no pose on its branch (N,).
    """

    largest: np.ndarray
    usual: np.ndarray
    mean: np.ndarray
    turn_largest: np.ndarray
    lost: np.ndarray


def draw(balls: tuple[slice, ...], m: int, shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Return errors (*shape, m), each source uniform in its unit ball."""
    e = np.empty((*shape, m))
    for ball in balls:
        size = ball.stop - ball.start
        normal = rng.standard_normal((*shape, size))
        radius = rng.random((*shape, 1)) ** (1 / size)
        e[..., ball] = radius * normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    return e


def monte_carlo(device: Device, state: State, samples: int, seed: int) -> Draws:
    """Return statistics of `samples` draws at every pose, the same draws at all of them.

    The same draws everywhere make a map smooth and cheap; poses are then compared on equal terms.
    """
    e = draw(device.balls, device.m, (samples,), np.random.default_rng(seed))
    rows = [_some(device, state.take(slice(i, i + step)), e)
            for step in [max(1, BLOCK // samples)] for i in range(0, len(state), step)]  # fmt: skip
    return Draws(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def _some(device: Device, state: State, e: np.ndarray) -> Draws:
    n, k = len(state), len(e)
    moved = device.closed(state.take(np.repeat(np.arange(n), k)), np.tile(e, (n, 1)))
    size, turn = (np.linalg.norm(x, axis=1).reshape(n, k) for x in (moved.shift, moved.turn))
    lost = np.mean(~moved.ok.reshape(n, k), axis=1)
    whole = lost == 0
    size, turn = np.where(whole[:, None], size, np.nan), np.where(whole[:, None], turn, np.nan)
    return Draws(size.max(axis=1), np.quantile(size, 0.95, axis=1), size.mean(axis=1), turn.max(axis=1), lost)
