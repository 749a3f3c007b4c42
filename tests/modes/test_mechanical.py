"""M, D, K from a model: right, definite, honest about its errors, and never `identified` when it is not."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from sampling import assert_scatter

sys.path.insert(0, str(Path(__file__).parent))
from structures import DT, Found, chain, refined, relative_error

from tau_dyn.modes import StateSpace
from tau_dyn.modes.mechanical import Mechanical, SecondOrder, fit_mechanical
from tau_dyn.modes.mechanical.structure import OUTPUTS, pack

HZ = (7.4, 11.5, 14.0)
HZ4 = (7.4, 11.5, 14.0, 103.0)


def subsets(n: int) -> list[tuple[int, ...]]:
    return [c for k in range(1, n + 1) for c in combinations(range(n), k)]


def pairs(driven: Sequence[int], sensed: Sequence[int]) -> list[tuple[int, int]]:
    return [(driven.index(d), sensed.index(d)) for d in driven if d in sensed]


def assert_definite(found: Mechanical) -> None:
    """M and K are symmetric and positive definite, D symmetric and not negative."""
    for part in (found.M, found.D, found.K):
        assert_allclose(part, part.T, rtol=1e-12)
    assert np.linalg.eigvalsh(found.M)[0] > 0 and np.linalg.eigvalsh(found.K)[0] > 0
    assert np.linalg.eigvalsh(found.D)[0] > -1e-12 * np.linalg.norm(found.D)


@pytest.mark.parametrize("output", OUTPUTS)
def test_an_exact_model_gives_the_exact_matrices(output: str) -> None:
    """Without noise nothing is lost, whichever derivative is measured."""
    truth = chain(HZ, 3)
    found = fit_mechanical(truth.sampled(DT, range(3), range(3), output), output=output)
    assert found.status == "identified" and found.stderr is None
    for name in "MDK":
        assert relative_error(getattr(found, name), getattr(truth, name)) < 1e-4


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_twenty_decibels_leave_one_two_one_per_cent(seed: int) -> None:
    """20 k samples at 20 dB: M within 1 %, D within 2 %, K within 1 %, static compliance within 1 %; all definite."""
    truth = chain(HZ, seed)
    found = fit_mechanical(refined(truth.sampled(DT, range(3), range(3)), 20, 20000, np.random.default_rng(seed)))
    assert found.status == "identified"
    assert_definite(found)
    for name, limit in (("M", 1.0), ("D", 2.0), ("K", 1.0)):
        assert relative_error(getattr(found, name), getattr(truth, name)) < limit
    assert relative_error(found.static_compliance, np.linalg.inv(truth.K)) < 1.0


def test_standard_errors_cover() -> None:
    """Over 20 draws about 95 % of the intervals of M, D, K and the static compliance hold the truth."""
    truth, inside, still = chain(HZ, 4), [], []
    sure = refined(truth.sampled(DT, range(3), range(3)), 25, 5000, None)
    half, rng = np.linalg.cholesky(sure.covariance), np.random.default_rng(7)
    for _ in range(20):
        theta = sure.theta + half @ rng.normal(size=len(half))
        found = fit_mechanical(replace(sure, theta=theta, model=sure.model_at(theta)))
        inside.append(np.abs(pack(found.structure) - pack(truth)) < 1.96 * pack(found.stderr))
        error = np.abs(found.static_compliance - np.linalg.inv(truth.K))
        still.append(error < 1.96 * found.static_compliance_stderr)
    assert 0.88 < np.mean(inside) < 0.99  # 360 intervals, but only 20 independent draws of 18 numbers
    assert 0.85 < np.mean(still) <= 1.0


def test_likelihood_beats_the_unweighted_fit() -> None:
    """Weighing by the covariance lowers the errors against the same model taken at its word."""
    truth, ratio = chain(HZ, 5), []
    for seed in range(4):
        model = refined(truth.sampled(DT, range(3), range(3)), 20, 5000, np.random.default_rng(seed))
        errors = [relative_error(fit_mechanical(each).D, truth.D) for each in (model, model.model)]
        ratio.append(errors[0] / errors[1])
    assert np.exp(np.mean(np.log(ratio))) < 0.7


@pytest.mark.parametrize("noisy", [False, True])
def test_partial_sensing_of_three_masses_is_never_identified(noisy: bool) -> None:
    """Of all choices of sensors and forces just those are identified that name every mass and share one; those are right."""
    truth = chain(HZ, 3)
    choices = [(a, b) for a in subsets(3) for b in subsets(3)]
    for sensed, driven in choices[::3] if noisy else choices:
        model: StateSpace | Found = truth.sampled(DT, driven, sensed)
        if noisy:
            model = refined(model, 30, 20000, np.random.default_rng(1))
        found = fit_mechanical(model, collocated=pairs(driven, sensed))
        whole = set(sensed) & set(driven) and len({*sensed, *driven}) == 3
        assert (found.status == "identified") == bool(whole), (sensed, driven, found.why)
        if whole:
            dofs = [*sensed, *(d for d in driven if d not in sensed)]
            right = SecondOrder(*(part[np.ix_(dofs, dofs)] for part in (truth.M, truth.D, truth.K)))
            assert relative_error(found.K, right.K) < 1.0
            assert relative_error(found.static_compliance, np.linalg.inv(right.K)) < 1.0
        elif not set(sensed) & set(driven):
            assert "collocated" in found.why
        else:
            assert "too few sensed degrees of freedom" in found.why


def test_partial_sensing_of_four_masses_is_never_identified() -> None:
    """A draw of the 225 choices on four masses, one mode far above the others."""
    truth, rng = chain(HZ4, 3), np.random.default_rng(0)
    choices = [(a, b) for a in subsets(4) for b in subsets(4)]
    for k in rng.choice(len(choices), 40, replace=False):
        sensed, driven = choices[k]
        found = fit_mechanical(truth.sampled(DT, driven, sensed), collocated=pairs(driven, sensed))
        whole = set(sensed) & set(driven) and len({*sensed, *driven}) == 4
        assert (found.status == "identified") == bool(whole), (sensed, driven, found.why)


def test_a_stand_in_holds_on_its_band() -> None:
    """Two of three masses sensed, the third mode far above: condensed, right in its band and at rest, and not beyond."""
    truth = chain((7.4, 11.5, 103.0), 3)
    found = fit_mechanical(refined(truth.sampled(DT, [0, 1], [0, 1]), 30, 20000, np.random.default_rng(1)))
    assert found.status == "condensed" and "2, and there are 3 modes" in found.why
    assert_definite(found)
    low, high = found.valid_hz
    assert low < 1.0 and 15 < high < 100
    for f in (low, 7.4, 11.5, 0.99 * high):
        s = np.array([2j * np.pi * f])
        wanted = truth.compliance(s)[:, :2, :2]
        assert np.linalg.norm(found.structure.compliance(s) - wanted) < 0.07 * np.linalg.norm(wanted)
    assert relative_error(found.static_compliance, np.linalg.inv(truth.K)[:2, :2]) < 1.0
    s = np.array([2j * np.pi * 103.0])
    wanted = truth.compliance(s)[:, :2, :2]
    assert np.linalg.norm(found.structure.compliance(s) - wanted) > 0.2 * np.linalg.norm(wanted)


def test_a_stand_in_knows_its_own_errors() -> None:
    """Scatter of a stand-in's K over draws is what its standard errors say; its bias is no part of them."""
    truth, scatter, stated = chain((7.4, 11.5, 103.0), 3), [], []
    for seed in range(10):
        model = refined(truth.sampled(DT, [0, 1], [0, 1]), 30, 20000, np.random.default_rng(seed))
        found = fit_mechanical(model)
        scatter.append(found.K)
        stated.append(found.stderr.K)
    assert_scatter(np.array(scatter), np.mean(stated, axis=0))


