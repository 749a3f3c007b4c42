"""Rods that may spin about themselves: what nothing drives and nothing pulls is left alone, and all else is refused."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.mechanism import TreeMechanism
from tau_dyn.robot import Robot, load_robot_from_urdf

CRANK, ROD, AT = 0.3, 0.9, 0.4  # [m], [m], crank's angle at zero [rad]


def slider_crank(
    write: SimpleNamespace, hinges: str, *, height: float = 0.0, spin: float = 0.0, off: float = 0.0
) -> Robot:
    """Return a crank about z whose rod pushes a block along x, with these hinges between crank and rod, the last along it.

    The rod is a uniform bar of 2 kg, its centre `off` its length [m], with `spin` [kg m^2] about its own length; the block slides
    on a level `height` [m] above the crank. Gravity pulls along -z.
    """
    across = 2 * ROD**2 / 12
    turn = -AT - np.arcsin(CRANK * np.sin(AT) / ROD)  # the rod's direction seen from the crank
    reach = CRANK * np.cos(AT) + ROD * np.cos(AT + turn)
    parts = [write.rod("crank_link", 1, CRANK), write.joint("crank", "revolute", "base_link", "crank_link", yaw=AT)]
    axes, links = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}, [*(f"{axis}_link" for axis in hinges[:-1]), "rod_link"]
    for k, (axis, link, before) in enumerate(zip(hinges, links, ("crank_link", *links), strict=False)):
        rod = link == "rod_link"
        parts.append(
            write.link(link, 2.0, f"{ROD / 2} {off} 0", f"{spin} {across} {across}") if rod else write.link(link)
        )
        place = {"xyz": "0 0 0"} if k else {"xyz": f"{CRANK} 0 0", "yaw": turn}
        parts.append(write.joint(f"rod_{axis}", "revolute", before, link, axes[axis], **place))
    parts.append(write.link("block_link", 3.0, "0 0 0", "0.01 0.01 0.01"))
    parts.append(write.joint("block", "prismatic", "base_link", "block_link", "1 0 0", f"{reach} 0 {height}"))
    parts += [write.ball("rod_link", f"{ROD} 0 0", "block_link", "0 0 0"), write.drive("crank")]
    return load_robot_from_urdf(write.text("slider_crank", *parts), "slider_crank")


@pytest.mark.parametrize(
    ("height", "spin"), [(0.0, 0.0), (0.0, 0.002), (0.25, 0.0)], ids=["flat", "flat and thick", "thin"]
)
@pytest.mark.parametrize("n", [4, 30])
def test_a_rod_that_may_spin_is_driven_as_one_that_may_not(write, rng, n: int, height: float, spin: float) -> None:
    """A third hinge, along the rod, adds a motion that no force reaches in a plane, nor ever where the rod is thin."""
    two, three = (TreeMechanism(slider_crank(write, hinges, height=height, spin=spin)) for hinges in ("zy", "zyx"))
    q = rng.uniform(-0.5, 0.5, (n, 1))
    v, a = rng.standard_normal((2, n, 1))
    expected = two.inverse_dynamics(q, v, a)
    assert_allclose(three.inverse_dynamics(q, v, a), expected, rtol=1e-9, atol=1e-9)
    assert_allclose(three.inertia(q), two.inertia(q), rtol=1e-9)
    assert np.abs(expected).max() > 0.1


@pytest.mark.parametrize("height", [0.0, 0.25])
def test_a_slider_crank_on_paper(write, height: float) -> None:
    """Kinetic energy of crank, rod and block by hand, the rod's from its two ends' speeds, is `M v^2 / 2`."""
    mechanism = TreeMechanism(slider_crank(write, "zyx", height=height))
    for q in (-0.3, 0.0, 0.4):
        x, y = (
            CRANK * np.cos(AT + q),
            CRANK * np.sin(AT + q),
        )  # where crank and rod meet; its speed per rad/s is (-y, x)
        along = np.sqrt(ROD**2 - y**2 - height**2)  # x of the block less that
        block = -y - y * x / along
        one, other = np.array([-y, x]), np.array([block, 0.0])
        rod = 2.0 / 3 * (one @ one + one @ other + other @ other)
        expected = CRANK**2 / 3 + rod + 3.0 * block**2
        assert mechanism.inertia(np.array([[q]]))[0, 0, 0] == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(
    "more",
    [{"off": 0.05}, {"off": 0.002}, {"height": 0.25, "spin": 0.002}],
    ids=["its weight", "a little", "its inertia"],
)
def test_a_rod_that_would_be_turned_is_refused(write, more: dict[str, float]) -> None:
    """Off its centre it hangs as it likes; thick, it is left behind by hinges that turn it in space: an equation is missing."""
    with raises_code("unsupported", "1"):
        TreeMechanism(slider_crank(write, "zyx", **more))
    TreeMechanism(slider_crank(write, "zy", **more))
