"""Choosing poses: each criterion does what it says, exchange never makes a set worse, and predictions come true."""

from __future__ import annotations

import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code
from sampling import assert_scatter

sys.path.insert(0, str(Path(__file__).parent))
from pose_rigs import candidates, l1_geometry

from tau_dyn.calibrate import PoseSet, constrain_parameters, fit_geometry_to_poses
from tau_dyn.calibrate.poses import (
    CalibrationPrediction,
    PoseChoice,
    UniformDevice,
    choose_poses,
    compute_doubling_gain,
    compute_min_poses,
)
from tau_dyn.calibrate.poses.choice import choose_from, predict
from tau_dyn.calibrate.poses.criteria import (
    NAMES,
    PoseExchange,
    build_criterion,
    compute_observability_indices,
    leave_one_out,
)
from tau_dyn.calibrate.poses.design import PoseDesign, build_design, refine
from tau_dyn.calibrate.poses.devices import add_noise, transform_to_device
from tau_dyn.calibrate.poses.monte_carlo import draw_robot, simulate_measurement
from tau_dyn.exceptions import InputError


@pytest.fixture(scope="module")
def design() -> PoseDesign:
    """L1, positions with 0.1 mm."""
    return build_design(l1_geometry(), candidates(), (1e-4,))


def test_frame_of_the_device_takes_six_of_twenty_seven(design: PoseDesign) -> None:
    """Moving robot and device together shows in no measurement: 21 dimensions and 6 of a frame have rank 21."""
    assert len(design.found.names) == 27 and design.found.rank == 21
    assert not design.untold  # what is blind together moves no tool anywhere


@pytest.mark.parametrize("name", NAMES)
def test_each_criterion_beats_chance_at_itself(design: PoseDesign, name: str) -> None:
    """A set chosen by a criterion is better by it than the best of forty random sets."""
    search = PoseExchange(design.whitened(), build_criterion(name, design))
    chosen = choose_from(design, 15, criterion=name).index
    rng = np.random.default_rng(0)
    drawn = [search.value(rng.choice(design.n, 15, replace=False)) for _ in range(40)]
    assert len(np.unique(chosen)) == 15
    assert search.value(chosen) > max(drawn)


def test_exchange_finds_the_best_of_all_sets() -> None:
    """On a problem small enough to try every set, exchange finds the one with the largest determinant."""
    rng = np.random.default_rng(4)
    blocks = rng.standard_normal((11, 1, 3)) * 10
    places = rng.standard_normal((5, 3, 3))
    small = PoseExchange(blocks, build_criterion("determinant", _Fake(places)))  # type: ignore[arg-type]
    best = max(combinations(range(11), 5), key=lambda s: small.value(np.array(s)))
    start = np.array([0, 1, 2, 3, 4])
    found = small.exchanged(start)
    assert small.value(found) >= small.value(start)
    assert tuple(found) == best


class _Fake:
    def __init__(self, places: np.ndarray) -> None:
        self.places = places


def test_gradients_are_what_a_pose_adds_to_first_order(design: PoseDesign) -> None:
    """A criterion's gradient ranks small additions of information as its value does."""
    m = PoseExchange(design.whitened(), build_criterion("tool", design)).information(np.arange(0, design.n, 5))
    blocks = design.whitened()[:12] * 1e-3
    for name in ("tool", "determinant"):
        c = build_criterion(name, design)
        exact = [float(c.value(m + b.T @ b) - c.value(m)) for b in blocks]
        linear = [float(np.trace(b @ c.gradient(m) @ b.T)) for b in blocks]
        ratio = np.array(exact) / np.array(linear)
        assert np.allclose(ratio, ratio[0], rtol=1e-3)


def test_same_seed_same_poses(design: PoseDesign) -> None:
    """The choice is a function of its input and its seed."""
    a, b = (choose_from(design, 14, seed=7).index for _ in range(2))
    assert np.array_equal(a, b)


