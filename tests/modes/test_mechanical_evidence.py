"""What a sampled model says in continuous time, and how surely."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

sys.path.insert(0, str(Path(__file__).parent))
from structures import DT, chain, refined

from tau_dyn.modes.mechanical.structure import OUTPUTS, build_evidence, convert_to_continuous

HZ = (7.4, 11.5, 14.0)


@pytest.mark.parametrize("output", OUTPUTS)
def test_sampling_is_undone_exactly(output: str) -> None:
    """The compliance comes back from a model sampled under held inputs, whatever its sensors measure."""
    structure = chain(HZ)
    model = structure.sampled(DT, range(3), range(3), output)
    s = 2j * np.pi * np.geomspace(1, 100, 9)
    assert_allclose(convert_to_continuous(model, OUTPUTS.index(output)).response(s), structure.compliance(s), rtol=1e-7)


def test_a_pure_delay_is_no_part_of_the_structure() -> None:
    """Whole samples of delay leave M, D, K alone."""
    model = chain(HZ).sampled(DT, range(3), range(3))
    s = 2j * np.pi * np.array([5.0])
    assert_allclose(
        convert_to_continuous(replace(model, delay=5)).response(s), convert_to_continuous(model).response(s)
    )


def test_a_pole_beyond_half_the_rate_goes_into_the_direct_part() -> None:
    """No held-input system has a negative real pole alone: its response at rest stays, and a model of no other is refused."""
    model = chain(HZ).sampled(DT, [0], [0])
    beyond = replace(model, A=np.diag([-0.5, 0.2, 0.3, 0.4, 0.5, 0.6]))
    found = convert_to_continuous(beyond)
    assert found.n_left_out == 1
    at_rest = beyond.C @ np.linalg.solve(np.eye(6) - beyond.A, beyond.B) + beyond.D
    assert_allclose(found.response(np.array([0j]))[0], at_rest, rtol=1e-9)
    with raises_code("not_identifiable"):
        convert_to_continuous(replace(model, A=-np.diag([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])))


def test_the_factor_is_the_scatter_of_the_response() -> None:
    """Models drawn from the stated covariance scatter as the factor says."""
    truth, rng = chain(HZ[:2]).sampled(DT, range(2), range(2)), np.random.default_rng(1)
    found = refined(truth, 40, 5000, None)
    s = 2j * np.pi * np.array([3.0, 7.0, 20.0])
    factor = build_evidence(found).factor(s)
    half = np.linalg.cholesky(found.covariance)
    draws = [
        convert_to_continuous(found.model_at(found.theta + half @ rng.normal(size=len(half)))).response(s).ravel()
        for _ in range(600)
    ]
    assert_allclose(np.std(draws, axis=0), np.linalg.norm(factor, axis=1), rtol=0.12)
