"""A robot file's zeros need not close its loops: a home is searched within the limits, taken near the zeros, and stated."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.exceptions import LoopClosureError
from tau_dyn.mechanism.loops import LoopSolver
from tau_dyn.message_codes import get_code
from tau_dyn.robot import Robot, load_robot_from_urdf
from tau_dyn.robot.closed_home import LoopGap

CRANK, ROD = 0.35, 0.7


def write_five_bar(base: float, passive: tuple[float, float] = (-3.1, 3.1), home: str = "") -> str:
    """Return a five-bar about y whose zeros lie all along x; its cranks are `base` [m] apart and drive, its rods have limits."""
    body = '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
    links = "".join(f'<link name="{name}_link">{body}</link>' for name in ("c1", "k1", "c2", "k2"))
    limits = {"k1": passive, "k2": passive}
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/><axis xyz="0 1 0"/>'
        f'<origin xyz="{x} 0 0"/><limit lower="{low}" upper="{high}" velocity="8" effort="200"/></joint>'
        for name, parent, x in (
            ("c1", "base", 0),
            ("k1", "c1_link", CRANK),
            ("c2", "base", base),
            ("k2", "c2_link", CRANK),
        )
        for low, high in (limits.get(name, (-3.1, 3.1)),)
    )
    drives = "".join(
        f'<transmission name="t_{name}"><type>transmission_interface/SimpleTransmission</type>'
        f'<joint name="{name}"/></transmission>'
        for name in ("c1", "c2")
    )
    return (
        '<robot name="fb" xmlns:drake="http://drake.mit.edu" xmlns:tau_dyn="urn:tau_dyn"><link name="base"/>'
        f"{links}{joints}{drives}"
        '<drake:ball_constraint><drake:ball_constraint_body_A name="k1_link"/><drake:ball_constraint_body_B name="k2_link"/>'
        f'<drake:ball_constraint_p_AP value="{ROD} 0 0"/><drake:ball_constraint_p_BQ value="{ROD} 0 0"/></drake:ball_constraint>'
        f"{home}</robot>"
    )


def close(robot: Robot) -> tuple[float, dict[str, float]]:
    """Return the gap [m] at home and the positions of all joints there."""
    solver = LoopSolver(robot)
    q = solver.close(robot.home)
    return solver.closure_error(q), dict(zip(robot.model.names[1:], q.tolist(), strict=True))


def test_stretched_zeros_are_a_dead_centre_and_a_closure_is_found() -> None:
    """With both cranks at zero the rods of 0.7 m meet above or below the middle of their ends, 0.5 m apart."""
    robot = load_robot_from_urdf(write_five_bar(0.5), "five bar")
    gap, x = close(robot)
    assert gap < 1e-10 and not robot.home.any()
    assert abs(abs(x["k1"]) - np.arccos(0.25 / ROD)) < 1e-9 and abs(abs(x["k2"]) - np.arccos(-0.25 / ROD)) < 1e-9
    said = [w for w in robot.warnings if get_code(w) == "home_searched"]
    assert len(said) == 1 and f"k1 = {x['k1']:.4g} rad" in said[0] and "one other closure" in said[0]


def test_limits_choose_between_closures() -> None:
    """Joints that only turn upwards have one closure of the two."""
    for passive, sign in (((-0.01, 3.1), 1), ((-3.1, 0.01), -1)):
        _, x = close(load_robot_from_urdf(write_five_bar(0.5, passive), "five bar"))
        assert np.sign([x["k1"], x["k2"]]).tolist() == [sign, sign]


def test_a_home_in_the_file_is_not_searched_for() -> None:
    """The file names the assembly mode, so nothing is searched or said."""
    for sign in (1, -1):
        home = f'<tau_dyn:home joint="k1" value="{sign * 1.2}"/><tau_dyn:home joint="k2" value="{sign * 1.9}"/>'
        robot = load_robot_from_urdf(write_five_bar(0.5, home=home), "five bar")
        gap, x = close(robot)
        assert gap < 1e-10 and np.sign(x["k1"]) == sign
        assert not [w for w in robot.warnings if get_code(w) == "home_searched"]


def test_drives_move_where_their_zeros_close_no_loop() -> None:
    """Cranks 1.9 m apart reach each other only when they point inwards; the drives' home moves there, as little as it must."""
    robot = load_robot_from_urdf(write_five_bar(1.9), "five bar")
    gap, _ = close(robot)
    assert gap < 1e-10 and np.abs(robot.home).max() > 0.5
    assert any(get_code(w) == "home_searched" and "c2 = " in w for w in robot.warnings)


def test_loops_that_no_position_closes_are_refused() -> None:
    """Cranks and rods reach 2.1 m together, and the cranks are 2.2 m apart."""
    robot = load_robot_from_urdf(write_five_bar(2.2), "five bar")
    with pytest.raises(LoopClosureError, match="cannot be closed at home"):
        close(robot)


def test_joints_that_follow_a_drive_move_the_loops_along() -> None:
    """The gaps' derivative by a drive holds what its followers do: central differences agree."""
    follower = (
        '<link name="e_link"/><joint name="e" type="revolute"><parent link="c2_link"/><child link="e_link"/><axis xyz="0 1 0"/>'
        '<limit lower="-3" upper="3" velocity="8" effort="200"/><mimic joint="c1" multiplier="0.5" offset="0.1"/></joint></robot>'
    )
    text = (
        write_five_bar(0.5).replace('<parent link="c2_link"/>', '<parent link="e_link"/>').replace("</robot>", follower)
    )
    robot = load_robot_from_urdf(text, "five bar")
    gap, every = LoopGap(robot), [int(k) for k in (*robot.passive_v, *robot.active_v)]
    assert close(robot)[0] < 1e-10 and len(every) == robot.model.nv - 1
    x, step = gap.follow(np.random.default_rng(3).uniform(-1, 1, robot.model.nv)), 1e-6
    slope = gap.differentiate(x, every)
    for k, joint in enumerate(every):
        moved = [gap.measure(gap.follow(x + sign * step * np.eye(robot.model.nv)[joint])) for sign in (1, -1)]
        assert np.allclose(slope[:, k], (moved[0] - moved[1]) / (2 * step), atol=1e-8)
