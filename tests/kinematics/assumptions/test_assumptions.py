"""Checks of measured points: what was put into them comes out, and what was not is not claimed."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises_code
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.assumptions import check_orientation, check_parallelism, fit_guideway, load_shift
from tau_dyn.mechanism import Poses

NOISE = 10e-6
FRAME = Rotation.from_euler("xyz", (0.3, -0.5, 1.1)).as_matrix()


def cart(
    rng: np.random.Generator, q: np.ndarray, direction=(1.0, 0.0, 0.0), along=0.0, across=0.0, noise: float = NOISE
) -> np.ndarray:
    """Return a cart's measured points: along x of a frame turned away, with errors along and across (towards y)."""
    d = np.asarray(direction, float)
    e = np.outer(q, d) + np.outer(along * np.ones(len(q)), d) + np.outer(across * np.ones(len(q)), (0.0, 1.0, 0.0))
    return (e + noise * rng.standard_normal((len(q), 3))) @ FRAME.T + (1.0, 2.0, 3.0)


def test_residual_is_split_along_and_across_the_line() -> None:
    """e_par and e_perp of (4.11), (4.12) are orthogonal, add to e, and hold what was put along and across the guideway."""
    rng, q = np.random.default_rng(0), np.linspace(0, 2, 41)
    wave, bend = 50e-6 * np.sin(2 * np.pi * q / 0.31), 80e-6 * (np.cos(2 * np.pi * q / 2) - np.mean(np.cos(np.pi * q)))
    line = fit_guideway("cart1", q, cart(rng, q, along=wave, across=bend))
    assert np.allclose(line.across @ line.direction, 0, atol=1e-15)
    assert np.allclose(np.linalg.norm(line.residuals, axis=1) ** 2, line.along**2 + np.sum(line.across**2, axis=1))
    assert np.std(line.along - wave) < 2 * NOISE and abs(np.std(line.along) - np.std(wave)) < NOISE
    assert abs(abs(line.direction @ FRAME[:, 0]) - 1) < 1e-8
    assert line.shape < 1e-6 and line.bow.sure
    assert line.cycle is not None and abs(line.cycle.period - 0.31) < 0.02 and abs(line.cycle.amplitude - 50e-6) < 10e-6


def test_bow_is_found_with_an_honest_interval() -> None:
    """A parabola of 100 um rise is recovered within three standard errors in nearly every draw, scale error apart."""
    inside = 0
    for seed in range(40):
        rng, q = np.random.default_rng(seed), np.linspace(-1, 1, 30)
        line = fit_guideway("cart1", q, cart(rng, q * 1.0002, across=100e-6 * q**2))
        assert abs(line.scale[0] - 2e-4) < 5 * line.scale[1] + 1e-6
        inside += abs(line.bow.size - 100e-6) < 3 * line.bow.stderr
    assert inside >= 37


def test_straight_guideways_are_seldom_called_crooked() -> None:
    """On white scatter the tests of shape, cycle, backlash and parallelism fire about once in a hundred."""
    fired = {"shape": 0, "cycle": 0, "backlash": 0, "parallel": 0}
    for seed in range(150):
        rng = np.random.default_rng(seed)
        q = np.concatenate([np.linspace(0, 1.5, 20), np.linspace(1.5, 0, 20)])
        lines = [fit_guideway(f"cart{k}", q, cart(rng, q)) for k in (1, 2)]
        fired["shape"] += lines[0].shape < 0.01
        fired["cycle"] += lines[0].cycle.p_value < 0.01
        fired["backlash"] += lines[0].backlash.sure
        fired["parallel"] += check_parallelism(lines)[0].sure
    assert max(fired.values()) <= 6, fired


def test_backlash_follows_the_direction_of_approach() -> None:
    """A drive that lags by 20 um either way shows 40 um of backlash; one direction alone shows none of it."""
    rng = np.random.default_rng(2)
    q = np.concatenate([np.linspace(0, 1, 30), np.linspace(1, 0, 30)])
    way = np.sign(np.diff(q, prepend=-1))
    line = fit_guideway("cart1", q, cart(rng, q, along=-20e-6 * way))
    assert line.backlash is not None and line.backlash.sure
    assert abs(line.backlash.size - 40e-6) < 4 * line.backlash.stderr
    assert fit_guideway("cart1", q[:30], cart(rng, q[:30])).backlash is None


def test_fine_teeth_show_as_a_long_wave_with_the_teeth_among_its_aliases() -> None:
    """Points 50 mm apart see a 31.4 mm pinion error as a longer cycle, and say which periods it may really have."""
    rng, q = np.random.default_rng(3), 0.05 * np.arange(40)
    line = fit_guideway("cart2", q, cart(rng, q, along=40e-6 * np.sin(2 * np.pi * q / 0.0314)))
    assert line.cycle is not None and line.cycle.p_value < 1e-3 and line.cycle.period > 0.08
    assert min(abs(period - 0.0314) for period in line.cycle.aliases) < 1e-3


def test_angle_between_guideways_comes_with_its_error() -> None:
    """0.4 mrad between two lines is found within its interval and called by name; the pair that is parallel is not."""
    rng, q = np.random.default_rng(4), np.linspace(0, 2, 40)
    tilt = (1.0, 4e-4, 0.0)
    lines = [fit_guideway(f"cart{k}", q, cart(rng, q, d)) for k, d in ((1, (1.0, 0, 0)), (2, tilt), (3, (1.0, 0, 0)))]
    pairs = {p.joints: p for p in check_parallelism(lines)}
    seen = pairs["cart1", "cart2"]
    assert seen.sure and abs(seen.angle - 4e-4) < 4 * seen.stderr and abs(seen.apart - 8e-4) < 5e-5
    assert not pairs["cart1", "cart3"].sure and "parallel as far" in pairs["cart1", "cart3"].sentence


