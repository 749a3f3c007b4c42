"""Bundle adjustment: derivatives, covariance and the optimum against independent computations."""

import numpy as np
import pytest

from tau_dyn.vision import solve
from tau_dyn.vision.bundle import adjust
from tau_dyn.vision.cameras import project

N, PLATES = 2, 4


def test_the_optimum_and_covariance_are_those_of_the_dense_problem(rig):
    """At the optimum every derivative of the cost is zero, and covariances are those of the full inverse."""
    rng = np.random.default_rng(1)
    truth = rig.plates(rng, PLATES, N)
    views = rig.views(rng, truth, N, noise=0.05)
    ours = adjust(views, rig.pattern.points, rig.cameras(N), truth, noise=np.full(N, 0.05))
    p = len(rig.cameras(N).names)
    free = np.flatnonzero(np.concatenate([rig.cameras(N).free(), np.ones(6 * PLATES, bool)]))
    small = np.concatenate([np.tile([1, 1, 1, 1, 1e-2, 1e-2, 1e-2, 1e-2, 1], N), np.full(6 + 6 * PLATES, 1e-2)]) * 1e-3

    def residuals(step):
        cameras, plates = ours.cameras.moved(step[:p]), ours.plates.moved(step[p:].reshape(-1, 6))
        at = np.einsum("kij,nj->kni", plates.rotation, rig.pattern.points) + plates.position[:, None]
        pixels = [
            project(at[k] @ cameras.rotation[c].T + cameras.position[c], cameras.intrinsics[c])
            for c, k in zip(views.camera, views.plate, strict=True)
        ]
        return ((views.corners - pixels) / 0.05).ravel()

    jacobian = np.column_stack(
        [(residuals(small * e) - residuals(-small * e)) / (2 * small @ e) for e in np.eye(len(small))[free]]
    )
    length = np.linalg.norm(jacobian, axis=0)
    assert np.abs(jacobian.T @ residuals(np.zeros(len(small))) / length).max() < 1e-2 * np.sqrt(2 * ours.cost)
    scaled = jacobian / length
    stderr = np.sqrt(np.diag(np.linalg.inv(scaled.T @ scaled))) / length
    found = np.concatenate(
        [ours.cameras.stderr[free[free < p]], np.sqrt(np.diagonal(ours.covariance, axis1=1, axis2=2)).ravel()]
    )
    assert np.allclose(found, stderr, rtol=1e-2)


def test_one_camera_gives_what_opencv_gives(rig):
    """The focal length, principal point and lens agree with OpenCV's calibration of the same corners."""
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(2)
    views = rig.views(rng, rig.plates(rng, 12, 1), 1)
    flat = [rig.pattern.points.astype(np.float32)] * 12
    _, k, lens, _, _ = cv2.calibrateCamera(
        flat, list(views.corners.astype(np.float32)), (640, 480), None, None, flags=cv2.CALIB_FIX_K3
    )
    ours = solve(views, rig.pattern, rig.size[:1]).bundle.cameras.intrinsics[0]
    assert np.allclose(ours[:4], [k[0, 0], k[1, 1], k[0, 2], k[1, 2]], atol=0.02)
    assert np.allclose(ours[4:8], lens.ravel()[:4], atol=2e-4)


def test_standard_errors_hold(rig):
    """Over 12 seeds, 95 % intervals of all plates' positions and orientations cover the truth in 90 to 99 %."""
    inside = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        truth = rig.plates(rng, 10, 1)
        bundle = solve(rig.views(rng, truth, 1), rig.pattern, rig.size[:1]).bundle
        stderr = np.sqrt(np.diagonal(bundle.covariance, axis1=1, axis2=2))
        inside.append(np.abs(rig.errors(bundle.plates, truth)) < 1.96 * stderr)
    assert 0.90 < np.mean(inside) < 0.99
