"""Mode shapes on the robot: what is joined stays joined, and a robot's own springs give back the shapes that they made."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.mechanism import FlexibleModel
from tau_dyn.modes import Mode, ShapesOnRobot, project_shapes_on_robot
from tau_dyn.modes.on_robot import compute_mac, find_sensed_places
from tau_dyn.render.kinds.modes import draw_on_robot
from tau_dyn.render.pictures import draw_swing
from tau_dyn.robot import Robot, load_robot

AXES = ("x_tool", "y_tool", "z_tool")


def mode(frequency: float, shape: Sequence[complex] | np.ndarray) -> Mode:
    """Return a mode of damping 1 %."""
    return Mode(frequency, 0.01, 0.01, 1e-3, np.asarray(shape, complex), 0.0)


@pytest.fixture(scope="module")
def flexible() -> Robot:
    """The L1 with its springs."""
    return load_robot("gantry_tau", arms="complete", flexible="true", wrist="serial2")


@pytest.fixture(scope="module")
def found(flexible) -> ShapesOnRobot:
    """Its own four slowest modes as if measured 1 % too low, in an order of their own and turned in phase."""
    own = FlexibleModel(flexible).at().modes()
    seen = [mode(0.99 * own[k].frequency_hz, (1 + 2j) * own[k].tool) for k in (2, 0, 3, 1)]
    shapes = project_shapes_on_robot(flexible, seen, AXES)
    assert shapes is not None
    return shapes


def test_a_robots_own_modes_are_recognised(found, flexible) -> None:
    """Each measured shape meets the mode of the springs that made it: MAC 1, frequency 1 % off."""
    own = FlexibleModel(flexible).at().modes()
    for pair, k in zip(found.pairs, (2, 0, 3, 1), strict=True):
        assert pair.model is not None and pair.mac == pytest.approx(1, abs=1e-4)
        assert pair.model.frequency_hz == pytest.approx(own[k].frequency_hz)
        near, far = pair.model.arrows["tool"], own[k].tool
        assert compute_mac(near, far) == pytest.approx(1, abs=1e-4)
    assert [row["mac"] for row in found.to_list()] == [pair.mac for pair in found.pairs]


def test_the_tools_body_moves_as_measured_and_carts_stand(found) -> None:
    """The measured drawing: the point at the tool by the whole arrow, carts not at all, halves of a rod joined in the middle."""
    swing, skeleton = found.pairs[0].measured, found.skeleton
    everything, moved = np.concatenate(skeleton.links), np.concatenate(swing.links)
    for a in range(len(everything)):
        same = np.linalg.norm(everything - everything[a], axis=1) < 1e-6
        assert_allclose(moved[same], np.broadcast_to(moved[a], moved[same].shape), atol=1e-9)
    shares = np.concatenate(skeleton.carries)
    assert shares.min() == 0 and shares.max() == 1 and np.any((shares > 0.3) & (shares < 0.7))
    for cart in skeleton.joints:
        assert_allclose(moved[np.linalg.norm(everything - cart, axis=1) < 1e-6], 0, atol=1e-12)
    assert_allclose(moved[shares == 1], np.broadcast_to(swing.arrows["tool"], (int(np.sum(shares == 1)), 3)))


def test_a_rigid_robot_has_no_shapes_of_its_own() -> None:
    """Without springs in the file the measured shape is drawn alone, on rods that end at one point."""
    shapes = project_shapes_on_robot(
        load_robot("gantry_tau"), [mode(7.0, [1, 0.5j, 0])], ("ax_tool", "ay_tool", "az_tool")
    )
    assert shapes is not None and shapes.pairs[0].model is None and np.isnan(shapes.pairs[0].mac)
    assert shapes.to_list() == [{"frequency_hz": 7.0, "model_frequency_hz": None, "mac": None}]
    _, group, _ = draw_on_robot(shapes, [True])
    (couple,) = group.blocks
    (swing,) = map(draw_swing, couple.drawings)
    assert couple.captions[0][0] == "measured" and "<animate " in swing and "arrow" in swing
    assert list(draw_on_robot(shapes, [False])) == []


def test_outputs_name_axes_and_places() -> None:
    """`x`, `vy_plate`, `az_tool`: axis and place; anything else, and places that the robot does not have, are not drawn."""
    assert find_sensed_places(("x", "vy_plate", "az_tool", "force_x")) == {"tool": {0: 0, 2: 2}, "plate": {1: 1}}
    robot = load_robot("gantry_tau")
    assert project_shapes_on_robot(robot, [mode(7.0, [1.0])], ("force_x",)) is None
    assert project_shapes_on_robot(robot, [mode(7.0, [1.0])], ("x_moon",)) is None
    assert project_shapes_on_robot(robot, [], AXES) is None


def test_an_arm_without_loops_yields_more_the_farther_out() -> None:
    """No loops, no carts: the base stands, the tool's body moves by all of the arrow, shares grow along the arm."""
    robot = load_robot("parallelogram")
    shapes = project_shapes_on_robot(robot, [mode(7.0, [1.0])], ("x_tool",))
    assert shapes is not None
    reach = [np.linalg.norm(x, axis=1) for x in shapes.skeleton.links]
    assert all(np.all((s >= 0) & (s <= 1)) for s in shapes.skeleton.carries) and reach
