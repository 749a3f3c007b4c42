"""What an oracle gains that knows the hidden force's true shape, on the samples on which `diagnose` measured its own gain.

All errors are against the force without noise, put through the same filters, so that the noise both leave does not count:

    gain ratio = (E_before^2 - E_found^2) / (E_before^2 - E_oracle^2)

The oracle takes the diagnosis' own base prediction, encoder noise included, and fits to what it leaves of the measured force
the shape and the base model's columns, on the parts that the extended model is fitted on. Its last low-pass is put
on the true force; where that does not give its trace, there is no ratio.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hidden_effects_parts.recording import Recording
from hidden_effects_parts.strength import base_columns
from tau_dyn.evidence import Diagnosis
from tau_dyn.log import Log, decimate, lowpass

FAITHFUL = 0.2
"""Largest difference between a trace and our filter's, as a share of the noise; the diagnosis thins logs in steps of its own."""

GAIN = 2
"""The part of a trace that the gain is measured on; 0 and 1 were fitted on."""


def gain_ratio(found: Diagnosis, logs: Sequence[Log], runs: Sequence[Recording], shapes: Sequence[np.ndarray]) -> float:
    """Return the gain over that of the oracle.

    Args:
        found: The answer.
        logs: All logs, held-out ones last, as the traces are.
        runs: What they recorded, before noise.
        shapes: The hidden force of each (N, na, k), one column for each thing that hides.
    """
    if len(found.traces) != len(logs):
        return np.nan
    cutoff = found.settings["preparation"]["force_cutoff_hz"]
    rows: list[tuple[np.ndarray, ...]] = []
    for trace, log, run, shape in zip(found.traces, logs, runs, shapes, strict=True):
        factor = max(1, round(log.rate_hz * float(np.median(np.diff(trace.t)))))

        def passed(x: np.ndarray, log: Log = log, factor: int = factor) -> np.ndarray:
            return decimate(lowpass(x, cutoff, log.rate_hz), factor)

        tau = log.joint("tau", run.rig.joints)
        noise = passed(tau - run.tau)
        if noise.shape != trace.measured.shape:
            return np.nan
        odd = (passed(tau) - trace.measured)[trace.usable]
        if np.std(odd) > FAITHFUL * np.std(noise[trace.usable]):
            return np.nan
        columns = np.concatenate([base_columns(run), shape], axis=2)
        clean = trace.measured - noise
        rows.append((passed(columns), trace.measured, clean, trace.before, trace.after, trace.usable, trace.part))
    W, tau, true, before, after, usable, part = (np.concatenate(x) for x in zip(*rows, strict=True))
    fit = usable & np.isin(part, (0, 1))[:, None]
    own = np.linalg.norm(W[fit], axis=0)
    W = W[:, :, own > 0] / own[own > 0]
    theta = np.linalg.lstsq(W[fit], (tau - before)[fit], rcond=1e-9)[0]
    judged = usable & (part == GAIN)[:, None]

    def square(prediction: np.ndarray) -> float:
        return float(np.sum((prediction - true)[judged] ** 2))

    best = square(before) - square(before + W @ theta)
    return (square(before) - square(after)) / best if best > 0 else np.nan
