"""What happens to logs on their way from a drive to a file: each corruption with the warnings that are true of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from spoiled_logs_parts.machines import GRAVITY, Made, as_log, make_log
from tau_dyn.log import Log


class Corruption(NamedTuple):
    """A corruption: its name, which codes are true of it, and how it is done, given also the machine's name and the seed."""

    name: str
    codes: tuple[str, ...]
    make: Callable[[Made, np.random.Generator, str, int], Log | None]


TIMING = ("force_late", "force_lowpassed")
"""A short delay and a lag are the same to a slow motion; either is true."""


def _log(made: Made, q: np.ndarray, tau: np.ndarray, t: np.ndarray | None = None) -> Log:
    n = len(q)
    return as_log(made.robot, made.log.t[:n] if t is None else t, q, tau, made.log.name)


def _rows(made: Made, rows: np.ndarray) -> Log:
    """Take rows under a counted clock."""
    rows = rows[: len(made.position)]
    return _log(made, made.position[rows], made.force[rows])


def lose(share: float):
    def make(made: Made, rng: np.random.Generator, *_) -> Log:
        return _rows(made, np.flatnonzero(rng.random(len(made.position)) > share))

    return make


def insert(share: float):
    def make(made: Made, rng: np.random.Generator, *_) -> Log:
        n = len(made.position)
        return _rows(made, np.sort(np.concatenate([np.arange(n), np.flatnonzero(rng.random(n) < share)])))

    return make


def repeat(share: float):
    def make(made: Made, rng: np.random.Generator, *_) -> Log:
        rows = np.arange(len(made.position))
        rows[1:] -= rng.random(len(rows) - 1) < share
        return _rows(made, rows)

    return make


def zero(share: float):
    def make(made: Made, rng: np.random.Generator, *_) -> Log:
        return _log(made, made.position, np.where(rng.random(made.force.shape) < share, 0.0, made.force))

    return make


