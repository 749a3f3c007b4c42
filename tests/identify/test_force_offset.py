"""Forces that were logged a part of a sample late or early, and what that does to intervals."""

import numpy as np
import pytest

from tau_dyn.identify import identify
from tau_dyn.identify.data import shift_forces
from tau_dyn.identify.force_offset import ForceOffset
from tau_dyn.log import Log
from tau_dyn.robot import load_robot

RATE_HZ = 250.0
MASS, COULOMB, VISCOUS = 95.0, 20.0, 200.0


def recording(offset_samples: float, rng: np.random.Generator, seconds: float = 24.0) -> Log:
    """Return a slide's log whose forces stand `offset_samples` late."""
    t = np.arange(0, seconds, 1 / RATE_HZ)
    w, phase = 2 * np.pi * rng.uniform(0.2, 2.0, 6), rng.uniform(0, 6.3, 6)

    def motion(t):
        angle = w * t[:, None] + phase
        return (
            0.05 * np.sum(np.sin(angle) / w, 1),
            0.05 * np.sum(np.cos(angle), 1),
            -0.05 * np.sum(w * np.sin(angle), 1),
        )

    def force(t):
        _, v, a = motion(t)
        return MASS * a + COULOMB * np.sign(v) + VISCOUS * v

    tau = force(t - offset_samples / RATE_HZ) + 0.3 * rng.standard_normal(len(t))
    q = motion(t)[0] + 1e-7 * rng.standard_normal(len(t))
    return Log(t, {"q_axis": q, "tau_axis": tau}, "log.csv")


@pytest.mark.parametrize("offset", [-0.5, 0.3])
def test_a_part_of_a_sample_is_found_and_taken_out(rng, offset: float):
    """Half a sample early, as a held force is logged, or a third late: found to a few hundredths, and the mass is right."""
    found = identify(load_robot("linear_axis"), recording(offset, rng), model="symmetric")
    assert found.force_offset is not None and found.force_offset.corrected
    assert found.force_offset.seconds * RATE_HZ == pytest.approx(offset, abs=0.05)
    assert found.to_dict()["timing"]["force_offset_samples"] == pytest.approx(offset, abs=0.05)
    mass = found.parameters["carriage_link.mass"]
    assert mass.stderr is not None and abs(mass.value - MASS) < 4 * mass.stderr < 1.0


def test_the_last_part_is_judged_at_the_corrected_times(rng):
    """A fit of the first part at full rate reads the shifted forces, as all of it does: it predicts the rest as well."""
    found = identify(load_robot("linear_axis"), recording(-0.5, rng), model="symmetric", estimator="ml")
    assert found.force_offset is not None and found.force_offset.corrected and found.estimate.estimator == "ml"
    assert found.holdout is not None and found.holdout.rms[0] < 1.1 * found.train.rms[0]


def test_forces_on_time_are_left_alone(rng):
    """Without an offset nothing is shifted, and its uncertainty is a part of every interval."""
    found = identify(load_robot("linear_axis"), recording(0.0, rng), model="symmetric")
    offset = found.force_offset
    assert offset is not None and not offset.corrected and abs(offset.seconds) < 4 * offset.stderr < 0.1 / RATE_HZ
    assert not any("late" in sentence for sentence in found.warnings)


def test_more_than_a_hold_explains_is_not_taken_out():
    """Three samples are no half of one; they are left in the log, where a check names them."""
    assert not ForceOffset(3.0, 0.01, 1.0).is_shown and not ForceOffset(0.3, 0.1, 1.0).is_shown
    assert ForceOffset(-0.5, 0.01, 1.0).is_shown


def test_shifting_reads_forces_later_and_keeps_positions():
    """A force that was logged 2 ms late is read 2 ms later than its stamp."""
    t = np.arange(0, 1, 0.01)
    log = Log(t, {"q_a": t, "tau_a": np.sin(5 * (t - 0.002))}, "log.csv")
    shifted = shift_forces(log, ["a"], 0.002)
    assert np.allclose(shifted.channels["tau_a"][1:-1], np.sin(5 * t)[1:-1], atol=1e-5)
    assert np.array_equal(shifted.channels["q_a"], t)
