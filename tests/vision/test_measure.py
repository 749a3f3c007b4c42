"""Photographs to poses, end to end, and everything a user can get wrong as one sentence."""

import shutil
import sys

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.calibrate import read_poses
from tau_dyn.vision import Pattern, measure_poses_from_images, read_cameras, read_positions, write_cameras
from tau_dyn.vision.album import find_images, match_images
from tau_dyn.vision.bundle import Plates

cv2 = pytest.importorskip("cv2")
JOINTS = ("cart1", "cart2", "cart3")


@pytest.fixture(scope="module")
def table(album, rig):
    return measure_poses_from_images(album.left, rig.pattern, second=album.right)


def test_poses_from_photographs_are_right_within_their_covariance(table, album, rig):
    """Stereo, lens and all poses from 12 photographs: below 1 mm, and no farther off than the covariance says."""
    wrong = rig.errors(Plates(table.rotation, table.position), album.truth)
    assert table.names == tuple(f"left_{k + 1}.png" for k in range(album.n))
    assert np.linalg.norm(wrong[:, :3], axis=1).max() < 1e-3
    chi2 = np.einsum("ki,kij,kj->k", wrong, np.linalg.inv(table.covariance), wrong) / 6
    assert np.mean(chi2) < 4
    assert table.rms.max() < 0.06


def test_rows_are_read_by_calibrate(table, tmp_path, album, rig):
    """The table with robot positions is what the calibration reads."""
    order = np.random.default_rng(0).permutation(album.n)
    text = "image,q_cart1,q_cart2,q_cart3\n" + "".join(f"left_{k + 1}.png,{0.1 * k},0.2,0.3\n" for k in order)
    (tmp_path / "q.csv").write_text(text)
    known = table.cameras
    write_cameras(tmp_path / "cameras.yaml", known)
    again = measure_poses_from_images(
        album.left,
        rig.pattern,
        second=album.right,
        cameras=read_cameras(tmp_path / "cameras.yaml"),
        positions=read_positions(tmp_path / "q.csv"),
    )
    (tmp_path / "poses.csv").write_text(again.to_csv())
    poses = read_poses(tmp_path / "poses.csv", JOINTS)
    assert np.allclose(poses.q[:, 0], 0.1 * np.arange(album.n))
    assert np.allclose(poses.position, table.position, atol=1e-4)
    assert poses.rotation is not None
    assert np.allclose(poses.rotation, table.rotation, atol=1e-3)


def test_cameras_are_kept_whole(table, tmp_path):
    """What is written is read again, covariance included."""
    write_cameras(tmp_path / "c.yaml", table.cameras)
    again = read_cameras(tmp_path / "c.yaml")
    assert np.allclose(again.minus(table.cameras), 0)
    assert np.allclose(again.stderr, table.cameras.stderr)


def test_images_of_two_cameras_meet_by_their_numbers(tmp_path):
    """A missing image of one camera moves no other."""
    left = [tmp_path / f"left_{k}.png" for k in (1, 2, 3)]
    assert match_images([left, [tmp_path / "right_2.png", tmp_path / "right_3.png"]]) == [[0, 1, 2], [1, 2]]
    with raises_code("mismatch"):
        match_images([left, [tmp_path / "a.png"]])


def test_names_are_in_natural_order(tmp_path):
    """img2 stands before img10, as the robot went."""
    for k in (10, 2, 1):
        (tmp_path / f"img{k}.png").write_bytes(b"")
    assert [p.stem for p in find_images(tmp_path)] == ["img1", "img2", "img10"]


def one(folder, name, image):
    cv2.imwrite(str(folder / name), image)


def test_bad_input_is_one_sentence(tmp_path, album, rig):
    """Empty folders, files that are no images, mixed sizes, the wrong pattern, no pattern: each named."""
    grey = np.tile(np.linspace(60, 200, 64).astype(np.uint8), (48, 1))
    with raises_code("file_not_found"):
        measure_poses_from_images(tmp_path, rig.pattern)
    with raises_code("file_not_found"):
        measure_poses_from_images(tmp_path / "nowhere", rig.pattern)
    (tmp_path / "a.png").write_text("not an image")
    with raises_code("damaged_file"):
        measure_poses_from_images(tmp_path, rig.pattern)
    (tmp_path / "a.png").write_bytes(b"")
    with raises_code("damaged_file"):
        measure_poses_from_images(tmp_path, rig.pattern)
    one(tmp_path, "a.png", grey)
    with raises_code("not_visible", "1"):
        measure_poses_from_images(tmp_path, rig.pattern)
    one(tmp_path, "b.png", grey[:40])
    with raises_code("mismatch"):
        measure_poses_from_images(tmp_path, rig.pattern)
    with raises_code("duplicate_name", "twice"):
        measure_poses_from_images([tmp_path / "a.png", tmp_path / "a.png"], rig.pattern)
    pair = [album.left / "left_1.png", album.left / "left_2.png"]
    with raises_code("not_visible", "2", "9x6"):
        measure_poses_from_images(pair, Pattern(8, 5, 0.03))
    with raises_code("too_little_data", "2", "1"):
        measure_poses_from_images(pair, rig.pattern)


