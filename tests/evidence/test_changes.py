"""A sign, a gain, friction, a tool or the base that changes inside a log is found with its time; sound logs have no change."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest

from tau_dyn.estimate import Preparation, Regression, RegressionRun
from tau_dyn.evidence import describe_changes, find_changes, list_changes
from tau_dyn.evidence.change_points.log_data import Hypothesis, LogData
from tau_dyn.evidence.change_points.step import Step
from tau_dyn.message_codes import format_warnings, get_code
from tau_dyn.parameters import Parameter, Parameters

RATE_HZ, DURATION_S, NOISE = 12.5, 40.0, 0.05
LATE_S = 24.0
NAMES = [f"{j}.{n}" for j in ("j1", "j2") for n in ("inertia", "load", "coulomb_pos", "coulomb_neg", "viscous")]
TRUE = np.array([2.0, 10.0, 1.5, 1.2, 0.8, 0.7, 5.0, 1.0, 1.1, 0.4])


def make_regression(seed: int = 0, duration_s: float = DURATION_S) -> Regression:
    """Return the regression of two joints with a load, inertia and friction of their own, with white noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(duration_s * RATE_HZ)) / RATE_HZ
    f, size, phase = rng.uniform(0.08, 0.8, (5, 2)), rng.uniform(0.2, 0.5, (5, 2)), rng.uniform(0, 6.28, (5, 2))
    w = 2 * np.pi * f
    angle = w * t[:, None, None] + phase
    size = size / np.sqrt(f / 0.08)
    q = np.sum(size * np.sin(angle), axis=1)
    v = np.sum(size * w * np.cos(angle), axis=1)
    a = -np.sum(size * w**2 * np.sin(angle), axis=1)
    W = np.zeros((len(t), 2, len(NAMES)))
    for k in range(2):
        own = [a[:, k], np.cos(q[:, k]), v[:, k] > 0, -1.0 * (v[:, k] < 0), v[:, k]]
        W[:, k, 5 * k : 5 * k + 5] = np.stack(own, axis=1)
    y = W @ TRUE + NOISE * rng.standard_normal((len(t), 2))
    usable = np.abs(v) > 0.02
    run = RegressionRun("log.csv", t, W, y, usable, W, y, {"q": q, "v": v, "a": a})
    parameters = Parameters(Parameter(name, 1.0, "1") for name in NAMES)
    band = Preparation(40.0, 5.0, RATE_HZ, np.full(2, 0.02), 0.05)
    return Regression(parameters, ("j1", "j2"), ("N m", "N m"), (run,), band)


def add_force(regression: Regression, force: np.ndarray) -> Regression:
    """Return the regression with another force (n, 2) added to the measured one."""
    run = regression.runs[0]
    return replace(regression, runs=(replace(run, y=run.y + force, y_all=run.y_all + force),))


def is_late(regression: Regression, time_s: float = LATE_S) -> np.ndarray:
    """Return which samples (n, 1) come after a time."""
    return (regression.runs[0].t > time_s)[:, None]


def test_the_time_at_which_a_force_changes_its_sign_is_found():
    """The common fit of both signs is useless; the joint, the time and the factor of -1 are found all the same."""
    clean = make_regression()
    y = clean.runs[0].y
    turned = add_force(clean, np.where(is_late(clean) & [False, True], -2 * y, 0.0))
    (found,) = find_changes(turned)
    assert (found.kind, found.joint, found.before) == ("sign", "j2", 1.0)
    assert found.time_s == pytest.approx(LATE_S, abs=0.2)
    assert found.after == pytest.approx(-1.0, abs=0.05)


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_a_gain_that_changes_is_found_with_its_factor(factor):
    """A drive whose force falls or rises by a fifth from one sample to the next has a changed gain."""
    clean = make_regression(1)
    scaled = add_force(clean, np.where(is_late(clean) & [True, False], (factor - 1) * clean.runs[0].y, 0.0))
    (found,) = find_changes(scaled)
    assert (found.kind, found.joint) == ("gain", "j1")
    assert found.time_s == pytest.approx(LATE_S, abs=0.2)
    assert found.after == pytest.approx(factor, abs=0.02)


