"""Trials tell a drive's response, what does not repeat, and whether a prediction held; learning promises no more than that."""

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raising import raises_code

from tau_dyn.control.iterative import LearningOptions, LearningStep, compute_learning_step
from tau_dyn.control.iterative.joint_learning import GAINS
from tau_dyn.control.iterative.trial_response import estimate_response
from tau_dyn.modes import Actuator

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments"))

from ilc_parts.servos import DT, draw_servos  # noqa: E402
from ilc_servos import learn_all  # noqa: E402

N = 600
FULL = slice(60, 540)
DRIVE = Actuator(1.0, 0.03, 0.02)
"""Time constant 30 ms, delay 5 samples."""


def stroke() -> np.ndarray:
    """10 mm there and back, (N, 1)."""
    t = np.arange(N) * DT
    rise = (np.clip((t - start) / 0.35, 0, 1) for start in (0.3, 1.2))
    there, back = (x**3 * (10 - 15 * x + 6 * x**2) for x in rise)
    return 0.01 * (there - back)[:, None]


def run(command: np.ndarray, noise: float = 0.0, seed: int = 0, drive: Actuator = DRIVE) -> np.ndarray:
    """Return positions (N, 1) of the drive with slow noise of an RMS [m]."""
    white = np.random.default_rng(seed).standard_normal(N + 49)
    slow = np.convolve(white, np.ones(50) / np.sqrt(50), "valid")
    return drive.simulate(command[:, 0], DT)[:, None] + noise * slow[:, None]


def learn(commands: list[np.ndarray], positions: list[np.ndarray], **more) -> LearningStep:
    return compute_learning_step(("axis",), DT, stroke(), commands, positions, **more)


def go_on(trials: int, noise: float, drive: Actuator = DRIVE, **more) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return commands and positions of a first trial and more with corrections."""
    commands, positions = [stroke()], [run(stroke(), noise, 0, drive)]
    for k in range(1, trials + 1):
        commands.append(stroke() + learn(commands, positions, **more).correction)
        positions.append(run(commands[-1], noise, k, drive))
    return commands, positions


def test_changes_tell_the_response_that_a_wrong_model_hides() -> None:
    """A model with twice the time constant and no delay is off by a third at 6 Hz; two changes mend it within its errors."""
    wrong = Actuator(1.0, 0.06, 0.0)
    commands, positions = go_on(2, 1e-6)
    found = estimate_response(wrong, [c[:, 0] for c in commands], [y[:, 0] for y in positions], DT, FULL)
    known = (found.frequency > 0.5) & (found.frequency < 6)
    true = DRIVE.response(found.frequency, DT)
    off = np.abs(found.mean - true)[known]
    before = np.abs(wrong.response(found.frequency, DT) - true)[known]
    assert np.mean(off < 2.5 * found.deviation[known]) > 0.9
    assert off.mean() < before.mean() / 3


def test_equal_commands_tell_what_does_not_repeat() -> None:
    """Without a change of the command the difference of two trials is noise alone: half of its power is one trial's."""
    noise = 2e-5
    commands = [stroke()] * 8
    positions = [run(stroke(), noise, seed) for seed in range(8)]
    found = estimate_response(DRIVE, [c[:, 0] for c in commands], [y[:, 0] for y in positions], DT, FULL)
    rms = np.sqrt(2 * found.noise.sum() / (found.length * found.n))
    assert_allclose(rms, noise, rtol=0.3)


def test_the_shift_makes_up_for_the_delay() -> None:
    """A drive that is late and does not lag is led by its delay, and a frequency keeps 1 - gain of its error."""
    late = Actuator(1.0, 1e-4, 0.032)
    commands, positions = go_on(1, 1e-6, late)
    (drive,) = learn(commands, positions).drives
    assert drive.law is not None and abs(drive.law.shift - 8) <= 1
    mean, _ = drive.growth()
    slow = (drive.response.frequency > 1) & (drive.response.frequency < 3)
    assert_allclose(mean[slow], 1 - drive.law.gain, atol=0.1)


