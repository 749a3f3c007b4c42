"""Rods read from robot files, their gaps, and the gaps' derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.mechanism import NotRods, Poses, build_rods, convert_from_quaternions, convert_to_quaternions
from tau_dyn.mechanism.rotations import rotate_by_vector
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import load_robot

KINDS = {
    "simplified": ("gantry_tau", {}),
    "complete": ("gantry_tau", {"arms": "complete"}),
    "d1": ("gantry_tau", {"arms": "complete", "prototype": "d1"}),
    "f1": ("gantry_tau_f1", {}),
    "delta": ("delta", {}),
    "stewart": ("stewart", {}),
    "queensland": ("gantry_tau_queensland", {}),
    "hexarot": ("hexarot", {}),
}


def rods_named(kind: str):
    name, arguments = KINDS[kind]
    return build_rods(load_robot(name, **arguments))


def near_home(rods, rng, n: int = 3) -> tuple[np.ndarray, Poses]:
    """Return positions and plate poses near home that do not belong together."""
    q = rods.robot.home + 0.1 * rng.standard_normal((n, rods.na))
    turn = np.zeros((3, n)) if rods.translates else 0.1 * rng.standard_normal((3, n))
    rotation = np.moveaxis(rotate_by_vector(turn, np.repeat(rods.rotation[:, :, None], n, axis=2)), 2, 0)
    return q, Poses(rods.home.position + 0.1 * rng.standard_normal((n, 3)), rotation)


@pytest.mark.parametrize("kind", KINDS)
def test_rods_close_at_home(kind):
    """At home every rod has its length, and all six (three) distances hold the plate."""
    rods = rods_named(kind)
    assert rods.n == (3 if rods.translates else 6)
    assert_allclose(rods.gap(rods.robot.home, rods.home), 0.0, atol=1e-13)


@pytest.mark.parametrize("kind", ["simplified", "f1", "delta", "stewart"])
def test_derivatives_of_the_gap(kind, rng):
    """By the plate's twist, by `q` and by every geometric parameter, against central differences."""
    rods = rods_named(kind)
    q, plate = near_home(rods, rng)
    h = 1e-6
    for k in range(6):
        twist = np.zeros((6, len(q)))
        twist[k] = h
        sides = [
            Poses(
                plate.position + s * twist[:3].T,
                np.moveaxis(rotate_by_vector(s * twist[3:], np.moveaxis(plate.rotation, 0, 2)), 2, 0),
            )
            for s in (1, -1)
        ]
        slope = (rods.gap(q, sides[0]) - rods.gap(q, sides[1])) / (2 * h)
        assert_allclose(rods.gap_by_pose(q, plate)[:, :, k], slope, atol=1e-8)
    for k, e in enumerate(h * np.eye(rods.na)):
        slope = (rods.gap(q + e, plate) - rods.gap(q - e, plate)) / (2 * h)
        assert_allclose(rods.gap_by_q(q, plate)[:, :, k], slope, atol=1e-8)
    values, columns = rods.geometry.values, rods.closure_by_geometry(q, plate)
    for k, e in enumerate(h * np.eye(len(values))):
        up, down = (rods.with_geometry(rods.geometry.with_values(values + s * e)) for s in (1, -1))
        assert_allclose(columns[:, :, k], (up.gap(q, plate) - down.gap(q, plate)) / (2 * h), atol=1e-8)


def test_a_simplified_gantry_tau_is_described_by_arms():
    """Seven parameters an arm, as the contract names them: length, origin and direction (thesis Table 5.7)."""
    rods = rods_named("simplified")
    assert len(rods.geometry) == 21 and rods.translates
    assert_allclose([rods.geometry[f"arm2.origin_{x}"].value for x in "xyz"], [0.25, -1.31, 1.46])
    assert_allclose([rods.geometry[f"arm{k}.length"].value for k in (1, 2, 3)], [2.05, 1.82, 1.81])


def test_chains_are_what_actuators_tie_together():
    """F1: cart 1 alone, cart 2 with q4, cart 3 with q5 and q6, and one, two and three rods on them (thesis 4.5)."""
    rods = rods_named("f1")
    names = [tuple(rods.robot.actuated[a] for a in actuators) for _, actuators in rods.groups]
    assert names == [("cart1",), ("cart2", "q4"), ("cart3", "q5", "q6")]
    assert [len(own) for own, _ in rods.groups] == [1, 2, 3]


def test_a_triangular_link_is_two_distances():
    """A body on one turn keeps its far point on a circle: two spheres around points of the axis (thesis 2.2)."""
    rods = rods_named("queensland")
    pair = [k for k, name in enumerate(rods.names) if name.startswith("triangle")]
    assert len(pair) == 2
    assert rods.lengths[pair[0]] == pytest.approx(rods.lengths[pair[1]], abs=1e-12)


def test_a_leg_grows_with_its_slide():
    """Stewart: the base point stands still, the length follows q one to one (thesis, after (4.3))."""
    rods = rods_named("stewart")
    home = rods.robot.home[None]
    assert_allclose(rods.leg_lengths(home + 0.02) - rods.leg_lengths(home), 0.02, atol=1e-15)
    assert_allclose(rods.base_points(home + 0.02), rods.base_points(home), atol=0)


@pytest.mark.parametrize(("name", "why"), [("linear_axis", "no loops"), ("h4", "rod"), ("parallelogram", "plate")])
def test_other_mechanisms_say_why_they_are_no_rods(name, why):
    """A serial axis, an articulated plate and a planar loop are refused with the reason."""
    with pytest.raises(NotRods, match=why):
        build_rods(load_robot(name))


def test_other_geometry_by_name_only():
    """A parameter that the geometry does not have is named."""
    with raises_code("unknown_name", "arm9.length"):
        rods_named("simplified").with_geometry(Parameters([Parameter("arm9.length", 1.0, "m")]))


def test_quaternions_go_there_and_back(rng):
    """A rotation and its quaternion x y z w, w not negative, are the same orientation."""
    quaternion = rng.standard_normal((20, 4))
    poses = convert_from_quaternions(np.zeros((20, 3)), quaternion)
    back = convert_to_quaternions(poses)
    unit = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    assert np.all(back[:, 3] >= 0)
    assert_allclose(back, unit * np.sign(unit[:, 3:]), atol=1e-14)


@pytest.mark.parametrize("kind", ["simplified", "f1", "stewart"])
def test_home_follows_the_geometry(kind, rng):
    """At other lengths and anchors the plate's home pose closes the new rods; lengths that cannot are refused."""
    rods = rods_named(kind)
    values = rods.geometry.values
    moved = rods.with_geometry(rods.geometry.with_values(values + 1e-3 * rng.standard_normal(len(values))))
    assert_allclose(moved.gap(rods.robot.home[None], moved.home), 0.0, atol=1e-12)
    assert 1e-5 < np.abs(moved.home.position - rods.home.position).max() < 0.1
    again = moved.with_geometry(rods.geometry)
    assert_allclose(again.home.position, rods.home.position, atol=1e-11)
    short = {n: 0.01 for n in rods.geometry.names if n.endswith(".length")}
    with raises_code("loop_not_closed"):
        _ = rods.with_geometry(rods.geometry.with_values(short)).home