def test_swapped_names_are_noticed() -> None:
    """Three forces named in the wrong order are no collocated pairs: reciprocity fails."""
    model = chain(HZ, 3).sampled(DT, [1, 2, 0], [0, 1, 2])
    for source in (model, refined(model, 30, 20000, np.random.default_rng(0))):
        found = fit_mechanical(source)
        assert found.status == "not_identifiable" and "not collocated" in found.why


@pytest.mark.parametrize(
    ("order", "signs", "said"),
    [
        ([1, 0, 2], [1, 1, 1], "with a and b exchanged"),
        ([0, 1, 2], [1, 1, -1], "with the sign of c reversed"),
        ([2, 1, 0], [-1, 1, 1], "with a and c exchanged and the sign of a reversed"),
        ([0, 1, 2], [-1, -1, -1], "with the sign of a and b and c reversed"),
    ],
)
def test_exchanged_and_reversed_sensors_are_named(order, signs, said) -> None:
    """Reciprocity and the phase at driving points leave one order and one set of signs of the sensors."""
    model = chain(HZ, 3).sampled(DT, [0, 1, 2], [0, 1, 2])
    turn = np.eye(3)[order] * np.array(signs)[:, None]
    wired = replace(model, C=turn @ model.C, D=turn @ model.D)
    for source in (wired, refined(wired, 30, 20000, np.random.default_rng(0))):
        found = fit_mechanical(source, names=("a", "b", "c"))
        assert found.status == "not_identifiable" and said in found.why


