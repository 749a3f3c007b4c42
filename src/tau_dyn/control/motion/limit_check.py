"""A plan judged on a fine clock, by the model in Python instead of the solver's expressions, and what the next round must keep.

Limits hold at the nodes and half-way between; friction that turns in between can leave them for a moment. Where the fine clock
finds an excess, the limit nearby is tightened by as much. A few rounds settle it.
"""

from __future__ import annotations

import numpy as np

from tau_dyn.control.feedforward import Feedforward
from tau_dyn.control.motion.coordinates import Actuated, Coordinates
from tau_dyn.control.motion.limits import MotionLimits
from tau_dyn.control.motion.nodes import Nodes, build_node_motion

MAX_LIMIT_EXCESS = 1e-3
"""Share of a limit that the solver leaves unused, and by which a plan may leave the rest between the places it looks at."""

_FINE = 10  # looks an interval


def compute_limit_usage(feedforward: Feedforward, motion: Actuated, limits: MotionLimits, which: list) -> np.ndarray:
    """Return by how much of its limit each limited quantity is used (M, m) along a motion."""
    values = {"force": feedforward(*motion), "speed": motion.v, "acceleration": motion.a}
    columns = [np.abs(values[name][:, k]) / getattr(limits, name)[k] for name, k in which]
    return np.stack(columns, axis=1)


def tighten_limits(
    share: np.ndarray,
    nodes: Nodes,
    coordinates: Coordinates,
    feedforward: Feedforward,
    limits: MotionLimits,
    which: list,
) -> np.ndarray | None:
    """Return the shares of the limits (2 N + 1, m) for the next round, or None where this one keeps everything."""
    looks = np.linspace(0, 1, _FINE * (len(nodes.x) - 1) + 1)
    used = compute_limit_usage(feedforward, build_node_motion(coordinates, nodes, looks, nodes.T), limits, which)
    if used.max(initial=0.0) <= 1 + MAX_LIMIT_EXCESS:
        return None
    step = _FINE // 2
    out = share.copy()
    for look, k in np.argwhere(used > 1 + MAX_LIMIT_EXCESS / 2):
        near = [look // step, min(look // step + 1, len(share) - 1)]
        out[near, k] = np.minimum(out[near, k], share[near, k] / used[look, k])
    return out
