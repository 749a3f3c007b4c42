"""Designed motions: exact gradients, limits kept, errors predicted as identification finds them, nothing lost when stopped."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.cli import main
from tau_dyn.estimate import solve_least_squares
from tau_dyn.exceptions import InputError
from tau_dyn.excitation import CRITERIA, ExcitationDesign, Noise, design_motion, estimate_log_noise, predict
from tau_dyn.excitation.bounds import Bounds
from tau_dyn.excitation.design import _generic, _information
from tau_dyn.excitation.search import MotionSearch, Series
from tau_dyn.identify import build_model, build_regression
from tau_dyn.model import Model
from tau_dyn.results import format_percent
from tau_dyn.robot import load_robot
from tau_dyn.simulate import (
    Sensors,
    build_fourier_motion,
    compute_reach,
    compute_top_speed,
    describe_exceeded_limit,
    simulate,
)

SIZES = {"coulomb_pos": 90.0, "coulomb_neg": 70.0, "viscous_pos": 130.0, "viscous_neg": 110.0}


def with_friction(name: str) -> Model:
    """Return a robot with asymmetric friction."""
    model = build_model(load_robot(name), "asymmetric")
    return model.with_values({f"{j}.{k}": x for j in model.robot.actuated for k, x in SIZES.items()})


@pytest.fixture(scope="module")
def axis() -> Model:
    """The linear axis."""
    return with_friction("linear_axis")


@pytest.fixture(scope="module")
def noise(axis) -> Noise:
    """Its sensors."""
    return Noise.given(axis.robot, [5.0], [5e-6])


@pytest.fixture(scope="module")
def design(axis, noise) -> ExcitationDesign:
    """A motion for it."""
    return design_motion(axis, 16.0, 0, noise=noise, trials=5, seconds=30)


def search_of(model: Model, criterion: str, box: np.ndarray | None = None) -> MotionSearch:
    """Return a small search whose bounds are all near."""
    series = Series(model.robot.home, compute_reach(model), 6.0, 4, 2)
    bounds = Bounds.of(model, compute_reach(model), 0.4 * compute_top_speed(model), 0.8 * compute_top_speed(model), box)
    path = _generic(model, series, 48, np.random.default_rng(3))
    information = _information(model, Noise.given(model.robot, [5.0], [5e-6]), 1.0, path)
    prior = information.prior
    return MotionSearch(series, information, bounds, CRITERIA[criterion], prior, 1000.0, 48, time.monotonic() + 60)


def test_a_log_of_twice_the_periods_tells_twice_as_much(axis) -> None:
    """Information counts the samples of the whole log, of which the search evaluates one period."""
    search = search_of(axis, "d")
    longer = replace(search, series=replace(search.series, periods=2 * search.series.periods))
    x = search.series.random(np.random.default_rng(1))
    assert_allclose(longer.matrix(x) - longer.added, 2 * (search.matrix(x) - search.added), rtol=1e-12)


def test_a_series_starts_and_ends_every_period_at_rest_at_home(rng) -> None:
    """Position, speed and acceleration at the ends; speeds are the positions' derivatives."""
    series = Series(np.array([0.3, -0.2]), np.array([0.5, 1.0]), 7.0, 6, 2)
    t = np.linspace(0, 14, 14001)
    path = series.path(series.waves(t), series.random(rng))
    for k in (0, 7000, 14000):
        assert_allclose(path.q[k], series.home, atol=1e-12)
        assert_allclose([path.v[k], path.a[k]], 0, atol=1e-10)
    assert_allclose(np.gradient(path.q, t, axis=0)[1:-1], path.v[1:-1], atol=1e-4)
    assert_allclose(np.gradient(path.v, t, axis=0)[1:-1], path.a[1:-1], atol=1e-3)


@pytest.mark.parametrize("name", CRITERIA)
def test_criteria_know_their_derivative(name: str, rng) -> None:
    """A small change of the information changes the criterion by `sum Gamma dM`; better information is a smaller value."""
    A, dA = rng.standard_normal((2, 9, 4))
    M, dM, scale = A.T @ A * np.outer([1, 3, 9, 27], [1, 3, 9, 27]), dA.T @ dA, np.array([1.0, 2.0, 0.1, 5.0])
    value, gamma = CRITERIA[name](M, scale)
    moved = [CRITERIA[name](M + x * dM, scale)[0] for x in (1e-6, -1e-6)]
    assert_allclose((moved[0] - moved[1]) / 2e-6, np.sum(gamma * dM), rtol=1e-4)
    if name != "condition":
        assert CRITERIA[name](4 * M, scale)[0] < value


