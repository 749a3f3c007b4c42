"""Measured points: what belongs together is read together, and what cannot be a pose is named with its line."""

from __future__ import annotations

from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.log import read_measured

HEADER = "q_a,q_b,x_tool,y_tool,z_tool,qx_tool,qy_tool,qz_tool,qw_tool"
TURNED = "0.1,0.2,1,2,3,0,0,0.6,0.8"  # 0.6^2 + 0.8^2 = 1


def test_positions_points_and_orientations_are_read(csv_file):
    """Joints come in the order asked for; a unit quaternion passes."""
    found = read_measured(csv_file([HEADER, TURNED, TURNED.replace("0.1,", "0.5,")]), ("b", "a"))
    assert found.joints == ("b", "a")
    assert_allclose(found.q, [[0.2, 0.1], [0.2, 0.5]])
    assert_allclose(found.column("a"), [0.1, 0.5])
    assert_allclose(found.points, [[1, 2, 3]] * 2)
    assert_allclose(found.quaternions, [[0, 0, 0.6, 0.8]] * 2)
    with raises_code("missing_column", "q_c"):
        found.column("c")


def test_an_orientation_of_another_length_is_named_by_its_line(csv_file):
    """A length of 1.2 is no orientation, whatever stands before and after it."""
    lines = [HEADER, TURNED, TURNED.replace("0.6,0.8", "0.72,0.96"), TURNED, TURNED.replace("0.6,0.8", "0,0.5")]
    with raises_code("bad_sample", "3", "1.2", "1"):
        read_measured(csv_file(lines), ("a", "b"))


def test_points_with_a_column_missing_are_no_points(csv_file):
    """Two of three coordinates say nothing; a file without any joint is refused."""
    found = read_measured(csv_file(["q_a,x_tool,y_tool", "0.1,1,2", "0.2,1,2"]), ("a", "b"))
    assert found.points is None and found.quaternions is None and found.joints == ("a",)
    with raises_code("missing_column", "q_J", "q_c"):
        read_measured(csv_file(["q_a,x_tool", "0.1,1"]), ("c",))
