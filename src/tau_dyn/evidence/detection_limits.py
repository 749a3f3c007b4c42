"""Detection limits of causes that were not found, causes that these logs cannot show, and periods that are not identifiable.

A detection limit is the amplitude at which the test at the family-wise level has 95 % power (noncentral chi-square), at the
setting in the middle of the grid and on the joint where the cause is hardest to detect.

Positions with a step `s` give the same values to all waves whose numbers of periods per metre differ by a multiple of `1 / s`,
and to their mirror images, `1 / p' = k / s +- 1 / p`. For static poses the periods that explain as much as the best one are
listed; if there is more than one, the period is not identifiable. Positions at uneven steps have no such aliases (Dressler
2012, 4.2, assumes them in measurements at steps of 50 mm).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from tau_dyn.effects import Effect, format_quantity
from tau_dyn.evidence.candidate_scan import FAMILY_LEVEL, CandidateCause, GroupTest, compute_explained
from tau_dyn.evidence.channel import Channel
from tau_dyn.evidence.measurements import EVERY
from tau_dyn.evidence.null_model import MIN_UNABSORBED_SHARE, NullModel
from tau_dyn.evidence.result import Finding, Limit, Untestable
from tau_dyn.evidence.stepwise_selection import SelectedCause, StepwiseSelection
from tau_dyn.evidence.unknown_structure import MIN_2LOGL_DIFFERENCE

POWER = 0.95  # of the test at the detection limit, by convention
OWNED = 1e-9  # share of a column's power left next to the null model; less is rounding
_WHOLE = 0.5
"""Share of an output's rms above which a limit means that the data hold no information about the cause."""


def compute_detection_limits(
    search: StepwiseSelection, named: Sequence[str]
) -> tuple[tuple[Limit, ...], tuple[Untestable, ...]]:
    """Return detection limits of the causes that were tested and not found, and the causes that could not be tested."""
    channel, limits, untestable = search.channel, [], []
    tried = {c.cause: c for c in search.last}
    for cls in channel.causes:
        absorbed = explain_absorbed(search.null_model, tried[cls.name]) if cls.name in tried else ""
        if absorbed:
            untestable.append(Untestable(cls.name, absorbed, cls.reveals))
        if cls.name in named:
            continue
        reason = cls.untestable(channel.scene)
        if reason is not None:
            untestable.append(Untestable(cls.name, *reason))
        elif cls.name not in tried:
            untestable.append(
                Untestable(
                    cls.name,
                    "this motion offers no setting at which it could be separated from the baseline",
                    cls.reveals,
                )
            )
        else:
            limit = _limit(search.null_model, tried[cls.name], len(search.last))
            if isinstance(limit, str):
                untestable.append(Untestable(cls.name, limit, cls.reveals))
            elif limit is None and _owned(search.null_model, tried[cls.name]):
                continue  # the baseline contains it under another name
            elif limit is None and not absorbed:
                why = "on this motion the refit of the baseline absorbs nearly all of it"
                untestable.append(Untestable(cls.name, why, cls.reveals))
            elif limit is not None:
                limits.append(limit)
    return tuple(limits), tuple(untestable)


def compute_finding_limit(search: StepwiseSelection, one: SelectedCause) -> Limit | None:
    """Return the detection limit of a selected cause with all others in the model; None if the baseline absorbs it."""
    null_model = search.null_model.with_effects(search.others(one))
    limit = _limit(null_model, one.candidate, len(search.last) + len(search.found))
    return limit if isinstance(limit, Limit) else None


def explain_absorbed(null_model: NullModel, candidate: CandidateCause) -> str:
    """Return the joints on which the baseline absorbs a cause, with the reason; empty if no reason is known."""
    reasons = []
    for fit in candidate.tested:
        C = null_model.rows(fit.effect)
        raw, measured = float(np.sum(C**2)), null_model.whiten(null_model.channel.target) / null_model.scale
        felt = raw > MIN_UNABSORBED_SHARE**2 * float(measured @ measured)
        if not (felt and float(np.trace(null_model.gram(C))) > MIN_UNABSORBED_SHARE * raw):
            reasons.append(fit.effect.explain_absorbed(fit.effect.joints, felt))
    return "; ".join(reason for reason in reasons if reason)


