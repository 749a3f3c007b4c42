"""Five black squares in rendered photographs with known truth: found to hundredths of a pixel, or refused with the reason."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.vision import Pattern, parse_pattern
from tau_dyn.vision.album import read_album
from tau_dyn.vision.cameras import project
from tau_dyn.vision.corner_fit import _model, fit_corners
from tau_dyn.vision.squares import find_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from camera_parts.photographs import Photography, draw_facing_rotation, render, render_clutter

cv2 = pytest.importorskip("cv2")
FIVE = parse_pattern("five-squares", 0.06)
NUMBERS = np.array([640, 642, 322, 238, -0.2, 0.08, 8e-4, -6e-4, 0.0])
SIZE = (640, 480)
ROOM = render_clutter(SIZE, np.random.default_rng(3))
PLATE = draw_facing_rotation(0.5, 1.0, 0.3), np.array([0.03, -0.02, 0.8])
SHARP = Photography(fine=8)


def photograph(plate=PLATE, photography=SHARP, background=ROOM, pattern=FIVE, motion=None, seed=1):
    rng = np.random.default_rng(seed)
    return render(pattern, *plate, NUMBERS, SIZE, rng, background=background, photography=photography, motion=motion)


def see(plate=PLATE):
    return project(FIVE.points @ plate[0].T + plate[1], NUMBERS)


def find_error(corners, truth):
    """Return corners less the truth (16, 2) in the quarter turn that is nearest."""
    turned = [np.rot90(truth.reshape(4, 4, 2), k).reshape(-1, 2) for k in range(4)]
    return min((corners - t for t in turned), key=lambda e: np.abs(e).max())


@pytest.mark.parametrize(
    ("photography", "px"),
    [
        (SHARP, 0.03),
        (replace(SHARP, blur=1.5), 0.05),
        (replace(SHARP, noise=6.0), 0.08),
        (replace(SHARP, gradient=0.8), 0.05),
        (replace(SHARP, exposure=0.15), 0.15),
    ],
    ids=["usual", "blurred", "noisy", "uneven light", "dim"],
)
def test_sixteen_corners_are_found(photography, px):
    """All corners in a cluttered room, in light in which the thesis lost half of its images too."""
    found = find_squares(photograph(photography=photography), FIVE)
    assert found.corners is not None, found.reason
    assert np.sqrt((find_error(found.corners, see()) ** 2).mean()) < px


def test_corners_are_as_far_off_as_they_state():
    """Over 6 plates the error of a corner is 0.8 to 1.4 of its stated standard error, of crossings and of single corners."""
    ratio = []
    rng = np.random.default_rng(5)
    for k in range(6):
        plate = draw_facing_rotation(rng.uniform(0, 0.6), rng.uniform(0, 6), rng.uniform(-3, 3)), PLATE[1]
        found = find_squares(photograph(plate, Photography(noise=5.0, fine=6), seed=k), FIVE)
        assert found.corners is not None and found.stderr is not None
        ratio.append(find_error(found.corners, see(plate)) / found.stderr[:, None])
    crossing = np.isin(np.arange(16), [5, 6, 9, 10])
    rms = [np.sqrt(np.mean(np.square(np.array(ratio)[:, own]))) for own in (crossing, ~crossing)]
    assert 0.8 < min(rms) and max(rms) < 1.4


def test_motion_during_the_exposure_moves_no_corner():
    """A plate that moves by 4 px is where it was in the middle of the exposure; a round blur would be 0.08 px off."""
    for angle in (0.3, 1.2, 2.2):
        shift = 4 * PLATE[1][2] / 640 * np.array([np.cos(angle), np.sin(angle), 0])
        found = find_squares(photograph(motion=np.concatenate([shift, np.zeros(3)])), FIVE)
        assert found.corners is not None, found.reason
        assert np.sqrt((find_error(found.corners, see()) ** 2).mean()) < 0.045


def test_motion_beyond_the_detector_is_named():
    """A plate that moves by a quarter of a square during the exposure is refused with the reason, not measured."""
    quick = Photography(fine=3)
    found = find_squares(photograph(photography=quick, motion=np.array([0.015, 0.005, 0, 0, 0, 0])), FIVE)
    assert found.corners is None and "moved" in found.reason and "exposure" in found.reason


def test_rooms_and_chessboards_are_no_five_squares():
    """Of 5 rooms with up to 260 boxes and 3 chessboards none is taken for the plate, though a chessboard holds its 20 sides."""
    for k in range(5):
        room = render_clutter(SIZE, np.random.default_rng(k), things=60 + 50 * k)
        assert find_squares(room.clip(0, 255).astype(np.uint8), FIVE).corners is None
    for size in ("4x3", "5x4", "9x6"):
        found = find_squares(photograph(pattern=parse_pattern(size, 0.04), photography=Photography()), FIVE)
        assert found.corners is None
        assert "white" in found.reason or "five squares" in found.reason


def test_a_hidden_part_is_refused():
    """A thin bar at any place before the plate hides a side or a cell: no pose, and the reason says so."""
    image, truth = photograph(), see()
    rng = np.random.default_rng(0)
    for _ in range(12):
        middle, angle = truth.mean(axis=0) + rng.uniform(-25, 25, 2), rng.uniform(0, np.pi)
        v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
        bar = np.abs((u - middle[0]) * np.cos(angle) + (v - middle[1]) * np.sin(angle)) < rng.uniform(2, 6)
        hidden = np.where(bar, rng.choice([10, 120, 240]), image).astype(np.uint8)
        found = find_squares(hidden, FIVE)
        assert found.corners is None and found.reason


def test_darkness_is_named():
    """An image without light says that it is dark and what its grey values are."""
    found = find_squares(photograph(photography=Photography(exposure=0.03)), FIVE)
    assert found.corners is None
    assert "too dark" in found.reason


def test_of_two_plates_the_moving_one_is_taken(tmp_path):
    """A second plate on the wall is ambiguous in one image, and is background where ten images show it at one place."""
    wall = photograph((np.eye(3), np.array([-0.3, -0.15, 1.0])), replace(SHARP, noise=0.0, gradient=0.0)).astype(float)
    alone = find_squares(photograph((PLATE[0], np.array([0.2, 0.1, 0.9])), background=wall), FIVE)
    assert alone.corners is None and len(alone.several) == 2 and "2 plates" in alone.reason
    places = [np.array([0.1 + 0.02 * k, 0.14 - 0.015 * k, 0.95]) for k in range(10)]
    for k, place in enumerate(places):
        image = photograph((PLATE[0], place), Photography(gradient=0.0), wall, seed=k)
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    seen = read_album(tmp_path, None, None, None, FIVE, lambda step: None)
    for place, found in zip(places, seen.found[0], strict=True):
        assert found.corners is not None, found.reason
        assert np.abs(find_error(found.corners, see((PLATE[0], place)))).max() < 0.5


def test_derivatives_of_a_blurred_corner_are_those_of_its_grey_values():
    """Analytic derivatives by all eleven parameters agree with central differences, of single corners and of crossings."""
    at = np.array([(u, v) for u in range(-4, 5) for v in range(-4, 5)], float)
    theta = np.array([[0.2, -0.3, 0.3, 2.0, 0.9, 1.2, 100, 0.5, 0.2, -80, 0.1]] * 2)
    crossing = np.array([False, True])
    jacobian = _model(theta, at, crossing, None)[1]
    for j, h in enumerate(1e-5 * np.eye(theta.shape[1])):
        there, back = (_model(theta + d, at, crossing, None)[0] for d in (h, -h))
        assert np.allclose(jacobian[..., j], (there - back) / 2e-5, atol=1e-5)


def test_a_wedge_blurred_in_one_direction_is_where_it_is():
    """With the blur's covariance known the fit of a Gaussian-blurred wedge of 60 degrees is exact to a hundredth of a pixel."""
    fine, half = 10, 8
    grid = (np.arange((2 * half + 1) * fine) + 0.5) / fine - 0.5 - half
    u, v = np.meshgrid(grid, grid)
    corner, edges, motion = np.array([0.2, -0.3]), np.array([0.3, 2.4]), np.array([2.0, 1.0])
    weight = np.exp(-0.5 * np.linspace(-4, 4, 81) ** 2)
    total = np.zeros_like(u)
    for share, w in zip(np.linspace(-4, 4, 81), weight / weight.sum(), strict=True):
        du, dv = u - corner[0] - share * motion[0], v - corner[1] - share * motion[1]
        total += w * np.all([-np.sin(a) * du + np.cos(a) * dv > 0 for a in edges], axis=0)
    grey = 200 - 150 * total.reshape(2 * half + 1, fine, 2 * half + 1, fine).mean(axis=(1, 3))
    at = np.array([(x, y) for y in range(-half, half + 1) for x in range(-half, half + 1)], float)
    blur = np.outer(motion, motion) + np.eye(2) / 12
    single = np.array([False])
    fit = fit_corners(grey.reshape(1, -1), at, np.zeros((1, 2)), edges[None] + 0.02, single, blur=blur)
    assert np.abs(fit.place - corner).max() < 0.01
    round_one = fit_corners(grey.reshape(1, -1), at, np.zeros((1, 2)), edges[None], single)
    assert np.abs(round_one.place - corner).max() > 0.05


def test_five_squares_are_a_pattern():
    """Sixteen points about their middle, a square apart; its picture is the same after a quarter turn."""
    assert FIVE.n == 16 and FIVE.turns == 4 and FIVE.name == "five-squares"
    assert np.allclose(FIVE.points.mean(axis=0), 0)
    assert np.allclose(FIVE.points[1] - FIVE.points[0], [0.06, 0, 0])
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    exact = Photography(noise=0.0, gradient=0.0, fine=8)
    plain = np.full(SIZE[::-1], 90.0)
    here, there = (photograph((PLATE[0] @ r, PLATE[1]), exact, plain).astype(float) for r in (np.eye(3), quarter))
    assert np.abs(here - there).max() <= 12
    assert Pattern(9, 6, 0.06).turns == 1
