"""What no plan can do is refused with a sentence that names it, before or after the search."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.control.motion import MotionLimits, plan_motion
from tau_dyn.exceptions import InputError
from tau_dyn.robot import load_robot_from_urdf

sys.path.insert(0, str(Path(__file__).parent))
from planned_robots import END, START, block, l1

pytest.importorskip("casadi")

PENDULUM = """<robot name="pendulum"><link name="base_link"/><link name="rod"><inertial><origin xyz="0 0 -0.5"/><mass value="2"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.01"/></inertial></link>
<joint name="pivot" type="revolute"><parent link="base_link"/><child link="rod"/><axis xyz="0 1 0"/>
<limit lower="-7" upper="7" velocity="20" effort="{effort}"/></joint>
<transmission name="drive"><joint name="pivot"/></transmission></robot>"""


def pendulum(effort: float):
    """Return a rod that hangs from a pivot and weighs 9.81 N m when level."""
    return load_robot_from_urdf(PENDULUM.format(effort=effort), "pendulum")


@pytest.mark.parametrize(
    ("start", "end", "said"),
    [
        ([9.0, 0, 0], END, "start .* out of reach"),
        (START, [1.75, -0.6, 5.0], "end .* out of reach"),
        ([0.75, -0.6, 0.75 + 1e-3], [4.5, -0.6, 0.75], "joint limit"),
        (START, START, "the same place"),
        (START[:2], END, "x, y, z"),
        ([np.nan, 0, 0], END, "finite"),
    ],
)
def test_ends_that_cannot_be(start, end, said: str):
    """A place out of reach, outside the joints' ranges, or no place at all."""
    with pytest.raises(InputError, match=said):
        plan_motion(l1(), start, end)


def test_a_weight_that_cannot_be_held():
    """A drive that cannot hold the arm still at an end: the joint, what it needs and what it may."""
    with raises_code("unreachable", "9", "5"):
        plan_motion(pendulum(5.0), [0.0], [np.pi / 2], joints=True)


def test_a_weak_drive_swings_up_without_holding_on_the_way():
    """A drive too weak to hold the arm level can pass there in motion: it pumps energy first."""
    plan = plan_motion(pendulum(6.0), [0.0], [np.pi - 0.05], joints=True, nodes=40)
    assert plan.q.min() < -0.1 and np.abs(plan.tau).max() <= 6.0 * 1.01


def test_a_path_no_limit_allows():
    """What no motion can do is no plan (exit status 3), not even where the solver found one that cheats between its nodes."""
    limits = MotionLimits.of(pendulum(6.0), force=6.0, speed=0.05)  # no speed to pass the level pose
    with raises_code("no_solution"):
        plan_motion(pendulum(6.0), [0.0], [np.pi - 0.05], joints=True, limits=limits, nodes=12)


def test_a_place_near_a_singularity():
    """A conditioning above the limit at an end, or on a prescribed path, is refused by its number."""
    model = l1()
    with raises_code("unreachable"):
        plan_motion(model, START, END, limits=MotionLimits.of(model, condition=3.0))


def test_a_path_that_leaves_the_workspace():
    """A line or a spline through points that the robot cannot follow to its end."""
    with raises_code("unreachable", "path"):
        plan_motion(l1(), START, END, path=np.array([[1.75, -0.6, 3.0]]))
    with raises_code("wrong_shape", "3"):
        plan_motion(l1(), START, END, path=np.zeros((4, 2)))
    with raises_code("invalid_value"):
        plan_motion(l1(), START, END, path="circle")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"force": 0.0}, "above zero"),
        ({"force": [1.0, 2.0]}, "one a joint"),
        ({"speed": -1.0}, "above zero"),
        ({"margin": 1.0}, "margin"),
        ({"force": np.inf}, "no force limit"),
        ({"condition": 0.5}, "conditioning"),
    ],
)
def test_limits_that_make_no_sense(given: dict, said: str):
    """Each faulty limit by name."""
    with pytest.raises(InputError, match=said):
        MotionLimits.of(l1(), **given)


@pytest.mark.parametrize(
    "given", [{"energy_weight": -1.0}, {"energy_weight": np.nan}, {"dt": 0.0}, {"nodes": 3}, {"dt": np.inf}]
)
def test_settings_out_of_range(given: dict):
    """Weights, clocks and numbers of intervals that no plan can have."""
    with raises_code("invalid_value"):
        plan_motion(block(), [-0.4], [0.4], joints=True, **given)
