"""Confirmation where held-out logs cannot speak: on blocks of the training logs that a second search does not see.

Held-out logs may move in a way that does not show a cause at all: few reversals, another speed, another place. Their silence is
no evidence against it. So a quarter of the training logs, in blocks, is set aside; the search is made anew on the rest, and what
it finds again, at the same family-wise level, has to show on the blocks in the size predicted. On clean data that is as rare as
the first procedure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.confirm import Confirmation
from tau_dyn.diagnose.encoders import NoiseOnly
from tau_dyn.diagnose.fits import FAMILY_LEVEL
from tau_dyn.diagnose.parts import TRAIN, divide_training
from tau_dyn.diagnose.search import Found, Search, search
from tau_dyn.diagnose.stages import confirmation
from tau_dyn.diagnose.trials import DRAWS
from tau_dyn.diagnose.unexplained import Told, structure_confirmation, told_apart
from tau_dyn.diagnose.unknown import Structure, find_structure


@dataclass(frozen=True)
class Tests:
    """What held-out data say of each cause found, and of the structure without a name."""

    causes: tuple[Confirmation, ...]
    structure: Told | None


def tests_of(channel: Channel, hunt: Search, structure: Structure | None) -> Tests:
    """Test everything found on the confirmation part."""
    causes = tuple(confirmation(channel, hunt, one) for one in hunt.found)
    return Tests(causes, structure and told_apart(channel, hunt, structure))


def heard(
    channel: Channel,
    hunt: Search,
    tests: Tests,
    gap_s: float,
    rng: np.random.Generator,
    noise: NoiseOnly,
) -> Tests:
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
    if not whole or not any(test.silent for test in every):
        return tests
    inner = replace(channel, parts=tuple(divide_training(channel.runs, channel.parts, gap_s)))
    again = search(inner, rng, lambda step: None, sift=noise.within(inner.parts).sift)
    causes = tuple(
        _better(test, inner, again, _alike(again, one)) if test.silent else test
        for one, test in zip(hunt.found, tests.causes, strict=True)
    )
    left = tests.structure
    if left is not None and left.test.silent:
        found = find_structure(inner, again.ground, again.ground.draws(DRAWS, rng), FAMILY_LEVEL)
        if found and found.output == left.structure.output and set(found.variables) & set(left.structure.variables):
            test = structure_confirmation(inner, again, found)
            left = replace(left, test=replace(test, within=True)) if test.holds else left
    return Tests(causes, left)


def _alike(again: Search, one: Found) -> Found | None:
    """Return the same cause on one of its joints, found again."""
    same = (other for other in again.found if other.candidate.cause == one.candidate.cause)
    return next((other for other in same if _joints(other) & _joints(one)), None)


def _joints(found: Found) -> set[str]:
    return {joint for effect in found.candidate.effects for joint in effect.joints}


def _better(before: Confirmation, inner: Channel, again: Search, other: Found | None) -> Confirmation:
    if other is None:
        return before
    test = confirmation(inner, again, other)
    return replace(test, within=True) if test.holds else before
