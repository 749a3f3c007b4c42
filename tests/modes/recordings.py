"""Vibration tests whose truth is known: a structure of separate modes under held inputs, with noise on the outputs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from tau_dyn.log import Log
from tau_dyn.modes import Record, StateSpace

HZ, DAMPING, DT = (7.4, 11.5), (0.02, 0.015), 0.01


def structure(
    hz: Sequence[float] = HZ, damping: Sequence[float] = DAMPING, dt: float = DT, *, accelerometers: bool = False
) -> StateSpace:
    """Return a structure of unit modal masses, its shapes a fixed rotation, from forces to displacements in mm."""
    n = len(hz)
    shapes = np.linalg.qr(np.random.default_rng(5).normal(size=(n, n)))[0]
    w, zeta = 2 * np.pi * np.array(hz), np.array(damping)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(w**2), -np.diag(2 * zeta * w)]])
    B = np.vstack([np.zeros((n, n)), shapes.T])
    C, D = 1e3 * np.hstack([shapes, np.zeros((n, n))]), np.zeros((n, n))
    if accelerometers:
        C, D = shapes @ A[n:], shapes @ shapes.T
    held = expm(np.block([[A, B], [np.zeros((n, 3 * n))]]) * dt)
    return StateSpace(held[: 2 * n, : 2 * n], held[: 2 * n, 2 * n :], C, D, np.zeros((2 * n, n)), dt)


def response(plant: StateSpace, u: np.ndarray, delay: int = 0) -> np.ndarray:
    """Return outputs (N, p) from rest, one filter a pole: not the library's way."""
    values, vectors = np.linalg.eig(plant.A)
    b, c = np.linalg.solve(vectors, plant.B.astype(complex)), plant.C @ vectors
    late = np.vstack([np.zeros((delay, u.shape[1])), u[: len(u) - delay]])
    y = late @ plant.D.T
    for pole, row, column in zip(values, b, c.T, strict=True):
        y = y + np.real(np.outer(lfilter([0, 1], [1, -pole], late @ row), column))
    return y


def binary(n: int, m: int, rng: np.random.Generator, hold: int = 2) -> np.ndarray:
    """Return random binary inputs (n, m), each value held for so many samples."""
    return np.repeat(rng.choice([-1.0, 1.0], (n // hold + 1, m)), hold, axis=0)[:n]


def recorded(
    plant: StateSpace, n: int = 2500, decibels: float = 40.0, delay: int = 0, seed: int = 0, u: np.ndarray | None = None
) -> Record:
    """Return a record with white noise so many decibels below the outputs."""
    rng = np.random.default_rng(seed)
    u = binary(n, plant.B.shape[1], rng) if u is None else u
    y = response(plant, u, delay)
    y = y + rng.normal(size=y.shape) * y.std(axis=0) * 10 ** (-decibels / 20)
    names = tuple(f"force{k + 1}" for k in range(u.shape[1])), tuple(f"place{k + 1}" for k in range(y.shape[1]))
    return Record(u, y, plant.dt, *names, "bench.csv")


def pulses(plant: StateSpace, n: int, count: int, decibels: float = 40.0) -> Record:
    """Return hammer blows on each input in turn, each followed by so many samples of decay."""
    u = np.zeros((n * count, plant.B.shape[1]))
    for k in range(count):
        u[k * n + 20 : k * n + 24, k % u.shape[1]] = np.array([50.0, 100.0, 100.0, 40.0])
    return recorded(plant, decibels=decibels, u=u)


def in_loop(plant: StateSpace, n: int, *, gain: float, disturbance: float, seed: int = 0) -> tuple[Record, np.ndarray]:
    """Return a record of a loop with damping feedback under a coloured disturbance, and the loop's reference."""
    rng, p = np.random.default_rng(seed), len(plant.C)
    r = binary(n, p, rng, 4)
    v = lfilter([1], [1, -0.95], rng.normal(size=(n, p)), axis=0)
    open_loop = response(plant, r).std()
    v *= disturbance * open_loop / v.std()
    x, before, u, y = np.zeros(plant.order), np.zeros(p), np.zeros((n, p)), np.zeros((n, p))
    for t in range(n):
        y[t] = plant.C @ x + v[t]
        u[t] = r[t] - gain / open_loop * (0.3 * y[t] + (y[t] - before))
        before, x = y[t], plant.A @ x + plant.B @ u[t]
    names = tuple(f"force{k + 1}" for k in range(p)), tuple(f"place{k + 1}" for k in range(p))
    return Record(u, y, plant.dt, *names, "loop.csv"), r


def log_of(record: Record, offset: float = 0.0) -> Log:
    """Return a record as a log; the outputs rest at `offset`."""
    channels = dict(zip(record.inputs, record.u.T, strict=True))
    channels |= dict(zip(record.outputs, record.y.T + offset, strict=True))
    return Log(np.arange(record.n_samples) * record.dt, channels, record.name)
