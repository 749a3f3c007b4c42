"""What all channels have in common: each of the three parts needs enough to be of use."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.evidence.measurements import EVERY, TEST, TRAIN, VALIDATION, refuse_scarce


def channel(counts: dict[int, int]) -> Any:
    """Return a channel with so many usable values of each part, in two runs."""
    return cast(Any, SimpleNamespace(masks=lambda part: [np.ones((counts[part] - 1, 1), bool), np.ones((1, 1), bool)]))


@pytest.mark.parametrize(
    ("part", "use"), [(TRAIN, "train on"), (VALIDATION, "confirm on"), (TEST, "measure the gain on")]
)
def test_the_part_with_too_little_is_named(part: int, use: str) -> None:
    """One value less than needed in one part of three is refused, and the sentence says what it would have been for."""
    counts = dict.fromkeys(EVERY, 12)
    refuse_scarce(channel(counts), (12, 12, 12), "too little is left", "there are 3 s", "record more")
    with raises_code("too_little_data") as fault:
        refuse_scarce(channel(counts | {part: 11}), (12, 12, 12), "too little is left", "there are 3 s", "record more")
    assert fault.value.missing == f"too little is left to {use}: there are 3 s"
