"""What any motion could show: textbook counts of base parameters, and poses that the robot can take."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.identify import build_model
from tau_dyn.identify.fitted_model import draw_random_positions, find_structural_base
from tau_dyn.robot import load_robot


def test_two_links_in_a_vertical_plane_have_six_base_parameters(two_link) -> None:
    """`Iyy, mx, mz` of each link, the first link's with the second's mass at its end (Khalil & Dombre, ch. 9).

    The second joint's rotor is the seventh; the first's is in its link's inertia.
    """
    base = find_structural_base(build_model(two_link, "rigid"))
    said = {base.expression(k) for k in range(base.rank)}
    assert base.rank == 7
    assert {n for n, alone in zip(base.names, base.alone, strict=True) if alone} == {
        "upper_link.mz",
        "lower_link.mx",
        "lower_link.mz",
        "lower_link.iyy",
        f"{two_link.actuated[1]}.armature",
    }
    assert any("upper_link.mx" in text and "lower_link.mass" in text for text in said)


def test_what_is_known_beforehand_is_one_more_that_is_seen(two_link) -> None:
    """A second link that was weighed: its mass stands for itself, and the sums that hold it lose it."""
    model = build_model(two_link, "rigid")
    known = model.with_parameters(model.parameters.update({"lower_link.mass": {"prior_stderr": 0.01}}))
    base = find_structural_base(known)
    assert base.rank == 8
    fixed = model.with_parameters(model.parameters.update({"lower_link.mass": {"free": False, "prior_stderr": 0.01}}))
    assert find_structural_base(fixed).rank == 7 and "lower_link.mass" not in find_structural_base(fixed).names


@pytest.mark.parametrize("name", ["gantry_tau", "linear_axis", "delta"])
def test_random_poses_lie_within_limits_and_close_the_loops(name: str, rng) -> None:
    """Four fifths of the way to the limits at most, and spread over half of it."""
    robot = load_robot(name)
    q = draw_random_positions(build_model(robot, "rigid"), 60, rng)
    share = (q - robot.home) / np.where(q > robot.home, robot.upper - robot.home, robot.home - robot.lower)
    limited = np.isfinite(share)
    assert q.shape == (60, robot.na) and np.all(np.abs(share[limited]) <= 0.8 + 1e-12)
    assert np.ptp(share[limited]) > 0.5
