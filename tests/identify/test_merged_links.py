"""Links fixed to another one have no parameters of their own; the result says whose parameters hold theirs."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.identify import Choices, build_model, identify
from tau_dyn.log import Log
from tau_dyn.robot import Robot, load_robot_from_urdf


@pytest.fixture
def arm(write) -> Robot:
    """Return a rod that turns about y with a plate of 2 kg screwed to its end, which carries a frame without mass."""
    rod = write.rod("forearm_link", 3, 0.4) + write.joint("elbow", "revolute", "base_link", "forearm_link", "0 1 0")
    plate = write.rod("plate_link", 2, 0.1) + write.joint(
        "screws", "fixed", "forearm_link", "plate_link", xyz="0.4 0 0"
    )
    tool = '<link name="tool"/>' + write.joint("tip", "fixed", "plate_link", "tool")
    return load_robot_from_urdf(write.text("arm", rod, plate, tool, write.drive("elbow")), "arm.urdf")


def test_a_screwed_plate_is_part_of_the_forearm(arm) -> None:
    """Five kilograms turn as one body; only bodies with mass are named, and the identification lists them."""
    assert arm.merged_links == {"plate_link": "forearm_link"}
    assert arm.parameters["forearm_link.mass"].value == pytest.approx(5.0)
    t = np.arange(0, 10, 0.01)
    q = 0.8 * np.sin(1.7 * t) + 0.3 * np.sin(4.1 * t)
    v, a = np.gradient(q, t, edge_order=2), np.gradient(np.gradient(q, t, edge_order=2), t, edge_order=2)
    tau = build_model(arm, "rigid").torque(q[:, None], v[:, None], a[:, None])[:, 0]
    found = identify(arm, Log(t, {"q_elbow": q, "tau_elbow": tau}), model="rigid")
    assert found.to_dict()["merged_links"] == arm.merged_links


def test_a_parameter_of_a_merged_link_names_the_link_that_holds_it(arm) -> None:
    """No data separate the plate from the forearm; the refusal says where its mass is."""
    with raises_code("unknown_name", "plate_link.mass", "plate_link is part of forearm_link"):
        Choices(free=("plate_link.mass",)).apply(build_model(arm, "rigid"))
