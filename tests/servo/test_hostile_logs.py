"""Logs of commands whose clock, supply or switch cannot be what they say are refused, cut or doubted, never believed."""

import numpy as np
import pytest
from raising import raises_code
from tests.servo.arms import build_arm, build_law, build_truth, record

from tau_dyn.log import Log
from tau_dyn.servo.preparation import read_loop_logs
from tau_dyn.simulate import build_servo_law

ARM = build_arm(1)
LAW = {"law": "servo", "position_gain": 2.65, "force_per_unit": 2.9}


@pytest.fixture(scope="module")
def log() -> Log:
    """Return eight seconds of one joint."""
    return record(ARM, build_truth(ARM), build_law(ARM), 3, 8.0)


def read(log: Log, exclude: tuple[str, ...] = (), **law: object):
    """Return a log as a fit needs it, under a law with more entries."""
    return read_loop_logs(ARM, log, {"law": build_servo_law(LAW | law, ARM, "law.yaml"), "exclude": exclude})


@pytest.mark.parametrize("volts", [np.nan, -7.0, 1e300, 700.0])
def test_a_supply_that_none_can_be_is_refused(log, volts):
    """Not a number, below zero, or tenths and hundredths of a volt; between zero and ten times the nominal one it is believed."""
    supply = {"column": "volts", "nominal": 7.0}
    at = np.where(np.arange(log.n_samples) == 100, volts, 7.0)
    with raises_code("bad_sample", "volts"):
        read(log.with_channels(volts=at), supply=supply)
    assert read(log.with_channels(volts=np.full(log.n_samples, 8.4)), supply=supply).kept[0].supply == pytest.approx(
        1.2
    )


def test_a_switch_that_says_nothing_is_refused(log):
    """A motor is on or off; an empty cell is neither."""
    with raises_code("bad_sample", "torque_on"):
        read(log.with_channels(torque_on=np.full(log.n_samples, np.nan)), enabled="torque_on")


def test_a_clock_that_jumps_is_cut_and_milliseconds_are_refused(log):
    """Motion is not made up between samples a year apart; seconds that are thousandths are asked about."""
    t = log.t + np.where(np.arange(log.n_samples) < 200, 0.0, 3e7)
    found = read(Log(t, log.channels, "jump.csv"))
    assert [len(r.t) for r in found.kept] == [200, 200] and any("1 gap in time" in w for w in found.warnings)
    with raises_code("wrong_unit", "ms"):
        read(Log(1e3 * log.t, log.channels, "ms.csv"))


def test_degrees_are_doubted(log):
    """Positions far outside a joint's limits, and within them as degrees, are said to be so."""
    turned = log.with_channels(**{name: np.rad2deg(x) for name, x in log.channels.items()})
    assert any("degrees" in w for w in read(turned).warnings) and not any("degrees" in w for w in read(log).warnings)


def test_a_column_to_exclude_by_must_be_there(log):
    """It is missed by its name, whoever named it."""
    with raises_code("missing_column", "contact", "exclude"):
        read(log, exclude=("contact",))


def test_a_simulated_robot_that_runs_away_gives_no_log():
    """A torque of 1e300 N m ends in a sentence, and not in positions that no joint has."""
    with raises_code("unstable", "ran away"):
        record(ARM, build_truth(ARM), build_law(ARM, force_per_unit=1e300, load_friction=0.0, back_emf=0.0), 3, 1.0)
