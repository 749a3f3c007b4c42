"""What poses tell by chance: noise, intervals, folds, comparisons, gross outliers and moves, held against repetition."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parent))
from calibration_rigs import RodFamily, family_at, measured, rods_of

from tau_dyn.calibrate import outliers
from tau_dyn.calibrate.addition_tests import _ProjectedResidual
from tau_dyn.calibrate.crossvalidation import compare_paired, earns_parameters, split_folds
from tau_dyn.calibrate.geometry_fit import GeometryFit
from tau_dyn.calibrate.laws import RodLoads
from tau_dyn.calibrate.measured import PoseErrors, PoseSet, estimate_measurement_noise
from tau_dyn.calibrate.model_selection import CandidateModel, Options, fit_and_cross_validate, fit_geometry
from tau_dyn.calibrate.outliers import _fit_move, _leave_out_each, find_moved_frames, find_outliers
from tau_dyn.mechanism import forward_kinematics

NOISE = 1e-4
N = 14
"""Poses of a fit: 42 numbers for the frames and dimensions of a Gantry-Tau, so that what a fit swallows shows."""


def fit(seed: int, n: int = N) -> CandidateModel:
    """Return a small calibration with its errors at poses left out."""
    rods = rods_of()
    poses, _ = measured(rods, "nonparallel", n, seed, noise=(NOISE, NOISE))
    family = family_at(rods)
    return fit_and_cross_validate(family, family.spec("nonparallel"), poses, Options(seed=seed))


@pytest.fixture(scope="module")
def fits() -> list[CandidateModel]:
    """Twenty of them."""
    return [fit(seed) for seed in range(20)]


def test_the_noise_counts_the_parameters(fits):
    """Of 42 residuals 13 or more are swallowed: the noise is right in the mean square of 20 fits, which 20 x 25 freedoms tell."""
    square = np.mean([one.fit.noise[0] ** 2 for one in fits]) / NOISE**2
    left = np.mean([one.fit.residuals.size - one.fit.n_estimated for one in fits])
    assert 15 < left < 32
    assert abs(square - 1) < 4 * np.sqrt(2 / (20 * left))


def test_errors_at_poses_left_out_are_larger_than_at_those_fitted(fits):
    """Sums of squares `N - p` fitted and more than `N + p` left out: their ratio is that or more, in the mean of 20 fits."""
    unseen = np.mean([one.unseen.squared_distance().sum() for one in fits])
    fitted = np.mean([np.sum(one.fit.residuals[:, :3] ** 2) for one in fits])
    n, p = fits[0].fit.residuals.size, np.mean([one.fit.n_estimated for one in fits])
    assert unseen / fitted > 0.8 * (n + p) / (n - p) > 1.3


def test_an_interval_is_students(fits):
    """95 % lie between the tails of 2.5 % of Student's law with as many freedoms as are left."""
    one: GeometryFit = fits[0].fit
    p = next(p for p in one.parameters if p.stderr)
    low, high = cast(Any, one.interval(p))
    left = one.residuals.size - one.n_estimated
    assert_allclose([(high - p.value) / p.stderr, (p.value - low) / p.stderr], stats.t.ppf(0.975, left), rtol=1e-9)


def test_repeats_tell_the_noise_without_their_means():
    """Sixty places measured twice: half of the freedom goes into the means; 1 um to 5 % in the mean of 20."""
    rods, found = rods_of(), []
    for seed in range(20):
        poses, _ = measured(rods, "frames", 60, seed, size=0.0, noise=(1e-6, 1e-6))
        poses = poses.take(np.repeat(np.arange(60), 2))
        noisy = replace(poses, position=poses.position + 1e-6 * np.random.default_rng(seed).standard_normal((120, 3)))
        found.append(cast(float, estimate_measurement_noise(noisy).position))
    assert_allclose(np.mean(np.square(found)), 1e-12, rtol=0.1)


def see_targets(rng: np.random.Generator, sigma: float, n: int = 40) -> PoseSet:
    """Return positions of three targets on a tool at `n` attitudes with noise [m]; one row is 5 mm off."""
    places = np.array([[0.1, 0, 0], [0, 0.08, 0], [0, 0, 0.12]])
    turn = Rotation.random(n, rng=rng).as_matrix()
    x = rng.uniform(-0.5, 0.5, (n, 1, 3)) + np.einsum("nij,kj->nki", turn, places)
    x = x.reshape(-1, 3) + sigma * rng.standard_normal((3 * n, 3))
    x[7] += 0.005
    q = np.repeat(rng.uniform(-1, 1, (n, 6)), 3, axis=0)
    return PoseSet(q, x, target=np.tile(np.arange(3), n), targets=("a", "b", "c"))


