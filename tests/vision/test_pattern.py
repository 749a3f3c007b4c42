"""The pattern: what it must be to be told from itself upside down."""

import numpy as np
import pytest

from tau_dyn.exceptions import InputError
from tau_dyn.vision import Pattern, parse_pattern


def test_corners_lie_about_their_middle_a_square_apart():
    """The origin is the middle of the corners, where a pose is measured best."""
    points = Pattern(4, 3, 0.02).points
    assert np.allclose(points.mean(axis=0), 0)
    assert np.allclose(points[1] - points[0], [0.02, 0, 0])
    assert np.allclose(points[4] - points[0], [0, 0.02, 0])


@pytest.mark.parametrize(
    ("size", "square", "says"),
    [
        ("8x6", 0.02, "upside down"),
        ("7x7", 0.02, "upside down"),
        ("9x2", 0.02, "too small"),
        ("9", 0.02, "COLUMNSxROWS"),
        ("9x6x3", 0.02, "COLUMNSxROWS"),
        ("9x6", 20.0, "in m"),
        ("9x6", float("nan"), "in m"),
    ],
)
def test_a_pattern_that_cannot_serve_is_refused(size, square, says):
    """A symmetric chessboard has two orientations that look alike; a square of 20 m is one in mm."""
    with pytest.raises(InputError, match=says):
        parse_pattern(size, square)
