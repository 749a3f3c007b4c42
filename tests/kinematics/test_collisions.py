"""Touching solids: arrays and coal agree with distances on paper."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest

from tau_dyn.kinematics import (
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    PlacedSolid,
    build_capsule,
    build_standing_solid,
    find_collisions,
)
from tau_dyn.kinematics.solids import Shape, Sphere

SOLIDS = [Box((0.3, 0.2, 0.5)), Cylinder(0.1, 0.4), Sphere(0.15), Capsule(0.05, 0.6)]


def at_random(shape: Shape, rng: np.random.Generator, n: int) -> PlacedSolid:
    turns = np.array([pin.Quaternion(*(q / np.linalg.norm(q))).matrix() for q in rng.normal(size=(n, 4))])
    return PlacedSolid(shape, turns, rng.uniform(-0.5, 0.5, (n, 3)))


@pytest.mark.parametrize("other", [*SOLIDS, HalfSpace()])
@pytest.mark.parametrize("shape", SOLIDS)
def test_arrays_agree_with_coal_pose_by_pose(shape: Shape, other: Shape, rng: np.random.Generator) -> None:
    """The spheres' shortcut never changes the answer of the collision library."""
    a, b = at_random(shape, rng, 60), at_random(other, rng, 60)
    expected = []
    for k in range(60):
        request, result = coal.CollisionRequest(), coal.CollisionResult()
        request.security_margin = 0.01
        expected.append(bool(coal.collide(*a.for_coal(k), *b.for_coal(k), request, result)))
    np.testing.assert_array_equal(find_collisions(a, b, 0.01), expected)


def test_parallel_rods_touch_at_the_sum_of_their_radii() -> None:
    """Rods of 20 and 30 mm radius side by side touch when their axes are 50 mm apart, not at 51."""
    start, end = np.zeros((2, 3)), np.tile([0.0, 0.0, 1.0], (2, 1))
    aside = np.array([[0.0499, 0, 0], [0.0501, 0, 0]])
    one, two = build_capsule(0.02, 1.0, start, end), build_capsule(0.03, 1.0, start + aside, end + aside)
    np.testing.assert_array_equal(find_collisions(one, two), [True, False])
    np.testing.assert_array_equal(find_collisions(one, two, 0.001), [True, True])


def test_telescopic_leg_is_as_long_as_its_joints_are_apart() -> None:
    """A leg drawn 1 m long that is pulled out to 2 m touches a ball that stands at 1.9 m."""
    start, end = np.zeros((2, 3)), np.array([[0, 0, 1.0], [0, 0, 2.0]])
    ball = build_standing_solid(Sphere(0.05), pin.SE3(np.eye(3), np.array([0.03, 0, 1.9])))
    np.testing.assert_array_equal(find_collisions(build_capsule(0.01, 1.0, start, end), ball), [False, True])


@pytest.mark.parametrize("shape", SOLIDS)
def test_covering_spheres_cover(shape: Shape, rng: np.random.Generator) -> None:
    """Every point of a solid lies in one of its spheres, and every centre lies in the solid."""
    points = rng.uniform(-0.5, 0.5, (4000, 3))
    points = points[shape.distance(points) < 0]
    for size in (0.6, 0.15, 0.04):
        centres, radius = shape.cover(size)
        gaps = np.linalg.norm(points[:, None] - centres[None], axis=2).min(axis=1)
        assert gaps.max() <= radius + 1e-12
        assert shape.distance(centres).max() < 0 or isinstance(shape, Cylinder)