def test_distances_between_targets_tell_the_noise(rng):
    """The tool is rigid: 40 x 3 distances scatter by the noise of two coordinates; one gross error is left out."""
    found = [estimate_measurement_noise(see_targets(rng, 5e-5)) for _ in range(20)]
    assert {one.source for one in found} == {"targets"}
    assert_allclose(np.sqrt(np.mean([cast(float, one.position) ** 2 for one in found])), 5e-5, rtol=0.05)


def test_targets_at_attitudes_of_their_own_tell_nothing(rng):
    """Targets that were not measured at the same joints have no distances."""
    poses = see_targets(rng, 5e-5)
    apart = replace(poses, q=rng.uniform(-1, 1, poses.q.shape))
    assert estimate_measurement_noise(apart).source == "unknown"


def scattered(rng: np.random.Generator, size: float) -> PoseErrors:
    return PoseErrors(size * rng.standard_normal((60, 3)), None)


def test_a_model_that_halves_the_error_gains_fifty_per_cent(rng):
    """Errors of the same poses, all halved: 50 % with an interval of no width, and sure; the other way it is sure to be none."""
    small = scattered(rng, 1e-3)
    large = PoseErrors(0.5 * small.position, None)
    gain, loss = compare_paired(small, large), compare_paired(large, small)
    assert_allclose([gain.reduction_percent, *gain.ci95], 50.0, atol=1e-9)
    assert gain.p_value < 1e-6 and earns_parameters(gain)
    assert_allclose(loss.reduction_percent, -100.0, atol=1e-9)
    assert loss.p_value > 0.999 and not earns_parameters(loss)
    assert_allclose(gain.rms_before / gain.rms_after, 2.0)


@pytest.mark.parametrize(("away", "found"), [(30.0, [7]), (15.0, [])])
def test_a_gross_outlier_is_six_times_as_far_as_one_good_pose_in_a_hundred(rng, away, found):
    """That one is 3.4 standard deviations off in three numbers: 30 are gross, 15 may be a model that lacks something."""
    residuals = NOISE * rng.standard_normal((100, 3))
    residuals[7] = [away * NOISE, 0, 0]
    made = SimpleNamespace(residuals=residuals, sigma=np.full((100, 3), NOISE), numbers=np.full(100, 3))
    assert find_outliers(cast(GeometryFit, made)).tolist() == found


def test_columns_of_chance_have_p_values_of_chance(fits):
    """Two columns that have nothing to do with the poses reduce what a fit leaves by a share whose p-value is uniform."""
    rng, p = np.random.default_rng(5), []
    for one in fits:
        rest = _ProjectedResidual(one.fit)
        for _ in range(10):
            basis = rest.span(rest.whiten(rng.standard_normal((*rest.sigma.shape, 2))))
            p.append(rest.judged(float(np.sum((basis.T @ rest.r) ** 2)), basis.shape[1])[0])
    assert stats.kstest(p, "uniform").pvalue > 0.01


def test_a_device_that_stands_still_is_not_said_to_move():
    """A fit to few poses, held against sixty of the same set-up: its own uncertainty is counted, and no move is found."""
    rods = rods_of()
    for seed in range(8):
        poses, _ = measured(rods, "nonparallel", N + 60, seed, noise=(NOISE, NOISE))
        family = family_at(rods)
        train, held = poses.take(np.arange(N)), poses.take(np.arange(N, N + 60))
        found = fit_and_cross_validate(family, family.spec("nonparallel"), train, Options(seed=seed)).fit
        assert find_moved_frames(found, held) == ([], ())


def test_rods_carry_plate_and_half_of_themselves():
    """On all carts together the rods put the weight of the plate and half of their own; the carts carry the other half."""
    rods = rods_of()
    robot = rods.robot
    masses = {link.link: float(link.nominal[0]) for link in robot.links}
    carried = masses[f"{rods.plate}"] + 0.5 * sum(m for name, m in masses.items() if name.startswith("rod"))
    force = RodLoads(rods)(robot.home[None])
    assert_allclose(force.sum(axis=1)[0], carried * robot.model.gravity.linear, rtol=1e-6, atol=1e-6)
    assert forward_kinematics(rods, robot.home[None]).ok.all()


