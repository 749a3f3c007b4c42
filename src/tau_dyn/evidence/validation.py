"""Tests of all causes and structures found, on the validation data or within the training logs.

The motion of held-out logs may not excite a cause at all; this is no evidence against it. Then a quarter of the blocks of the
training logs is held out, the selection is repeated on the rest, and a cause that it selects again, at the same family-wise
level, must be present in these blocks in the predicted size. On clean data its false-alarm rate is that of the first procedure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.evidence.candidate_scan import FAMILY_LEVEL, N_NULL_DRAWS
from tau_dyn.evidence.confirmation import Confirmation, confirm
from tau_dyn.evidence.measurements import TRAIN, divide_training
from tau_dyn.evidence.noise_only_bootstrap import NoiseOnlyBootstrap
from tau_dyn.evidence.stepwise_selection import SelectedCause, StepwiseSelection, select_causes
from tau_dyn.evidence.unexplained import StructureTest, confirm_structure, discriminate_structures
from tau_dyn.evidence.unknown_structure import Structure, find_structure


@dataclass(frozen=True)
class ConfirmationResults:
    """Tests of each cause found, and of unexplained structure, on held-out data."""

    causes: tuple[Confirmation, ...]
    structure: StructureTest | None


def confirm_cause(selection: StepwiseSelection, one: SelectedCause) -> Confirmation:
    """Test one cause on the validation data, with the others in the model."""
    return confirm(selection.null_model, selection.columns(one.candidate.effects), selection.others(one))


def drop_unconfirmed_joints(selection: StepwiseSelection, one: SelectedCause) -> SelectedCause:
    """Return a confirmed cause without the joints at which the validation data contradict it.

    Each joint is tested with all other causes and the cause's other joints in the model. A joint whose validation data have too
    little power to show the effect stays: its cause is confirmed elsewhere.
    """
    fits = one.candidate.fits
    if len(fits) < 2:
        return one
    kept = []
    for fit in fits:
        rest = [other.effect for other in fits if other is not fit]
        test = confirm(selection.null_model, selection.columns([fit.effect]), [*selection.others(one), *rest])
        if test.is_confirmed or test.is_inconclusive:
            kept.append(fit)
    return replace(one, candidate=replace(one.candidate, fits=tuple(kept) or fits))


def confirm_all(selection: StepwiseSelection, structure: Structure | None) -> ConfirmationResults:
    """Test all causes and structures found on the validation data."""
    causes = tuple(confirm_cause(selection, one) for one in selection.found)
    return ConfirmationResults(
        causes, structure and discriminate_structures(selection.null_model, selection.known_columns, structure)
    )


def confirm_within_training(
    selection: StepwiseSelection,
    tests: ConfirmationResults,
    gap_s: float,
    rng: np.random.Generator,
    noise: NoiseOnlyBootstrap,
) -> ConfirmationResults:
    """Return the tests; those for which the validation data have too little power are repeated within the training logs.

    Args:
        selection: The search on all of the training data.
        tests: The tests on the validation data.
        gap_s: Memory of the filters, left out next to a block's border [s].
        rng: For noise draws.
        noise: Measurements due to encoder noise alone.
    """
    every = [*tests.causes, *([tests.structure.test] if tests.structure else [])]
    channel = selection.channel
    whole = any(np.all(part == TRAIN) for part in channel.parts)
    if not whole or not any(test.is_inconclusive for test in every):
        return tests
    inner = replace(channel, parts=tuple(divide_training(channel.runs, channel.parts, gap_s)))
    again = select_causes(inner, rng, lambda step: None, artefact_filter=noise.within(inner.parts).reject_artefacts)
    causes = tuple(
        _confirm_again(test, again, one) if test.is_inconclusive else test
        for one, test in zip(selection.found, tests.causes, strict=True)
    )
    left = tests.structure
    if left is not None and left.test.is_inconclusive:
        found = find_structure(again.null_model, again.null_model.draw_null_residuals(N_NULL_DRAWS, rng), FAMILY_LEVEL)
        if found and found.output == left.structure.output and set(found.variables) & set(left.structure.variables):
            test = confirm_structure(again.null_model, again.known_columns, found)
            left = replace(left, test=replace(test, within=True)) if test.is_confirmed else left
    return ConfirmationResults(causes, left)


def _confirm_again(before: Confirmation, again: StepwiseSelection, one: SelectedCause) -> Confirmation:
    """Return the test of the same cause, found again on one of its joints, if it confirms; otherwise the previous one."""
    joints = {joint for effect in one.candidate.effects for joint in effect.joints}
    for other in again.found:
        shared = any(joints & set(effect.joints) for effect in other.candidate.effects)
        if other.candidate.cause == one.candidate.cause and shared:
            test = confirm_cause(again, other)
            return replace(test, within=True) if test.is_confirmed else before
    return before