@pytest.mark.parametrize("criterion", ["d", "worst"])
def test_the_search_follows_the_exact_gradient(criterion: str, rng) -> None:
    """Information, speeds, forces, conditioning, the tool's box and passive joints, all through one chain rule."""
    model = with_friction("gantry_tau")
    tool = model.mechanism.tool_position(model.robot.home[None])[0]
    search = search_of(model, criterion, np.array([tool - 0.05, tool + 0.05]))
    x = 0.4 * search.series.random(rng)
    names = {e.name for e in search.bounds.of_places(search.series.path(search._waves, x).q) if e.values.max() > -1}
    assert names == {"place", "passive joints"}
    _, slope = search._lagrangian(x.ravel())
    for k in rng.choice(x.size, 4, replace=False):
        step = np.zeros(x.size)
        step[k] = 1e-5
        ahead, back = (search._lagrangian(x.ravel() + s * step)[0] for s in (1, -1))
        assert_allclose(slope[k], (ahead - back) / 2e-5, rtol=2e-3, atol=1e-3 * np.abs(slope).max())


def test_a_design_keeps_its_limits_and_beats_random_motions(axis, noise, design) -> None:
    """Same limits, same time: the largest error falls; it starts and ends at rest at home."""
    motion = design.motion
    assert describe_exceeded_limit(axis, motion, margin=0.04) is None and motion.duration == pytest.approx(
        16.0, abs=0.01
    )
    assert np.abs(motion.a).max() <= 6 * compute_top_speed(axis)[0] * 1.01
    for k in (0, -1):
        assert_allclose(motion.q[k], axis.robot.home, atol=1e-9)
        assert_allclose(motion.v[k], 0, atol=1e-9)
    random = min(predict(axis, build_fourier_motion(axis, 16.0, s), noise).worst[1] for s in range(10))
    assert design.prediction.worst[1] < 0.8 * random and design.values[1] < design.values[0]


def test_predicted_errors_are_those_of_the_experiment(axis, noise, design) -> None:
    """The true robot, driven with controller and sensors and identified: reported errors within 20 % of the predicted."""
    sensors = Sensors(force_noise=5.0, encoder_noise=5e-6)
    log = simulate(axis, design.motion, sensors=sensors, seed=11)
    estimate = solve_least_squares(build_regression(axis, [log]))
    ratio = np.sqrt(np.diag(estimate.cov)) / design.prediction.stderr
    assert 0.8 < np.exp(np.mean(np.log(ratio))) < 1.25  # one draw of the noise moves single ones by up to a fifth
    assert np.all((ratio > 0.7) & (ratio < 1.4))
    z = (estimate.beta_plain - design.prediction.values) / design.prediction.stderr
    assert np.abs(z).max() < 4
    found = estimate_log_noise(axis, log, 1000.0)
    assert_allclose(found.force, 5.0, rtol=0.15)
    assert_allclose(found.encoder, 5e-6, rtol=0.2)


def test_more_noise_is_more_error(axis) -> None:
    """Ten times the force noise, ten times the error, in the mean over draws of it; encoder noise counts as well."""
    motion = build_fourier_motion(axis, 16.0, 3)

    def compute_errors(force: float, encoder: float, seed: int) -> np.ndarray:
        return predict(axis, motion, Noise.given(axis.robot, [force], [encoder]), seed).stderr

    ratios = [compute_errors(50.0, 0.0, seed) / compute_errors(5.0, 0.0, seed) for seed in range(12)]
    assert_allclose(np.exp(np.mean(np.log(ratios))), 10.0, rtol=0.1)  # its colour is fitted anew
    assert np.median(compute_errors(5.0, 2e-4, 0) / compute_errors(5.0, 0.0, 0)) > 1.2


