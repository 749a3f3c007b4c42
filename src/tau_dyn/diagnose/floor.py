"""The noise floor: what is left of the residual when every output may depend smoothly on all its own variables.

It is an estimate of what no model of these variables can get below; freedom spent on the smooth functions is given back.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.data_split import EVERY
from tau_dyn.diagnose.extended_fit import EvaluatedFit, compute_errors
from tau_dyn.diagnose.noise import build_smooth_columns
from tau_dyn.diagnose.result import OutputErrors
from tau_dyn.estimate import scale_columns


def estimate_noise_floor(channel: Channel, extended: EvaluatedFit, rng: np.random.Generator) -> OutputErrors:
    """Return the floor on the part used for nothing else; over all samples, the same functions are taken beyond the masks."""
    masks, variables = channel.masks(*EVERY), channel.variables()
    left = [e.copy() for e in extended.residuals]
    whole = [e.copy() for e in extended.regression.residuals_all(extended.theta)]
    for k, output in enumerate(channel.outputs):
        runs, smooth = extended.regression.runs, build_smooth_columns(variables, output)
        basis = [np.concatenate([run.W[:, k], rich], axis=1) for run, rich in zip(runs, smooth, strict=True)]
        rows = np.concatenate([b[m[:, k]] for b, m in zip(basis, masks, strict=True)])
        y = np.concatenate([e[m[:, k], k] for e, m in zip(left, masks, strict=True)])
        unit, norm = scale_columns(rows)
        theta, _, rank, _ = np.linalg.lstsq(unit, y, rcond=1e-7)
        given_back = np.sqrt(len(y) / max(1, len(y) - rank))
        for e, b in zip(left, basis, strict=True):
            e[:, k] = (e[:, k] - b @ (theta / norm)) * given_back
        for e, run, rich in zip(whole, runs, smooth, strict=True):
            b = np.concatenate([run.W_all[:, k], rich], axis=1)
            e[:, k] = (e[:, k] - b @ (theta / norm)) * given_back
    return compute_errors(channel, left, rng, whole=whole)
