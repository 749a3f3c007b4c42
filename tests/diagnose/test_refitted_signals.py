"""Causes that move weakly determined masses: their signals are made with values refitted next to them."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.diagnose.force_baseline import FittedBaseline, fit_baseline
from tau_dyn.effects import SHIFTED_FORCE, JointZero, TorqueSaturation
from tau_dyn.evidence.channel import ColumnCache
from tau_dyn.evidence.measurements import TRAIN
from tau_dyn.evidence.null_model import NullModel, fit_noise_models
from tau_dyn.evidence.settings import estimate_amplitudes
from tau_dyn.identify import build_model
from tau_dyn.log import Log
from tau_dyn.mechanism import build_mechanism
from tau_dyn.robot import load_robot_from_urdf

NOISE_NM = 0.02


def record(robot, rng, *, zero: float = 0.0, saturation: float = 0.0, joint: int = 0, noise: float = NOISE_NM) -> Log:
    """Return 20 s of an arm, one encoder of which reads a zero, or the first drive of which saturates."""
    t = np.arange(0, 20, 0.005)
    q, v, a = np.zeros((3, len(t), robot.na))
    for k in range(robot.na):
        for f in (0.11, 0.29, 0.53, 0.83):
            w, phase = 2 * np.pi * f * rng.uniform(0.95, 1.05), rng.uniform(0, 6)
            q[:, k] += 0.4 * np.sin(w * t + phase)
            v[:, k] += 0.4 * w * np.cos(w * t + phase)
            a[:, k] -= 0.4 * w**2 * np.sin(w * t + phase)
    force = build_mechanism(robot).inverse_dynamics(q, v, a) + 1.5 * np.sign(v) + 0.8 * v
    largest = np.abs(force[:, 0]).max()
    force[:, 0] += saturation * force[:, 0] * (force[:, 0] / largest) ** 2
    force += noise * rng.standard_normal(force.shape)
    channels = {f"q_{j}": q[:, k] + zero * (k == joint) for k, j in enumerate(robot.actuated)}
    return Log(t, channels | {f"tau_{j}": force[:, k] for k, j in enumerate(robot.actuated)}, "log")


def fit(robot, log: Log) -> FittedBaseline:
    """Return the fitted baseline."""
    return fit_baseline(build_model(robot, "symmetric"), [log], [], None, (), lambda step: None)


def explained(case: FittedBaseline, effect) -> tuple[float, float]:
    """Return an effect's amplitude on the training part and its standard error."""
    library = ColumnCache(case.channel)
    noise = fit_noise_models(case.channel, (TRAIN,), [library.columns(effect)])
    null_model = NullModel.of(library, (TRAIN,), noise)
    stderr = float(1 / np.sqrt(null_model.gram(null_model.rows(effect))[0, 0]))
    return float(estimate_amplitudes(effect, null_model)[0]), stderr


@pytest.mark.parametrize("zero", [0.3, -0.02])
def test_a_shoulders_zero_comes_out_and_the_elbows_is_its_body(two_link, rng, zero: float) -> None:
    """The search proposes the zero, its column has it as amplitude within three errors, and the last joint proposes none."""
    case = fit(two_link, record(two_link, rng, zero=zero))
    zeros = case.channel.scene.zeros
    effect = JointZero(["shoulder"], ["N m"], about=zeros["shoulder"])
    amplitude, stderr = explained(case, effect)
    assert abs(amplitude - zero) < 3.5 * stderr < 0.04
    assert zeros["shoulder"] == pytest.approx(zero, abs=5 * stderr) and zeros["elbow"] == 0.0


def test_a_saturation_of_ten_per_cent_comes_out(two_link, rng) -> None:
    """The force in its column is the one that the drive gives, and not the larger one that the baseline is fitted to."""
    case = fit(two_link, record(two_link, rng, saturation=0.1))
    (setting,) = TorqueSaturation.grid(case.channel.scene, ("shoulder",))
    amplitude, stderr = explained(case, TorqueSaturation(["shoulder"], ["N m"], largest=setting["largest"]))
    assert abs(amplitude - 0.1) < 3.5 * stderr + 0.003
    assert stderr < 0.01


def test_a_yaw_that_no_force_feels_proposes_no_zero(write, rng) -> None:
    """The first joint turns about the vertical: rounding of its forces is no reason to look for its zero."""
    upper = write.rod("upper_link", 3, 0.4) + write.joint("shoulder", "revolute", "base_link", "upper_link", "0 0 1")
    lower = write.rod("lower_link", 2, 0.3) + write.joint(
        "elbow", "revolute", "upper_link", "lower_link", "0 1 0", "0.4 0 0"
    )
    text = write.text("yaw", upper, lower, write.drive("shoulder"), write.drive("elbow"))
    robot = load_robot_from_urdf(text, "yaw")
    case = fit(robot, record(robot, rng))
    assert case.channel.scene.zeros["shoulder"] == 0.0
    columns = case.channel.columns(JointZero(["shoulder"], ["N m"]))
    assert not any(c.any() for c in columns)


def test_errors_are_reported_with_the_values_that_an_effect_was_fitted_with(write, rng) -> None:
    """A refit in another band has other weakly determined masses; the forces at displaced positions are those of the search."""
    parts = [write.rod("column_link", 4, 0.1) + write.joint("pan", "revolute", "base_link", "column_link", "0 0 1")]
    parts.append(
        write.rod("upper_link", 5, 0.45)
        + write.joint("lift", "revolute", "column_link", "upper_link", "0 1 0", "0 0 0.2")
    )
    parts.append(
        write.rod("fore_link", 3, 0.3)
        + write.joint("elbow", "revolute", "upper_link", "fore_link", "0 1 0", "0.45 0 0")
    )
    text = write.text("arm", *parts, write.drive("pan"), write.drive("lift"), write.drive("elbow"))
    robot = load_robot_from_urdf(text, "arm")
    case = fit(robot, record(robot, rng, zero=0.3, joint=1, noise=0.5))
    channel, shown = case.channel, case.channel.report()
    assert shown is not channel
    searched, reported = (c.prepared[0].motion.signals[SHIFTED_FORCE][400:-400] for c in (channel, shown))
    assert np.linalg.norm(searched - reported) < 0.003 * np.linalg.norm(searched)