def hold(every: int, share: float = 1.0):
    """Renew forces only every so many samples, in a share of the time."""

    def make(made: Made, rng: np.random.Generator, *_) -> Log:
        rows = np.arange(len(made.force)) // every * every
        if share < 1:
            chosen = np.repeat(rng.random(-(-len(rows) // every)) < share, every)[: len(rows)]
            rows = np.where(chosen, rows, np.arange(len(rows)))
        return _log(made, made.position, made.force[rows])

    return make


def freeze(made: Made, rng: np.random.Generator, *_) -> Log:
    tau = made.force.copy()
    k, start = rng.integers(tau.shape[1]), len(tau) // 3
    tau[start : start + 500, k] = tau[start, k]
    return _log(made, made.position, tau)


def delay(seconds: float, one: bool = False):
    def make(made: Made, rng: np.random.Generator, *_) -> Log:
        t, tau = made.log.t, made.force.copy()
        for k in [int(rng.integers(tau.shape[1]))] if one else range(tau.shape[1]):
            tau[:, k] = np.interp(t - seconds, t, made.force[:, k])
        return _log(made, made.position, tau)

    return make


def lag(seconds: float, one: bool = False):
    def make(made: Made, rng: np.random.Generator, *_) -> Log:
        pole, tau = np.exp(-made.log.dt / seconds), made.force.copy()
        for k in [int(rng.integers(tau.shape[1]))] if one else range(tau.shape[1]):
            x = made.force[:, k]
            tau[:, k] = lfilter([1 - pole], [1, -pole], x, zi=[pole * x[0]])[0]
        return _log(made, made.position, tau)

    return make


def sign(*signals: str, which: int | None = None):
    def make(made: Made, rng: np.random.Generator, *_) -> Log:
        k = rng.integers(made.robot.na) if which is None else which % made.robot.na
        q, tau = made.position.copy(), made.force.copy()
        if "q" in signals:
            q[:, k] *= -1
        if "tau" in signals:
            tau[:, k] *= -1
        return _log(made, q, tau)

    return make


def all_forces_reversed(made: Made, *_) -> Log:
    return _log(made, made.position, -made.force)


def exchange(*signals: str):
    def make(made: Made, rng: np.random.Generator, *_) -> Log | None:
        if made.robot.na < 2:
            return None
        i, j = rng.choice(made.robot.na, 2, replace=False)
        q, tau = made.position.copy(), made.force.copy()
        for signal, x in (("q", q), ("tau", tau)):
            if signal in signals:
                x[:, [i, j]] = x[:, [j, i]]
        return _log(made, q, tau)

    return make


def scale(signal: str, factor: float, one: bool = True):
    def make(made: Made, rng: np.random.Generator, *_) -> Log:
        q, tau = made.position.copy(), made.force.copy()
        x = q if signal == "q" else tau
        chosen = [int(rng.integers(made.robot.na))] if one else range(made.robot.na)
        x[:, chosen] *= factor
        return _log(made, q, tau)

    return make


def mount(*direction: float):
    def make(made: Made, rng: np.random.Generator, name: str, seed: int) -> Log:
        unit = np.array(direction) / np.linalg.norm(direction)
        return make_log(name, seed, gravity=np.linalg.norm(GRAVITY) * unit).log

    return make


def quantise(made: Made, *_) -> Log:
    step = np.sqrt(np.mean(made.force**2, axis=0)) / 50
    return _log(made, np.round(made.position / 2e-5) * 2e-5, np.round(made.force / step) * step)


def drift(made: Made, *_) -> Log:
    ramp = np.linspace(0, 1, len(made.force))[:, None]
    return _log(made, made.position, made.force + 0.2 * np.sqrt(np.mean(made.force**2, axis=0)) * ramp)


def clip(made: Made, *_) -> Log:
    return _log(made, made.position, np.clip(made.force, *np.quantile(made.force, [0.06, 0.94], axis=0)))


def jitter(made: Made, rng: np.random.Generator, *_) -> Log:
    t = made.log.t + 0.2 * made.log.dt * rng.uniform(-1, 1, made.log.n_samples)
    return _log(made, made.position, made.force, t)


def clock(factor: float):
    def make(made: Made, *_) -> Log:
        return _log(made, made.position, made.force, made.log.t * factor)

    return make


def spikes(made: Made, rng: np.random.Generator, *_) -> Log:
    size = 5 * np.sqrt(np.mean(made.force**2, axis=0))
    hit = rng.random(made.force.shape) < 0.002
    return _log(made, made.position, made.force + hit * size * rng.normal(size=made.force.shape))


LOST, REPEATED, ZERO, HELD = (("lost_samples",), ("repeated_samples",), ("zero_force_runs",), ("held_channel",))
SIGN, SWAP, SCALE, MOUNT = (("sign_reversed",), ("joints_exchanged",), ("scale_wrong",), ("gravity_direction",))
WIRING = (*SIGN, *SWAP, *SCALE)
"""Wrong columns have several descriptions; where two fit alike, either is true."""
ANY = ("*",)
"""Any warning that names the trouble is true; these have older sentences without a code of their own."""

CORRUPTIONS = (
    *(Corruption(f"lose_{100 * x:g}%", LOST, lose(x)) for x in (0.001, 0.003, 0.01, 0.02, 0.05, 0.1)),
    *(Corruption(f"insert_{100 * x:g}%", REPEATED, insert(x)) for x in (0.003, 0.02)),
    *(Corruption(f"repeat_{100 * x:g}%", REPEATED, repeat(x)) for x in (0.003, 0.02, 0.1)),
    *(Corruption(f"zero_{100 * x:g}%", ZERO, zero(x)) for x in (0.002, 0.01, 0.05, 0.1)),
    Corruption("held_2", HELD, hold(2)),
    Corruption("held_5", HELD, hold(5)),
    Corruption("held_10_in_5%", HELD, hold(10, 0.05)),
    Corruption("frozen_2s", HELD, freeze),
    *(Corruption(f"late_{1e3 * x:g}ms", TIMING, delay(x)) for x in (-0.01, 0.001, 0.004, 0.01, 0.02, 0.06)),
    Corruption("late_20ms_one", TIMING, delay(0.02, True)),
    *(Corruption(f"lag_{1e3 * x:g}ms", TIMING, lag(x)) for x in (0.005, 0.02, 0.05)),
    Corruption("lag_20ms_one", TIMING, lag(0.02, True)),
    Corruption("sign_q", WIRING, sign("q")),
    Corruption("sign_tau", WIRING, sign("tau")),
    Corruption("sign_both", WIRING, sign("q", "tau")),
    Corruption("sign_both_first", WIRING, sign("q", "tau", which=0)),
    Corruption("sign_tau_last", WIRING, sign("tau", which=-1)),
    Corruption("sign_all_tau", WIRING, all_forces_reversed),
    Corruption("swap_q", WIRING, exchange("q")),
    Corruption("swap_tau", WIRING, exchange("tau")),
    Corruption("swap_both", WIRING, exchange("q", "tau")),
    *(Corruption(f"tau_x{x:g}", SCALE, scale("tau", x)) for x in (0.01, 0.5, 2.0, 57.3, 100.0)),
    Corruption("all_tau_x100", SCALE, scale("tau", 100.0, False)),
    Corruption("all_tau_x0.01", SCALE, scale("tau", 0.01, False)),
    Corruption("q_degrees", SCALE, scale("q", 57.29578)),
    Corruption("q_x1000", SCALE, scale("q", 1000.0)),
    Corruption("q_x0.01", SCALE, scale("q", 0.01)),
    Corruption("all_q_degrees", SCALE, scale("q", 57.29578, False)),
    Corruption("wall", MOUNT, mount(1, 0, 0)),
    Corruption("ceiling", MOUNT, mount(0, 0, 1)),
    Corruption("slope", MOUNT, mount(0, -1, -1)),
    Corruption("quantised", (), quantise),
    Corruption("drift", (), drift),
    Corruption("clipped", ANY, clip),
    Corruption("jitter", ANY, jitter),
    Corruption("clock_in_ms", ANY, clock(1000.0)),
    Corruption("clock_x2", SCALE, clock(2.0)),
    Corruption("spikes", (), spikes),
)
