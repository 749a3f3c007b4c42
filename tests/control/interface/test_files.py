"""Reference and correction files: what a controller may take is written, all else is refused with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raising import raises_code
from scipy.signal import lfilter

from tau_dyn.control import (
    CommandLimits,
    Correction,
    LearningLaw,
    MotorSide,
    Reference as Repeated,
    TimeShift,
    apply_correction,
    build_correction,
    build_reference,
    design_low_pass,
    learn,
    read_correction,
    read_reference,
    stack_controlled_actuators,
    write_correction,
    write_reference,
)
from tau_dyn.control.interface.reference import compute_digest
from tau_dyn.effects import build_friction_model
from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.modes import Actuator
from tau_dyn.robot import load_robot
from tau_dyn.simulate import Trajectory, move

MODEL = Model.of(load_robot("gantry_tau"), [])
ROBOT = MODEL.robot
STROKE = np.array([0.03, -0.02, 0.01])


def there(rate_hz: float = 250.0, seconds: float = 0.6) -> Trajectory:
    """Return a minimum-jerk move from home."""
    return move(ROBOT.actuated, ROBOT.home, ROBOT.home + STROKE, seconds, rate_hz)


def faded(size: float = 1e-3) -> Correction:
    """Return a correction of the move that fades in and out."""
    shape = np.sin(np.linspace(0, np.pi, there().n_samples)) ** 2
    return Correction(
        ROBOT.actuated, 0.004, size * shape[:, None] * np.array([1.0, -1.0, 0.5]), compute_digest(there())
    )


def test_a_reference_is_read_as_it_was_written(tmp_path) -> None:
    """Twelve digits of every sample, on the controller's clock."""
    write_reference(tmp_path / "r.csv", MODEL, there())
    found = read_reference(tmp_path / "r.csv", ROBOT.actuated)
    for name in "tqva":
        np.testing.assert_allclose(getattr(found, name), getattr(there(), name), rtol=0, atol=1e-11)
    assert compute_digest(found) == compute_digest(there()) != compute_digest(replace(there(), q=there().q + 1e-6))


@pytest.mark.parametrize("rate_hz", [100.0, 1000.0, 240.0])
def test_another_period_is_refused_or_resampled_on_demand(rate_hz, tmp_path) -> None:
    """Nothing is played at another speed: refused with both periods, or interpolated to within a thousandth of the stroke."""
    motion = there(rate_hz)
    with raises_code("time_stamps", f"{1000.0 / rate_hz:.6g}", "4"):
        write_reference(tmp_path / "r.csv", MODEL, motion)
    assert not (tmp_path / "r.csv").exists()
    found = build_reference(MODEL, motion, resample=True)
    np.testing.assert_allclose(np.diff(found.t), 0.004, rtol=1e-9)
    s = np.clip(found.t / 0.6, 0, 1)[:, None]
    true = ROBOT.home + STROKE * (10 * s**3 - 15 * s**4 + 6 * s**5)
    assert np.abs(found.q - true).max() < 3e-5 and np.abs(found.q[-1] - motion.q[-1]).max() < 1e-9


def test_a_file_at_another_period_is_not_read(tmp_path) -> None:
    """A file of 10 ms is no file for a controller of 4 ms; for one of 10 ms it is."""
    write_reference(tmp_path / "r.csv", MODEL, there(100.0), period=0.01)
    with raises_code("time_stamps", "r.csv", "10"):
        read_reference(tmp_path / "r.csv", ROBOT.actuated)
    assert read_reference(tmp_path / "r.csv", ROBOT.actuated, period=0.01).n_samples == 61


def test_a_motion_too_fast_for_the_period_is_not_resampled() -> None:
    """A shake at 30 Hz cannot be told by a sample every 20 ms."""
    t = np.arange(600) * 0.001
    shake = 1e-3 * np.sin(2 * np.pi * 30 * t) * np.sin(np.pi * t / 0.599) ** 2
    motion = Trajectory.through(ROBOT.actuated, t, ROBOT.home + shake[:, None])
    with raises_code("invalid_value", "cart1"):
        build_reference(MODEL, motion, period=0.02, resample=True)


@pytest.mark.parametrize(
    ("motion", "given", "said"),
    [
        (there(), {"speed": 0.05}, r"joint cart1 moves at 0\.09\d* m/s at t = .* may no more than 0\.05 m/s"),
        (there(), {"acceleration": [1.0, 0.1, 1.0]}, r"joint cart2 accelerates by .* may no more than 0\.1 m/s\^2"),
        (there(), {"force": 5.0}, r"joint cart\d needs .* N at t = .* may no more than 5 N"),
        (replace(there(), q=there().q + 50.0), {}, "joint cart1 reaches 49.* and may go from"),
        (replace(there(), q=there().q + 0.1 * (np.arange(151) > 70)[:, None]), {}, r"moves at 25\.\d* m/s"),
        (replace(there(), v=there().v + 0.05), {}, "it begins with joint cart1 at 0.05 m/s; it must be at rest"),
        (replace(there(), joints=("a", "b", "c")), {}, "it moves a, b, c, the robot has cart1"),
    ],
)  # fmt: skip
def test_limits_are_checked_before_anything_is_written(motion, given, said, tmp_path) -> None:
    """Range, speed and acceleration as stated and from sample to sample, force, rest at both ends."""
    with pytest.raises(InputError, match=said):
        write_reference(tmp_path / "r.csv", MODEL, motion, limits=CommandLimits.of(ROBOT, **given))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("quantity", "share", "said"), [("force", 0.8, "needs -"), ("speed", 0.9, "moves at 0.06")])
