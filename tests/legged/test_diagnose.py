"""Causes of a walker's residual: which ones its equations can show, and gravity that its logged orientation does not show."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.spatial.transform import Rotation

from tau_dyn.cli import main
from tau_dyn.diagnose import diagnose
from tau_dyn.diagnose.noise_only_log import NoiseOnlyLog
from tau_dyn.diagnose.walking import list_walking_causes
from tau_dyn.effects import EFFECTS, Scene
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify import build_model, choose_preparation, prepare_segment
from tau_dyn.legged import QUATERNION, complete_base
from tau_dyn.log import Log

SECONDS, RATE_HZ, TORQUE_NOISE = 80.0, 50.0, 0.05  # [s], [Hz], [N m]
TURN = np.array([0.02, -0.015, 0.0])  # [rad] of the base against its logged axes


def add_noise(log: Log, robot, seed: int) -> Log:
    """Return a log with white noise on the torques."""
    rng = np.random.default_rng(seed)
    columns = {f"tau_{j}": log[f"tau_{j}"] + TORQUE_NOISE * rng.standard_normal(len(log)) for j in robot.driven}
    return log.with_channels(**columns)


@pytest.fixture(scope="module")
def log(walker, walk) -> Log:
    """Return an exact walk."""
    return walk.record(walker, SECONDS, 1, rate_hz=RATE_HZ)


def test_an_imu_at_an_angle_is_named(walker, log):
    """The base is 20 and -15 mrad off its logged axes: the angles come back to 3 mrad, and nothing else is confirmed."""
    turned = Rotation.from_quat(np.column_stack([log[name] for name in QUATERNION])) * Rotation.from_rotvec(-TURN)
    logged = log.with_channels(**dict(zip(QUATERNION, turned.as_quat().T, strict=True)))
    found = diagnose(walker, add_noise(logged, walker, 1))
    assert {u.cause for u in found.untestable} >= {"load_friction", "joint_zero", "cyclic_ripple"}
    (named,) = (f for f in found.findings if f.status == "confirmed")
    assert found.verdict == "named" and named.cause == "imu_misalignment"
    assert_allclose([p.value for p in named.parameters], TURN[:2], atol=0.003)
    assert "imu_misalignment" not in {effect.name for effect in found.extended_model.effects}  # a fault of the log


def test_causes_act_on_joints_with_a_motor(walker):
    """No coordinate of the base has friction; gravity acts on all; laws of the force in a joint are refused with a reason."""
    na = walker.na
    ones = np.ones(na)
    scene = Scene(
        walker.actuated, walker.force_units, -ones, ones, 0.01 * ones, ones, 10.0, 60.0,
        frozenset({"reversal", "gravity_turn", "imu_turn"}), coupled=walker.coupled_pairs,
    )  # fmt: skip
    causes = {cls.name: cls for cls in list_walking_causes(walker)}
    assert set(causes) == {name for name, cls in EFFECTS.items() if cls.cause} | {"imu_misalignment"}
    assert causes["stribeck"].groups(scene) == [(joint,) for joint in walker.driven]
    assert causes["gravity_direction"].groups(scene) == [walker.actuated]
    assert causes["imu_misalignment"].untestable(scene) is None and causes["stribeck"].untestable(scene) is None
    for name, reason in {
        "load_friction": "forces of the ground",
        "cyclic_ripple": "periods",
        "guideway_nonparallel": "no joint",
        "back_emf": "voltage",
    }.items():
        assert reason in (causes[name].untestable(scene) or ("",))[0]


def test_noise_alone_keeps_the_equations_without_contacts(walker, walk):
    """A drawn log obeys the model in all equations without contacts, and its other torques are the measured ones."""
    (log,) = complete_base(walker, [walk.record(walker, 6.0, 1, rate_hz=RATE_HZ)])
    model = build_model(walker, "symmetric")
    preparation = choose_preparation(walker, [log])
    piece = prepare_segment(model, log, preparation, smooth_hz=preparation.position_cutoff_hz)
    drawn = NoiseOnlyLog.of(piece, model, log, preparation.position_cutoff_hz)
    m = piece.motion
    assert piece.contacts is not None
    rigid = model.mechanism.inverse_dynamics(m.q, m.v, m.a)
    wanted = piece.contacts.project(rigid + model.effect_force(m))
    assert_allclose(piece.contacts.project(drawn.force), wanted, atol=1e-6)
    assert np.abs(rigid - drawn.force).max() > 10  # forces of the ground
    assert np.abs(drawn.force[:, :3]).max() < 10  # no motor lifts the base


def test_a_short_walk_is_refused_with_a_length_that_is_enough(walker, walk):
    """A quarter of the walk of the other tests holds too few values; the length advised is at most that walk's."""
    short = walk.record(walker, SECONDS / 4, 1, rate_hz=RATE_HZ)
    with pytest.raises(CannotAnswer) as refused:
        diagnose(walker, add_noise(short, walker, 1))
    assert refused.value.code == "too_little_data"
    assert SECONDS / 4 < float(refused.value.experiment.split()[1]) <= SECONDS


def test_a_motion_for_a_walker_is_not_proposed(walker, walker_file, walk, tmp_path):
    """A motion of joints that keeps no feet on the ground would throw the robot over."""
    path = tmp_path / "walk.csv"
    walk.record(walker, 6.0, 1, rate_hz=RATE_HZ).to_csv(path)
    feet = ["--base", "floating", "--contact", *(contact.frame for contact in walker.contacts)]
    assert main(["diagnose", str(walker_file), str(path), *feet, "--propose", str(tmp_path / "m.csv"), "--quiet"]) == 2
    t = np.arange(0, 6, 0.01)
    with raises_code("missing_column", "q_base_qx"):
        diagnose(walker, Log(t, {f"{signal}_{j}": 0 * t for signal in ("q", "tau") for j in walker.driven}))
