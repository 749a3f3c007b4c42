"""What was not found but would have been, and what these logs cannot show.

A detection limit is the amplitude at which the test at the family-wise level has 95 % power (noncentral chi-square), at the
setting in the middle of the grid and on the joint where the cause is hardest to see.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import optimize, stats

from tau_dyn.diagnose.candidate_scan import ColumnCache
from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.data_split import EVERY
from tau_dyn.diagnose.group_tests import FAMILY_LEVEL, CandidateCause, GroupTest
from tau_dyn.diagnose.null_model import MIN_UNABSORBED_SHARE, NullModel
from tau_dyn.diagnose.result import Limit, Untestable
from tau_dyn.diagnose.stepwise_selection import StepwiseSelection
from tau_dyn.effects import Effect, format_quantity

POWER = 0.95  # of the test at the detection limit, by convention
OWNED = 1e-9  # share of a column's power left beside the null model; less is rounding
_WHOLE = 0.5
"""Share of an output's rms above which a limit says that the data show nothing of the cause."""


def compute_detection_limits(
    channel: Channel, search: StepwiseSelection, named: Sequence[str]
) -> tuple[tuple[Limit, ...], tuple[Untestable, ...]]:
    """Return detection limits of the causes that were tried and not found, and what could not be tried."""
    limits, untestable = [], []
    tried = {c.cause: c for c in search.last}
    for cls in channel.causes:
        if cls.name in named:
            continue
        reason = cls.untestable(channel.scene)
        if reason is not None:
            untestable.append(Untestable(cls.name, *reason))
        elif cls.name not in tried:
            untestable.append(
                Untestable(
                    cls.name, "this motion offers no setting at which it could be told from the baseline", cls.reveals
                )
            )
        else:
            limit = _limit(channel, search.library, search.ground, tried[cls.name], len(search.last))
            if isinstance(limit, str):
                untestable.append(Untestable(cls.name, limit, cls.reveals))
            elif limit is None and _owned(search.library, search.ground, tried[cls.name]):
                continue  # the baseline has it, under another name
            elif limit is None:
                why = "on this motion the refit of the baseline absorbs nearly all of it"
                untestable.append(Untestable(cls.name, why, cls.reveals))
            else:
                limits.append(limit)
    return tuple(limits), tuple(untestable)


def solve_noncentrality(level: float, dof: int, power: float = POWER) -> float:
    """Return the noncentrality at which a chi-square test of this level has this power."""
    critical = float(stats.chi2.isf(level, dof))
    root = optimize.root_scalar(lambda x: float(stats.ncx2.sf(critical, dof, x)) - power, bracket=(1e-3, 1e5))
    return float(root.root)


def _limit(
    channel: Channel, library: ColumnCache, ground: NullModel, candidate: CandidateCause, causes: int
) -> Limit | str | None:
    """Return the limit at the joint where a plausible cause is hardest to see, or why no plausible one would be seen."""
    found: list[tuple[float, str, str]] = []
    beyond: list[tuple[float, str, str]] = []
    for fit in candidate.tested:
        if len(fit.effect.joints) > 1 and any(len(f.effect.joints) == 1 for f in candidate.tested):
            continue
        tests = len(candidate.tested) * (2 if len(candidate.tested) > 1 else 1)  # each alone, and all together
        amplitude = _amplitude(channel, library, ground, fit, tests * causes)
        if amplitude is None:
            continue  # a joint that hardly moves says nothing of the others
        first = next(iter(fit.effect.parameters))
        values = fit.effect.parameters.with_values({first.name: max(amplitude, first.lower)})
        plausible = not fit.effect.find_implausible(values, channel.scene.scales)
        (found if plausible else beyond).append((amplitude, first.unit, "+".join(fit.effect.joints)))
    if not found and beyond:
        amplitude, unit, joint = min(beyond)
        return (
            f"it would be seen from {format_quantity(amplitude, unit)} at {joint}, which is more than it plausibly has"
        )
    if not found:
        return None
    amplitude, unit, joint = max(found)
    phrase = f"{candidate.cause.replace('_', ' ')} of {format_quantity(amplitude, unit)} at {joint}"
    return Limit(candidate.cause, amplitude, unit, phrase)


def _amplitude(
    channel: Channel, library: ColumnCache, ground: NullModel, fit: GroupTest, families: int
) -> float | None:
    """Return the amplitude seen with 95 % power, or None where it would exceed half of what is measured."""
    effect = select_median_setting(channel, fit.effect)
    C = ground.whiten_columns(library.columns(effect))
    units = [p.unit for p in effect.parameters]
    C = C[:, [unit == units[0] for unit in units]]
    G, raw = ground.gram(C), C.T @ C
    k = C.shape[1]
    if not np.trace(G) > MIN_UNABSORBED_SHARE * np.trace(raw) or np.trace(raw) == 0:
        return None
    level = FAMILY_LEVEL / families / fit.n_effective_tests * (2 if fit.one_sided else 1)
    size = float(np.sqrt(solve_noncentrality(min(level, 0.5), k) * fit.overdispersion * k / np.trace(G)))
    force = size * float(np.sqrt(np.trace(raw) / k))
    measured = float(np.linalg.norm(ground.whiten(channel.target) / ground.scale))
    return None if force > _WHOLE * measured else size


def _owned(library: ColumnCache, ground: NullModel, candidate: CandidateCause) -> bool:
    """Tell whether the baseline has parameters for exactly this, and not only on a motion that never turns back."""
    for fit in candidate.tested:
        C = ground.whiten_columns(library.columns(fit.effect))
        if np.trace(ground.gram(C)) > OWNED * np.trace(C.T @ C):
            return False
    joints = {joint for fit in candidate.tested for joint in fit.effect.joints}
    return not any(_one_way(ground.channel, joint) for joint in joints)


def _one_way(channel: Channel, joint: str) -> bool:
    """Tell whether a joint's usable samples all go the same way, or there are none."""
    speed, mine = f"v_{joint}", channel.outputs.index(joint) if joint in channel.outputs else None
    v = [
        row[speed][mask[:, mine]]
        for row, mask in zip(channel.variables(), channel.masks(*EVERY), strict=True)
        if speed in row and mine is not None
    ]
    return bool(v) and len(np.unique(np.sign(np.concatenate(v)))) < 2


def select_median_setting(channel: Channel, effect: Effect) -> Effect:
    """Return an effect with the middle one of its settings, the form of its law being the first."""
    grid = type(effect).grid(channel.scene, effect.joints)
    if effect.refined:
        first = grid[0]  # a proposed mode has settings that a plain one has not
        grid = [g for g in grid if all(g.get(k) == first.get(k) for k in {*g, *first} if k not in effect.refined)]
    return effect.with_settings(**grid[len(grid) // 2])