def test_a_limit_holds_in_both_directions(quantity, share, said) -> None:
    """A stroke backwards against friction needs its largest force, and has its largest speed, below zero."""
    robot = load_robot("linear_axis")
    model = Model.of(robot, build_friction_model("symmetric", robot.actuated, robot.force_units))
    model = model.with_values({"axis.coulomb": 20.0})
    motion = move(robot.actuated, robot.home, robot.home - 0.02, 0.6, 250.0)
    used = model.torque(motion.q, motion.v, motion.a) if quantity == "force" else motion.v
    lowest = share * float(used.min())
    assert used.max() < -lowest
    build_reference(model, motion, limits=CommandLimits.of(robot, **{quantity: -lowest / share**2}))
    with pytest.raises(InputError, match=f"joint axis {said}"):
        build_reference(model, motion, limits=CommandLimits.of(robot, **{quantity: -lowest}))


def test_a_learned_correction_comes_back_from_its_file(tmp_path) -> None:
    """Learnt on carts that lag, written, read, added: the reference and what learning had found, sample by sample."""
    motion = there(250.0, 1.6)
    model = stack_controlled_actuators([Actuator.from_discrete(0.4, 0.6, 2, 0.004)] * 3, 0.004)
    repeated = Repeated(0.004, motion.q, np.zeros((motion.n_samples, 3)), 100, 300, 50)
    law = LearningLaw(MotorSide(model), (design_low_pass(10, 0.004),) * 3, TimeShift(0.9, 2, 0.004))
    done = learn(_Lagging(), repeated, law, iterations=3)
    correction = build_correction(done, law, ROBOT.actuated)
    write_correction(tmp_path / "c.csv", MODEL, motion, correction)
    found = read_correction(tmp_path / "c.csv", ROBOT.actuated)
    np.testing.assert_allclose(found.dq, done.corrections[-1], rtol=0, atol=1e-11)
    assert np.abs(found.dq).max() > 1e-4 and found.motion == compute_digest(motion)
    both = apply_correction(MODEL, motion, found)
    np.testing.assert_allclose(both.q, motion.q + done.corrections[-1], rtol=0, atol=1e-11)
    middle = slice(5, -5)
    np.testing.assert_allclose(found.dv[middle], (both.v - motion.v)[middle], rtol=0, atol=2e-3 * np.abs(both.v).max())


class _Lagging:
    """Carts that follow with a lag."""

    dt = 0.004

    def run(self, reference, trial):
        """Return what was reached."""
        late = np.vstack([np.zeros((2, 3)), (reference - reference[0])[:-2]])
        self.q = reference[0] + np.asarray(lfilter([0.4], [1, -0.6], late, axis=0))
        self.kinematic = self.acceleration = self.tool = np.zeros_like(self.q)
        return self


@pytest.mark.parametrize(
    ("change", "given", "said"),
    [
        (lambda c: replace(c, dq=20 * c.dq), {}, r"the correction of joint cart1 is (20|19\.\d+) mm .* no more than 10 mm"),
        (lambda c: c, {"correction": [1.0, 5e-4, 1.0]}, r"correction of joint cart2 is -(1|0\.\d+) mm .* no more than 0\.5 mm"),
        (lambda c: replace(c, dq=c.dq + 5e-3), {"speed": 1.0}, "jumps at sample 1: .*fade it in and out"),
        (lambda c: replace(c, motion="0" * 16), {}, "learnt on another motion"),
        (lambda c: replace(c, dt=0.005), {}, "for a correction every 5 ms"),
        (lambda c: replace(c, dq=c.dq[:-3]), {}, "has 148 samples, move has 151"),
        (lambda c: replace(c, joints=("a", "b", "c")), {}, "is for a, b, c"),
        (lambda c: c, {"speed": 0.0938}, "move with its correction is not written: joint cart1 moves at"),
    ],
)  # fmt: skip
def test_an_unfitting_correction_is_refused(change, given, said, tmp_path) -> None:
    """Too large, too sudden, of another motion, period, length or robot; or the sum leaves a limit."""
    with pytest.raises(InputError, match=said):
        limits = CommandLimits.of(ROBOT, **given)
        write_correction(tmp_path / "c.csv", MODEL, there(), change(faded()), limits=limits)
    assert not list(tmp_path.iterdir())


def test_ten_degrees_are_the_most_of_a_turning_drive() -> None:
    """Where nothing else is said a correction of a turning drive may be 10 degrees, as in the thesis."""
    robot = load_robot("gantry_tau_f1")
    limits = CommandLimits.of(robot)
    turning = np.array(robot.joint_kinds) == "revolute"
    np.testing.assert_allclose(np.rad2deg(limits.correction[turning]), 10.0)
    with raises_code("invalid_value"):
        CommandLimits.of(robot, speed=0.0)


@pytest.mark.parametrize("text", ["t,dq_cart1\n0,0\n0.004,0\n", "# correction of motion xyz\nt\n", ""])
def test_a_file_that_is_no_correction_is_not_read(text, tmp_path) -> None:
    """A sentence, not an answer."""
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(InputError):
        read_correction(tmp_path / "c.csv", ROBOT.actuated)