_MAX_LISTED_JOINTS = 3
"""Largest number of joints that are named one by one if an effect acts on all."""


def solve_noncentrality(level: float, dof: int, power: float = POWER) -> float:
    """Return the noncentrality at which a chi-square test of this level has this power."""
    return float(special.chndtrinc(special.chdtri(dof, level), dof, 1 - power))


def _limit(null_model: NullModel, candidate: CandidateCause, causes: int) -> Limit | str | None:
    """Return the limit at the joint where a plausible cause is hardest to detect, or the reason why it cannot be detected."""
    found: list[tuple[float, str, str]] = []
    beyond: list[tuple[float, str, str]] = []
    for fit in candidate.tested:
        if len(fit.effect.joints) > 1 and any(len(f.effect.joints) == 1 for f in candidate.tested):
            continue
        tests = len(candidate.tested) * (2 if len(candidate.tested) > 1 else 1)  # groups separately, and all together
        amplitude = _amplitude(null_model, fit, tests * causes)
        if amplitude is None:
            continue  # a joint that hardly moves is not representative of the others
        first = next(iter(fit.effect.parameters))
        amplitude = max([amplitude, *(row.low for row in fit.effect.plausible if not (row.of or row.setting))])
        values = fit.effect.parameters.with_values({first.name: max(amplitude, first.lower)})
        plausible = not fit.effect.find_implausible(values, null_model.channel.scene.scales)
        joints = fit.effect.joints
        several = len(joints) > _MAX_LISTED_JOINTS and set(joints) == set(null_model.channel.scene.joints)
        (found if plausible else beyond).append((amplitude, first.unit, "all joints" if several else "+".join(joints)))
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


def _amplitude(null_model: NullModel, fit: GroupTest, families: int) -> float | None:
    """Return the amplitude detected with 95 % power, or None if it would exceed half of the measurement."""
    effect = select_median_setting(null_model.channel, fit.effect)
    C = null_model.rows(effect)
    units = [p.unit for p in effect.parameters]
    C = C[:, [unit == units[0] for unit in units]]
    G, raw = null_model.gram(C), C.T @ C
    k = C.shape[1]
    if not np.trace(G) > MIN_UNABSORBED_SHARE * np.trace(raw) or np.trace(raw) == 0:
        return None
    level = FAMILY_LEVEL / families / fit.n_effective_tests * (2 if fit.one_sided else 1)
    size = float(np.sqrt(solve_noncentrality(min(level, 0.5), k) * fit.overdispersion * k / np.trace(G)))
    force = size * float(np.sqrt(np.trace(raw) / k))
    measured = float(np.linalg.norm(null_model.whiten(null_model.channel.target) / null_model.scale))
    return None if force > _WHOLE * measured else size


def _owned(null_model: NullModel, candidate: CandidateCause) -> bool:
    """Return whether the baseline has parameters for exactly this effect, not only on a motion without reversals."""
    for fit in candidate.tested:
        C = null_model.rows(fit.effect)
        if np.trace(null_model.gram(C)) > OWNED * np.trace(C.T @ C):
            return False
    joints = {joint for fit in candidate.tested for joint in fit.effect.joints}
    return not any(_one_way(null_model.channel, joint) for joint in joints)


def _one_way(channel: Channel, joint: str) -> bool:
    """Return whether a joint's usable samples all move in the same direction, or there are no such samples."""
    speed, mine = f"v_{joint}", channel.outputs.index(joint) if joint in channel.outputs else None
    v = [
        row[speed][mask[:, mine]]
        for row, mask in zip(channel.variables(), channel.masks(*EVERY), strict=True)
        if speed in row and mine is not None
    ]
    return bool(v) and len(np.unique(np.sign(np.concatenate(v)))) < 2


