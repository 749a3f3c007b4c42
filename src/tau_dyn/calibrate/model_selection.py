"""Which model the poses bear: structures from small to large, then additions that residuals ask for, each by cross-validation.

A larger model is taken only where it predicts training poses that its refit had not seen significantly better, by a
paired test over poses. Held-out poses take no part in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from tau_dyn.calibrate.addition_tests import screen_additions
from tau_dyn.calibrate.candidates import CandidateModel, Options, SelectionStep, fit_and_cross_validate
from tau_dyn.calibrate.crossvalidation import compare_paired
from tau_dyn.calibrate.families import Family
from tau_dyn.calibrate.models import BETWEEN_CAMPAIGNS, Spec
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.exceptions import CannotAnswer, InputError

_MAX_ADDITIONS = 12  # steps of the forward selection; bounds its time
_MAX_CONSECUTIVE_FAILURES = 3  # additions tried at a step before the selection ends


def select_model(
    family: Family, poses: PoseSet, options: Options, progress: Callable[[str], None] = lambda step: None
) -> tuple[list[CandidateModel], list[SelectionStep], tuple[str, ...]]:
    """Return the models of the ladder, the last one chosen, all steps that were tried, and warnings.

    Raises:
        InputError: Too few poses for the smallest model.
    """
    taken, steps, warnings = _structures(family, poses, options, progress)
    _additions(family, poses, options, taken, steps, progress)
    return taken, steps, warnings


def _structures(
    family: Family, poses: PoseSet, options: Options, progress: Callable[[str], None]
) -> tuple[list[CandidateModel], list[SelectionStep], tuple[str, ...]]:
    taken: list[CandidateModel] = []
    steps: list[SelectionStep] = []
    warnings: list[str] = []
    moved: dict[str, tuple[str, ...]] = {}
    for spec in _list_structures(family, options.additions):
        structure = Spec(spec.structure, {**spec.additions, **moved})
        progress(f"fitting {structure.name_for(family.joints)}")
        try:
            candidate = fit_and_cross_validate(family, structure, poses, options)
        except (InputError, CannotAnswer) as fault:
            if not taken:
                raise
            warnings.append(str(fault))
            break
        if taken:
            gain = compare_paired(taken[-1].unseen, candidate.unseen, options.seed)
            steps.append(SelectionStep(candidate.name, taken[-1].name, gain, gain.is_significant))
            if not gain.is_significant:
                continue
        between = {a: own for a, own in candidate.spec.additions.items() if a in BETWEEN_CAMPAIGNS}
        if moved and set(between) > set(moved) and candidate.spec.structure == family.structures[0]:
            candidate = _drop_earlier_frame(family, poses, options, taken, steps, candidate, moved)
            between = {a: own for a, own in candidate.spec.additions.items() if a in BETWEEN_CAMPAIGNS}
        moved = between
        taken.append(candidate)
    return taken, steps, tuple(warnings)


def _drop_earlier_frame(
    family: Family,
    poses: PoseSet,
    options: Options,
    taken: list[CandidateModel],
    steps: list[SelectionStep],
    both: CandidateModel,
    earlier: Mapping[str, tuple[str, ...]],
) -> CandidateModel:
    """Return the model with the later frame alone where the earlier one, taken in its place, adds nothing beside it."""
    alone = Spec(both.spec.structure, {a: own for a, own in both.spec.additions.items() if a not in earlier})
    candidate = fit_and_cross_validate(family, alone, poses, options)
    gain = compare_paired(candidate.unseen, both.unseen, options.seed)
    steps.append(SelectionStep(both.name, candidate.name, gain, gain.is_significant))
    if gain.is_significant:
        return both
    taken.pop()
    return candidate


def _list_structures(family: Family, always: Mapping[str, tuple[str, ...]]) -> list[Spec]:
    """Return the structures, after the robot file as it is those with the additions that every model has.

    Frames that moved between campaigns come before larger structures: what they do looks like geometry.
    """
    first, *rest = family.structures
    moved = [{a: family.can_have(a)} for a in BETWEEN_CAMPAIGNS if family.can_have(a)]
    with_always = [Spec(first, {**always, **own}) for own in ([{}] if always else []) + moved]
    return [Spec(first), *with_always, *(Spec(s, dict(always)) for s in rest)]


def _additions(
    family: Family,
    poses: PoseSet,
    options: Options,
    taken: list[CandidateModel],
    steps: list[SelectionStep],
    progress: Callable[[str], None],
) -> None:
    periods: dict[str, float] = {}
    refused: set[tuple[str, tuple[str, ...]]] = set()
    for _ in range(_MAX_ADDITIONS):
        now = taken[-1]
        hints = [h for h in screen_additions(now.fit, family, now.spec) if (h.addition, h.joints) not in refused]
        failed = 0
        for hint in hints[:_MAX_CONSECUTIVE_FAILURES]:
            progress(f"trying {hint.addition} at {', '.join(hint.joints)}")
            label = "2" if hint.addition == "periodic2" else ""
            tried = periods | ({hint.joints[0] + label: hint.period} if hint.period else {})
            try:
                candidate = fit_and_cross_validate(
                    family, now.spec.plus(hint.addition, hint.joints), poses, options, now.fit, tried
                )
            except (InputError, CannotAnswer):
                refused.add((hint.addition, hint.joints))
                continue
            gain = compare_paired(now.unseen, candidate.unseen, options.seed)
            steps.append(SelectionStep(candidate.name, now.name, gain, gain.is_significant))
            if gain.is_significant:
                taken.append(candidate)
                periods = tried
                break
            refused.add((hint.addition, hint.joints))
            failed += 1
        if taken[-1] is now:
            return
