"""From a picture to the move that brings a camera to its place: rendered pictures of cameras that are off by a known move."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent))
from pose_rigs import MIDDLE, UP, at, camera, l1, six_axes

from tau_dyn.calibrate.frames import Frame
from tau_dyn.calibrate.poses import Camera, CameraCorrection, choose_picture_pose, find_camera_correction
from tau_dyn.calibrate.poses.alignment import compute_camera_covariance
from tau_dyn.calibrate.poses.camera import CameraPattern, build_camera_frame, build_target_frame
from tau_dyn.calibrate.poses.devices import transform_to_base, transform_to_device
from tau_dyn.kinematics.workspace import build_machine
from tau_dyn.mechanism import Poses
from tau_dyn.render import draw_camera_picture
from tau_dyn.vision import Pattern

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "experiments"))
from camera_parts.photographs import Photography, render

cv2 = pytest.importorskip("cv2")
PLATE = CameraPattern(9, 6, 0.04)
TILTED = {"pattern": PLATE, "on_tool": build_target_frame(np.array([0.1, 0, 0]), np.array([1.0, 0.5, 0.3]), UP)}
"""A plate that the camera sees at 30 degrees."""


def displace(wanted: Camera, shift: np.ndarray, turn: np.ndarray) -> Camera:
    """Return the camera that must be moved by `shift` and turned by `turn`, in its own axes, to stand where it should."""
    rotation = wanted.pose.rotation @ Rotation.from_rotvec(turn).as_matrix().T
    return replace(wanted, pose=Frame(rotation, wanted.pose.translation - rotation @ shift))


def photograph(stands: Camera, tool: Poses, path: Path, seed: int = 0, photo: Photography | None = None) -> np.ndarray:
    """Write what a camera takes of its plate, and return the picture."""
    seen = transform_to_device(stands.frames, tool)
    p = stands.pattern
    numbers = np.array([*stands.focal, *stands.centre, 0, 0, 0, 0, 0])
    printed = seen.rotation[0] @ np.diag([1.0, -1.0, -1.0])
    rng = np.random.default_rng(seed)
    image = render(
        Pattern(p.columns, p.rows, p.square), printed, seen.position[0], numbers, stands.image, rng, photography=photo
    )
    cv2.imwrite(str(path), image)
    return image


def off(found: CameraCorrection, shift: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return the correction's errors (6,) in standard errors."""
    apart = Rotation.from_rotvec(found.turn) * Rotation.from_rotvec(turn).inv()
    return np.concatenate([found.shift - shift, apart.as_rotvec()]) / found.stderr


@pytest.mark.parametrize("seed", range(4))
def test_the_correction_is_the_move_that_was_made(tmp_path: Path, seed: int) -> None:
    """Of a camera that is off by a known move, the picture tells this move, sign by sign, within its standard errors."""
    wanted, rng = camera((4.0, -0.2, 1.0), **TILTED), np.random.default_rng(seed)
    shift, turn = rng.uniform(-0.05, 0.05, 3), np.deg2rad(rng.uniform(-3, 3, 3))
    tool = at((1.6, -0.6, 0.7))
    photograph(displace(wanted, shift, turn), tool, tmp_path / "p.png", seed)
    found = find_camera_correction(wanted, tool, tmp_path / "p.png")
    assert np.abs(off(found, shift, turn)).max() < 4.5
    assert np.abs(found.shift - shift).max() < 0.01 and np.abs(found.turn - turn).max() < np.deg2rad(0.2)
    moved = Frame(found.camera.rotation, found.camera.translation + found.camera.rotation @ found.shift)
    assert np.allclose(moved.translation, wanted.pose.translation, atol=1e-9)
    assert not found.warnings


def test_standard_errors_are_the_scatter(tmp_path: Path) -> None:
    """Over pictures with other noise, the correction scatters as its standard errors say, within a factor of two."""
    wanted, tool = camera((4.0, -0.2, 1.0), **TILTED), at((1.6, -0.6, 0.7))
    shift, turn, rows = np.array([0.02, 0.01, -0.03]), np.deg2rad([1.0, -1.0, 0.5]), []
    for seed in range(8):
        photograph(displace(wanted, shift, turn), tool, tmp_path / "p.png", seed, Photography(noise=4.0))
        rows.append(off(find_camera_correction(wanted, tool, tmp_path / "p.png"), shift, turn))
    assert 0.5 < np.sqrt(np.mean(np.square(rows))) < 2.0