@pytest.mark.parametrize("n", [12, 30])
def test_predicted_accuracy_comes_true(design: PoseDesign, n: int) -> None:
    """Over two dozen simulated campaigns the tool's error agrees with the prediction within 15 %, and scatters so."""
    choice, device = choose_from(design, n), UniformDevice((1e-4,))
    geometry, errors = l1_geometry(), []
    for rng in np.random.default_rng(11).spawn(24):
        theta = draw_robot(geometry, design.q, 0.1 * design.unknowns.scales[:21], rng)
        fitted = fit_geometry_to_poses(geometry, simulate_measurement(device, geometry, theta, choice.q, rng))
        truth = PoseSet(design.q, transform_to_device(device.frames, geometry.forward(theta, design.q).poses).position)
        errors.append(fitted.errors(truth).position_size.rms)
    made = choice.predicted
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(made.rms, rel=0.15)
    assert_scatter(np.array(errors), made.scatter)


def test_chosen_poses_are_worth_more_than_random_ones(design: PoseDesign) -> None:
    """Twenty chosen poses calibrate better than twenty random ones ever do in thirty draws."""
    rng = np.random.default_rng(1)
    chosen = choose_from(design, 20).predicted.rms
    assert chosen < min(predict(design, rng.choice(design.n, 20, replace=False)).rms for _ in range(30))


def test_more_poses_never_hurt_and_are_worth_less_and_less(design: PoseDesign) -> None:
    """Predicted errors fall with every pose, the held-out one towards the device's noise."""
    curve = choose_from(design, 60).curve
    rms = [row.rms for row in curve]
    assert all(a > b for a, b in zip(rms[:-1], rms[1:], strict=True))
    assert all(row.held_out > 1e-4 * np.sqrt(3) for row in curve)
    assert compute_doubling_gain(curve[-1]) < 0.25 * compute_doubling_gain(curve[0])


def test_auto_stops_where_the_gain_falls_below_the_threshold(design: PoseDesign) -> None:
    """One pose less and twice as many would still be worth the threshold; a smaller threshold asks for more poses."""
    loose, tight = choose_from(design, gain=0.06), choose_from(design, gain=0.03)
    assert compute_min_poses(design) <= loose.n < tight.n
    assert compute_doubling_gain(loose.curve[-1]) < 0.06 <= compute_doubling_gain(loose.curve[-2])


def test_an_accuracy_asked_for_sets_the_number(design: PoseDesign) -> None:
    """With a target the number of poses grows as the target's inverse square, and the prediction meets it."""
    coarse, fine = choose_from(design, target=1.2e-4), choose_from(design, target=0.8e-4)
    assert fine.predicted.rms <= 0.8e-4 and coarse.predicted.rms <= 1.2e-4
    assert coarse.n < fine.n


def test_the_thesis_rule_picks_single_poses_not_sets(design: PoseDesign) -> None:
    """Poses ranked each by itself (5.9) lie close together and are worth less than those chosen as a set."""
    ranked = leave_one_out(design.whitened(), 20)
    assert predict(design, ranked).rms > 1.5 * choose_from(design, 20).predicted.rms


def test_repeated_measurement_halves_the_variance(design: PoseDesign) -> None:
    """Half the noise is half the predicted error, for the model is linear in small errors."""
    fine = build_design(l1_geometry(), candidates(), (0.5e-4,))
    index = np.arange(0, design.n, 4)
    assert predict(fine, index).rms == pytest.approx(0.5 * predict(design, index).rms, rel=1e-6)


def test_uneven_noise_is_predicted_for_both_kinds_of_fit() -> None:
    """Where one axis is measured ten times worse, plain and weighted fits are as accurate as predicted, weighted better."""
    geometry, q = l1_geometry(), candidates()[::2]
    cov = np.repeat(np.diag([1e-4, 1e-4, 1e-3])[None] ** 2, len(q), axis=0)
    index, places = np.arange(0, len(q), 2), geometry.forward(geometry.parameters.values, q).poses
    made, errors = {}, {False: [], True: []}
    for weighted in errors:
        made[weighted] = predict(build_design(geometry, q, cov, weighted=weighted), index).rms
    for rng in np.random.default_rng(5).spawn(16):
        measured = add_noise(places.take(index), cov[index], rng)
        plain = fit_geometry_to_poses(geometry, PoseSet(q[index], measured.position))
        for weighted, fitted in ((False, plain), (True, refine(plain, cov[index]))):
            errors[weighted].append(fitted.errors(PoseSet(q, places.position)).position_size.rms)
    for weighted, reached in errors.items():
        assert np.sqrt(np.mean(np.square(reached))) == pytest.approx(made[weighted], rel=0.25)
    assert made[True] < 0.75 * made[False]


