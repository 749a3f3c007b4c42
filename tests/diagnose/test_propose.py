"""Proposed motions: causes that a dull motion confuses are told apart, and what no motion tells is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.diagnose import diagnose, propose_motion
from tau_dyn.diagnose.proposal.design import (
    Setting,
    build_planned_motion,
    compute_columns,
    flatten_noise_spectrum,
)
from tau_dyn.diagnose.proposal.plan import (
    CauseHypothesis,
    DesignGoal,
    build_design_scene,
    build_discrimination_plan,
    find_design_goal,
)
from tau_dyn.diagnose.proposal.propose import build_candidate_pieces
from tau_dyn.effects import DriveGain, QuadraticDrag, Stribeck
from tau_dyn.estimate import Autoregression, fit_autoregression
from tau_dyn.evidence import Diagnosis, Finding
from tau_dyn.excitation import choose_by_exchange
from tau_dyn.identify import build_model
from tau_dyn.log import Log, lowpass
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import load_robot
from tau_dyn.simulate import Trajectory, build_slow_motion, describe_exceeded_limit

robot = load_robot("linear_axis")
model = build_model(robot, "asymmetric")
JOINT, UNIT = robot.actuated[0], robot.force_units[0]
PEAK, SPEED = 3.0, 0.02  # [N], [m/s] of the hidden Stribeck friction
NOISE = 2.0  # [N] at 500 Hz


def hidden(v: np.ndarray) -> np.ndarray:
    """Return Stribeck friction (N,) [N]."""
    return PEAK * np.sign(v) * np.exp(-np.abs(v) / SPEED)


def record(motion: Trajectory, seed: int, strength: float = 1.0) -> Log:
    """Return a log at 500 Hz of 95 kg with Coulomb and viscous friction and the hidden one, written without the library."""
    rng = np.random.default_rng(seed)
    t, q, v, a = motion.t[::2], motion.q[::2, 0], motion.v[::2, 0], motion.a[::2, 0]
    tau = 95 * a + 8 * np.sign(v) + 30 * v + strength * hidden(v) + NOISE * rng.standard_normal(len(t))
    return Log(t, {f"q_{JOINT}": q + 2e-6 * rng.standard_normal(len(t)), f"tau_{JOINT}": tau}, motion.name)


def told(motion: Trajectory, x: np.ndarray, rival: np.ndarray) -> float:
    """Return by plain least squares what baseline and a rival leave of a force (N,), in a second of white noise [1/s]."""
    v, a = motion.v[:, 0], motion.a[:, 0]
    here = np.abs(v) > 0.005
    columns = [a, v * (v > 0), v * (v < 0), 1.0 * (v > 0), 1.0 * (v < 0), rival]
    B = np.column_stack(columns)[here]
    B = B / np.maximum(np.linalg.norm(B, axis=0), 1e-300)
    left = x[here] - B @ np.linalg.lstsq(B, x[here], rcond=1e-10)[0]
    return float(left @ left) / NOISE**2 / 2 / motion.duration  # the noise is white at 500 Hz, motions stand at 1 kHz


@pytest.fixture(scope="module")
def dull() -> Trajectory:
    """A slow circle of at most 0.06 m/s."""
    return build_slow_motion(model, 40.0, 0, speed=0.06)


@pytest.fixture(scope="module")
def log(dull) -> Log:
    """Its log."""
    return record(dull, 0)


@pytest.fixture(scope="module")
def confused(log) -> Diagnosis:
    """What the dull motion lets one say."""
    return diagnose(robot, [log])


@pytest.fixture(scope="module")
def motion(confused, log) -> Trajectory:
    """What is proposed to tell more."""
    return propose_motion(confused, [log], duration=40, seed=0)


def _finding(effect, value: float, twins: tuple[str, ...], status="confirmed") -> Finding:
    p = Parameters([replace(p, value=value) for p in effect.parameters])
    return Finding(effect.name, effect.joints, status, 50.0, 1e-9, tuple(p), None, twins, "", "", "", (effect,))


def test_a_dull_motion_confuses_what_the_proposed_one_tells(confused, log, dull, motion):
    """Below 0.06 m/s a drag and a Stribeck term bend the friction law alike; the proposal shows where they part."""
    names = {f.cause for f in confused.findings}
    twins = {t for f in confused.findings for t in f.indistinguishable_from}
    assert {"stribeck", "quadratic_drag"} <= names | twins and "stribeck" in twins | names and twins
    v, before = motion.v[:, 0], dull.v[:, 0]
    assert told(motion, hidden(v), v * np.abs(v)) > 10 * told(dull, hidden(before), before * np.abs(before))
    answer = diagnose(robot, [record(motion, 10)])
    assert answer.findings[0].cause == "stribeck" and answer.findings[0].status == "confirmed"
    assert "quadratic_drag" not in answer.findings[0].indistinguishable_from
    peak = next(p for p in answer.findings[0].parameters if p.name == f"{JOINT}.stribeck")
    assert abs(peak.value - PEAK) < 4 * (peak.stderr or 0)


def test_notes_say_how_sure_the_answer_will_be(motion):
    """Both causes are taken as true in turn, and lambda is given beside that of the measured motion."""
    for one, other in (("stribeck", "quadratic_drag"), ("quadratic_drag", "stribeck")):
        note = next(n for n in motion.notes if n.startswith(f"if {one} is the cause") and f"from {other}: " in n)
        assert "noncentrality" in note and "over 99 %" in note and "the measured motion" in note


def test_the_motion_can_be_driven(motion, confused, tmp_path):
    """It has the length asked for, starts and ends at rest at home, keeps within the robot's limits, and survives its file."""
    assert describe_exceeded_limit(confused.extended_model, motion) is None
    assert motion.duration == pytest.approx(40, rel=0.02) and np.allclose(motion.v[[0, -1]], 0, atol=1e-5)
    assert_allclose(motion.q[[0, -1]], np.tile(robot.home, (2, 1)), atol=1e-9)
    motion.to_csv(tmp_path / "m.csv")
    again = Trajectory.from_csv(tmp_path / "m.csv", robot.actuated)
    assert_allclose(again.a, motion.a, atol=1e-8)


