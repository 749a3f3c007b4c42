"""Where the closed form ends: what it says of carts whose rods do not meet, and of one sample or many."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.mechanism import GantryTauMechanism


@pytest.mark.parametrize("n", [1, 40], ids=["one by one", "all at once"])
def test_carts_too_far_apart_are_named_and_millimetres_are_suspected_only_of_large_numbers(robots, n: int) -> None:
    """A cart 5 m off its place cannot be reached by rods of 2 m; one at 1400 m is one at 1400 mm, and is asked about."""
    mechanism = GantryTauMechanism(robots("l1 simplified uniform"))
    for shift, hint in ((5.0, False), (1400.0, True), (-1400.0, True)):
        q = np.repeat(mechanism.robot.home[None], n, axis=0)
        q[n // 2, 1] += shift
        with raises_code("loop_not_closed", "cart1", "=", "cart2") as fault:
            mechanism.tool_position(q)
        assert ("are they in mm?" in str(fault.value)) is hint
        assert f"cart2 = {q[n // 2, 1]:.4g} m" in str(fault.value)


def test_a_block_boundary_changes_nothing(robots, rng) -> None:
    """5000 samples are computed in three blocks, each as it would be alone."""
    mechanism = GantryTauMechanism(robots("l1 simplified uniform"))
    q = mechanism.robot.home + rng.uniform(-0.2, 0.2, (5000, 3))
    v, a = rng.standard_normal((2, 5000, 3))
    Y = mechanism.regressor(q, v, a)
    for k in (0, 2047, 2048, 4095, 4096, 4999):
        assert_allclose(Y[k], mechanism.regressor(q[[k]], v[[k]], a[[k]])[0], rtol=1e-10, atol=1e-10)


def test_other_robots_are_refused(robots, two_link) -> None:
    """A rod with another parameter than its mass, six rods, an arm without a rod."""
    whole = robots("l1 simplified uniform")
    assert GantryTauMechanism.describes(whole)
    for robot in (whole.untied(["rod2_link.mx"]), robots("l1 complete uniform"), two_link):
        assert not GantryTauMechanism.describes(robot)
        with raises_code("unsupported"):
            GantryTauMechanism(robot)
