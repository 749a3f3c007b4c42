"""What motions offer to the search for causes: their range, their speeds, and the signals that all of them have."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.effects import JointScales, Motion, Scene
from tau_dyn.parameters import Parameters

_FASTEST = 0.98  # quantile of the speed that counts as fast
_RARE = 0.01
"""Share of the training beyond either end of the range that a joint visits often."""


def build_scene(
    motions: Sequence[Motion],
    joints: tuple[str, ...],
    units: tuple[str, ...],
    *,
    slow: np.ndarray,
    cutoff_hz: float,
    duration: float,
    signals: frozenset[str],
    campaigns: int = 1,
    trained: Sequence[np.ndarray] | None = None,
    coupled: tuple[tuple[str, str], ...] = (),
) -> Scene:
    """Return what motions offer together.

    Args:
        motions: The motions.
        joints: Their joints.
        units: The joints' force units, 'N' or 'N m'.
        slow: Slowest speed with a sure sign (na,) [m/s or rad/s].
        cutoff_hz: Frequency above which nothing is seen [Hz].
        duration: Length of all of them [s].
        signals: What effects may feel; see `find_shared_signals`.
        campaigns: Number of logs that are told apart.
        trained: Which samples of each motion causes are fitted to (n,); by default all.
        coupled: Pairs of joints that a shared motor may drive.
    """
    q, v = (np.concatenate([getattr(motion, key) for motion in motions]) for key in ("q", "v"))
    seen = q if trained is None else q[np.concatenate(trained)]
    often = np.quantile(seen, (_RARE, 1 - _RARE), axis=0)
    ends = q.min(axis=0), q.max(axis=0)
    hard = compute_fast_speeds(np.concatenate([motion.a for motion in motions]))
    return Scene(
        joints,
        units,
        *ends,
        slow,
        compute_fast_speeds(v),
        cutoff_hz,
        duration,
        signals,
        campaigns,
        often=often,
        coupled=coupled,
        hard=hard,
    )


def find_shared_signals(motions: Sequence[Motion]) -> frozenset[str]:
    """Return the names of the signals that all motions give."""
    return frozenset.intersection(*(frozenset(motion.signals) for motion in motions))


def compute_fast_speeds(v: np.ndarray) -> np.ndarray:
    """Return the speed that each joint exceeds in 2 % of the samples (na,), of speeds (n, na)."""
    return np.quantile(np.abs(v), _FASTEST, axis=0)


def measure_scales(
    parameters: Parameters, scene: Scene, force: np.ndarray, inertia: np.ndarray
) -> dict[str, dict[str, float]]:
    """Return what plausible amplitudes are shares of.

    Args:
        parameters: A fitted model's, with any friction it has.
        scene: The joints and their speeds.
        force: Largest measured force (na,) [N or N m].
        inertia: Largest inertia (na,) [kg or kg m^2].
    """
    friction = measure_friction(parameters, scene)
    return {
        joint: {"force": float(force[k]), "inertia": float(inertia[k])} | friction[joint]
        for k, joint in enumerate(scene.joints)
    }


def measure_friction(parameters: Parameters, scene: Scene) -> dict[str, dict[str, float]]:
    """Return the friction of each joint of a fitted model [N or N m, and per speed]; nothing where it has none."""
    found: dict[str, dict[str, float]] = {}
    for k, joint in enumerate(scene.joints):
        own: dict[str, float] = {}
        for key in ("coulomb", "viscous"):
            names = [n for n in (f"{joint}.{key}", f"{joint}.{key}_pos", f"{joint}.{key}_neg") if n in parameters]
            if names:
                own[key] = float(np.mean([abs(parameters[n].value) for n in names]))
        if {"coulomb", "viscous"} <= own.keys() and scene.fast[k] > 0:
            fast = float(scene.fast[k])
            own["drag"] = (own["coulomb"] + own["viscous"] * fast) / fast**2
        found[joint] = own
    return found


def widen_scales(first: JointScales, *others: JointScales) -> JointScales:
    """Return the larger of each scale: beside a friction cause the fit may leave little to the baseline's friction."""
    return {
        joint: {key: max([x, *(s[joint][key] for s in others if key in s.get(joint, {}))]) for key, x in own.items()}
        for joint, own in first.items()
    }