def test_six_rods_balance_the_moments_too():
    """About the plate's origin, pulls along the rods balance a plate that is heavy on one side, and half of each rod."""
    rods = rods_of(prototype="d1", arms="complete")
    loads = RodLoads(rods)
    loads.centre = np.array([0.2, -0.1, 0.05])
    q = rods.robot.home[None]
    plate = rods.plate_poses(forward_kinematics(rods, q).poses)
    pulls = loads._axial(q, plate, np.zeros((1, 7)))[0, :, None] * rods.rod_directions(q, plate)[0]
    halves, arms = np.outer(loads.half, loads.gravity), rods.plate_points(plate)[0] - plate.position[0]
    weight = loads.plate_mass * loads.gravity
    assert_allclose(pulls.sum(axis=0) + weight + halves.sum(axis=0), 0, atol=1e-9)
    moment = np.cross(arms, pulls + halves).sum(axis=0) + np.cross(plate.rotation[0] @ loads.centre, weight)
    assert_allclose(moment, 0, atol=1e-9)


@pytest.mark.parametrize(("size", "moved"), [(16.0, False), (30.0, True)])
def test_a_move_is_judged_as_six_numbers(fits, monkeypatch, size, moved):
    """A move that is no chance of one in a thousand has a squared size of 22.5 in units of its covariance, not of 10.8."""
    poses, _ = measured(rods_of(), "nonparallel", N + 30, 0, noise=(NOISE, NOISE))
    held = poses.take(np.arange(N, N + 30))
    held.position[:] += [0.02, 0, 0]

    def fit(*arguments: Any) -> Any:
        return _fit_move(*arguments)._replace(
            move=np.full(6, 1e-3 * np.sqrt(size / 6)), cov=1e-6 * np.eye(6), determined=1e-6 * np.eye(6)
        )

    monkeypatch.setattr(outliers, "_fit_move", fit)
    assert bool(find_moved_frames(fits[0].fit, held)[0]) is moved


def test_a_move_that_is_none_is_as_large_as_its_covariance_says(fits):
    """Thirty other poses of each small fit's robot: the fitted move of the device in units of its covariance is 6 in the mean.

    Poses and dimensions both are uncertain; either one alone would make it twice as large or more.
    """
    sizes = []
    for seed, one in enumerate(fits):
        poses, _ = measured(rods_of(), "nonparallel", N + 30, seed, noise=(NOISE, NOISE))
        held = poses.take(np.arange(N, N + 30))
        sigma = np.full((30, 3), one.fit.noise[0])
        made = _fit_move("device", one.fit.frames, one.fit, held, one.fit.predict(held).base, sigma)
        sizes.append(float(made.move @ np.linalg.pinv(made.cov) @ made.move))
    assert 6 - 4 * np.sqrt(12 / 20) < np.mean(sizes) < 6 + 4 * np.sqrt(12 / 20)


def test_each_pose_is_judged_by_a_move_fitted_without_it(rng):
    """Leaving one pose after the other out of a linear fit gives the residuals that leverages promise."""
    columns, r = rng.normal(size=(12, 3, 6)), rng.normal(size=(12, 3))
    x = np.linalg.lstsq(columns.reshape(-1, 6), r.ravel(), rcond=None)[0]
    left = _leave_out_each(cast(Any, SimpleNamespace(columns=columns, residuals=r - columns @ x)))
    for k in range(12):
        rest = np.arange(12) != k
        own = np.linalg.lstsq(columns[rest].reshape(-1, 6), r[rest].ravel(), rcond=None)[0]
        assert_allclose(left[k], r[k] - columns[k] @ own, rtol=1e-9)


def test_poses_of_the_same_joints_are_left_out_together():
    """Seven configurations measured three times: each stands in one fold with all of its poses, and each pose in one fold."""
    configuration = np.tile(np.arange(7), 3)
    for seed in range(5):
        folds = split_folds(configuration, seed)
        assert sorted(np.concatenate(folds).tolist()) == list(range(21)) and len(folds) == 5
        for k in range(7):
            assert [int(np.sum(configuration[fold] == k)) for fold in folds].count(3) == 1


def test_a_play_is_as_sure_as_it_says():
    """Sixty um of play at one cart, found in 24 small campaigns: its errors are those that the fits state."""
    rods, z = rods_of(), []
    for seed in range(24):
        poses, _ = measured(rods, "nonparallel", 40, seed, noise=(2e-5, 2e-5), backlash=np.array([6e-5, 0, 0]))
        family = RodFamily(rods, poses)
        spec = replace(family.spec("nonparallel"), additions={"backlash": ("cart1",)})
        p = fit_geometry(family.build(spec), spec, poses, Options(seed=seed), None, "it").parameters["cart1.backlash"]
        z.append((p.value - 6e-5) / p.stderr)
    assert 1 - 3 * np.sqrt(2 / 24) < np.mean(np.square(z)) < 1 + 4 * np.sqrt(2 / 24)