def test_one_sensor_mounted_upside_down_is_named() -> None:
    """At a driving point every mode moves as the force pushes; of an unknown sensor a sign may be a quantity."""
    model = chain(HZ, 3).sampled(DT, [0], [0, 1])
    wired = replace(model, C=-model.C, D=-model.D)
    found = fit_mechanical(wired, collocated=[(0, 0)], names=("a", "b"))
    assert found.status == "not_identifiable" and "the sign of a reversed" in found.why
    assert "reversed" not in fit_mechanical(wired, collocated=[(0, 0)], names=("a", "b"), output="auto").why
    assert "reversed" not in fit_mechanical(model, collocated=[(0, 0)], names=("a", "b")).why


def test_forces_in_different_units_are_noticed() -> None:
    """One force in kilonewtons among newtons breaks reciprocity."""
    model = chain(HZ, 3).sampled(DT, range(3), range(3))
    found = fit_mechanical(replace(model, B=model.B * [1, 1000, 1]))
    assert found.status == "not_identifiable" and "units" in found.why


def test_units_do_not_matter() -> None:
    """Millimetres and kilonewtons scale M, D, K and their standard errors and change no verdict."""
    truth = chain(HZ, 3)
    model = refined(truth.sampled(DT, range(3), range(3)), 20, 20000, np.random.default_rng(0))
    plain = fit_mechanical(model)
    one = np.array([1.0, 1e3, 1e-2])  # each degree of freedom in its own unit; the forces keep their work

    def turned(theta: np.ndarray) -> StateSpace:
        old = model.model_at(theta)
        return replace(old, B=old.B * one, C=old.C * one[:, None])

    scaled = fit_mechanical(
        SimpleNamespace(model=turned(model.theta), theta=model.theta, covariance=model.covariance, model_at=turned)
    )
    assert scaled.status == plain.status == "identified", scaled.why
    unit = np.outer(one, one)
    for name in "MDK":
        assert_allclose(
            getattr(scaled, name) * unit,
            getattr(plain, name),
            rtol=1e-4,
            atol=1e-5 * np.abs(getattr(plain, name)).max(),
        )
        assert_allclose(getattr(scaled.stderr, name) * unit, getattr(plain.stderr, name), rtol=1e-3)


def test_a_model_with_too_little_information_says_so() -> None:
    """At -10 dB with 300 samples neither M nor K is known, however feasible the program."""
    model = refined(chain(HZ, 3).sampled(DT, range(3), range(3)), -10, 300, None)
    found = fit_mechanical(model)
    assert found.status == "not_identifiable" and "no information" in found.why


def test_more_sensors_than_modes_are_not_identified() -> None:
    """Four sensors that see three modes leave a fourth degree of freedom without information."""
    truth = chain(HZ, 3)
    model = truth.sampled(DT, [0], [0, 1, 2])
    wide = replace(model, C=np.vstack([model.C, model.C[0] + model.C[1]]), D=np.zeros((4, 1)), K=np.zeros((6, 4)))
    found = fit_mechanical(wide, collocated=[(0, 0)])
    assert found.status == "not_identifiable" and "only 3 modes" in found.why


