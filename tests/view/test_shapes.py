"""What is drawn of a robot: the file's solids as they are, furniture that follows from the tree, all where the loops close."""

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from tau_dyn.kinematics.solids import read_bodies
from tau_dyn.mechanism import LoopSolver
from tau_dyn.robot import list_robot_names, load_robot, load_robot_from_urdf
from tau_dyn.view import Placer, build_furniture
from tau_dyn.view.scene import compute_outline
from tau_dyn.view.shapes import CASING, ROLES, build_visual_shapes, list_body_roles

ENDS = '<visual><geometry><mesh filename="/etc/passwd"/></geometry></visual></link>'


def test_every_link_is_seen(write):
    """A file without any visual shape is drawn as sticks, one with shapes as they are; what is no mesh file is not opened."""
    assert {s.kind for s in build_visual_shapes(load_robot("gantry_tau"))} == {"box", "cylinder"}
    bare = load_robot_from_urdf(write.two_link(), "bare")
    assert {s.joint for s in build_furniture(bare)} >= {1}
    build_furniture(load_robot_from_urdf(write.two_link().replace("</link>", ENDS, 1), "mesh"))


def test_shapes_are_where_pinocchio_puts_their_joints(rng):
    """At random positions each rod lies midway between its joint and the plate's joint that it reaches."""
    robot = load_robot("gantry_tau")
    place = Placer(robot, build_visual_shapes(robot))
    q = robot.home + rng.uniform(-0.1, 0.1, 3)
    placed = place(q)
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, LoopSolver(robot).close(q))
    rods = [k for k, s in enumerate(place.shapes) if s.kind == "cylinder"]
    assert len(rods) == 3
    for k, loop in zip(rods, robot.loops, strict=True):
        far = data.oMf[loop.frame_b].translation
        near = data.oMi[place.shapes[k].joint].translation
        assert_allclose(placed[k][0], (near + far) / 2, atol=1e-9)


def test_every_ball_joint_has_one_ball_at_either_end_of_its_rod():
    """Six rods have twelve balls, at the carts' joints and at the plate's, each once."""
    robot = load_robot("gantry_tau", arms="complete")
    place = Placer(robot, build_furniture(robot))
    placed = place(robot.home + 0.05)
    balls = np.array([p for s, (p, _) in zip(place.shapes, placed, strict=True) if s.kind == "sphere"])
    assert len(balls) == 12
    apart = np.linalg.norm(balls[:, None] - balls[None], axis=2) + np.eye(12)
    assert apart.min() > 0.01
    lengths = sorted(np.round(apart.ravel(), 3))
    for rod in (2.05, 1.82, 1.81):
        assert rod in lengths


def test_a_plate_is_the_hull_of_its_joints_not_its_envelope():
    """The Delta's plate holds all six balls inside its hull; a plate held in one point keeps its box."""
    robot = load_robot("delta")
    (plate,) = [s for s in build_furniture(robot) if s.kind == "hull" and s.joint]
    points = np.array([robot.model.frames[loop.frame_b].placement.translation for loop in robot.loops])
    assert plate.faces is not None
    for a, b, c in plate.size[plate.faces]:
        normal = np.cross(b - a, c - a)
        assert np.all((points - a) @ normal <= 1e-12)  # every joint lies behind every face
    assert not [s for s in build_furniture(load_robot("gantry_tau")) if s.kind == "hull"]


@pytest.mark.parametrize("name", list_robot_names())
def test_parts_are_told_by_what_they_do(name):
    """What is driven is told from rods and plate, in the file's own colours; furniture is no solid that collisions know."""
    robot = load_robot(name)
    found = dict(zip(robot.model.names, list_body_roles(robot), strict=True))
    assert {j for j, r in found.items() if r == "driven"} == set(robot.actuated)
    if robot.loops:
        tool = robot.model.frames[robot.tool_frame].parentJoint
        assert found[robot.model.names[tool]] == "plate"
        assert sum(r == "rod" for r in found.values()) >= len(robot.loops) - 1
    drawn, (solids, _) = build_visual_shapes(robot), read_bodies(robot)
    assert len(solids) == len(drawn)
    assert all(s.colour == ROLES[s.role] for s in drawn)  # the files' materials are the same colours


def test_a_file_s_own_colours_are_kept(write):
    """A visual with a material of its own is not painted over."""
    look = '<visual><geometry><box size="1 1 1"/></geometry><material name="x"><color rgba="1 0 0 1"/></material></visual></link>'
    robot = load_robot_from_urdf(write.two_link().replace("</link>", look, 1), "red")
    assert build_visual_shapes(robot)[0].colour == (255, 0, 0)


def test_a_mesh_takes_the_place_of_sticks_and_keeps_its_corners(write, tmp_path):
    """A link with a mesh is no stick; its outline is the mesh's, where the joint carries it; a missing mesh leaves sticks."""
    (tmp_path / "t.obj").write_text("v 0 0 0\nv 0.4 0 0\nv 0 0 0.1\nv 0 0.1 0\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    path = tmp_path / "robot.urdf"
    look = '</inertial><visual><geometry><mesh filename="t.obj"/></geometry></visual></link>'
    path.write_text(write.two_link().replace("</inertial></link>", look, 1))
    robot = load_robot(path)
    place = Placer(robot, build_furniture(robot))
    (mesh,) = [s for s in place.shapes if s.joint == 1]
    assert mesh.kind == "mesh" and mesh.colour == CASING
    turned = place(np.array([np.pi / 2, 0.0]))  # about y: x points down
    corners = compute_outline([mesh], [turned[place.shapes.index(mesh)]])
    assert_allclose(corners.min(axis=0), [0, 0, -0.4], atol=1e-7)
    assert_allclose(corners.max(axis=0), [0.1, 0.1, 0], atol=1e-7)
    (tmp_path / "t.obj").unlink()
    assert {s.kind for s in build_furniture(load_robot(path))} == {"cylinder"}


def test_parts_are_found_by_joint_link_or_rod():
    """A cart's name is the cart and its rods; a rod's, with or without `_link`, is the rod alone; others are nothing."""
    robot = load_robot("gantry_tau", arms="complete")
    place = Placer(robot, build_furniture(robot))
    joints = {robot.model.names[place.shapes[k].joint] for k in place.carried_by("cart2")}
    assert joints == {"cart2", "rod2a_pitch", "rod2b_pitch"}
    assert place.carried_by("rod2a") == place.carried_by("rod2a_link") != []
    assert place.carried_by("nobody") == []