def test_an_image_that_does_not_show_the_plate_is_told(tmp_path, album, rig, table):
    """Others are measured, the one is named with its reason."""
    for k in (1, 2):
        shutil.copy(album.left / f"left_{k}.png", tmp_path)
    one(tmp_path, "left_3.png", np.full((480, 640), 12, np.uint8))
    known = type(table.cameras)(
        *(a[:1] for a in (table.cameras.intrinsics, table.cameras.rotation, table.cameras.position, table.cameras.size))
    )
    known = type(known)(
        known.intrinsics, known.rotation, known.position, known.size, "brown", table.cameras.covariance[:9, :9]
    )
    found = measure_poses_from_images(tmp_path, rig.pattern, cameras=known)
    assert found.n == 2
    assert "too dark" in found.refused["left_3.png"]
    assert "left_3.png" in found.warnings[0]


def test_robot_positions_must_belong(tmp_path, album, rig, table):
    """Rows that name no image, or are too few, are refused."""
    (tmp_path / "q.csv").write_text("q_a\n1\n2\n")
    with raises_code("missing_column", "2", "3"):
        read_positions(tmp_path / "q.csv").of(["a", "b", "c"])
    (tmp_path / "q.csv").write_text("image,q_a\nx.png,1\nb.png,2\n")
    with raises_code("mismatch", "x.png"):
        read_positions(tmp_path / "q.csv").of(["a.png", "b.png"])
    (tmp_path / "q.csv").write_text("image,q_a\nb.png,1\nb.png,2\n")
    with raises_code("duplicate_name", "twice"):
        read_positions(tmp_path / "q.csv")
    (tmp_path / "q.csv").write_text("image,a\nb.png,1\n")
    with raises_code("missing_column", "q_<joint>"):
        read_positions(tmp_path / "q.csv")


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "cameras: []",
        "cameras: [{fx: 1}]",
        "cameras: [{size: [4, 3], fx: -1, fy: 1, cx: 0, cy: 0}]",
        "cameras: 3",
        "cameras: [{size: [4, 3], fx: .nan, fy: 1, cx: 0, cy: 0}]",
    ],
)
def test_a_file_that_is_no_cameras_is_refused(tmp_path, text):
    """Never a traceback."""
    (tmp_path / "c.yaml").write_text(text)
    with raises_code("file_format"):
        read_cameras(tmp_path / "c.yaml")


@pytest.mark.parametrize("text", ["", "- 1\n", "t,q\n0,1\n", "cameras: []\n"])
def test_a_file_without_a_list_of_cameras_is_named_so(tmp_path, text):
    """An empty file, a list or a table is named, without words of Python's own."""
    (tmp_path / "c.yaml").write_text(text)
    with raises_code("file_format", "no list of cameras in it"):
        read_cameras(tmp_path / "c.yaml")


def test_cameras_of_another_size_are_refused(album, rig, table):
    """A calibration holds for its image size only, and for as many cameras."""
    cameras = table.cameras
    other = type(cameras)(
        cameras.intrinsics, cameras.rotation, cameras.position, cameras.size * 2, "brown", cameras.covariance
    )
    pair = {"images": [album.left / "left_1.png"], "second": [album.right / "right_1.png"]}
    with raises_code("mismatch"):
        measure_poses_from_images(pattern=rig.pattern, cameras=other, **pair)
    with raises_code("mismatch", "2", "1"):
        measure_poses_from_images(pair["images"], rig.pattern, cameras=cameras)


def test_without_opencv_the_way_to_it_is_told(monkeypatch, album, rig):
    """Only reading images needs OpenCV; its absence is a sentence."""
    monkeypatch.setitem(sys.modules, "cv2", None)
    with raises_code("missing_package"):
        measure_poses_from_images(album.left, rig.pattern)


def test_a_public_stereo_set_is_used_whole(measured):
    """OpenCV's 26 sample pictures, through lenses of k1 = -0.29: none is refused; cv2 leaves 0.196 px and finds 83.2 mm."""
    folder = measured("chessboard")
    table = measure_poses_from_images(folder / "left", Pattern(9, 6, 0.025), second=folder / "right")
    assert not table.refused and table.n == 13
    assert max(table.rms) < 0.196
    assert np.linalg.norm(table.cameras.position[1]) == pytest.approx(0.0832, abs=2e-4)
