"""Bodies of MJCF files whose mass is that of their meshes: against MuJoCo and the formulas of solids."""

import struct

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.exceptions import InputError
from tau_dyn.robot import load_robot
from tau_dyn.robot.mesh_inertia import measure_mesh, read_triangles

SIZE = (0.2, 0.3, 0.05)
"""Sides of a block [m], one corner of which is at the origin."""


def extrude(outline: list[tuple[float, float]], cut: list[tuple[int, int, int]], height: float) -> np.ndarray:
    """Return the triangles (n, 3, 3) of a prism over an outline, counter-clockwise, that is cut into triangles."""
    n, flat = len(outline), np.column_stack([np.array(outline, float), np.zeros(len(outline))])
    low, high = flat, flat + [0, 0, height]
    sides = [
        t
        for k in range(n)
        for t in ((low[k], low[(k + 1) % n], high[k]), (low[(k + 1) % n], high[(k + 1) % n], high[k]))
    ]
    return np.array([[low[k] for k in face[::-1]] for face in cut] + [[high[k] for k in face] for face in cut] + sides)


BLOCK = extrude([(0, 0), (SIZE[0], 0), SIZE[:2], (0, SIZE[1])], [(0, 1, 2), (0, 2, 3)], SIZE[2])
ANGLE = extrude(
    [(0, 0), (0.3, 0), (0.3, 0.1), (0.1, 0.1), (0.1, 0.4), (0, 0.4)], [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)], 0.06
)
"""An angle, which is not convex."""


def write_stl(path, triangles: np.ndarray) -> None:
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *t.ravel(), 0) for t in triangles)
    path.write_bytes(bytes(80) + struct.pack("<I", len(triangles)) + rows)


def write_obj(path, triangles: np.ndarray) -> None:
    points = "".join(f"v {x} {y} {z}\n" for x, y, z in triangles.reshape(-1, 3))
    path.write_text(
        points + "".join(f"f {3 * k + 1}//1 {3 * k + 2}//1 {3 * k + 3}//1\n" for k in range(len(triangles)))
    )


@pytest.mark.parametrize("form", ["legacy", "exact"])
def test_a_block_has_the_moments_of_a_block(form: str) -> None:
    """Volume, centre and moments of a box, wherever it is."""
    x, y, z = SIZE
    volume, centre, inertia = measure_mesh(BLOCK + [1.0, -2.0, 0.5], form)
    assert_allclose(volume, x * y * z, rtol=1e-9)
    assert_allclose(centre, [1 + x / 2, -2 + y / 2, 0.5 + z / 2], rtol=1e-9)
    assert_allclose(
        inertia, volume / 12 * np.diag([y * y + z * z, x * x + z * z, x * x + y * y]), rtol=1e-6, atol=1e-15
    )


@pytest.mark.parametrize("write", [write_stl, write_obj])
@pytest.mark.parametrize("form", ["", 'inertia="exact"'])
@pytest.mark.parametrize("weight", ["", 'mass="0.7"', 'density="300"'])
@pytest.mark.parametrize("scale", ["1 1 1", "0.5 -1 2"])
def test_bodies_weigh_what_mujoco_weighs(tmp_path, write, form: str, weight: str, scale: str) -> None:
    """An angle and a ball on one body, turned and scaled: mass, centre and inertia are MuJoCo's."""
    import mujoco

    write(tmp_path / f"angle.{'stl' if write is write_stl else 'obj'}", ANGLE)
    path = tmp_path / "robot.xml"
    path.write_text(
        f"""<mujoco><asset><mesh name="m" file="angle.{"stl" if write is write_stl else "obj"}" scale="{scale}" {form}/></asset>
        <worldbody><body name="b"><joint name="j" axis="0 1 0"/>
        <geom type="mesh" mesh="m" pos="0.1 0.2 0.3" euler="10 20 30" {weight}/><geom size="0.05" pos="0.3 0 0"/>
        </body></worldbody>
        <actuator><motor joint="j"/></actuator></mujoco>"""
    )
    theirs = mujoco.MjModel.from_xml_path(str(path))
    body, axes = theirs.body("b").id, np.zeros(9)
    mujoco.mju_quat2Mat(axes, theirs.body_iquat[body])
    axes = axes.reshape(3, 3)
    ours = load_robot(path).model.inertias[1]
    assert_allclose(ours.mass, theirs.body_mass[body], rtol=1e-6)
    assert_allclose(ours.lever, theirs.body_ipos[body], atol=1e-7)
    assert_allclose(ours.inertia, axes @ np.diag(theirs.body_inertia[body]) @ axes.T, rtol=1e-5, atol=1e-8)


def test_a_mesh_that_is_missing_or_no_mesh_is_named(tmp_path) -> None:
    """One sentence with the file; a text file, a cut one and one without triangles are no meshes."""
    with pytest.raises(InputError, match=r"no\.stl.*<inertial>"):
        read_triangles(tmp_path / "no.stl")
    for name, data in (("a.stl", b"solid"), ("b.stl", bytes(80) + struct.pack("<I", 9)), ("c.obj", b"v 0 0 0\nf 1 2 3\n"),
                       ("d.obj", b"")):  # fmt: skip
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match="no triangles"):
            read_triangles(tmp_path / name)
