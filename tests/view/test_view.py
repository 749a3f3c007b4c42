"""The viewer shows the robot where its loops close, only to this computer, and says where it cannot be."""

import json

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from tau_dyn.cli import main
from tau_dyn.exceptions import InputError
from tau_dyn.kinematics import LoopSolver
from tau_dyn.log import Log
from tau_dyn.robot import load_robot, robot_from_urdf
from tau_dyn.view import Placer, shapes_of
from tau_dyn.view.overlay import cloud_in, findings_in, playback_of


@pytest.fixture
def viewer():
    """A window on the complete Gantry-Tau, closed afterwards."""
    pytest.importorskip("viser")
    from tau_dyn.view import Viewer

    made = Viewer(load_robot("gantry_tau", arms="complete"), port=18080)
    yield made
    made.close()


def test_every_link_is_seen(write):
    """A file without any visual shape is drawn as sticks, one with shapes as they are; meshes are not opened."""
    assert {s.kind for s in shapes_of(load_robot("gantry_tau"))} == {"box", "cylinder"}
    bare = robot_from_urdf(write.two_link(), "bare")
    assert {s.joint for s in shapes_of(bare)} >= {1}
    mesh = '<visual><geometry><mesh filename="/etc/passwd"/></geometry></visual></link>'
    shapes_of(robot_from_urdf(write.two_link().replace("</link>", mesh, 1), "mesh"))


def test_shapes_are_where_pinocchio_puts_their_joints(rng):
    """At random positions each rod's shape lies midway between its joint and the plate's joint that it reaches."""
    robot = load_robot("gantry_tau")
    place = Placer(robot, shapes_of(robot))
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


def test_sliders_move_the_plate_and_say_where_it_cannot_be(viewer):
    """Within reach the robot follows; beyond it stays where it was and the reason stands under the sliders."""
    robot, before = viewer.robot, viewer.q.copy()
    there = robot.home + np.array([0.05, -0.03, 0.02])
    assert viewer.show(there) and viewer.message == ""
    assert_allclose(viewer.q, there)
    assert not viewer.show(robot.home + np.array([6.0, 0.0, 0.0]))
    assert "out of reach" in viewer.message
    assert_allclose(viewer.q, there)
    assert not np.allclose(before, there)


def test_the_window_is_open_to_this_computer_only(viewer):
    """The server listens on the loopback address unless told otherwise."""
    assert viewer.url.startswith("http://127.0.0.1:")


def test_a_log_plays_at_the_rate_of_the_eye():
    """500 Hz become about 30 pictures a second, with the references as ghost where the log has them."""
    robot, t = load_robot("linear_axis"), np.arange(1000) / 500
    log = Log(t, {"q_axis": np.sin(t), "q_ref_axis": np.cos(t)})
    made = playback_of(log, robot)
    assert 25 < len(made.t) / made.t[-1] < 35
    assert made.ghost is not None and made.ghost.shape == made.q.shape == (len(made.t), 1)


def test_a_finding_lights_what_its_joint_carries(viewer):
    """Cart 2's finding colours cart 2 and its rods, not the others."""
    from tau_dyn.view.viewer import COLOURS

    viewer.light(("cart2",))
    lit = {k for k, h in enumerate(viewer._handles) if tuple(h.color) == COLOURS["named"]}
    joints = {viewer.robot.model.names[viewer._placer.shapes[k].joint] for k in lit}
    assert "cart2" in joints and {j[:4] for j in joints} == {"cart", "rod2"}


@pytest.mark.parametrize(
    ("text", "says"), [("[]", "not a result"), ("{", "not a result"), ('{"findings": [1]}', "not a result")]
)
def test_what_is_no_diagnosis_is_one_sentence(tmp_path, text, says):
    """A broken result file names itself."""
    (tmp_path / "r.json").write_text(text)
    with pytest.raises(InputError, match=says):
        findings_in(tmp_path / "r.json")


def test_a_cloud_is_read_with_its_first_value(tmp_path):
    """Columns x y z place the points, a further numeric one colours them; without them the columns there are listed."""
    (tmp_path / "c.csv").write_text("x,y,z,stiffness\n0,0,1,5\n1,nan,0,6\n2,2,2,7\n")
    points, value = cloud_in(tmp_path / "c.csv")
    assert_allclose(points, [[0, 0, 1], [2, 2, 2]])
    assert value is not None and list(value) == [5, 7]
    (tmp_path / "d.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="there are a, b"):
        cloud_in(tmp_path / "d.csv")


def test_the_command_shows_and_ends(tmp_path, capsys):
    """`view` prints its address, stays for as long as told, and leaves status 0."""
    pytest.importorskip("viser")
    result = tmp_path / "r.json"
    result.write_text(json.dumps({"findings": [{"cause": "stribeck", "status": "confirmed", "joints": ["axis"]}]}))
    assert main(["view", "linear_axis", "--result", str(result), "--for", "0.2", "--port", "18090"]) == 0
    assert "linear_axis at http://127.0.0.1:" in capsys.readouterr().out
