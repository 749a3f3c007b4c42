"""The lead-through controller as a whole, and what it refuses."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.control.lead_through import ForceLoop, ForceSensor, LeadThrough, LeadThroughSettings
from tau_dyn.exceptions import InputError


class Pose(NamedTuple):
    """Where a tool is."""

    position: np.ndarray
    rotation: np.ndarray


STILL = Pose(np.zeros(3), np.eye(3))
NONE = np.zeros(6)


def wrench(x=0.0, y=0.0, z=0.0):
    return np.array([x, y, z, 0, 0, 0], float)


def settings(**changed):
    return LeadThroughSettings(**{"contact_stiffness": 20e3, "force_gain": 0.01, "normal_hz": None, **changed})


def run(law, hand, work, n=1):
    return np.array([law(hand, work, STILL) for _ in range(n)])[-1]


def test_in_free_space_the_tool_follows_the_hand():
    """Steady speed is F / D in the hand's direction, and the tool does not turn."""
    v = run(LeadThrough(settings()), np.array([2.0, 0, 1.0, 5, 5, 5]), NONE, 500)
    assert np.allclose(v, [2 / 40, 0, 1 / 40, 0, 0, 0], atol=1e-6)


def test_a_weak_contact_is_pressed_harder_and_a_hard_one_less():
    """(8.4) with forces on the robot: at 1 N the tool moves into the work, at 3 N out of it, at 2 N it stays."""
    for force, speed in ((1.0, -0.01), (2.0, 0.0), (3.0, 0.01)):
        v = run(LeadThrough(settings()), NONE, wrench(z=force))
        assert v[2] == pytest.approx(speed)
        assert not v[:2].any()


def test_the_hand_moves_along_the_surface_but_cannot_press():
    """With contact the handle's normal part is gone and its tangential part is whole."""
    v = run(LeadThrough(settings()), wrench(2.0, 0, -10.0), wrench(z=2.0), 500)
    assert np.allclose(v, [2 / 40, 0, 0, 0, 0, 0], atol=1e-6)


def test_a_pull_lets_go():
    """Contact ends by a pull above the release force, and the hand then lifts the tool."""
    law = LeadThrough(settings())
    run(law, NONE, wrench(z=2.0), 5)
    assert law.in_contact
    v = run(law, wrench(z=8.0), wrench(z=2.0), 5)
    assert not law.in_contact and v[2] > 0


def test_beyond_the_force_limit_no_hand_presses_on():
    """Across the normal (8.8) leaves the hand free; at the limit the command gives way instead."""
    law = LeadThrough(settings(force_limit=5.0, correction_range=0.0))
    assert run(law, wrench(x=10.0), wrench(x=-4.0, z=2.0), 300)[0] > 0
    assert run(law, wrench(x=10.0), wrench(x=-6.0, z=2.0), 300)[0] < 0


def test_the_tool_of_a_turned_arm_weighs_nothing():
    """A tool of 2 kg on the sensor makes no contact in any posture once its weight is known, and does where it is not."""
    tool = ForceSensor(mass=2.0, centre=np.array([0, 0, 0.1]))
    for known in (True, False):
        law = LeadThrough(settings(tool_sensor=tool if known else ForceSensor()))
        turned = Pose(np.zeros(3), np.diag([1.0, -1.0, -1.0]))
        law(NONE, tool.reading(NONE, turned.rotation), turned)
        assert law.in_contact is not known


def test_a_limited_command_does_not_wind_up_behind_the_speed_limit():
    """Pushed hard for 2 s at the limit, the tool turns back within two samples of the hand."""
    law = LeadThrough(settings())
    assert run(law, wrench(x=50.0), NONE, 500)[0] == pytest.approx(0.1)
    assert run(law, wrench(x=-80.0), NONE, 2)[0] < 0


