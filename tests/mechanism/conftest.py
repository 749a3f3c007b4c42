"""Robots of the kinds that dynamics must agree on."""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf


def _example(name: str) -> Path:
    """Return a file of example-robot-data, whose package cannot be imported but carries data."""
    try:
        found = [f for f in files("example-robot-data") or () if str(f).endswith(name)]
    except PackageNotFoundError:
        found = []
    if not found:
        pytest.skip("example-robot-data is not installed")
    return Path(str(found[0].locate()))


def _write_telescope(write: SimpleNamespace) -> str:
    """Return a slide on a link that turns about an oblique axis, and a wrist behind it."""
    chain = (("turn", "revolute", "0 0.6 0.8"), ("slide", "prismatic", "1 0 0"), ("wrist", "revolute", "0 1 0"))
    parts, parent = ["<robot name='telescope'>", write.link("base_link")], "base_link"
    for k, (name, kind, axis) in enumerate(chain):
        parts.append(write.link(f"{name}_link", 2.0 + k, "0.1 0.05 -0.1", "0.03 0.04 0.05"))
        parts.append(write.joint(name, kind, parent, f"{name}_link", axis, "0.2 0.1 0.3") + write.drive(name))
        parent = f"{name}_link"
    return "".join(parts) + "</robot>"


@pytest.fixture
def robots(write, measured) -> Callable[[str], Robot]:
    """Return a maker of robots by kind."""

    def make(kind: str) -> Robot:
        if kind in ("two_link", "four_bar", "block", "pendulum"):
            return load_robot_from_urdf(getattr(write, kind)(), kind)
        if kind == "turning":
            return load_robot_from_urdf(write.two_link().replace("revolute", "continuous"), kind)
        if kind == "telescope":
            return load_robot_from_urdf(_write_telescope(write), kind)
        if kind == "tx40":
            return load_robot(measured("tx40/tx40.urdf"))
        if kind in ("ur5", "panda"):
            return load_robot(_example("urdf/ur5_robot.urdf" if kind == "ur5" else "urdf/panda.urdf"))
        prototype, arms, rods = kind.split()
        return load_robot("gantry_tau", prototype=prototype, arms=arms, rod_mass_model=rods)

    return make


@pytest.fixture
def motion(rng) -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return random samples of positions around home, velocities and accelerations, each (n, na)."""

    def sample(robot: Robot, n: int = 8, reach: float = 0.25) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q = robot.home + rng.uniform(-reach, reach, (n, robot.na))
        return q, rng.standard_normal((n, robot.na)), rng.standard_normal((n, robot.na))

    return sample