def test_a_brake_that_starts_to_drag_is_friction_and_a_constant_force_is_none():
    """A Coulomb force opposes motion in both directions; a constant force does not."""
    clean = make_regression(2)
    v = clean.runs[0].signals["v"]
    (brake,) = find_changes(add_force(clean, is_late(clean) * [1.0, 0.0] * np.sign(v)))
    (pull,) = find_changes(add_force(clean, is_late(clean) * [1.0, 0.0]))
    assert (brake.kind, brake.joint, pull.kind, pull.joint) == ("friction", "j1", "offset", "j1")
    assert brake.after - brake.before == pytest.approx(1.0, abs=0.1)
    assert brake.before == pytest.approx(1.35, abs=0.15)
    assert pull.after == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("start_s", "end_s"), [(8.0, 16.0), (20.0, 28.0)])
def test_a_brake_that_drags_for_a_while_begins_and_ends(start_s: float, end_s: float):
    """Neither step holds alone, because the force is the same before and after; each holds with the other in the model."""
    clean = make_regression(4)
    within = is_late(clean, start_s) & ~is_late(clean, end_s)
    begins, ends = find_changes(add_force(clean, within * [1.0, 0.0] * np.sign(clean.runs[0].signals["v"])))
    assert {(one.kind, one.joint) for one in (begins, ends)} == {("friction", "j1")}
    assert (begins.time_s, ends.time_s) == (pytest.approx(start_s, abs=0.5), pytest.approx(end_s, abs=0.5))
    assert begins.after - begins.before == pytest.approx(1.0, abs=0.1)
    assert ends.after - ends.before == pytest.approx(-1.0, abs=0.1)


def test_a_brake_on_a_vertical_slide_is_found_beside_its_weight():
    """The weight of a slide is a constant force and no part of its friction, with which a change of friction is compared.

    With the drive's inertia free, a fit cannot separate the weight from a difference of both Coulomb values.
    """
    clean = make_regression(2)
    (run,) = clean.runs
    W = run.W.copy()
    W[:, 0, 0], W[:, 0, 1] = 0.1 * W[:, 0, 0] + 9.81, 0.1 * W[:, 0, 0]  # a mass that hangs, and a drive inertia
    run = replace(run, W=W, W_all=W, y=run.y + (W - run.W) @ TRUE)
    drag = is_late(clean) * [0.8, 0.0] * np.sign(run.signals["v"])
    (brake,) = find_changes(add_force(replace(clean, runs=(run,)), drag))
    assert (brake.kind, brake.joint) == ("friction", "j1")
    assert brake.after - brake.before == pytest.approx(0.8, abs=0.1)


def test_a_tool_that_is_picked_up_loads_all_joints_at_once():
    """One body explains the change at both joints; no joint gets a change of its own."""
    clean = make_regression(3)
    q = clean.runs[0].signals["q"]
    columns = np.stack([np.cos(q), np.cos(q.sum(axis=1, keepdims=True)) * [1.0, 0.5]], axis=2)
    (found,) = find_changes(add_force(clean, is_late(clean) * (columns @ [1.5, 0.5])), {"payload": [columns]})
    assert (found.kind, found.joint, found.unit) == ("payload", "", "kg")
    assert found.after == pytest.approx(1.5, abs=0.1)


@pytest.mark.parametrize(("reach", "n_found"), [(0.02, 0), (1.0, 2)])
def test_a_body_that_hardly_moves_a_force_for_a_while_is_no_change(reach: float, n_found: int):
    """A body of 10 kg at a place where it exerts 0.2 N m explains an error of the model; where it exerts 10 N m it is carried."""
    clean = make_regression(4)
    within = is_late(clean, 20.0) & ~is_late(clean, 28.0)
    column = np.where(within, reach, 1.0) * np.cos(3 * clean.runs[0].t)[:, None] * [1.0, 0.0]
    found = find_changes(add_force(clean, 10.0 * within * column), {"payload": [column[:, :, None]]})
    assert len(found) == n_found and all(one.kind == "payload" for one in found)


@pytest.mark.parametrize("seed", [3, 4, 7])
def test_a_torque_constant_that_is_wrong_throughout_is_no_change(seed):
    """The forearm loads both joints; currents by another constant at one of them contradict it from the first sample on."""
    clean = make_regression(seed, 60.0)
    (run,) = clean.runs
    q, a = run.signals["q"], run.signals["a"]
    forearm = 8.0 * np.cos(q.sum(axis=1)) + 1.5 * a.sum(axis=1)
    shared = np.repeat(forearm[:, None, None], 2, axis=1)
    W = np.concatenate([run.W, shared], axis=2)
    parameters = Parameters([*clean.parameters, Parameter("forearm", 1.0, "1")])
    y = (run.y + shared[:, :, 0]) * [1.0, 1.2]
    run = replace(run, W=W, W_all=W, y=y, y_all=y)
    assert find_changes(replace(clean, runs=(run,), parameters=parameters)) == ()


