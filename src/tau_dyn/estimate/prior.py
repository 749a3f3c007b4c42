"""What was measured beforehand, as equations of a fit: `theta_k / s_k = value / s_k`, a row of unit noise for each."""

from __future__ import annotations

import numpy as np

from tau_dyn.parameters import Parameters


def build_prior_rows(parameters: Parameters) -> tuple[np.ndarray, np.ndarray]:
    """Return columns (k, p) and values (k,) of the k parameters with a `prior_stderr` among p."""
    known = [(k, p.value, float(p.prior_stderr)) for k, p in enumerate(parameters) if p.prior_stderr]
    rows = np.zeros((len(known), len(parameters)))
    for row, (column, _, stderr) in zip(rows, known, strict=True):
        row[column] = 1 / stderr
    return rows, np.array([value / stderr for _, value, stderr in known])
