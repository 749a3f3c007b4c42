"""Robots with wrong dimensions and their measured poses, for the tests of this folder."""

from __future__ import annotations

from functools import cache

import numpy as np

from tau_dyn.calibrate import PoseSet
from tau_dyn.calibrate.models import RodFamily, Spec
from tau_dyn.calibrate.simulated import simulate_poses
from tau_dyn.mechanism import Rods, build_rods
from tau_dyn.robot import load_robot


@cache
def rods_of(name: str = "gantry_tau", **arguments: str) -> Rods:
    """Return a robot's rods, built once."""
    return build_rods(load_robot(name, **arguments))


def family_at(rods: Rods, reach: float = 0.4) -> RodFamily:
    """Return its models for poses within `reach` of home."""
    home = rods.robot.home
    return RodFamily(
        rods, PoseSet(np.array([home - reach, home + reach]), np.zeros((2, 3)), approach=np.ones((2, rods.na)))
    )


def spoiled(geometry, rng: np.random.Generator, size: float = 1e-3, **given: float) -> np.ndarray:  # noqa: ANN001
    """Return parameters with random errors in every dimension, laws at zero unless `given` (dots as double underscores)."""
    theta = geometry.parameters.values.copy()
    for k, p in enumerate(geometry.parameters):
        if p.origin != "law":
            theta[k] += size * rng.standard_normal()
    for name, value in given.items():
        theta[geometry.parameters.names.index(name.replace("__", "."))] = value
    return theta


def measured(
    rods: Rods,
    model: str,
    n: int,
    seed: int,
    *,
    noise: tuple[float, float] = (1e-5, 2e-5),
    periods: dict[str, float] | None = None,
    turned: bool = True,
    backlash: np.ndarray | None = None,
    size: float = 1e-3,
    reach: float = 0.4,
    **given: float,
) -> tuple[PoseSet, np.ndarray]:
    """Return poses of a robot with wrong dimensions, and its true parameters."""
    rng = np.random.default_rng(seed)
    family = family_at(rods, reach)
    geometry = family.build(family.spec(model), periods)
    theta = spoiled(geometry, rng, size, **given)
    q = rods.robot.home + reach * (2 * rng.random((n, rods.na)) - 1)
    return simulate_poses(
        geometry, theta, q, rng, noise=noise, turned=turned and not rods.translates, backlash=backlash
    ), theta


__all__ = ["RodFamily", "Spec", "family_at", "measured", "rods_of", "spoiled"]


SCARA_JOINTS = (("s1", "revolute", "0 0 0.5"), ("s2", "revolute", "0.4 0 0"), ("z3", "prismatic", "0.3 0 0"),
          ("r4", "revolute", "0 0 -0.1"))  # fmt: skip


def scara_text() -> str:
    """Return the file of a SCARA with a flange."""
    rows, parent = ['<robot name="scara"><link name="base_link"/>'], "base_link"
    for name, kind, at in SCARA_JOINTS:
        rows.append(
            f'<link name="{name}_link"/><joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{name}_link"/>'
            f'<origin xyz="{at}"/><axis xyz="0 0 1"/><limit lower="-2.2" upper="2.2" velocity="2" effort="50"/></joint>'
        )
        parent = f"{name}_link"
    tool = '<link name="tool"/><joint name="flange" type="fixed"><origin xyz="0.05 0 -0.1"/>'
    return "".join(rows) + f'{tool}<parent link="{parent}"/><child link="tool"/></joint></robot>'
