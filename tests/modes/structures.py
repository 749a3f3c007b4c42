"""Structures whose M, D, K are known, and models of them as a refinement would give: with the Cramer-Rao covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh

from tau_dyn.modes import StateSpace
from tau_dyn.modes.mechanical import SecondOrder

DT = 0.004  # [s]


def chain(hz: Sequence[float], seed: int = 0, damping: tuple[float, float] = (0.01, 0.03)) -> SecondOrder:
    """Return a structure with given undamped frequencies, shapes of an uneven chain and damping that is not proportional."""
    rng, n = np.random.default_rng(seed), len(hz)
    springs = rng.uniform(0.5, 2.0, n + 1)
    stiffness = np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
    masses = np.diag(rng.uniform(5.0, 12.0, n))
    shapes = eigh(stiffness, masses)[1]
    inverse = np.linalg.inv(shapes)
    w = 2 * np.pi * np.sort(hz)
    mix = rng.normal(size=(n, n)) * 0.3
    modal = np.diag(2 * rng.uniform(*damping, n) * w)
    modal = modal + np.sqrt(np.outer(np.diag(modal), np.diag(modal))) * 0.2 * (mix + mix.T)
    value, vector = np.linalg.eigh(modal)
    modal = vector @ np.diag(np.maximum(value, 0.1 * value[-1] * 0.01)) @ vector.T
    return SecondOrder(inverse.T @ inverse, inverse.T @ modal @ inverse, inverse.T @ np.diag(w**2) @ inverse)


@dataclass(frozen=True, eq=False)
class Found:
    """What a refinement returns: a model, its parameters and their covariance."""

    model: StateSpace
    theta: np.ndarray
    covariance: np.ndarray
    shape: tuple[int, int, int]
    through: np.ndarray

    def model_at(self, theta: np.ndarray) -> StateSpace:
        """Return the model of other parameters."""
        return modal_model(theta, self.shape, self.model.dt, self.through)


def modal_model(theta: np.ndarray, shape: tuple[int, int, int], dt: float, through: np.ndarray) -> StateSpace:
    """Return a model from Re, Im of poles (k), output shapes (k, p) with the first entry 1, input shapes (k, m), direct part."""
    k, p, m = shape
    parts = np.split(theta, np.cumsum([k, k, k * (p - 1), k * (p - 1), k * m, k * m]))
    c = np.hstack([np.ones((k, 1)), (parts[2] + 1j * parts[3]).reshape(k, p - 1)])
    b = (parts[4] + 1j * parts[5]).reshape(k, m)
    A, first = np.zeros((2 * k, 2 * k)), 2 * np.arange(k)
    A[first, first] = A[first + 1, first + 1] = parts[0]
    A[first + 1, first], A[first, first + 1] = parts[1], -parts[1]
    B = np.stack([b.real, b.imag], axis=1).reshape(2 * k, m)
    C = np.stack([c.real, -c.imag], axis=1).reshape(2 * k, p).T
    D = through + parts[6].reshape(p, m) if parts[6].size else through
    return StateSpace(A, B, C, D, np.zeros((2 * k, p)), dt)


def modal_response(theta: np.ndarray, shape: tuple[int, int, int], w: np.ndarray) -> np.ndarray:
    """Return the same model's response (F, p, m) at points of the z plane, but for a fixed direct part."""
    k, p, m = shape
    parts = np.split(theta, np.cumsum([k, k, k * (p - 1), k * (p - 1), k * m, k * m]))
    z = parts[0] + 1j * parts[1]
    c = np.hstack([np.ones((k, 1)), (parts[2] + 1j * parts[3]).reshape(k, p - 1)])
    b = (parts[4] + 1j * parts[5]).reshape(k, m)
    residue = c[:, :, None] * b[:, None, :]
    term = np.einsum("fk,kpm->fpm", 1 / (w[:, None] - z), residue)
    mirror = np.einsum("fk,kpm->fpm", 1 / (w[:, None] - z.conj()), residue.conj())
    direct = parts[6].reshape(p, m) if parts[6].size else np.zeros((p, m))
    return 0.5 * (term + mirror) + direct


def modal_theta(model: StateSpace, direct: bool) -> tuple[np.ndarray, tuple[int, int, int]]:
    """Return the parameters that `modal_model` takes; `direct` adds the direct part."""
    z, V = np.linalg.eig(model.A)
    keep = np.flatnonzero(z.imag > 0)
    keep = keep[np.argsort(np.angle(z[keep]))]
    c, b = 2 * (model.C @ V)[:, keep].T, np.linalg.solve(V, model.B.astype(complex))[keep]
    b, c = b * c[:, :1], c / c[:, :1]
    k, m = b.shape
    pieces = [z[keep].real, z[keep].imag, c[:, 1:].real.ravel(), c[:, 1:].imag.ravel(), b.real.ravel(), b.imag.ravel()]
    if direct:
        pieces.append(np.zeros(model.D.size))
    return np.concatenate(pieces), (k, c.shape[1], m)


def refined(
    truth: StateSpace, snr_db: float, n: int, rng: np.random.Generator | None, direct: bool = False, spread: float = 1.0
) -> Found:
    """Return a model as found from n samples under white unit inputs held over a step, with white output noise.

    Args:
        truth: The true model.
        snr_db: Signal to noise of every output.
        n: Number of samples.
        rng: Draws the error of the parameters; None: the true ones.
        direct: Whether the direct part was estimated too.
        spread: Factor on the drawn error, not on the stated covariance.
    """
    theta, shape = modal_theta(truth, direct)
    # per output, the sum of squares of its impulse response is its variance under white unit inputs
    f = (np.arange(1500) + 0.5) / 3000 / truth.dt
    f = np.concatenate([f, *[f0 + 0.5 * np.linspace(-1, 1, 201) ** 3 for f0 in resonances(truth)]])
    f = np.unique(f[(f > 0) & (f < 0.5 / truth.dt)])
    width = np.gradient(f) * 2 * truth.dt  # of the half circle, both halves counted
    H = truth.frequency_response(f)
    power = np.einsum("k,kpm->p", width, np.abs(H) ** 2)
    noise = power * 10 ** (-snr_db / 10)
    columns = []
    for k in range(len(theta)):
        step = np.zeros(len(theta))
        step[k] = 1e-6 * max(abs(theta[k]), 1e-3 * np.abs(theta).max(), 1e-9)
        up, down = (modal_response(theta + sign * step, shape, np.exp(2j * np.pi * f * truth.dt)) for sign in (1, -1))
        columns.append((up - down).ravel() / (2 * step[k]))
    weight = np.sqrt(width[:, None, None] * n / noise[None, :, None] * np.ones(H.shape)).ravel()
    J = np.column_stack(columns) * weight[:, None]
    J = np.vstack([J.real, J.imag])
    size = np.linalg.norm(J, axis=0)
    Q, R = np.linalg.qr(J / size)
    half = np.linalg.inv(R) / size[:, None]
    found = theta + (spread * half @ rng.normal(size=len(theta)) if rng is not None else 0)
    model = modal_model(found, shape, truth.dt, truth.D)
    return Found(replace(model, noise=np.diag(noise)), found, half @ half.T, shape, truth.D)


def resonances(model: StateSpace) -> np.ndarray:
    """Return the frequencies of the poles in the upper half plane [Hz]."""
    z = model.poles()
    return np.angle(z[z.imag > 0]) / (2 * np.pi * model.dt)


def relative_error(found: np.ndarray, truth: np.ndarray) -> float:
    """Return the error of a matrix in per cent of its norm."""
    return 100 * float(np.linalg.norm(found - truth) / np.linalg.norm(truth))
