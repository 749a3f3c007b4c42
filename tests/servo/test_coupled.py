"""Loops of coupled joints against an independent simulator, stops within a step, and what intervals hold."""

import numpy as np
import pytest
from tests.servo.arms import build_arm, build_commands, build_law, build_link, build_truth, record
from tests.servo.coupled import PlanarArms

from tau_dyn.identify import Choices
from tau_dyn.servo import identify_loop
from tau_dyn.servo.data import Mixing
from tau_dyn.servo.loads import InertialSpace, compute_load_waves
from tau_dyn.servo.loop import simulate_motion
from tau_dyn.servo.records import build_records, build_waves
from tau_dyn.servo.simulation import read_values
from tau_dyn.servo.waves import Trials
from tau_dyn.simulate import ServoLaw


@pytest.mark.parametrize(("joints", "mass", "seconds"), [(3, 0.15, 4.0), (6, 0.05, 1.0)])
def test_coupled_joints_move_as_one_system(joints, mass, seconds):
    """Joints whose loads are taken along the motion that they simulate move as the solution of all equations at once."""
    arm, one = build_arm(joints, mass), np.ones((joints, 1))
    motion = build_commands(arm, 0, seconds)
    together = PlanarArms(
        0.12, mass * one, 0.07 * one, 2e-4 * one, 0.012 * one, 0.06 * one, 0.02 * one, 0.2 * one, 0.01 * one, 0.05,
        2.65 * one, 2.9, 0.17, 0.012 * one,
    )  # fmt: skip
    q = together.simulate(motion.q[:, :, None], 0.02)[:, :, 0]
    log = record(arm, build_truth(arm), build_law(arm), 0, seconds, clean=True)
    np.testing.assert_allclose(log.joint("q", arm.actuated), q[: log.n_samples], atol=3e-4)


@pytest.mark.parametrize("step", [0.02, 0.0066, 0.001])
def test_a_stop_within_a_step_is_where_friction_brings_it(step):
    """A joint that coasts against Coulomb friction alone stops after v^2 inertia / (2 friction), whatever the step."""
    robot = build_link(0.02)
    law = ServoLaw.of(robot.actuated, position_gain=1.0, force_per_unit=1e-12)
    truth = build_truth(robot).with_values({"j1.viscous": 0.0, "j1.coulomb": 0.06, "j1.armature": 0.0})
    records = build_records(truth, law, [record(robot, truth, law, 0, 2.0)])
    space = InertialSpace.of(truth)
    waves = build_waves(records, [compute_load_waves(space, *r.motion, r.dt) for r in records], law)
    waves = type(waves)(**(vars(waves) | {"speed": np.array([[1.0]]), "step": step}))
    trials = Trials({key: x[:, None] for key, x in read_values(truth, law).items()}, np.zeros((0, 1)))
    _, q, v = simulate_motion(waves, trials)[:, :, 0, 0, 0]
    assert q[-1] - q[0] == pytest.approx(0.02 / (2 * 0.06), rel=1e-6)
    assert v[-1] == 0


def test_intervals_hold_what_is_true():
    """Of arms with friction and drives of their own, intervals of 95 % hold nearly all true values, and none is far."""
    z = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        arm = build_arm(2)
        values = {f"{j}.{k}": x * np.exp(0.3 * rng.normal()) for j in arm.actuated
                  for k, x in (("coulomb", 0.06), ("viscous", 0.02), ("armature", 0.012))}  # fmt: skip
        log = record(arm, build_truth(arm).with_values(values), build_law(arm), seed, 24.0)
        law = ServoLaw.of(arm.actuated, position_gain=2.65, force_per_unit=2.9, back_emf=0.17)
        found = identify_loop(arm, log, law=law, holdout=log.split(0.9)[1], choices=Choices(fix=("j*_link.mass",)))
        alike = {"load_friction": 0.2, "stiction": 0.01, "command_delay": 0.012, "offset": 0.0}
        values |= {f"{j}.{k}": x for j in arm.actuated for k, x in alike.items()}
        z += [(p.value - values[p.name]) / p.stderr for p in found.parameters if p.name in values and p.stderr]
    assert len(z) > 40
    assert np.mean(np.abs(z) < 1.96) > 0.85
    assert np.max(np.abs(z)) < 4
    assert np.std(z) > 0.5


def test_mixing_finds_what_a_linear_map_leaves_in_place() -> None:
    """Of a map with n slow directions, n + 1 answers tell where it would stay, in whatever units."""
    rng = np.random.default_rng(5)
    A = np.linalg.qr(rng.normal(size=(6, 6)))[0] @ np.diag([0.95, 0.9, 0.85, 0.0, 0.0, 0.0])
    stays, scale = rng.normal(size=6), 10.0 ** rng.uniform(-3, 3, 6)
    mixing, points, answers, x = Mixing(), [], [], np.zeros(6)
    for _ in range(6):
        points, answers = [*points, x], [*answers, scale * (stays + A @ (x / scale - stays))]
        x = mixing.mix(points, answers, scale)
    assert np.abs(x / scale - stays).max() < 1e-6
    assert np.abs(answers[0] / scale - stays).max() > 0.3