def select_median_setting(channel: Channel, effect: Effect) -> Effect:
    """Return an effect with the middle one of its settings, and the first form of its law."""
    grid = type(effect).grid(channel.scene, effect.joints)
    if effect.refined:
        first = grid[0]  # a proposed mode has additional settings
        grid = [g for g in grid if all(g.get(k) == first.get(k) for k in {*g, *first} if k not in effect.refined)]
    return effect.with_settings(**grid[len(grid) // 2])


_FINE = 5  # settings tried on each side of a good grid point
_LISTED = 4  # periods named in a sentence
_PER_PERIOD = 2.5
"""Positions per period, slightly more than two."""
_MIN_EXPLAINED_SHARE = 0.8  # share of the best statistic at a grid point from which a finer one may reach it


def find_alias_periods(selection: StepwiseSelection) -> list[tuple[float, ...]]:
    """Return the possible periods [m or rad] of each cyclic error found; empty for other causes and motion sampled in time."""
    poses = selection.channel.poses
    found: list[tuple[float, ...]] = []
    for one in selection.found:
        effect = one.candidate.effects[0]
        found.append(())
        if poses and effect.dense and "period" in effect.settings:
            found[-1] = compute_alias_periods(selection.null_model.with_effects(selection.others(one)), effect)
    return found


def leave_period_open(channel: Channel, one: SelectedCause, finding: Finding, periods: tuple[float, ...]) -> Finding:
    """Warn that the measured positions do not determine the period of a cyclic error, with a spacing that would."""
    effect = one.candidate.effects[0]
    joint = effect.joints[0]
    unit = "m" if effect.units[joint] == "N" else "rad"
    listed = ", ".join(format_quantity(p, unit) for p in periods[:_LISTED])
    more = (
        f" and {len(periods) - _LISTED} more down to {format_quantity(periods[-1], unit)}"
        if len(periods) > _LISTED
        else ""
    )
    step, finer = (
        format_quantity(x, unit) for x in (compute_position_spacing(channel, joint), periods[-1] / _PER_PERIOD)
    )
    return replace(
        finding,
        status="suspected",
        gain=None,
        sentence=f"{joint} has a cyclic error, but at places {step} apart periods of {listed}{more} fit alike.",
        experiment=f"measure the tool while {joint} goes in steps of {finer} or less, or at as many places in uneven steps",
    )


def compute_alias_periods(null_model: NullModel, effect: Effect) -> tuple[float, ...]:
    """Return the periods [m or rad] that explain as much as an effect's own, longest first; only its own if it is unique.

    Args:
        null_model: The null model with everything else.
        effect: An effect with a setting `period`.
    """
    scene = null_model.channel.scene
    k = scene.index(effect.joints[0])
    travel = float(scene.high[k] - scene.low[k])
    lines = np.array([1 / s["period"] for s in type(effect).grid(scene, effect.joints) if "period" in s])
    own = 1 / effect.settings["period"]
    if travel <= 0 or not len(lines):
        return (effect.settings["period"],)
    step = float(np.median(np.abs(np.diff(lines)))) if len(lines) > 1 else 1 / travel
    rough = _explained(null_model, effect, lines)
    starts = [own, *lines[rough > rough.max() * _MIN_EXPLAINED_SHARE - MIN_2LOGL_DIFFERENCE]]
    fine = np.concatenate([x + step * np.linspace(-0.5, 0.5, 2 * _FINE + 1) for x in starts])
    fine = np.concatenate([[own], fine[fine > 0]])
    found = list(zip(_explained(null_model, effect, fine), fine, strict=True))
    top = max(T for T, _ in found)
    kept: list[float] = []
    for T, line in sorted(found, reverse=True):
        if T > top - MIN_2LOGL_DIFFERENCE and all(abs(line - other) > 1 / travel for other in kept):
            kept.append(line)
    return tuple(sorted((1 / line for line in kept), reverse=True))


def compute_position_spacing(channel: Channel, joint: str) -> float:
    """Return the usual step between positions of a joint [m or rad]."""
    steps = [np.abs(np.diff(v[f"q_{joint}"])) for v in channel.variables()]
    all_steps = np.concatenate(steps)
    moved = all_steps[all_steps > 1e-6 * max(float(all_steps.max(initial=0.0)), 1e-300)]
    return float(np.median(moved)) if len(moved) else 0.0


def _explained(null_model: NullModel, effect: Effect, lines: np.ndarray) -> np.ndarray:
    """Return `T` (g,) of the effect with these numbers of periods per metre or radian (g,)."""
    settings = [effect.with_settings(period=float(1 / line)) for line in lines]
    return compute_explained(settings, null_model, null_model.e[:, None])[:, 0]