def test_the_covariance_is_that_of_noisy_corners() -> None:
    """Cameras placed from noisy corners scatter as predicted, in place, turn and both together."""
    eye, tool = camera((4.0, 0.3, 1.2), pixel_noise=0.02, **TILTED), at((1.6, -0.8, 0.4))
    seen, base = transform_to_device(eye.frames, tool), transform_to_base(eye.frames, tool)
    many = seen.take(np.zeros(600, int))
    pixels = eye.project(eye.place_corners(many))
    found = eye.locate(pixels + eye.pixel_noise * np.random.default_rng(0).standard_normal(pixels.shape), many)
    rotation = base.rotation[0] @ np.swapaxes(found.rotation, 1, 2)
    place = base.position[0] - np.einsum("nij,nj->ni", rotation, found.position)
    shift = (place - eye.pose.translation) @ eye.pose.rotation
    turn = Rotation.from_matrix(eye.pose.rotation.T @ rotation).as_rotvec()
    root = np.linalg.inv(np.linalg.cholesky(compute_camera_covariance(eye, tool)[0]))
    assert np.allclose(np.cov((np.hstack([shift, turn]) @ root.T).T), np.eye(6), atol=0.2)


def test_it_holds_for_a_turning_arm(tmp_path: Path) -> None:
    """On a six-axis arm the joints at which the picture is taken tell where the plate is; at other joints the move is another."""
    machine = build_machine(six_axes())
    q = np.array([[0.3, -0.4, 0.6, 0.2, 0.5, -0.3]])
    tool = machine.kinematics.forward(q).poses
    normal = tool.rotation[0][:, 2]
    place = tool.position[0] + 1.5 * normal + 0.5 * np.cross(normal, UP)
    wanted = camera(
        tuple(place),
        pattern=CameraPattern(8, 5, 0.03),
        pose=build_camera_frame(place, tool.position[0], UP),
        on_tool=build_target_frame(np.zeros(3), UP, np.array([1.0, 0, 0])),
    )
    shift, turn = np.array([0.01, -0.03, 0.02]), np.deg2rad([0.5, 1.0, -2.0])
    photograph(displace(wanted, shift, turn), tool, tmp_path / "p.png")
    assert np.abs(off(find_camera_correction(wanted, tool, tmp_path / "p.png"), shift, turn)).max() < 4.5
    other = machine.kinematics.forward(q + 0.05).poses
    assert np.abs(off(find_camera_correction(wanted, other, tmp_path / "p.png"), shift, turn)).max() > 20


def test_a_plate_seen_squarely_has_two_tilts(tmp_path: Path) -> None:
    """Small and nearly square to the sight, two tilts give one picture: the answer is doubted, not worse than the other."""
    nearly = build_target_frame(np.array([0.1, 0, 0]), np.array([1.0, 0.05, 0]), UP)
    wanted, tool = camera((5.5, -0.6, 0.7), pattern=CameraPattern(9, 6, 0.02), on_tool=nearly), at(tuple(MIDDLE))
    shift, turn = np.array([0.01, 0.0, 0.0]), np.deg2rad([0.0, 0.5, 0.0])
    warned = 0
    for seed in range(5):
        photograph(displace(wanted, shift, turn), tool, tmp_path / "p.png", seed, Photography(noise=8.0, fine=8))
        found = find_camera_correction(wanted, tool, tmp_path / "p.png")
        warned += any("two answers" in said for said in found.warnings)
        assert np.linalg.norm(found.turn - turn) < 2 * 0.06
    assert warned >= 4


def test_a_wrong_focal_length_is_doubted(tmp_path: Path) -> None:
    """A lens that bends lines leaves corners far from those of the pinhole in the file: a warning names what to check."""
    wanted, tool = camera((2.8, -0.6, 0.8), pixel_noise=0.05, **TILTED), at(tuple(MIDDLE))
    seen = transform_to_device(wanted.frames, tool)
    bent = np.array([*wanted.focal, *wanted.centre, -0.4, 0, 0, 0, 0])
    printed = seen.rotation[0] @ np.diag([1.0, -1.0, -1.0])
    image = render(Pattern(9, 6, 0.04), printed, seen.position[0], bent, wanted.image, np.random.default_rng(0))
    cv2.imwrite(str(tmp_path / "p.png"), image)
    assert any("focal length" in said for said in find_camera_correction(wanted, tool, tmp_path / "p.png").warnings)


