"""Forces of carts with two motors and of three arms on two freedoms: shares, preload and backlash, against d'Alembert."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
import redundant
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.cli import main
from tau_dyn.control import compute_drive_forces
from tau_dyn.identify import build_model
from tau_dyn.log import differentiate
from tau_dyn.message_codes import get_code
from tau_dyn.model import Model
from tau_dyn.robot import load_robot, load_robot_from_urdf
from tau_dyn.simulate import Trajectory

MASS = redundant.CART_MASS + redundant.SHOE_MASS
FRICTION = {"rail1.coulomb": 8.0, "rail1.viscous": 20.0, "rail2.coulomb": 14.0, "rail2.viscous": 35.0}


@pytest.fixture(scope="module")
def cart() -> Model:
    """Return a cart with two motors, each with friction of its own."""
    robot = load_robot_from_urdf(redundant.write_cart(), "cart.urdf")
    return build_model(robot, "symmetric").with_values(FRICTION)


def build_motion(joints: tuple[str, ...], t: np.ndarray, q: np.ndarray, v: np.ndarray) -> Trajectory:
    """Return a motion with numerical accelerations."""
    return Trajectory(joints, t, q, v, differentiate(v, float(t[1] - t[0]), accuracy=4), "motion")


@pytest.fixture(scope="module")
def stroke(cart) -> Trajectory:
    """Return a motion of the cart."""
    t = np.arange(0, 4, 0.002)
    moved = redundant.move_cart(t)
    return build_motion(cart.robot.actuated, t, moved.q[:, :1], moved.v[:, :1])


def test_two_motors_share_half_each_and_carry_their_own_friction(cart, stroke) -> None:
    """Without preload each pinion has half of `m a`; a motor's friction is at that motor alone."""
    found = compute_drive_forces(cart, stroke, [0.0])
    half = MASS * stroke.a[:, 0] / 2
    assert_allclose(found.shared, np.column_stack([half, half]), atol=1e-9)
    fast = np.abs(stroke.v[:, 0]) > 0.01
    for k, joint in enumerate(("rail1", "rail2")):
        own = FRICTION[f"{joint}.coulomb"] * np.sign(stroke.v[:, 0]) + FRICTION[f"{joint}.viscous"] * stroke.v[:, 0]
        assert_allclose((found.force[:, k] - half)[fast], own[fast], atol=1e-9)


def test_the_smallest_preload_is_half_of_the_largest_inertial_force(cart, stroke) -> None:
    """Pinions stay on their flanks from `p = max |m a| / 2` on; just below one of them is relieved, and a code names it."""
    half = MASS * np.abs(stroke.a[:, 0]).max() / 2
    chosen = compute_drive_forces(cart, stroke)
    assert_allclose(chosen.smallest, [half], rtol=1e-9)
    assert chosen.warnings == () and chosen.preload[0] == pytest.approx(1.1 * half)
    assert_allclose(chosen.inside, np.array([[-1.0, 1.0]]) * chosen.preload[0] * np.ones((len(stroke.t), 1)))
    assert not compute_drive_forces(cart, stroke, [1.001 * half]).relieved.any()
    low = compute_drive_forces(cart, stroke, [-0.99 * half])
    assert low.relieved.any() and {get_code(w) for w in low.warnings} == {"preload_low"}


def test_shares_of_three_arms_move_them_as_dalembert_says() -> None:
    """Least-squares shares are the rigid forces of the study's own mechanics; a preload does no work on any motion."""
    robot = load_robot_from_urdf(redundant.write_three_arms(), "arms.urdf")
    t = np.arange(0, 3, 0.002)
    moved = redundant.move_three_arms(t)
    index = [redundant.ARMS.index(joint) for joint in robot.actuated]
    motion = build_motion(robot.actuated, t, moved.q[:, index], moved.v[:, index])
    found = compute_drive_forces(Model.of(robot, []), motion, [4.0])
    order = [redundant.ARMS.index(joint) for joint in found.joints]
    inside = slice(10, -10)
    assert_allclose(found.shared[inside], moved.tau[inside][:, order], atol=2e-3)
    least = compute_drive_forces(Model.of(robot, []), motion, [1.0])
    turning = np.ptp(np.sign(least.inside), axis=0) > 0
    assert turning.any() and not least.held[turning].any()  # no constant preload keeps that arm on one flank
    assert {get_code(w) for w in least.warnings} == {"preload_low"}
    enough, low = (compute_drive_forces(Model.of(robot, []), motion, k * least.smallest) for k in (1.001, 0.99))
    assert not enough.relieved.any() and low.relieved.any()
    power = np.sum(found.inside * moved.v[:, order], axis=1)
    assert np.abs(power).max() < 1e-6 and np.abs(found.inside).max() >= 4.0


def test_limits_and_robots_without_double_motors_are_named(cart, stroke) -> None:
    """A preload beyond the motor's 200 N is status 3; a robot with one motor a joint has nothing to share."""
    with raises_code("no_solution", "rail", "200"):
        compute_drive_forces(cart, stroke, [400.0])
    with raises_code("bad_option"):
        compute_drive_forces(cart, stroke, [1.0, 2.0])
    plain = Model.of(load_robot("linear_axis"), [])
    with raises_code("unsupported"):
        compute_drive_forces(plain, Trajectory(("axis",), stroke.t, stroke.q, stroke.v, stroke.a, "motion"))


def test_the_command_writes_what_each_motor_gets(tmp_path, stroke, capsys) -> None:
    """From robot file and motion to a table; both motors together give `m a`, and the result names the smallest preload."""
    (tmp_path / "cart.urdf").write_text(redundant.write_cart())
    stroke.to_csv(tmp_path / "m.csv")
    out, result = tmp_path / "f.csv", tmp_path / "r.json"
    command = [
        "feedforward",
        "share",
        str(tmp_path / "cart.urdf"),
        "--motion",
        str(tmp_path / "m.csv"),
        "--out",
        str(out),
    ]
    assert main([*command, "--json", str(result)]) == 0
    table = pd.read_csv(out)
    assert_allclose(table["tau_ff_rail1"] + table["tau_ff_rail2"], MASS * stroke.a[:, 0], atol=1e-6)
    found = json.loads(result.read_text())
    assert found["preload"][0] == pytest.approx(1.1 * found["smallest_preload"][0])
    assert "rail2" in capsys.readouterr().out
    assert main([*command, "--preload", "400"]) == 3 and main([*command, "--preload", "1", "2"]) == 2


def test_code_of_a_generalised_force_names_the_drives_that_share_it(tmp_path) -> None:
    """The C function of a cart with two motors returns the force of both, so the export carries `redundant_drives`."""
    (tmp_path / "cart.urdf").write_text(redundant.write_cart())
    result = tmp_path / "r.json"
    command = ["feedforward", "export", str(tmp_path / "cart.urdf"), "--to", "c", "--out", str(tmp_path / "f.c")]
    assert main([*command, "--json", str(result), "--quiet"]) == 0
    assert json.loads(result.read_text())["warning_codes"] == ["redundant_drives"]
