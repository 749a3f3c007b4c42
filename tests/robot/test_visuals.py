"""What a robot file draws: meshes in their place and size; what cannot be read costs its picture alone."""

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from tau_dyn.robot import Mesh, list_missing_meshes, load_robot, load_robot_from_urdf, read_visuals

CORNERS = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])  # counted outwards
COLLADA = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="centimeter" meter="0.01"/><up_axis>Z_UP</up_axis></asset><library_geometries><geometry id="g"><mesh>
<source id="s"><float_array id="a" count="12">{corners}</float_array><technique_common><accessor source="#a" count="4" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#s"/></vertices><triangles count="4"><input semantic="VERTEX" source="#v"
offset="0"/><p>{faces}</p></triangles></mesh></geometry></library_geometries><library_visual_scenes>
<visual_scene id="w"><node><instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#w"/></scene></COLLADA>"""


def write_tetrahedron(path) -> None:
    """Write the corners and faces as STL, OBJ or Collada, the last in centimetres."""
    if path.suffix == ".obj":
        rows = [f"v {x} {y} {z}" for x, y, z in CORNERS] + ["f " + " ".join(map(str, f + 1)) for f in FACES]
        path.write_text("\n".join(rows))
    elif path.suffix == ".dae":
        faces = " ".join(map(str, FACES.ravel()))
        path.write_text(COLLADA.format(corners=" ".join(map(str, 100 * CORNERS.ravel())), faces=faces))
    else:
        loops = "".join(
            "facet normal 0 0 0\nouter loop\n"
            + "".join(f"vertex {x} {y} {z}\n" for x, y, z in CORNERS[f])
            + "endloop\nendfacet\n"
            for f in FACES
        )
        path.write_text(f"solid t\n{loops}endsolid t\n")


def draw(name: str, tag: str = "visual", scale: str = "") -> str:
    """Return a link's picture by a mesh, moved and turned."""
    origin = '<origin xyz="0.5 0 0.1" rpy="0 0 1.5707963267948966"/>'
    return f"<{tag}>{origin}<geometry><mesh filename='{name}' {scale}/></geometry></{tag}></link>"


@pytest.mark.parametrize("suffix", ["stl", "obj", "dae"])
def test_a_mesh_is_read_in_its_size_and_place(write, tmp_path, suffix):
    """A tetrahedron, twice as long along x as in its file, stands where its origin puts it; Collada's centimetres are metres."""
    write_tetrahedron(tmp_path / f"t.{suffix}")
    path = tmp_path / "robot.urdf"
    path.write_text(
        write.two_link().replace("</inertial></link>", "</inertial>" + draw(f"t.{suffix}", scale='scale="2 1 1"'), 1)
    )
    (visual,), missing = read_visuals(load_robot(path))
    assert not missing and isinstance(visual.shape, Mesh) and visual.joint == 1
    assert_allclose(visual.placement.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    seen = np.unique(visual.shape.vertices.round(6), axis=0)
    assert_allclose(seen, np.unique((CORNERS * [2, 1, 1]).round(6), axis=0), atol=1e-6)
    corners = visual.shape.vertices[visual.shape.faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(0.6 * 0.2 * 0.1 / 6, rel=1e-5)  # positive: faces are counted outwards


def test_a_mirrored_mesh_keeps_its_outside(write, tmp_path):
    """A negative scale along one axis mirrors the corners; faces still look outwards."""
    write_tetrahedron(tmp_path / "t.stl")
    path = tmp_path / "robot.urdf"
    path.write_text(
        write.two_link().replace("</inertial></link>", "</inertial>" + draw("t.stl", scale='scale="1 -1 1"'), 1)
    )
    (visual,), _ = read_visuals(load_robot(path))
    corners = visual.shape.vertices[visual.shape.faces]
    assert np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() > 0


def test_packages_given_by_hand_hold_meshes(write, tmp_path):
    """`packages` says where `package://NAME` lies; without it the mesh is missing and the sentence names it."""
    (tmp_path / "elsewhere").mkdir()
    write_tetrahedron(tmp_path / "elsewhere" / "t.obj")
    path = tmp_path / "robot.urdf"
    path.write_text(write.two_link().replace("</inertial></link>", "</inertial>" + draw("package://far/t.obj"), 1))
    found, missing = read_visuals(load_robot(path))
    assert not found and missing == ["package://far/t.obj"]
    assert "package://far/t.obj" in list_missing_meshes(missing)[0] and not list_missing_meshes([])
    found, missing = read_visuals(load_robot(path, packages={"far": tmp_path / "elsewhere"}))
    assert len(found) == 1 and not missing


@pytest.mark.parametrize("content", [b"", b"solid nothing\nendsolid nothing\n", b"\x00\xff" * 100])
def test_a_broken_mesh_costs_its_picture_only(write, tmp_path, content):
    """An empty, an empty-handed and a garbled file are missing; the robot answers."""
    (tmp_path / "t.stl").write_bytes(content)
    path = tmp_path / "robot.urdf"
    path.write_text(write.two_link().replace("</inertial></link>", "</inertial>" + draw("t.stl"), 1))
    found, missing = read_visuals(load_robot(path))
    assert not found and missing == ["t.stl"]


def test_a_link_without_a_picture_is_drawn_by_its_collision(write):
    """Where both stand in the file only the visual counts."""
    box = '<collision><geometry><box size="0.1 0.2 0.3"/></geometry></collision></link>'
    urdf = write.two_link().replace("</inertial></link>", f"</inertial>{box}", 1)
    (visual,), _ = read_visuals(load_robot_from_urdf(urdf, "r"))
    assert_allclose(2 * visual.shape.halfSide, [0.1, 0.2, 0.3])
    ball = '<visual><geometry><sphere radius="0.05"/></geometry></visual><collision>'
    (visual,), _ = read_visuals(load_robot_from_urdf(urdf.replace("<collision>", ball), "r"))
    assert type(visual.shape).__name__ == "Sphere"


def test_meshes_of_mjcf_stand_where_mujoco_draws_them(tmp_path):
    """A scaled mesh of a geom that is moved and turned: its corners in the world are MuJoCo's, its colour the material's."""
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "parts").mkdir()
    write_tetrahedron(tmp_path / "parts" / "t.obj")
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><compiler meshdir="parts"/><asset><mesh file="t.obj" scale="1 2 1"/>'
        '<material name="red" rgba="1 0 0 1"/></asset>'
        '<worldbody><body name="arm" pos="0 0 1"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
        '<joint name="turn" axis="0 1 0" range="-90 90" '
        'pos="0 0 0.2"/><geom type="mesh" mesh="t" pos="0.1 0 0" euler="0 0 90" material="red"/></body></worldbody></mujoco>'
    )
    robot = load_robot(path)
    (visual,), missing = read_visuals(robot)
    assert not missing and visual.colour is not None
    assert_allclose(visual.colour, [1, 0, 0, 1])
    assert visual.colour.flags.owndata  # Pinocchio's geometry, which held it, is gone
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, np.array([0.7]))
    ours = np.array([(data.oMi[visual.joint] * visual.placement).act(x) for x in visual.shape.vertices])
    model = mujoco.MjModel.from_xml_path(str(path))
    theirs = mujoco.MjData(model)
    theirs.qpos[:] = 0.7
    mujoco.mj_kinematics(model, theirs)
    world = model.mesh_vert @ theirs.geom_xmat[0].reshape(3, 3).T + theirs.geom_xpos[0]
    for corner in world:
        assert np.linalg.norm(ours - corner, axis=1).min() < 1e-6
