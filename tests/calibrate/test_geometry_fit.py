"""Fits find the dimensions that made the poses, say how sure they are, and keep what no pose can tell."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from calibration_rigs import family_at, measured, rods_of, spoiled

from tau_dyn.calibrate import fit_geometry_to_poses
from tau_dyn.calibrate.frames import DeviceFrames
from tau_dyn.calibrate.models import Spec
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.calibrate.simulated import simulate_poses
from tau_dyn.calibrate.unknowns import find_identifiable
from tau_dyn.estimate import compute_robust_weights, compute_tuning_constant


@pytest.mark.parametrize("residual", ["forward", "closure", "inverse"])
def test_every_residual_reaches_the_noise_on_a_simplified_gantry_tau(residual):
    """21 parameters and an unknown tracker frame are found from positions alone, whichever residual is made small."""
    rods = rods_of()
    poses, _ = measured(rods, "nonparallel", 80, 1, size=3e-3)
    found = fit_geometry_to_poses(family_at(rods).build(Spec("nonparallel")), poses, residual=residual)
    assert found.converged and found.n_estimated == 21
    assert found.errors(poses).position_size.rms < 1.9e-5  # sqrt(3) times 10 um


@pytest.mark.parametrize(
    ("name", "arguments", "estimated"),
    [("gantry_tau", {"prototype": "d1", "arms": "complete"}, 51), ("gantry_tau_f1", {}, 63)],
)
def test_six_rods_and_their_noise_are_found_from_full_poses(name, arguments, estimated):
    """Both noises, of position and of orientation, come out of the fit and weigh the two kinds of residuals."""
    rods = rods_of(name, **arguments)
    poses, _ = measured(rods, "complete", 90, 2)
    found = fit_geometry_to_poses(family_at(rods).build(Spec("complete")), poses)
    assert found.converged and found.n_estimated == estimated
    assert found.noise == pytest.approx((1e-5, 2e-5), rel=0.15)
    turned = found.errors(poses).orientation_size
    assert turned is not None and turned.rms < 4e-5


def test_closure_and_forward_agree_on_six_rods():
    """Both residuals describe one machine, but closure weighs poses by their geometry: most predictions agree to the noise."""
    rods = rods_of("gantry_tau_f1")
    poses, _ = measured(rods, "complete", 60, 3)
    a, b = (
        fit_geometry_to_poses(family_at(rods).build(Spec("complete")), poses, residual=r)
        for r in ("forward", "closure")
    )
    assert np.median(np.linalg.norm(a.seen(poses).position - b.seen(poses).position, axis=1)) < 3e-5
    assert a.errors(poses).position_size.rms < b.errors(poses).position_size.rms


def test_intervals_hold_the_truth_about_as_often_as_they_say():
    """Over many noisy campaigns 95 % intervals hold the true rod lengths in about 95 % of cases."""
    rods = rods_of()
    geometry = family_at(rods).build(Spec("nonparallel"))
    theta = geometry.parameters.values.copy()
    lengths = [k for k, name in enumerate(geometry.parameters.names) if name.endswith("length")]
    theta[lengths] += (1e-3, -2e-3, 1.5e-3)
    hits = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        poses = simulate_poses(
            geometry, theta, rods.robot.home + 0.4 * (2 * rng.random((40, 3)) - 1), rng, turned=False
        )
        found = fit_geometry_to_poses(geometry, poses)
        for k in lengths:
            interval = found.interval(found.parameters[geometry.parameters.names[k]])
            assert interval is not None
            hits.append(interval[0] <= theta[k] <= interval[1])
    assert 0.89 <= np.mean(hits) <= 0.99


def test_blind_parameters_stay_nominal_and_name_their_partners():
    """The base frame is not part of the robot: six of the guideways' numbers stay nominal, the device makes up for them."""
    rods = rods_of()
    geometry = family_at(rods).build(Spec("nonparallel"))
    poses, _ = measured(rods, "nonparallel", 60, 4)
    found = fit_geometry_to_poses(geometry, poses)
    blind = found.identifiability
    assert len(blind.dropped) == 6
    nominal = {p.name: p.value for p in geometry.parameters}
    for k, partners in zip(blind.dropped, blind.depends_on, strict=True):
        p = found.parameters[blind.names[k]]
        assert p.value == nominal[p.name] and p.stderr is None
        assert any(name.startswith("device") for name in partners)


