"""Measured forces of the ground are measurements: the mass follows from them, whatever the scale of the torques."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.identify import identify
from tau_dyn.legged import check_robot_log, complete_base, list_base_warnings
from tau_dyn.log import Log
from tau_dyn.mechanism import build_mechanism
from tau_dyn.robot import load_robot


@pytest.fixture(scope="module")
def log(walker, walk) -> Log:
    """Return an exact log of a crawl with the force on each foot."""
    return walk.record(walker, 8.0, rate_hz=100.0, with_forces=True)


def test_torques_and_forces_of_the_ground_add_up_to_the_motion(walker, walk, log):
    """All 18 equations hold without elimination: those of the base to 1e-9, those of the legs up to their friction."""
    (found,) = complete_base(walker, [log])
    _, q, v, a = walk.move(walker, 8.0, 1, 100.0)
    rigid = build_mechanism(walker).inverse_dynamics(q, v, a)
    total = found.joint("tau", walker.actuated)
    assert_allclose(total[:, :6], rigid[:, :6], atol=1e-9)
    assert_allclose(total[:, 6:] - rigid[:, 6:], walk.coulomb * np.sign(v[:, 6:]) + walk.viscous * v[:, 6:], atol=1e-9)
    assert not any(found[f"contact_{contact.frame}"].any() for contact in walker.contacts)


def test_the_mass_follows_from_the_forces_and_not_from_the_torques(walker, log):
    """Torques that read 10 % too much make a robot without force sensors 10 % too heavy; with them 11.6 kg to 1 %."""
    scaled = log.with_channels(**{f"tau_{joint}": 1.1 * log[f"tau_{joint}"] for joint in walker.driven})
    bare = replace(scaled, channels={name: x for name, x in scaled.channels.items() if not name.startswith("force_")})
    by_torque, by_force = (identify(walker, x, model="symmetric").estimate.beta[0] for x in (bare, scaled))
    assert abs(by_torque / 11.6 - 1.1) < 0.01
    assert abs(by_force / 11.6 - 1) < 0.01


def test_forces_that_do_not_carry_the_robot_are_refused(walker, walker_file, log):
    """Forces on the ground have the other sign; a foot has three columns; a flat one would need its moment as well."""
    names = [name for name in log.channels if name.startswith("force_")]
    reversed_ = log.with_channels(**{name: -log[name] for name in names})
    with raises_code("mismatch", "on the foot"):
        complete_base(walker, [reversed_])
    assert not check_robot_log(reversed_, walker).fit_for_use and check_robot_log(log, walker).fit_for_use
    lost = replace(log, channels={name: x for name, x in log.channels.items() if name != "force_hr_foot_y"})
    with raises_code("missing_column", "force_hr_foot_y"):
        complete_base(walker, [lost])
    flat = load_robot(walker_file, base="floating", contacts=["fl_foot=flat"])
    with raises_code("unsupported", "flat"):
        complete_base(flat, [log])


def test_one_foot_may_have_a_sensor_and_another_flags(walker, log):
    """The measured foot needs no flag; the others keep theirs."""
    kept = {name: x for name, x in log.channels.items() if not name.startswith("force_") or "fl_foot" in name}
    one = replace(log, channels={name: x for name, x in kept.items() if name != "contact_fl_foot"})
    assert not list_base_warnings(walker, [one])
    (found,) = complete_base(walker, [one])
    assert not found["contact_fl_foot"].any() and found["contact_fr_foot"].any()