def test_two_changes_in_one_log_are_both_found():
    """A gain of one joint and a sign of the other change at times of their own."""
    clean = make_regression(4)
    y = clean.runs[0].y
    found = find_changes(
        add_force(clean, is_late(clean, 12.0) * [-0.3, 0.0] * y + is_late(clean, 26.0) * [0.0, -2.0] * y)
    )
    assert [(one.kind, one.joint, round(one.time_s)) for one in found] == [("gain", "j1", 12), ("sign", "j2", 26)]


def test_friction_that_warms_up_is_a_drift_and_no_change():
    """Coulomb friction that falls by two fifths while the gear warms up fits an exponential better than a step."""
    clean = make_regression(5)
    t, v = clean.runs[0].t[:, None], clean.runs[0].signals["v"]
    assert find_changes(add_force(clean, 0.6 * np.exp(-t / 8.0) * np.sign(v))) == ()


@pytest.mark.parametrize("seed", range(6, 10))
def test_sound_logs_with_friction_that_the_model_lacks_have_no_change(seed):
    """Stribeck friction and friction that depends on position leave a residual, at every time alike."""
    clean = make_regression(seed)
    q, v = clean.runs[0].signals["q"], clean.runs[0].signals["v"]
    rough = np.sign(v) * (0.6 * np.exp(-np.abs(v) / 0.1) + 0.2 * np.sin(9 * q))
    assert find_changes(clean) == ()
    assert find_changes(add_force(clean, rough)) == ()


def test_another_load_in_another_log_is_no_change_within_a_log():
    """Each log is tested by itself."""
    one, other = make_regression(10, 30.0), make_regression(11, 30.0)
    loaded = replace(add_force(other, 3.0 * np.cos(other.runs[0].signals["q"])).runs[0], name="loaded.csv")
    assert find_changes(replace(one, runs=(one.runs[0], loaded))) == ()


def test_a_log_too_short_for_its_columns_has_no_change():
    """Six seconds of two joints hold fewer rows than a test needs."""
    assert find_changes(make_regression(12, 6.0)) == ()


def test_a_change_is_told_with_code_joint_and_time():
    """JSON holds the time twice: with everything else about the change, and in a list of times alone."""
    clean = make_regression()
    turned = add_force(clean, np.where(is_late(clean) & [False, True], -2 * clean.runs[0].y, 0.0))
    found = find_changes(turned)
    (sentence,) = describe_changes(found)
    assert get_code(sentence) == "changes_within_log"
    assert "log.csv: j2: the force changes its sign at t = 24" in sentence
    assert format_warnings([sentence])["warning_joints"] == {"changes_within_log": ["j2"]}
    fields = list_changes(found)
    assert fields["time_s"] == [fields["changes"][0]["time_s"]]
    assert list_changes(()) == {}


def test_a_step_in_exact_forces_has_a_time():
    """Statistics of exact data are so large that a chi-square is lost in their digits; a time is returned all the same."""
    clean = make_regression()
    run = clean.runs[0]
    exact = replace(clean, runs=(replace(run, y=run.W @ TRUE, y_all=run.W @ TRUE),))
    for change in find_changes(add_force(exact, np.where(is_late(clean) & [False, True], 500.0, 0.0))):
        assert change.time_s == pytest.approx(LATE_S, abs=1.0)


def test_a_sign_that_makes_the_joints_own_fit_worse_is_no_change(monkeypatch):
    """Joints share bodies: another sign of one joint may help those of a poor model, but not its own force."""
    changes = importlib.import_module("tau_dyn.evidence.changes")
    clean = make_regression(4)
    turned = add_force(clean, np.where(is_late(clean) & [False, True], -2 * clean.runs[0].y, 0.0))
    step = Step(LATE_S, 0.1, -1.0, np.zeros(0), 1e-12, np.inf, 0, 20)
    monkeypatch.setattr(changes, "fit_step", lambda data, hypothesis, time_s: step)
    flipped = Hypothesis("sign", 1, ())
    for regression, is_change in ((clean, False), (turned, True)):
        found, _ = changes._test(LogData(regression), flipped, LATE_S, 10)
        assert (found is not None) is is_change
