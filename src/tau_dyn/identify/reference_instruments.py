r"""The motion that a log's references ask for, free of the encoders' noise: instruments for a robot in feedback.

A controller lets the robot deviate from its reference by what forces and the reference itself make of it:

    q - q_ref = sum_k h_k(t) * s_k(t),   s = forces, speeds and accelerations along the reference,

with impulse responses `h` of half a second. They are piecewise linear over lags that grow by half, and are fitted to the log by
least squares: some hundred numbers from as many equations as there are samples, so that next to no encoder noise passes. No
controller has to be known. Where it is known, simulating the closed loop does the same (Janot, Vandanjon & Gautier
2014, A generic instrumental variable approach for industrial robot identification); this only approximates it, which costs
precision, never consistency, since whatever follows from references alone is independent of the noise.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg
from scipy.fft import next_fast_len

from tau_dyn.identify.preparation import Preparation
from tau_dyn.log import Log, differentiate, lowpass
from tau_dyn.model import Model

MAX_RESPONSE_LAG_S = 0.5
"""Longest lag of the response to a reference [s]."""

FINE = 4
"""Lags up to this sample stand by themselves; beyond, they grow by half."""


def predict_tracked_motion(model: Model, log: Log, preparation: Preparation, q: np.ndarray) -> np.ndarray:
    """Return positions (n, m) that follow from the references alone.

    Args:
        model: Gives the forces along the reference.
        log: An even stretch with `q_ref_J` of every actuated joint.
        preparation: Gives the low-pass before the references are differentiated.
        q: Measured positions (n, m).
    """
    reference = log.joint("q_ref", model.robot.actuated)
    features = _responses(_sources(model, log, preparation, reference), log.dt)
    scale = np.linalg.norm(features, axis=0)
    features = features / np.where(scale > 0, scale, 1.0)
    gram, moment = features.T @ features, features.T @ (q - reference)
    ridge = 1e-10 * np.eye(len(gram))
    return reference + features @ linalg.solve(gram + ridge, moment, assume_a="pos")


def _sources(model: Model, log: Log, preparation: Preparation, reference: np.ndarray) -> np.ndarray:
    """Return what makes a robot deviate (n, 3 m): forces, speeds and accelerations along the reference."""
    q = lowpass(reference, preparation.position_cutoff_hz, log.rate_hz)
    v = differentiate(q, log.dt, accuracy=4)
    a = differentiate(v, log.dt, accuracy=4)
    force = model.steady().torque(q, v, a)
    return np.column_stack([force, v, a])


def _responses(sources: np.ndarray, dt: float) -> np.ndarray:
    """Return sources (n, k) behind each piece of the impulse responses (n, k lags), and a constant."""
    n, lags = len(sources), _lags(int(np.ceil(MAX_RESPONSE_LAG_S / dt)))
    length = next_fast_len(n + lags[-1] + 1, real=True)
    spectrum = np.fft.rfft(sources, length, axis=0)
    found = [np.ones((n, 1))]
    for before, at, after in zip(lags[:-2], lags[1:-1], lags[2:], strict=True):
        hat = np.interp(np.arange(after + 1), [before, at, after], [0.0, 1.0, 0.0], left=0.0)
        found.append(np.fft.irfft(spectrum * np.fft.rfft(hat, length)[:, None], length, axis=0)[:n])
    return np.concatenate(found, axis=1)


def _lags(last: int) -> list[int]:
    """Return the knots of the impulse responses, in samples, from one sample before zero."""
    lags = [-1, *range(FINE + 1)]
    while lags[-1] < last:
        lags.append(int(np.ceil(1.5 * lags[-1])))
    return lags