def test_the_seed_gives_the_motion(confused):
    """The same seed proposes the same motion, another seed another one."""
    one, two, other = (propose_motion(confused, duration=12, trials=4, seed=s) for s in (3, 3, 4))
    assert np.array_equal(one.q, two.q) and not np.array_equal(one.q, other.q)
    assert not any("the measured motion" in note for note in one.notes)  # nothing to compare with was given


def test_lambda_is_what_least_squares_leaves(confused):
    """By Schur complements of a Gram matrix comes the same lambda as by projecting rows, at the rival's worst setting."""
    setting = Setting.of(confused)
    setting = replace(setting, noise=(Autoregression(np.zeros(0), setting.noise[0].variance),))
    drag = QuadraticDrag((JOINT,), (UNIT,))
    suspect = CauseHypothesis("quadratic_drag", (drag,), Parameters([replace(p, value=200.0) for p in drag.parameters]))
    motion, counts = build_planned_motion(setting, build_slow_motion(model, 20.0, 1, speed=0.1))
    plan = build_discrimination_plan(
        setting, DesignGoal(((suspect, "stribeck"),)), build_design_scene(setting, [motion], frozenset())
    )
    (found,) = plan.strengths(plan.gram([(motion, counts)]))
    used, sigma = counts[:, 0], np.sqrt(setting.noise[0].variance)
    B = compute_columns(setting, motion, (), ())[used, 0] / sigma
    x = compute_columns(setting, motion, (), [((drag,), suspect.values)])[used, 0, -1] / sigma
    left = []
    for effect in plan.lines[0].instead.groups[0]:
        own = compute_columns(setting, motion, (), [((effect,), None)])[used, 0, -len(effect.parameters) :]
        A = np.column_stack([B, own / sigma])
        A = A / np.maximum(np.linalg.norm(A, axis=0), 1e-300)
        amplitude = np.linalg.lstsq(A, x, rcond=1e-10)[0]
        if amplitude[-1] > 0:
            left.append(float(np.sum((x - A @ amplitude) ** 2)))
    rate = (len(motion.t) - 1) / (motion.t[-1] - motion.t[0])
    assert min(left) < 0.5 * max(left)  # settings matter
    assert_allclose(found, min(left) * setting.rate_hz / rate, rtol=1e-3)


def test_the_exchange_finds_the_best_combination(confused):
    """Of all pairs out of eight pieces the exchange finds one that is as good as the best, to 2 %."""
    setting = Setting.of(confused)
    peak, drag = Stribeck((JOINT,), (UNIT,), speed=SPEED), QuadraticDrag((JOINT,), (UNIT,))
    values = [Parameters([replace(p, value=x) for p in e.parameters]) for e, x in ((peak, PEAK), (drag, 5.0))]
    pairs = (
        (CauseHypothesis("stribeck", (peak,), values[0]), "quadratic_drag"),
        (CauseHypothesis("quadratic_drag", (drag,), values[1]), "stribeck"),
    )
    pieces = build_candidate_pieces(model, 10.0, 8, np.random.default_rng(2))
    motions = [build_planned_motion(setting, piece) for piece in pieces]
    plan = build_discrimination_plan(
        setting, DesignGoal(pairs), build_design_scene(setting, [m for m, _ in motions], frozenset())
    )
    grams = np.array([plan.gram([piece]) for piece in motions])
    most = plan.most(grams)
    every = [plan.merit(grams[i] + grams[j], most) for i in range(8) for j in range(i, 8)]
    first, second = choose_by_exchange(lambda total: plan.merit(total, 2 * most), grams, 2)
    assert plan.merit(grams[first] + grams[second], most) > 0.98 * max(every) > 1.5 * np.median(every)


