"""How much each parameter matters: how far the tool moves and turns when it alone is off (thesis (5.8), Table 5.10)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.geometry_fit import GeometryFit

CHANGE = 5e-5
"""Change of each parameter in the thesis, in its own unit."""


class Sensitivity(NamedTuple):
    """What a change of one parameter does.

    Attributes:
        name: Of the parameter.
        position: Accumulated tool displacement over all poses, both signs [m], `S_pos` of (5.8).
        rotation: Accumulated tool rotation [rad].
        closure: Accumulated change of the closure residuals [m], nan where the mechanism has none.
    """

    name: str
    position: float
    rotation: float
    closure: float


def compute_sensitivities(fitted: GeometryFit, change: float = CHANGE) -> tuple[Sensitivity, ...]:
    """Return every geometric parameter's sensitivity at the fitted poses, to first order.

    Args:
        fitted: A fit.
        change: Of each parameter, in its unit.
    """
    state = fitted.state
    ok = state.ok
    q, base = fitted.poses.q[ok], state.base.take(ok)
    twist = fitted.geometry.tool_by_parameter(fitted.theta, q, base)
    closure = fitted.geometry.closure_by_parameter(fitted.theta, q, base)
    moved = 2 * change * np.linalg.norm(twist[:, :3], axis=1).sum(axis=0)
    turned = 2 * change * np.linalg.norm(twist[:, 3:], axis=1).sum(axis=0)
    gaps = np.full(len(moved), np.nan) if closure is None else 2 * change * np.abs(closure).sum(axis=(0, 1))
    names = fitted.geometry.parameters.names
    return tuple(
        Sensitivity(n, float(a), float(b), float(c)) for n, a, b, c in zip(names, moved, turned, gaps, strict=True)
    )
