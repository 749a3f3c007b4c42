"""What effects are tried on: a small robot with two driven joints, and a Gantry-Tau whose carts stand off their lines."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from tau_dyn.mechanism import GantryTauMechanism
from tau_dyn.robot import Robot, load_robot_from_urdf


@pytest.fixture
def make(write) -> SimpleNamespace:
    """Makers of robots: `pair` has two sliding blocks, one on the other, both driven."""

    def pair() -> Robot:
        lower = write.link("lower_link", 5) + write.joint("lower", "prismatic", "base_link", "lower_link", "1 0 0")
        upper = write.link("upper_link", 3) + write.joint("upper", "prismatic", "lower_link", "upper_link", "0 1 0")
        return load_robot_from_urdf(
            write.text("pair", lower, upper, write.drive("lower"), write.drive("upper")), "pair"
        )

    return SimpleNamespace(pair=pair)


@pytest.fixture
def tool_of() -> Callable[[GantryTauMechanism, np.ndarray, np.ndarray], np.ndarray]:
    """Return the tool's position (N, 3) at cart positions (N, 3) and displacements (N, 3, 3), by Newton on three spheres."""

    def solve(mechanism: GantryTauMechanism, q: np.ndarray, u: np.ndarray) -> np.ndarray:
        carts = mechanism.origin + q[:, :, None] * mechanism.direction + u
        tool = mechanism.tool_position(q)
        for _ in range(6):
            D = tool[:, None] - carts
            gap = 0.5 * (np.sum(D**2, axis=2) - mechanism.length**2)
            tool = tool - np.linalg.solve(D, gap[:, :, None])[:, :, 0]
        return tool

    return solve
