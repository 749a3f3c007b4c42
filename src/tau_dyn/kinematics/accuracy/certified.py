r"""An upper bound on the tool's error that holds for every error within its bounds, or the word that there is none.

With w = B - A, |w| = L and D the whole change of w, `|w + D| = L + l` reads exactly

    u . (dp + phi x R b) = [u . dA - u . R db + l] + r,      r = (l^2 - |D|^2) / 2L - u . (R' - R - [phi] R) b - u . (R' - R) db,

and |r| is bounded by the displacement itself: |D| <= d + t (|b| + |db|) + |db| + |dA| for |dp| <= d, |phi| <= t. If d and t bound
the right side's solution, that map takes the ball (d, t) into itself and shrinks distances there, so exactly one pose lies in it
(Banach; Kantorovich's condition for quadrics), which is the one reached from no error. The smallest such d comes from
repeating. Where repeating runs away, near a singularity, nothing is certified. Cf. Goldsztejn, Caro and Chabert 2015
(tolerance synthesis).
"""

from __future__ import annotations

from itertools import product

import numpy as np

from tau_dyn.kinematics.accuracy.parallelepiped import compute_half_heights
from tau_dyn.kinematics.accuracy.rod_device import RodDevice, State, solve

_STEPS = 200  # of the fixed-point iteration; it converges linearly or not at all
_MAX_BOUND_RATIO = 0.25
"""Share of the shortest rod beyond which a bound is no longer sought."""
_SAFE = 1 + 1e-9  # factor that outweighs rounding, so that the bound stays one


def explain_inapplicable(device: RodDevice) -> str:
    """Return why the bound does not apply, '' where it does."""
    rods, Q = device.rods, device.sources.actuator
    home = rods.robot.home[None]
    curved = np.any(rods.base_jacobian(home) @ Q) or np.any((rods.leg_rates(home) - rods.leg_rates(home + 0.05)) @ Q)
    return "an actuator's error moves its points on a curve, which the bound leaves out" if curved else ""


def bound_displacement(device: RodDevice, state: State) -> np.ndarray:
    """Return a displacement of the tool (N,) [m] that no errors within their bounds exceed; nan where none is proved."""
    A, b, L = device.ends(state.q, None)
    s, shortest = device.sources, L.min(axis=1)
    levers = np.linalg.norm(b[0], axis=1)
    shift, plate, length = (
        _reach(x, device.balls)
        for x in (s.shift, s.plate, (s.length + device.rods.leg_rates(state.q[:1])[0] @ s.actuator)[:, None])
    )
    h = compute_half_heights(device, state)
    C, _ = device.tangent(state, state.plate)
    inverse = solve(C, np.broadcast_to(np.eye(device.freedoms), C.shape))
    lever = state.plate.rotation @ device.rods.tool.translation
    signs = np.array([(1, *x) for x in product((1, -1), repeat=device.freedoms - 1)], float)
    d, t = np.zeros(len(h)), np.zeros(len(h))
    X, settled, lost = np.zeros((len(h), 1, device.freedoms)), np.zeros(len(h), bool), np.zeros(len(h), bool)
    for _ in range(_STEPS):
        change = d[:, None] + t[:, None] * (levers + plate) + plate + shift
        rest = np.maximum(change**2, length**2) / (2 * L) + t[:, None] ** 2 * levers / 2 + t[:, None] * plate
        X = np.einsum("Nik,sk,Nk->Nsi", inverse, signs, h + rest)
        new_d = _SAFE * np.linalg.norm(X[..., :3], axis=2).max(axis=1)
        new_t = _SAFE * np.linalg.norm(X[..., 3:], axis=2).max(axis=1)
        settled = (new_d <= d * _SAFE) & (new_t <= t * _SAFE)
        d, t = np.maximum(d, new_d), np.maximum(t, new_t)
        lost = ~(d < _MAX_BOUND_RATIO * shortest) | ~(t < 1.0)
        if np.all(settled | lost):
            break
    at_tool = d
    if not device.rods.translates:
        moved = X[..., :3] + np.cross(X[..., 3:], lever[:, None])
        at_tool = np.linalg.norm(moved, axis=2).max(axis=1) + t**2 * np.linalg.norm(lever, axis=1) / 2
    return np.where(settled & ~lost, at_tool * _SAFE, np.nan)


def _reach(effect: np.ndarray, balls: tuple[slice, ...]) -> np.ndarray:
    """Return how far all sources together can move each rod's point or length (n,) [m]."""
    sizes = [np.linalg.norm(effect[..., ball], ord=2, axis=(1, 2)) for ball in balls]
    return np.sum(sizes, axis=0) if sizes else np.zeros(len(effect))