def test_a_force_at_a_node_does_not_identify() -> None:
    """Three sensed masses in a row, pushed in the middle: the mode with the middle at rest is never told."""
    stiffness = 5e4 * np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 2]])
    truth = SecondOrder(np.diag([10.0, 6.0, 10.0]), 1e-4 * stiffness, stiffness)
    found = fit_mechanical(truth.sampled(DT, [1], range(3)), collocated=[(0, 1)])
    assert found.status != "identified", found.why
    off = replace(truth, M=np.diag([10.0, 6.0, 9.9]))  # all but at a node: with noise still nothing is told
    found = fit_mechanical(
        refined(off.sampled(DT, [1], range(3)), 30, 5000, np.random.default_rng(0)), collocated=[(0, 1)]
    )
    assert found.status != "identified", found.why


def test_a_force_at_an_unknown_place_names_a_place_of_its_own() -> None:
    """Three sensed masses and a second force somewhere else are four places for three modes; without it all is told."""
    truth = chain(HZ, 3)
    model = truth.sampled(DT, [0, 1], [0, 1, 2])
    model = replace(model, B=model.B @ np.array([[1.0, 0.3], [0.0, 0.8]]))  # the second pushes between two masses
    found = fit_mechanical(model, collocated=[(0, 0)])
    assert found.status == "not_identifiable" and "name 4" in found.why and "leave some out" in found.why
    found = fit_mechanical(replace(model, B=model.B[:, :1], D=model.D[:, :1]), collocated=[(0, 0)])
    assert found.status == "identified" and relative_error(found.K, truth.K) < 1e-4


def test_doubts_about_the_model_forbid_identified() -> None:
    """A model that misses part of the response, or has poles that are no modes, is at most condensed."""
    model = chain(HZ, 3).sampled(DT, range(3), range(3))
    assert fit_mechanical(model, complete=False).status == "condensed"
    slow = replace(
        model,
        A=np.block([[model.A, np.zeros((6, 1))], [np.zeros((1, 6)), np.array([[0.9]])]]),
        B=np.vstack([model.B, np.zeros((1, 3))]),
        C=np.hstack([model.C, np.ones((3, 1))]),
        K=np.zeros((7, 3)),
    )
    found = fit_mechanical(slow)
    assert found.status == "condensed" and "1 of the model's 7 poles" in found.why
    assert fit_mechanical(model, band=(5.0, 12.5)).status != "identified"  # the third mode is outside


def test_a_model_that_is_no_structure_is_contradicted_by_chance() -> None:
    """A residue off by ten standard errors, 1 % of the response, leaves no structure of that many masses."""
    truth = chain(HZ, 3)
    model = refined(truth.sampled(DT, range(3), range(3)), 50, 20000, None)
    theta = model.theta.copy()
    k = int(np.argmax(np.abs(theta[12:]))) + 12
    theta[k] += 10 * np.sqrt(model.covariance[k, k])
    found = fit_mechanical(replace(model, theta=theta, model=model.model_at(theta)))
    assert found.status == "condensed" and "probability" in found.why


def test_unstable_models_and_bad_bands_are_refused() -> None:
    """An unstable model has no D >= 0; a band without width or without modes has no answer."""
    model = chain(HZ, 3).sampled(DT, range(3), range(3))
    assert "unstable" in fit_mechanical(replace(model, A=1.01 * model.A)).why
    assert "no resonance" in fit_mechanical(model, band=(30.0, 60.0)).why
    with raises_code("invalid_value", "empty"):
        fit_mechanical(model, band=(8.0, 8.0))


def test_a_result_becomes_plain_numbers() -> None:
    """The record holds status, reason and, where there are any, the matrices with their standard errors."""
    truth = chain(HZ, 3)
    whole = fit_mechanical(refined(truth.sampled(DT, range(3), range(3)), 30, 20000, None)).to_dict()
    assert whole["status"] == "identified"
    assert np.shape(whole["M"]) == np.shape(whole["stderr"]["K"]) == (3, 3)
    assert json.loads(json.dumps(whole)) == whole
    none = fit_mechanical(truth.sampled(DT, [0], [1]), collocated=[]).to_dict()
    assert none["status"] == "not_identifiable" and none["M"] is None and none["stderr"] is None and none["why"]
