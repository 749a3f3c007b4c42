"""The camera model against finite differences, its own inverse and OpenCV's."""

import numpy as np
import pytest

from tau_dyn.vision.cameras import compute_rays, project, project_with_jacobians

NUMBERS = np.array([800, 810, 320, 240, -0.25, 0.12, 1e-3, -5e-4, 0.02])
POINTS = np.random.default_rng(0).uniform([-0.3, -0.2, 0.8], [0.3, 0.2, 1.3], (20, 3))


def test_derivatives_are_those_of_the_projection():
    """Both analytic derivatives agree with central differences to 1e-6 of a pixel."""
    pixels, by_point, by_numbers = project_with_jacobians(POINTS, NUMBERS)
    assert np.allclose(pixels, project(POINTS, NUMBERS))
    h = 1e-6
    for j in range(3):
        d = h * np.eye(3)[j]
        assert np.allclose(
            by_point[..., j], (project(POINTS + d, NUMBERS) - project(POINTS - d, NUMBERS)) / (2 * h), atol=1e-5
        )
    for j in range(9):
        d = h * np.eye(9)[j]
        assert np.allclose(
            by_numbers[..., j], (project(POINTS, NUMBERS + d) - project(POINTS, NUMBERS - d)) / (2 * h), atol=1e-5
        )


def test_rays_lead_back_to_the_point():
    """Undistortion is the inverse of distortion."""
    assert np.allclose(compute_rays(project(POINTS, NUMBERS), NUMBERS), POINTS[:, :2] / POINTS[:, 2:], atol=1e-7)


def test_the_lens_is_the_one_of_opencv():
    """The five coefficients mean what they mean in OpenCV, so calibrations can be exchanged."""
    cv2 = pytest.importorskip("cv2")
    k = np.array([[NUMBERS[0], 0, NUMBERS[2]], [0, NUMBERS[1], NUMBERS[3]], [0, 0, 1]])
    theirs = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), k, NUMBERS[4:9])[0][:, 0]
    assert np.allclose(project(POINTS, NUMBERS), theirs, atol=1e-9)