def test_slopes_are_as_uncertain_as_they_scatter() -> None:
    """Errors of neighbours that are alike by 0.6 widen the slope's standard error by 2, as much as it scatters over draws."""
    rng, q, z = np.random.default_rng(8), np.linspace(0, 1, 200), []
    for _ in range(60):
        noise = 1e-5 * lfilter([1], [1, -0.6], rng.standard_normal((200, 3)), axis=0)
        line = fit_guideway("cart1", q, np.outer(q, (1.0, 0.0, 0.0)) + noise)
        z.append((line.slope - (1, 0, 0)) / np.sqrt(np.diag(line.covariance)))
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.3


def test_another_load_shifts_the_cart() -> None:
    """A second measurement 100 um below the first line is reported as that shift (the squares of Figure 4.5)."""
    rng, q = np.random.default_rng(5), np.linspace(0, 2, 30)
    line = fit_guideway("cart1", q, cart(rng, q))
    shifted = load_shift(line, q, cart(rng, q, across=-100e-6))
    same = load_shift(line, q, cart(rng, q))
    assert abs(shifted["size"] - 100e-6) < 8e-6 and shifted["p_value"] < 1e-6 and same["p_value"] > 0.01


def grid_of_poses(rods: float, carts: float, seed: int = 0) -> tuple[np.ndarray, Poses]:
    """Return a grid of 6 layers of 20 places with rotations that depend on the place (rods) or on the layer (carts)."""
    rng = np.random.default_rng(seed)
    place, layer = np.tile(np.arange(20), 6), np.repeat(np.arange(6), 20)
    q = np.column_stack([0.2 * layer + 0.07 * place, 0.2 * layer - 0.03 * place, 0.2 * layer + 0.01 * (place % 5)])
    by_place, by_layer = rods * rng.standard_normal((20, 3)), carts * rng.standard_normal((6, 3))
    turn = by_place[place] + by_layer[layer] + 2e-5 * rng.standard_normal((120, 3))
    nominal = Rotation.from_euler("ZYZ", (0.4, 1.2, -0.3))
    position = np.column_stack([0.2 * layer, 0.1 * (place % 5), 0.1 * (place // 5)]) @ FRAME.T
    return q, Poses(position, (Rotation.from_rotvec(turn) * nominal).as_matrix())


def test_orientation_error_is_told_to_come_from_rods_or_from_carts() -> None:
    """What changes with the place across the guideways is the rods', what changes along them the carts' (Figure 4.7)."""
    for rods, carts in ((2e-3, 0.0), (0.0, 2e-3)):
        found = check_orientation(*grid_of_poses(rods, carts))
        big, small = (found.across, found.along) if rods else (found.along, found.across)
        assert big.share > 0.95 and big.p_value < 1e-6 and small.share < 0.02
        assert ("the rods" if rods else "carts that turn") in found.sentence
    still = check_orientation(*grid_of_poses(0.0, 0.0))
    assert "beyond chance" in still.sentence and still.sizes.max() < 1.5e-4


def test_three_axes_are_three_chances() -> None:
    """Where nothing turns the plate, one grid in ten has a p-value below 10 %, the best of three axes counted as such."""
    p_values = [check_orientation(*grid_of_poses(0.0, 0.0, seed)).across.p_value for seed in range(100)]
    assert np.sum(np.array(p_values) < 0.1) <= 18  # 10 expected, at most 18 in 99 % of such draws; 27 uncorrected


def test_euler_angles_are_those_of_the_rotation() -> None:
    """ZYZ angles rebuild the measured matrices, and angles near the pole are said to mean little."""
    q, poses = grid_of_poses(2e-3, 0.0)
    found = check_orientation(q, poses)
    assert np.allclose(Rotation.from_euler("ZYZ", found.euler).as_matrix(), poses.rotation, atol=1e-12)
    assert not found.near_pole
    flat = Poses(
        poses.position, Rotation.from_rotvec(1e-3 * np.random.default_rng(0).standard_normal((120, 3))).as_matrix()
    )
    assert check_orientation(q, flat).near_pole


def test_one_place_or_one_layer_tells_no_cause() -> None:
    """Without places visited twice rods and carts cannot be told apart, and the check says why."""
    q, poses = grid_of_poses(2e-3, 0.0)
    assert "one place along" in check_orientation(q[:20], poses.take(slice(0, 20))).sentence
    assert check_orientation(q[::20], poses.take(slice(0, None, 20))).across is None


@pytest.mark.parametrize(
    ("q", "points", "words"),
    [
        (np.linspace(0, 1, 5), np.zeros((5, 3)), "at least 8"),
        (np.linspace(0, 1, 9), np.zeros((9, 2)), r"points \(N, 3\)"),
        (np.linspace(0, 1, 9), np.full((9, 3), np.nan), "finite"),
        (np.ones(9), np.zeros((9, 3)), "measure it along its guideway"),
    ],
)
def test_points_that_tell_no_line_are_refused(q: np.ndarray, points: np.ndarray, words: str) -> None:
    """Too few points, wrong shapes, missing numbers and a cart at rest end in one sentence."""
    with pytest.raises(InputError, match=words):
        fit_guideway("cart1", q, points)


def test_a_cart_at_two_places_has_no_line(rng):
    """Thirty points of which one lies far beyond a travel are two places, and no shape of a guideway is fitted to them."""
    q = np.linspace(-0.4, 0.4, 30)
    far = np.where(np.arange(30) == 9, -5e13, q)
    with raises_code("too_little_data", "2 places"):
        fit_guideway("cart1", far, cart(rng, q))
