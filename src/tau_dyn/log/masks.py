"""Where a mask over samples holds without a break."""

import numpy as np


def find_true_runs(mask: np.ndarray) -> list[slice]:
    """Return the stretches of samples (n,) at which a mask is true, in time order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