def test_covariance_is_that_of_the_estimator() -> None:
    """A fit that weighs all alike is a linear map of the measurements; its covariance is theirs through that map."""
    q = candidates()[::6]
    cov = np.repeat(np.diag([1e-4, 3e-4, 1e-3])[None] ** 2, len(q), axis=0) * np.linspace(0.2, 4, len(q))[:, None, None]
    design = build_design(l1_geometry(), q, cov)
    flat = design.slopes.reshape(-1, 21)
    estimator = np.linalg.pinv(flat)  # one block of positions: its weight cancels
    noise = np.zeros((len(flat), len(flat)))
    for k, s in enumerate(cov):
        noise[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = s
    assert np.allclose(design.covariance(np.arange(len(q))), estimator @ noise @ estimator.T, rtol=1e-6, atol=1e-12)


def test_doubling_leaves_the_noise() -> None:
    """Twice the poses halve the model's variance and leave the device's: of equal parts 13 % of the error go."""
    made = CalibrationPrediction(20, 1.0, 0.1, 1.5, float(np.sqrt(2)), float("nan"), np.zeros(3))
    assert compute_doubling_gain(made) == pytest.approx(1 - np.sqrt(1.5 / 2))


def test_what_the_candidates_do_not_tell_is_named() -> None:
    """With cart 3 always at one place its guideway's direction is blind; candidates elsewhere would have told it."""
    q = candidates().copy()
    still = q[np.abs(q[:, 2] - np.median(q[:, 2])) < 0.15]
    still[:, 2] = np.median(q[:, 2])
    design = build_design(l1_geometry(), still, (1e-4,), workspace=candidates())
    assert any("arm3" in name for name, _ in design.untold)
    choice = choose_from(design, 12)
    assert any("no candidate shows" in text for text in choice.warnings)
    assert any(name.startswith("arm3.") for name in choice.not_identifiable)


def test_indices_are_singular_values_of_the_jacobian() -> None:
    """Condition number and amplification index follow from the singular values, the index not upside down."""
    s = np.array([5.0, 2.0, 0.5])
    found = compute_observability_indices(np.diag(s**2))
    assert found["condition_number"] == pytest.approx(10)
    assert found["noise_amplification_index"] == pytest.approx(0.5**2 / 5)


def test_result_names_everything() -> None:
    """The result holds the indices, the curve, standard errors by name, and what stays nominal."""
    choice: PoseChoice = choose_poses(l1_geometry(), candidates(), 12)
    result = choice.to_dict()
    assert result["chosen"] == 12 and len(result["criterion"]["trace"]) == 13
    assert set(result["predicted"]["stderr"]) == set(choice.design.names)
    assert len(result["identifiability"]["not_identifiable"]) == 6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"candidates": candidates()[:5]}, "at least 10 are needed"),
        ({"n": 4}, "need at least 8"),
        ({"candidates": np.full((30, 3), np.nan)}, "not finite"),
        ({"candidates": np.zeros((30, 2))}, "cart1, cart2, cart3"),
        ({"noise": (0.0,)}, "above zero"),
        ({"noise": (float("nan"),)}, "above zero"),
        ({"gain": 2.0}, "between 0 and 1"),
        ({"target": -1.0}, "above zero"),
        ({"candidates": np.vstack([candidates(), [[9.0, 0.0, 0.0]]])}, "leave the others out"),
    ],
)
def test_faulty_input_is_a_sentence(change: dict, message: str) -> None:
    """What cannot be chosen from is refused with the reason and what would be right."""
    given = {"candidates": candidates(), "n": "auto"} | change
    q, n = given.pop("candidates"), given.pop("n")
    with pytest.raises(InputError, match=message):
        choose_poses(l1_geometry(), q, n, **given)


def test_unknown_criterion_lists_the_others(design: PoseDesign) -> None:
    """A criterion that does not exist names those that do."""
    with raises_code("unknown_name", "amplification"):
        choose_from(design, 12, criterion="best")


def test_nothing_free_is_refused() -> None:
    """A geometry without free parameters, frames known, leaves nothing to choose for."""
    names = l1_geometry().parameters.names
    with raises_code("invalid_value"):
        build_design(constrain_parameters(l1_geometry(), {}, names), candidates(), (1e-4,), device=False)
