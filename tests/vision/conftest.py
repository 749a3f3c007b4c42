"""A rig of two cameras with real lenses, plates before it, their corners with noise, and rendered photographs."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tau_dyn.vision import Cameras, Pattern
from tau_dyn.vision.bundle import Plates, Views
from tau_dyn.vision.cameras import project

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from camera_parts.photographs import draw_facing_rotation, render, render_clutter

PATTERN = Pattern(9, 6, 0.03)
SIZE = (640, 480)
NUMBERS = np.array(
    [[800, 805, 325, 235, -0.25, 0.12, 1e-3, -5e-4, 0], [780, 783, 310, 245, -0.22, 0.10, -1e-3, 5e-4, 0.0]]
)
TURN = np.array([np.eye(3), Rotation.from_rotvec([0.02, -0.5, 0.01]).as_matrix()])
SHIFT = np.array([[0, 0, 0], np.array([0, 0, 1.0]) - TURN[1] @ [0, 0, 1.0]])


def cameras(n):
    return Cameras(NUMBERS[:n], TURN[:n], SHIFT[:n], np.tile(SIZE, (n, 1)))


def seen(plate, c):
    rotation, position = plate
    return project((PATTERN.points @ rotation.T + position) @ TURN[c].T + SHIFT[c], NUMBERS[c])


def plates(rng, n, n_cameras, tilt=(0.1, 0.6), roll=0.3):
    """Return plates that all cameras see whole, rim included."""
    out = []
    while len(out) < n:
        rotation = draw_facing_rotation(rng.uniform(*tilt), rng.uniform(0, 2 * np.pi), rng.uniform(-roll, roll))
        plate = rotation, rng.uniform([-0.2, -0.15, 0.7], [0.2, 0.15, 1.1])
        pixels = np.array([seen(plate, c) for c in range(n_cameras)])
        if np.all((pixels > 25) & (pixels < np.array(SIZE) - 26)):
            out.append(plate)
    return Plates(np.array([r for r, _ in out]), np.array([t for _, t in out]))


def views(rng, truth, n_cameras, noise=0.02):
    corners = np.array([seen(plate, c) for plate in zip(*truth, strict=True) for c in range(n_cameras)])
    n = len(truth.position)
    return Views(
        corners + noise * rng.standard_normal(corners.shape),
        np.tile(np.arange(n_cameras), n),
        np.repeat(np.arange(n), n_cameras),
    )


def errors(found, truth):
    """Return position [m] and rotation vector [rad] (k, 6) of found less true plates."""
    turned = Rotation.from_matrix(found.rotation @ np.swapaxes(truth.rotation, 1, 2)).as_rotvec()
    return np.hstack([found.position - truth.position, turned])


def photograph(plate, c, rng, background, photography=None):
    rotation, position = plate
    return render(
        PATTERN,
        TURN[c] @ rotation,
        TURN[c] @ position + SHIFT[c],
        NUMBERS[c],
        SIZE,
        rng,
        background=background,
        photography=photography,
    )


@pytest.fixture(scope="session")
def rig():
    """The truth and what makes scenes of it."""
    return SimpleNamespace(
        pattern=PATTERN,
        size=np.array([SIZE, SIZE]),
        cameras=cameras,
        plates=plates,
        views=views,
        errors=errors,
        seen=seen,
        photograph=photograph,
    )


@pytest.fixture(scope="session")
def album(tmp_path_factory):
    """Six moments photographed by both cameras in a cluttered room: folders, and the truth."""
    cv2 = pytest.importorskip("cv2")
    folder, rng = tmp_path_factory.mktemp("album"), np.random.default_rng(7)
    truth = plates(rng, 6, 2)
    for c, name in enumerate(("left", "right")):
        (folder / name).mkdir()
        room = render_clutter(SIZE, rng)
        for k, plate in enumerate(zip(*truth, strict=True)):
            cv2.imwrite(str(folder / name / f"{name}_{k + 1}.png"), photograph(plate, c, rng, room))
    return SimpleNamespace(folder=folder, left=folder / "left", right=folder / "right", truth=truth, n=6)