def test_f1_leaves_none_two_and_four_combinations_blind():
    """Thesis 5.4: beyond the quaternions' norms arm 1 has no redundancy, arm 2 two, arm 3 four, those of turning joints' axes."""
    rods = rods_of("gantry_tau_f1")
    geometry = RodGeometry(rods)
    rng = np.random.default_rng(0)
    q = rods.robot.home + 0.4 * (rng.random((120, 6)) - 0.5)
    theta = geometry.parameters.values
    columns = geometry.closure(theta, q, geometry.forward(theta, q).poses).by_parameter
    extra = set(family_at(rods)._superfluous("complete"))
    names = geometry.parameters.names
    counts, blind = [], []
    for own in ([0], [1, 2], [3, 4, 5]):
        seen = [k for k in range(len(names)) if np.any(columns[:, own, k]) and names[k] not in extra]
        flat = columns[:, own][:, :, seen].reshape(-1, len(seen)) / 1e-5
        found = find_identifiable(
            flat, tuple(names[k] for k in seen), np.full(len(seen), 0.01), geometry.priority[seen]
        )
        counts.append((len(seen), len(found.dropped)))
        blind.append({found.names[k]: set(d) for k, d in zip(found.dropped, found.depends_on, strict=True)})
    assert counts == [(10, 0), (23, 2), (36, 4)]
    around = next(d for name, d in blind[1].items() if "turn" in name)
    assert around == {f"rod2{ab}.base_{xyz}" for ab in "ab" for xyz in "xz"}  # turning about the axis moves both ends


def test_known_frames_are_not_fitted():
    """Where the device measures in the base frame, all 21 parameters can be told and none depends on a frame."""
    rods = rods_of()
    geometry = family_at(rods).build(Spec("nonparallel"))
    rng = np.random.default_rng(5)
    theta = spoiled(geometry, rng)
    poses = simulate_poses(
        geometry, theta, rods.robot.home + 0.4 * (2 * rng.random((60, 3)) - 1), rng, frames=DeviceFrames(), turned=False
    )
    found = fit_geometry_to_poses(geometry, poses, device=False)
    assert found.n_estimated == 21 and not len(found.identifiability.dropped)
    error = np.sqrt(np.diag(found.cov))
    assert np.abs((found.theta - theta) / error).max() < 4.5


def test_turned_frames_come_back_on_their_manifold():
    """Device and target are rotations to rounding, however far they are turned."""
    rods = rods_of("gantry_tau_f1")
    poses, _ = measured(rods, "complete", 40, 6)
    found = fit_geometry_to_poses(family_at(rods).build(Spec("frames")), poses)
    for frame in (*found.frames.device, *found.frames.tool):
        np.testing.assert_allclose(frame.rotation @ frame.rotation.T, np.eye(3), atol=1e-12)


def test_robust_weights_shrug_off_bad_poses():
    """A tenth of poses wrong by a centimetre hardly moves the lengths where weights are robust, and ruins them where not."""
    rods = rods_of()
    poses, theta = measured(rods, "nonparallel", 100, 7)
    poses.position[::10] += 0.01
    geometry = family_at(rods).build(Spec("nonparallel"))
    good, bad = (fit_geometry_to_poses(geometry, poses, robust=kind) for kind in ("biweight", "none"))
    ok = np.arange(100) % 10 != 0
    assert good.errors(poses.take(ok)).position_size.rms < 2e-5
    assert bad.errors(poses.take(ok)).position_size.rms > 1e-3
    assert np.all(good.weights[::10] == 0)


@pytest.mark.parametrize("m", [1, 3, 6])
def test_tuning_constants_keep_95_percent_of_the_information(m):
    """On Gaussian residuals an M-estimate of location scatters as its efficiency says."""
    if m == 1:
        assert compute_tuning_constant("huber", 1) == pytest.approx(1.345, abs=2e-3) and compute_tuning_constant(
            "biweight", 1
        ) == pytest.approx(4.685, abs=2e-3)
    rng = np.random.default_rng(0)
    x = rng.standard_normal((4000, 50, m))
    for kind in ("huber", "biweight"):
        at = np.zeros((4000, m))
        for _ in range(8):
            w = compute_robust_weights(kind, np.linalg.norm(x - at[:, None], axis=2).ravel(), m).reshape(4000, 50, 1)
            at = (w * x).sum(axis=1) / w.sum(axis=1)
        assert (1 / 50) / at.var() == pytest.approx(0.95, abs=0.025)
