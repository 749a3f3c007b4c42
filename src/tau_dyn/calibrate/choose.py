"""Which model the poses bear: structures from small to large, then additions that residuals ask for, each by cross-validation.

A larger model is taken only where it predicts training poses that its refit had not seen significantly better, by a
paired test over poses. Held-out poses take no part in it.
"""

from __future__ import annotations

from collections.abc import Callable

from tau_dyn.calibrate.candidates import Candidate, Options, Step, evaluate
from tau_dyn.calibrate.crossvalidation import LEVER, compare
from tau_dyn.calibrate.families import Family
from tau_dyn.calibrate.models import BETWEEN_CAMPAIGNS, RodFamily, Spec
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.calibrate.screening import screen
from tau_dyn.exceptions import CannotAnswer, InputError

_MOST_ADDITIONS = 12
_FAILED_IN_A_ROW = 3


def climb(
    family: Family, poses: PoseSet, options: Options, progress: Callable[[str], None] = lambda step: None
) -> tuple[list[Candidate], list[Step], tuple[str, ...]]:
    """Return the models of the ladder, the last one chosen, all steps that were tried, and warnings.

    Raises:
        InputError: Too few poses for the smallest model.
    """
    taken, steps, warnings = _structures(family, poses, options, progress)
    if isinstance(family, RodFamily):
        _additions(family, poses, options, taken, steps, progress)
    return taken, steps, warnings


def _structures(
    family: Family, poses: PoseSet, options: Options, progress: Callable[[str], None]
) -> tuple[list[Candidate], list[Step], tuple[str, ...]]:
    taken: list[Candidate] = []
    steps: list[Step] = []
    warnings: list[str] = []
    moved: dict[str, tuple[str, ...]] = {}
    for spec in _ladder(family):
        structure = Spec(spec.structure, spec.additions | moved)
        progress(f"fitting {structure.name_for(family.joints)}")
        try:
            candidate = evaluate(family, structure, poses, options)
        except (InputError, CannotAnswer) as fault:
            if not taken:
                raise
            warnings.append(str(fault))
            break
        if taken:
            gain = compare(taken[-1].unseen, candidate.unseen, LEVER, options.seed)
            steps.append(Step(candidate.name, taken[-1].name, gain, gain.real))
            if not gain.real:
                continue
        moved = candidate.spec.additions
        taken.append(candidate)
    return taken, steps, tuple(warnings)


def _ladder(family: Family) -> list[Spec]:
    """Return the structures, and after the first one frames that moved between campaigns: what they do looks like geometry."""
    first, *rest = family.structures
    moved = [Spec(first, {a: family.can_have(a)}) for a in BETWEEN_CAMPAIGNS if family.can_have(a)]
    return [Spec(first), *moved, *(Spec(s) for s in rest)]


def _additions(
    family: RodFamily,
    poses: PoseSet,
    options: Options,
    taken: list[Candidate],
    steps: list[Step],
    progress: Callable[[str], None],
) -> None:
    periods: dict[str, float] = {}
    refused: set[tuple[str, tuple[str, ...]]] = set()
    for _ in range(_MOST_ADDITIONS):
        now = taken[-1]
        hints = [h for h in screen(now.fit, family, now.spec) if (h.addition, h.joints) not in refused]
        failed = 0
        for hint in hints[:_FAILED_IN_A_ROW]:
            progress(f"trying {hint.addition} at {', '.join(hint.joints)}")
            label = "2" if hint.addition == "periodic2" else ""
            tried = periods | ({hint.joints[0] + label: hint.period} if hint.period else {})
            try:
                candidate = evaluate(family, now.spec.plus(hint.addition, hint.joints), poses, options, now.fit, tried)
            except (InputError, CannotAnswer):
                refused.add((hint.addition, hint.joints))
                continue
            gain = compare(now.unseen, candidate.unseen, LEVER, options.seed)
            steps.append(Step(candidate.name, now.name, gain, gain.real))
            if gain.real:
                taken.append(candidate)
                periods = tried
                break
            refused.add((hint.addition, hint.joints))
            failed += 1
        if taken[-1] is now:
            return
