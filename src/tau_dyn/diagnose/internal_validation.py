"""Confirmation where held-out logs cannot speak: on blocks of the training logs that a second search does not see.

Held-out logs may move in a way that does not show a cause at all: few reversals, another speed, another place. Their silence is
no evidence against it. So a quarter of the training logs, in blocks, is set aside; the search is made anew on the rest, and what
it finds again, at the same family-wise level, has to show on the blocks in the size predicted. On clean data that is as rare as
the first procedure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.diagnose.candidate_scan import N_NULL_DRAWS, get_columns
from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.confirm import Confirmation, confirm
from tau_dyn.diagnose.data_split import TRAIN, divide_training
from tau_dyn.diagnose.group_tests import FAMILY_LEVEL
from tau_dyn.diagnose.noise_only_bootstrap import NoiseOnlyBootstrap
from tau_dyn.diagnose.stepwise_selection import SelectedCause, StepwiseSelection, select_causes
from tau_dyn.diagnose.unexplained import StructureTest, confirm_structure, discriminate_structures
from tau_dyn.diagnose.unknown_structure import Structure, find_structure


@dataclass(frozen=True)
class ConfirmationResults:
    """What held-out data say of each cause found, and of the structure without a name."""

    causes: tuple[Confirmation, ...]
    structure: StructureTest | None


def confirm_cause(channel: Channel, hunt: StepwiseSelection, one: SelectedCause) -> Confirmation:
    """Test one cause on the confirmation part, the others accounted for."""
    effects, others = (get_columns(hunt.library, x) for x in (one.candidate.effects, hunt.others(one)))
    return confirm(channel, hunt.noise, effects, others)


def confirm_all(channel: Channel, hunt: StepwiseSelection, structure: Structure | None) -> ConfirmationResults:
    """Test everything found on the confirmation part."""
    causes = tuple(confirm_cause(channel, hunt, one) for one in hunt.found)
    return ConfirmationResults(causes, structure and discriminate_structures(channel, hunt, structure))


def confirm_within_training(
    channel: Channel,
    hunt: StepwiseSelection,
    tests: ConfirmationResults,
    gap_s: float,
    rng: np.random.Generator,
    noise: NoiseOnlyBootstrap,
) -> ConfirmationResults:
    """Return the tests, those on which the confirmation part is silent repeated within the training logs.

    Args:
        channel: The data.
        hunt: The search on all of the training part.
        tests: What the confirmation part says.
        gap_s: Memory of the filters, left out beside a block's border [s].
        rng: For noise draws.
        noise: What encoder noise alone makes.
    """
    every = [*tests.causes, *([tests.structure.test] if tests.structure else [])]
    whole = any(np.all(part == TRAIN) for part in channel.parts)
    if not whole or not any(test.is_inconclusive for test in every):
        return tests
    inner = replace(channel, parts=tuple(divide_training(channel.runs, channel.parts, gap_s)))
    again = select_causes(inner, rng, lambda step: None, sift=noise.within(inner.parts).reject_artefacts)
    causes = tuple(
        _better(test, inner, again, _alike(again, one)) if test.is_inconclusive else test
        for one, test in zip(hunt.found, tests.causes, strict=True)
    )
    left = tests.structure
    if left is not None and left.test.is_inconclusive:
        found = find_structure(inner, again.ground, again.ground.draw_null_residuals(N_NULL_DRAWS, rng), FAMILY_LEVEL)
        if found and found.output == left.structure.output and set(found.variables) & set(left.structure.variables):
            test = confirm_structure(inner, again, found)
            left = replace(left, test=replace(test, within=True)) if test.is_confirmed else left
    return ConfirmationResults(causes, left)


def _alike(again: StepwiseSelection, one: SelectedCause) -> SelectedCause | None:
    """Return the same cause on one of its joints, found again."""
    same = (other for other in again.found if other.candidate.cause == one.candidate.cause)
    return next((other for other in same if _joints(other) & _joints(one)), None)


def _joints(found: SelectedCause) -> set[str]:
    return {joint for effect in found.candidate.effects for joint in effect.joints}


def _better(
    before: Confirmation, inner: Channel, again: StepwiseSelection, other: SelectedCause | None
) -> Confirmation:
    if other is None:
        return before
    test = confirm_cause(inner, again, other)
    return replace(test, within=True) if test.is_confirmed else before