def test_the_noise_goes_on_above_the_low_pass(rng):
    """White noise that a low-pass took the upper end of counts as white again, of the density it has below."""
    x = rng.standard_normal(200_000)
    cut = fit_autoregression([lowpass(x, 40.0, 100.0)], 8)
    whole = flatten_noise_spectrum(cut)
    response = np.abs(1 - np.exp(-2j * np.pi * np.outer([0.02, 0.1, 0.3, 0.48], np.arange(1, 9))) @ whole.phi) ** -2.0
    shape = response / response[0]
    assert_allclose(shape, 1, atol=0.4)
    assert whole.variance == pytest.approx(1, rel=0.1) and cut.variance < 0.9


def test_what_was_not_shown_is_shown(dull):
    """Where nothing is found, the motion shows what the slow one could not: a drag is seen at a fraction of the size."""
    nothing = diagnose(robot, [record(dull, 5, strength=0.0)])
    assert not [f for f in nothing.findings if f.effects]
    better = propose_motion(nothing, [record(dull, 5, strength=0.0)], duration=40, seed=1)
    v, before = better.v[:, 0], dull.v[:, 0]
    constant, slow_constant = np.zeros_like(v), np.zeros_like(before)
    gained = told(better, v * np.abs(v), constant) / told(dull, before * np.abs(before), slow_constant)
    assert gained > 100 and any("quadratic_drag" in note for note in better.notes)


@pytest.mark.parametrize(
    ("cause", "twins", "experiment"),
    [("drive_gain", ("payload",), "weigh"), ("payload", ("link_mass", "drive_gain"), "weigh")],
)
def test_numbers_that_no_motion_settles_are_refused(confused, cause, twins, experiment):
    """A payload and a drive's gain scale the forces of every motion alike; a weighing is named instead."""
    p = Parameter("drive.gain", 1.2, "1")
    finding = Finding(cause, (), "parameter", 50.0, 1e-9, (p,), None, twins, "", "", "weigh the plate")
    with raises_code("no_solution", f"{cause}") as refusal:
        propose_motion(replace(confused, findings=(finding,), verdict="cannot_tell"), duration=12, trials=4)
    assert experiment in refusal.value.experiment


def test_equal_effects_are_refused(confused):
    """A gain beside a model that is all masses and friction is nothing that any motion shows: lambda is zero, and it says so."""
    gain = _finding(DriveGain((JOINT,), (UNIT,)), 0.1, ("quadratic_drag",))
    with raises_code("no_solution", "drive_gain", "quadratic_drag"):
        propose_motion(replace(confused, findings=(gain,)), duration=12, trials=6)


def test_a_twin_by_law_is_named_beside_one_that_motion_tells(confused):
    """Of two twins one may be a matter of motion and the other not: the motion is for the one, the note for the other."""
    finding = _finding(QuadraticDrag((JOINT,), (UNIT,)), 100.0, ("stribeck", "resolver_error"))
    motion = propose_motion(replace(confused, findings=(finding,)), duration=12, trials=6)
    assert any("from stribeck: noncentrality" in note for note in motion.notes)
    assert any(note.startswith("no motion separates quadratic_drag from resolver_error") for note in motion.notes)


def test_suspects_are_told_from_each_other(confused):
    """Of two causes that held-out data left open each one is the other's rival; one alone is told from chance."""
    drag = _finding(QuadraticDrag((JOINT,), (UNIT,)), 100.0, (), "suspected")
    peak = _finding(Stribeck((JOINT,), (UNIT,)), 3.0, (), "suspected")
    both = find_design_goal(replace(confused, findings=(drag, peak)), {"reversal"})
    assert [(s.cause, rival) for s, rival in both.pairs] == [
        ("quadratic_drag", "stribeck"),
        ("stribeck", "quadratic_drag"),
    ]
    alone = find_design_goal(replace(confused, findings=(peak,)), {"reversal"})
    assert [(s.cause, rival) for s, rival in alone.pairs] == [("stribeck", "")]
    sure = find_design_goal(replace(confused, findings=(replace(drag, status="confirmed"), peak)), {"reversal"})
    assert [e.name for e in sure.others] == ["quadratic_drag"]
    elsewhere = find_design_goal(replace(confused, findings=(replace(peak, channel="tool"),)), {"reversal"})
    assert not elsewhere.pairs and elsewhere.causes  # what tool positions show is no question to forces


def test_refusals(confused):
    """A length or a number of trials that cannot be is refused, and so are measurements that are not forces."""
    with raises_code("invalid_value", "6"):
        propose_motion(confused, duration=2)
    with raises_code("invalid_value"):
        propose_motion(confused, trials=0)
    with raises_code("unsupported"):
        propose_motion(replace(confused, channel="tool"))