def test_a_touch_stiffer_than_stated_lowers_the_gain():
    """Ten times the stated stiffness is found at the touch and the force loop brought below its limit; not without `watch`."""
    speeds = {}
    for watch in (True, False):
        law = LeadThrough(settings(force_gain=0.03, watch=watch))
        for k in range(10):
            law(NONE, wrench(z=200e3 * k * 2e-6), Pose(np.array([0, 0, -k * 2e-6]), np.eye(3)))
        speeds[watch] = law(NONE, wrench(z=3.6), Pose(np.array([0, 0, -18e-6]), np.eye(3)))[2]
    limit = ForceLoop().limit(200e3).gain
    assert 0.3 * limit < speeds[True] / 1.6 < 0.5 * limit
    assert speeds[False] == pytest.approx(0.03 * 1.6)


def test_a_second_run_starts_from_nothing():
    """After `reset` the same readings give the same commands."""
    law = LeadThrough(settings())
    first = run(law, wrench(1, 2, -3), wrench(z=1.0), 30)
    law.reset()
    assert np.array_equal(run(law, wrench(1, 2, -3), wrench(z=1.0), 30), first)


def test_a_gain_above_the_stability_limit_is_refused_with_limit_and_frequency():
    """The product of gain and stated stiffness decides; the sentence says where the loop would oscillate."""
    limit = ForceLoop().limit(20e3)
    settings(force_gain=0.99 * limit.gain)
    with raises_code("unstable", f"{limit.hz:.0f}", f"{limit.gain:.4g}"):
        settings(force_gain=1.01 * limit.gain)
    assert "stability limit" in settings(force_gain=0.9 * limit.gain).warnings[0]
    assert not settings(force_gain=0.4 * limit.gain).warnings


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"damping": -1.0}, "run away"),
        ({"mass": 0.0}, "positive definite"),
        ({"mass": np.nan}, "mass holds nan"),
        ({"force_gain": -0.001}, "ever harder"),
        ({"damping": 800.0}, "too fast for the sampling"),
        ({"hand_stiffness": 1e5}, "this handle allows"),
        ({"contact_stiffness": np.nan}, "contact_stiffness must be a finite"),
        ({"contact_damping": -1.0}, "contact_damping must not be below"),
        ({"press": 20.0}, "press .* must be below force_limit"),
        ({"press": 0.3}, "contact is lost"),
        ({"contact_off": 0.6}, "contact_off .* must be below contact_on"),
        ({"normal": np.zeros(3)}, "a direction"),
        ({"task": "drill"}, "there are surface, peg"),
        ({"task": "peg"}, "turning_stiffness"),
        ({"task": "peg", "turning_stiffness": 1e6, "press": 0.0}, "force_gain against turning"),
        ({"mass": np.ones(4)}, "mass must be a number"),
    ],
)
def test_unsafe_settings_are_refused_with_the_reason(changed, said):
    """Nothing moves on settings that make energy, oscillate or contradict themselves."""
    with pytest.raises(InputError, match=said):
        settings(**changed)


def test_readings_that_are_no_numbers_or_late_are_refused():
    """A broken cable or another sample rate stops the law instead of moving the arm."""
    law = LeadThrough(settings())
    with raises_code("bad_sample"):
        law(NONE, np.full(6, np.nan), STILL)
    with raises_code("bad_sample"):
        law(np.zeros(3), NONE, STILL)
    with raises_code("wrong_shape", "rotation"):
        law(NONE, NONE, STILL._replace(rotation=np.full((3, 3), np.nan)))
    law(NONE, NONE, STILL, 0.0)
    law(NONE, NONE, STILL, 0.004)
    with raises_code("mismatch", "10", "4"):
        law(NONE, NONE, STILL, 0.014)


def test_settings_do_not_change_under_the_law():
    """Matrices are read-only, and a changed copy is checked again."""
    kept = settings()
    with pytest.raises(ValueError, match="read-only"):
        kept.gain[0, 0] = 1.0
    with raises_code("unstable", "oscillates"):
        replace(kept, contact_stiffness=1e6)
