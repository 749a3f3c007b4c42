"""A recording split where the robot rests: motions that can be trained on, confirmed on and held out one by one."""

import numpy as np
from numpy.typing import NDArray

from tau_dyn.log.log import Log
from tau_dyn.log.noise_estimation import estimate_encoder_noise

_SIGMA = 6.0  # standard deviations of the noise; none of 1e8 samples exceeds them
_LOOK_S = 0.1  # [s] over which travel is measured


def split_by_motion(log: Log, *, rest_s: float = 0.5, least_s: float = 1.0) -> list[Log]:
    """Return a log's motions: the stretches between rests, each with half of the rests around it.

    The robot rests where, for `rest_s` or longer, no joint travels more in 0.1 s than six times its encoder's noise.

    Args:
        log: Positions `q_J` of at least one joint, evenly sampled.
        rest_s: Shortest rest that separates two motions [s].
        least_s: Shortest motion worth keeping [s]; shorter ones are left out.

    Returns:
        Parts in time order; the whole log where it never rests, none where it never moves.
    """
    moving = _moving(log)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], moving, [False]]).astype(int)))
    starts, stops = edges[::2], edges[1::2]
    if not starts.size:
        return []
    apart = np.flatnonzero((starts[1:] - stops[:-1]) * log.dt >= rest_s)
    firsts, lasts = np.r_[starts[0], starts[apart + 1]], np.r_[stops[apart], stops[-1]]
    cuts = np.r_[0, (lasts[:-1] + firsts[1:]) // 2, log.n_samples]
    kept = (lasts - firsts) * log.dt >= least_s
    return [log.window(int(a), int(b)) for a, b, keep in zip(cuts[:-1], cuts[1:], kept, strict=True) if keep]


def _moving(log: Log) -> NDArray[np.bool_]:
    """Tell at which samples (N,) some joint moves, judged over windows long enough to see through its noise."""
    q = log.joint("q", log.joints("q"))
    width = min(max(2, round(_LOOK_S / log.dt)), log.n_samples - 1)
    travel = np.abs(q[width:] - q[:-width])
    noise = np.sqrt(2) * estimate_encoder_noise(q)
    went = np.any(travel > np.maximum(_SIGMA * noise, 1e-12), axis=1)
    return np.concatenate([np.full(width // 2, went[0]), went, np.full(width - width // 2, went[-1])])