def test_learning_ends_at_the_noise_and_says_so() -> None:
    """An error of lag and delay falls to the noise; the interval of a trial holds what the next noise brings."""
    noise = 1e-5
    commands, positions = go_on(8, noise)
    found = learn(commands, positions)
    (drive,) = found.drives
    assert drive.outcomes[-3:].max() < 3 * noise < 0.05 * drive.outcomes[0]
    inside, predicted = found.count_inside()
    assert predicted == 8 and inside >= 7
    assert drive.law is not None and 0.7 * noise < drive.law.floor < 2.5 * noise


def test_a_trial_above_its_prediction_changes_the_law_and_two_stop_it() -> None:
    """An error four times the first is no convergence: back to the best trial with half the gain; after a second one, a stop."""
    commands, positions = go_on(3, 1e-6)
    best = learn(commands, positions)
    worse = stroke() - 4 * (stroke() - positions[0])
    once = learn([*commands, stroke() + best.correction], [*positions, worse])
    (drive,) = once.drives
    assert drive.action == "change" and drive.base < 4 and drive.law is not None and drive.law.gain < min(GAINS)
    assert once.warnings[0].code == "prediction_missed" and "trial 5" in drive.reason
    worst = stroke() - 5 * (stroke() - positions[0])
    twice = learn([*commands, stroke() + best.correction, stroke() + once.correction], [*positions, worse, worst])
    (drive,) = twice.drives
    assert drive.action == "stop"
    assert_array_equal(twice.correction, commands[drive.base] - stroke())


def test_before_a_change_is_seen_friction_may_hold_the_drive() -> None:
    """After one trial nothing shows that a correction moves the drive: the interval reaches up to the error as it is."""
    found = learn([stroke()], [run(stroke(), 1e-6)])
    (drive,) = found.drives
    assert drive.forecast.high >= drive.outcomes[0] and drive.forecast.rms < 0.5 * drive.outcomes[0]
    assert found.count_inside() == (0, 0)


def test_a_poor_model_of_the_drive_is_not_used() -> None:
    """Fitted to sticking steps, a time constant of 0.4 s would shift by a hundred samples; the trial contradicts it."""
    commands, positions = go_on(2, 1e-6, actuators=[Actuator(0.9, 0.4, 0.012)])
    found = learn(commands, positions, actuators=[Actuator(0.9, 0.4, 0.012)])
    (drive,) = found.drives
    assert "misses the first trial" in " ".join(found.warnings)
    assert drive.response.model.time_constant < 0.05 and drive.outcomes[-1] < 0.1 * drive.outcomes[0]


def test_a_law_that_is_asked_for_is_refused_at_the_frequency_that_grows() -> None:
    """A gain of 2.5 on a drive that follows overshoots one and a half times."""
    commands, positions = go_on(1, 1e-6)
    with raises_code("unstable", "would not converge"):
        learn(commands, positions, options=LearningOptions(gain=2.5, cutoff_hz=30.0))


def test_servos_with_friction_and_springs_keep_the_promise() -> None:
    """Friction up to three times the accelerating force: no error above its first, intervals that hold, most below a tenth."""
    found = learn_all(draw_servos(8, 11), 4)
    relative = np.array([one.drives[0].outcomes / one.drives[0].outcomes[0] for one in found])
    assert relative.max() <= 1.1
    assert np.mean(relative[:, -1] < 0.1) >= 0.75
    inside, predicted = np.sum([one.count_inside() for one in found], axis=0)
    assert predicted == 32 and inside >= 27


@pytest.mark.parametrize("count", [1, 3])
def test_rows_of_trials_and_frequencies_state_what_was_achieved(count: int) -> None:
    """Errors by trial are the RMS errors; the bands' errors add up to no more than the whole; growth needs two trials."""
    commands, positions = go_on(count - 1, 1e-6)
    found = learn(commands, positions)
    errors = [float(np.sqrt(np.mean((stroke() - y)[found.full] ** 2))) for y in positions]
    assert_allclose([row["error_rms"] for row in found.to_trial_rows()], errors)
    bands = found.to_frequency_rows()
    whole = float(np.sqrt(np.mean((stroke() - positions[0]) ** 2)))
    assert 0.6 * whole < np.sqrt(sum(row["first_error_rms"] ** 2 for row in bands)) <= whole
    achieved = [row["growth_achieved"] for row in bands if row["growth_achieved"] is not None]
    assert bool(achieved) == (count > 1) and all(g < 1 for g in achieved[:3])
