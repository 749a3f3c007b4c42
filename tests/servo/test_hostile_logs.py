"""Logs of commands whose clock, supply or switch cannot be what they say are refused, cut or doubted, never believed."""

import re

import numpy as np
import pytest
from raising import raises_code
from tests.servo.arms import build_arm, build_law, build_truth, record

from tau_dyn.exceptions import CannotAnswer
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


def _set_commands(log: Log, scale: float, offset: float = 0.0) -> Log:
    return log.with_channels(cmd_j1=scale * log.channels["cmd_j1"] + offset)


@pytest.mark.parametrize(
    ("scale", "offset", "line"),
    [
        (-1.0, 0.0, "scale: -1}"),
        (180 / np.pi, 0.0, "scale: 0.0174533}"),
        (4096 / (2 * np.pi), 2048.0, "scale: 0.00153398, offset: -3.14159}"),
        (1e3, 0.0, "scale: 0.001}"),
    ],
)
def test_commands_in_another_unit_or_sign_are_refused_with_a_map(log, scale, offset, line):
    """A servo follows its command, so their ratio is a unit; the line that is proposed makes the log readable."""
    with raises_code("wrong_unit", "cmd_j1", line) as refused:
        read(_set_commands(log, scale, offset))
    proposed = dict(part.split(": ") for part in re.search(r"\{(.*)\}", str(refused.value))[1].split(", "))
    mended = float(proposed["scale"]) * (scale * log.channels["cmd_j1"] + offset) + float(proposed.get("offset", 0.0))
    assert np.abs(mended - log.channels["cmd_j1"]).max() < 1e-4
    assert read(log.with_channels(cmd_j1=mended)).kept


def test_commands_that_stand_still_are_refused_unless_the_motor_is_off(log):
    """A constant command moves no servo; a motor that is switched off swings without one."""
    still = log.with_channels(cmd_j1=np.zeros(log.n_samples), torque_on=np.zeros(log.n_samples))
    with raises_code("poor_excitation", "commands never change", "q_j1"):
        read(still)
    assert read(still, enabled="torque_on").kept


def test_stamps_that_are_rounded_are_those_of_an_even_clock(log):
    """An even clock of 64 Hz written with two digits is that clock: commands keep their own steps."""
    t = np.arange(log.n_samples) / 64
    found = read(Log(np.round(t, 2), log.channels, "coarse.csv"))
    assert np.abs(np.diff(found.kept[0].t) * 64 - 1).max() < 1e-2
    assert np.array_equal(found.kept[0].command, read(Log(t, log.channels, "fine.csv")).kept[0].command)
    assert any("times are rounded" in w for w in found.warnings)


def test_gaps_that_leave_no_piece_are_named(log):
    """Pieces shorter than a loop's own start tell nothing; the share of lost samples is in the sentence."""
    kept = np.arange(log.n_samples) % 20 < 14  # 280 of the 394 samples from its first to its last
    with pytest.raises(CannotAnswer, match="gaps cut it.*29 % of its samples are missing"):
        read(Log(log.t[kept], {name: x[kept] for name, x in log.channels.items()}, "lost.csv"))
    few = np.ones(log.n_samples, bool)
    few[5:9] = False
    assert len(read(Log(log.t[few], {name: x[few] for name, x in log.channels.items()}, "few.csv")).kept) == 1