def test_what_is_no_picture_of_the_plate_is_refused(tmp_path: Path) -> None:
    """An empty picture, another size and a pattern that looks the same upside down are each refused in a sentence."""
    wanted, tool = camera((4.0, -0.2, 1.0), **TILTED), at((1.6, -0.6, 0.7))
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((960, 1280), 90, np.uint8))
    with raises_code("not_visible"):
        find_camera_correction(wanted, tool, tmp_path / "grey.png")
    photograph(wanted, tool, tmp_path / "p.png")
    with raises_code("mismatch"):
        find_camera_correction(replace(wanted, image=(640, 480)), tool, tmp_path / "p.png")
    with raises_code("invalid_value", "upside down"):
        find_camera_correction(replace(wanted, pattern=CameraPattern(8, 6, 0.04)), tool, tmp_path / "p.png")


def test_the_pose_of_the_picture_is_the_one_that_tells_most() -> None:
    """Of poses well inside the picture, a plate near and oblique tells the camera's place better than one far and square."""
    eye = camera((4.0, -0.2, 1.0), **TILTED)
    tool = at((0.9, -0.6, 0.7), (2.0, -0.6, 0.8), (1.5, -0.5, 0.7))
    spread = np.trace(compute_camera_covariance(eye, tool)[:, :3, :3], axis1=1, axis2=2)
    assert choose_picture_pose(eye, tool) == int(np.argmin(spread)) == 1
    edge = at((0.9, -0.6, 0.7), (2.4, -1.1, 0.6))  # nearer, and at the picture's border
    spread = np.trace(compute_camera_covariance(eye, edge)[:, :3, :3], axis1=1, axis2=2)
    assert int(np.argmin(spread)) == 1 and choose_picture_pose(eye, edge) == 0


def test_an_upside_down_picture_is_named(tmp_path: Path) -> None:
    """A camera mounted head down takes a picture that is turned by half a turn: the move says so, with a warning."""
    wanted, tool = camera((4.0, -0.2, 1.0), **TILTED), at((1.6, -0.6, 0.7))
    turn = np.array([0.0, 0.0, np.deg2rad(175.0)])
    photograph(displace(wanted, np.zeros(3), turn), tool, tmp_path / "p.png")
    found = find_camera_correction(wanted, tool, tmp_path / "p.png")
    assert found.turn[2] == pytest.approx(turn[2], abs=0.01) and "upside down" in found.warnings[0]


def test_the_picture_lies_over_what_the_camera_takes(tmp_path: Path) -> None:
    """Where the camera stands as it should, the green grid goes through the corners of its own picture; elsewhere it is clear."""
    wanted, machine = camera((4.0, -0.2, 1.0), **TILTED), build_machine(l1())
    q = l1().home
    tool = machine.kinematics.forward(q[None]).poses
    png = cv2.imdecode(np.frombuffer(draw_camera_picture(wanted, machine, q, tool), np.uint8), cv2.IMREAD_UNCHANGED)
    assert png.shape == (960, 1280, 4) and (png[..., 3] == 0).mean() > 0.8
    start, end = (
        machine.rods.base_points(q[None])[0, 0],
        machine.rods.plate_points(machine.rods.plate_poses(tool))[0, 0],
    )
    for share in (0.3, 0.6):  # along the first rod, as a pinhole sees it
        x, y, z = wanted.pose.rotation.T @ (start + share * (end - start) - wanted.pose.translation)
        u, v = round(1400 * x / z + 639.5), round(1400 * y / z + 479.5)
        assert (png[v - 2 : v + 3, u - 2 : u + 3, 0] > 200).any()  # blue
    image = photograph(wanted, tool, tmp_path / "p.png")
    ok, corners = cv2.findChessboardCornersSB(image, (9, 6))
    assert ok
    for u, v in corners.reshape(-1, 2):
        near = png[round(v) - 2 : round(v) + 3, round(u) - 2 : round(u) + 3]
        assert ((near[..., 1] > 150) & (near[..., 2] < 60) & (near[..., 3] == 255)).any()
    drawn = draw_camera_picture(wanted, machine, q, tool, taken=image, found=transform_to_device(wanted.frames, tool))
    over = cv2.imdecode(np.frombuffer(drawn, np.uint8), cv2.IMREAD_UNCHANGED)
    clear = png[..., 3] == 0
    assert (over[..., 3] == 255).all() and (over[clear][:, 0] == image[clear]).mean() > 0.99
