"""A calibrated geometry written back as a robot file: every program then has the calibrated robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.robot import load_robot, load_robot_from_urdf

URDF = Path(__file__).resolve().parents[2] / "urdf"


@pytest.mark.parametrize("name", ["delta", "parallelogram", "gantry_tau"])
def test_the_file_is_the_calibrated_robot(name: str) -> None:
    """The tool of the written file's nominal robot is the calibrated one, offsets, rod lengths and scales of slides included."""
    robot = load_robot(URDF / f"{name}.urdf.xacro")
    geometry = build_tree_geometry(robot)
    changed = np.array(
        [
            p.free or p.name.startswith("tool.") or (p.name.endswith(".gain") and name == "gantry_tau")
            for p in geometry.parameters
        ]
    )
    theta = geometry.parameters.values + np.random.default_rng(1).normal(0, 1e-3, len(changed)) * changed
    if (
        name == "parallelogram"
    ):  # what lies across its plane would leave the loop open, and a nominal robot's loops must close
        flat = [n for n in geometry.parameters.names if n.endswith(("_y", ".rx", ".rz"))]
        theta = geometry.parameters.with_values(
            {n: v for n, v in zip(geometry.parameters.names, theta, strict=True) if n not in flat}
        ).values
    again = build_tree_geometry(
        load_robot_from_urdf(geometry.format_urdf(theta), "calibrated", actuated=robot.actuated)
    )
    q = robot.home + np.random.default_rng(2).uniform(-0.1, 0.1, (3, robot.na))
    a, b = geometry.forward(theta, q).poses, again.forward(again.parameters.values, q).poses
    assert np.abs(a.position - b.position).max() < 1e-11 and np.abs(a.rotation - b.rotation).max() < 1e-11
    assert np.abs(a.position - geometry.forward(geometry.parameters.values, q).poses.position).max() > 1e-4


def test_gear_ratios_are_refused() -> None:
    """A robot file has no gear ratios of turning joints; leaving one out silently would be wrong by centimetres."""
    geometry = build_tree_geometry(load_robot(URDF / "delta.urdf.xacro"))
    with raises_code("unsupported", "arm2.gain"):
        geometry.format_urdf(geometry.parameters.with_values({"arm2.gain": 1.01}).values)
