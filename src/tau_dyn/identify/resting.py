"""Joints that rest most of the time: their errors, and what friction says of them, come from the little that is left."""

from __future__ import annotations

import numpy as np

from tau_dyn.coded_warning import CodedWarning
from tau_dyn.estimate import Regression
from tau_dyn.identify.preparation import Preparation

MAX_RESTING_SHARE = 0.5
"""Share of the samples at rest from which a joint rests most of the time."""


def compute_rest_shares(regression: Regression) -> np.ndarray:
    """Return the share of samples at which each joint (na,) is slower than the slowest speed of a sure sign."""
    preparation: Preparation = regression.settings["preparation"]
    v = np.concatenate([run.signals["v"] for run in regression.runs])
    return np.mean(np.abs(v) < preparation.speed_threshold, axis=0)


def list_resting_warnings(regression: Regression) -> list[str]:
    """Return one warning that names the joints at rest most of the time."""
    if not any(len(run.t) for run in regression.runs):
        return []
    resting = {
        j: x for j, x in zip(regression.outputs, compute_rest_shares(regression), strict=True) if x > MAX_RESTING_SHARE
    }
    if not resting:
        return []
    named = ", ".join(f"{joint} ({100 * share:.0f} %)" for joint, share in resting.items())
    return [
        CodedWarning(
            "rests_mostly",
            f"{named} rest{'s' if len(resting) == 1 else ''} most of the time; errors and friction there are of the moving "
            "samples only, so look at the errors over all samples too",
        )
    ]