def test_the_tool_stays_in_its_box() -> None:
    """A Gantry-Tau within 10 cm around home, passive joints and all; the box is in the tool's coordinates."""
    model = with_friction("gantry_tau")
    tool = model.mechanism.tool_position(model.robot.home[None])[0]
    box = [*(tool - 0.1), *(tool + 0.1)]
    noise = Noise.given(model.robot, [5.0], [5e-6])
    found = design_motion(model, 8.0, 1, criterion="d", noise=noise, trials=2, box=box, seconds=4)
    places = model.mechanism.tool_position(found.motion.q[::10])
    assert np.all(places > box[:3]) and np.all(places < box[3:]) and np.ptp(found.motion.q, axis=0).min() > 0.02


@pytest.mark.parametrize("how", ["time", "hand"])
def test_a_stopped_search_hands_back_its_best(how: str, axis, noise) -> None:
    """Neither the clock nor Ctrl-C loses the motion; it says that it was stopped."""

    def progress(step: str) -> None:
        if how == "hand" and step.startswith("round 1"):
            raise KeyboardInterrupt

    found = design_motion(axis, 8.0, 0, noise=noise, trials=2, seconds=1e-3 if how == "time" else 30, progress=progress)
    assert not found.finished and "stopped before" in found.motion.notes[-1]
    assert describe_exceeded_limit(axis, found.motion, margin=0.04) is None


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"duration": 1.0}, "between 4 s and an hour"),
        ({"fast_hz": 0.1}, "at least 3"),
        ({"speed": [1.0, 2.0]}, "highest speed must be a positive number"),
        ({"acceleration": [-1.0]}, "highest acceleration must be"),
        ({"strokes": 1.5}, "share of the duration"),
        ({"trials": 0}, "at least one random motion"),
        ({"box": [5.0, 5, 5, 6, 6, 6]}, "does not hold the tool at home"),
    ],
)
def test_what_cannot_be_asked_for_is_a_sentence(options, said: str) -> None:
    """Each wish that contradicts the robot or itself is named."""
    with pytest.raises(InputError, match=said):
        design_motion(with_friction("gantry_tau"), **{"duration": 10.0, **options})
    with raises_code("unknown_name", "criterion"):
        design_motion(with_friction("linear_axis"), 10.0, criterion="e")


def test_noise_must_fit_the_robot(axis) -> None:
    """One number, or one a joint, above zero."""
    with raises_code("wrong_shape", "1"):
        Noise.given(axis.robot, [1.0, 2.0], [0.0])
    with raises_code("invalid_value"):
        Noise.given(axis.robot, [0.0], [0.0])


def test_the_command_predicts(tmp_path, monkeypatch, capsys) -> None:
    """Motion, prediction and report from one command; random trials stay as they were."""
    monkeypatch.chdir(tmp_path)
    common = ["excite", "linear_axis", "--out", "m.csv", "--duration", "8", "--trials", "2", "--json", "r.json"]
    assert main([*common, "--force-noise", "5", "--time", "5", "--report", "r.html"]) == 0
    found = json.loads((tmp_path / "r.json").read_text())
    assert {row["name"] for row in found["predicted"]} >= {"carriage_link.mass", "axis.coulomb_pos"}
    assert found["method"] == "optimal" and found["condition_number"] > 1 and found["noise"]["force"] == [5.0]
    page, streams = (tmp_path / "r.html").read_text(), capsys.readouterr()
    assert "Predicted standard errors" in page and "search: " in streams.out and "criterion 'worst'" not in streams.err
    assert f"(largest relative error {100 * found['worst']['relative_stderr']:.3g} %; of the" in streams.out
    worst = max(100 * row["stderr"] / abs(row["value"]) for row in found["predicted"] if row["value"])
    assert f"predicted standard errors reach {format_percent(worst)} of the value" in page.replace("\u00a0", " ")
    assert main([*common, "--method", "random"]) == 0
    assert "predicted" not in json.loads((tmp_path / "r.json").read_text())
    for more, said in (
        (["--method", "random", "--criterion", "d"], "use --method optimal"),
        (["--encoder-noise", "1e-6"], "needs --force-noise as well"),
        (["--noise-from", "l.csv", "--force-noise", "1"], "excludes --force-noise"),
        (["--noise-from", "l.csv"], "l.csv"),
    ):
        assert main([*common, *more]) == 2
        assert said in capsys.readouterr().err
