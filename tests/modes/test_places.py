"""Which degree of freedom inputs and outputs belong to, and what reciprocity completes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

sys.path.insert(0, str(Path(__file__).parent))
from structures import DT, chain

from tau_dyn.exceptions import InputError
from tau_dyn.modes.mechanical.structure import Places, convert_to_continuous, find_places


def test_inputs_and_outputs_pair_in_order_when_as_many() -> None:
    """Named in the same order, they are taken as collocated; otherwise nothing is assumed."""
    assert find_places(3, 3, None) == Places((0, 1, 2), (0, 1, 2))
    assert find_places(3, 2, None).pairs == []
    assert find_places(3, 2, None).n == 5


def test_an_unpaired_input_has_a_place_of_its_own() -> None:
    """Two sensors and a hammer at three places, one of them without a sensor, name three degrees of freedom."""
    places = find_places(2, 3, [(0, 1), (2, 0)])
    assert places.driven == (1, 2, 0)
    assert places.n == 3
    assert places.pairs == [(0, 1), (2, 0)]


@pytest.mark.parametrize("pairs", [[(0, 3)], [(2, 0)], [(-1, 0)], [(0, 0), (0, 1)], [(0, 1), (1, 1)]])
def test_pairs_that_do_not_exist_are_refused(pairs: list[tuple[int, int]]) -> None:
    """A pair needs an input and an output that exist, each once."""
    with pytest.raises(InputError, match="collocated pair"):
        find_places(3, 2, pairs)


@pytest.mark.parametrize(
    "driven, sensed", [([0], [0, 1, 2]), ([0, 1, 2], [2]), ([0, 2], [0, 1]), ([2, 0, 1], [0, 1, 2])]
)
def test_reciprocity_completes_the_compliance(driven: list[int], sensed: list[int]) -> None:
    """From one collocated pair on, modes give the response between any two named places, also unmeasured ones."""
    structure = chain((7.4, 11.5, 14.0))
    model = structure.sampled(DT, driven, sensed)
    places = find_places(len(sensed), len(driven), [(driven.index(d), sensed.index(d)) for d in driven if d in sensed])
    dofs = [*sensed, *(d for d in driven if d not in sensed)]
    s = 2j * np.pi * np.array([1.0, 7.0, 12.0, 40.0])
    full = structure.compliance(s)[:, dofs][:, :, dofs]
    assert_allclose(convert_to_continuous(model).completed(places).response(s), full, rtol=1e-6)
