"""A serial arm calibrated from tool positions: error at the noise, honest intervals, and what parallel axes leave untold."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from tau_dyn.calibrate import calibrate, fit_geometry_to_poses
from tau_dyn.calibrate.simulated import TRACKER, simulate_poses
from tau_dyn.calibrate.tree_geometry import TreeGeometry, build_tree_geometry
from tau_dyn.robot import load_robot_from_urdf

NOISE = 5e-5  # m, each axis
PLACES = [
    ("0 0 0.3", "0 0 0"),
    ("0.1 0 0.1", "1.5707963267948966 0 0"),
    ("0.5 0 0", "0 0 0"),
    ("0.05 0.4 0.02", "-1.5707963267948966 0 0"),
    ("0 0 0.1", "1.5707963267948966 0 0"),
    ("0 0.08 0", "-1.5707963267948966 0 0"),
]


@pytest.fixture(scope="module")
def arm() -> TreeGeometry:
    """Return an industrial 6R arm: axes 2 and 3 parallel, all along z of their frames."""
    rows = ['<robot name="six"><link name="l0_link"/>']
    for k, (xyz, rpy) in enumerate(PLACES, start=1):
        rows.append(
            f'<link name="l{k}_link"/><joint name="j{k}" type="revolute"><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<parent link="l{k - 1}_link"/><child link="l{k}_link"/><axis xyz="0 0 1"/>'
            '<limit lower="-2.5" upper="2.5" velocity="2" effort="50"/></joint>'
        )
    tool = '<link name="tool"/><joint name="flange" type="fixed"><origin xyz="0 0 0.12"/>'
    tool += '<parent link="l6_link"/><child link="tool"/></joint>'
    return build_tree_geometry(load_robot_from_urdf("".join(rows) + tool + "</robot>", "six"))


def spread(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return joint positions (n, 6) all over the workspace."""
    return rng.uniform(-1.6, 1.6, (n, 6))


@pytest.fixture(scope="module")
def identifiable(arm: TreeGeometry) -> tuple[str, ...]:
    """Return which of the arm's own parameters positions tell beside the frames."""
    rng = np.random.default_rng(1)
    found = fit_geometry_to_poses(
        arm, simulate_poses(arm, arm.parameters.values, spread(60, rng), rng, noise=(NOISE, 1e-4), turned=False)
    )
    kept = [found.identifiability.names[k] for k in found.identifiability.kept]
    return tuple(name for name in kept if name in arm.parameters)


def test_what_parallel_axes_leave_untold(arm: TreeGeometry) -> None:
    """Of 6 revolute axes positions tell 27 numbers, 4 an axis and the target's 3; shifts along parallel axes are one."""
    rng = np.random.default_rng(2)
    truth = arm.parameters.values
    for turned, rank in ((False, 27), (True, 30)):
        found = fit_geometry_to_poses(
            arm, simulate_poses(arm, truth, spread(60, rng), rng, noise=(NOISE, 1e-4), turned=turned)
        )
        told = found.identifiability
        assert told.rank == rank
        depends = {told.names[k]: d for k, d in zip(told.dropped, told.depends_on, strict=True)}
        one, other = ("j3.origin_z", "j2.origin_y") if "j3.origin_z" in depends else ("j2.origin_y", "j3.origin_z")
        assert other in depends[one]  # both lie along axes 2 and 3
        assert depends["j1.origin_z"] and all(name.startswith("device.") for name in depends["j1.origin_z"])
        assert {f"j{k}.offset" for k in (2, 3, 4, 5)} <= {told.names[k] for k in told.kept}


def test_error_at_the_noise(arm: TreeGeometry) -> None:
    """Errors of a millimetre and a milliradian in every joint leave no more than the noise on poses used for nothing else."""
    rng = np.random.default_rng(3)
    free = np.array(arm.parameters.free)
    truth = arm.parameters.values + rng.normal(0, 1e-3, len(free)) * free
    poses = simulate_poses(arm, truth, spread(160, rng), rng, noise=(NOISE, 1e-4), turned=False)
    train, held = poses.take(np.arange(60)), poses.take(np.arange(60, 160))
    fitted = fit_geometry_to_poses(arm, train)
    nominal = fit_geometry_to_poses(arm, train, fix=arm.parameters.names)
    assert fitted.converged
    assert nominal.errors(held).position_size.rms > 1e-3
    # 27 numbers from 180 leave noise * sqrt(1 + 27 / 180) in what is predicted
    assert fitted.errors(held).position_size.rms < 1.2 * NOISE * np.sqrt(3 * (1 + 27 / 180))
    assert fitted.noise[0] == pytest.approx(NOISE, rel=0.2)


def test_standard_errors_hold(arm: TreeGeometry, identifiable: tuple[str, ...]) -> None:
    """Estimates scatter about the truth as their covariance says: chi-squared over seeds, 95 % intervals hold 90 to 99 %."""
    only = arm.only(identifiable)
    only = replace(only, parameters=only.parameters.update({n: {"free": True} for n in identifiable}))
    total, inside, count = 0.0, 0, 0
    for rng in np.random.default_rng(4).spawn(15):
        truth = only.parameters.values + rng.normal(0, 5e-4, len(identifiable))
        fitted = fit_geometry_to_poses(
            only, simulate_poses(only, truth, spread(40, rng), rng, noise=(NOISE, 1e-4), turned=False, frames=TRACKER)
        )
        names = list(fitted.identifiability.names)
        index = [names.index(n) for n in identifiable]
        off = fitted.theta - truth
        total += float(off @ np.linalg.solve(fitted.cov[np.ix_(index, index)], off))
        for value, name in zip(truth, identifiable, strict=True):
            low, high = fitted.interval(fitted.parameters[name])  # type: ignore[misc]
            inside, count = inside + (low <= value <= high), count + 1
    assert 0.90 <= inside / count <= 0.99
    dof = 15 * len(identifiable)
    assert chi2.ppf(1e-4, dof) < total < 1.15 * chi2.ppf(1 - 1e-4, dof)  # the noise is estimated too


@pytest.mark.parametrize("shift", [0.0, 0.002])
def test_a_target_that_slips_while_poses_are_measured_is_said(arm: TreeGeometry, shift: float) -> None:
    """From the thirtieth of 90 poses on, the target sits 2 mm elsewhere; nothing else is confirmed with that in the data."""
    rng = np.random.default_rng(6)
    poses = simulate_poses(arm, arm.parameters.values, spread(90, rng), rng, noise=(NOISE, 1e-4))
    assert poses.rotation is not None
    across = poses.rotation[:, :, 1] * np.where(np.arange(90) >= 30, shift, 0.0)[:, None]
    found = calibrate(arm.shape.robot, replace(poses, position=poses.position + across), model="complete")
    said = [w for w in found.warnings if "seems to sit elsewhere" in w]
    assert bool(said) == (shift > 0)
    if said:
        assert "the target" in said[0] and "by 2 mm" in said[0] and "column campaign" in said[0]
        assert int(re.findall(r"from pose (\d+)", said[0])[0]) == pytest.approx(30, abs=3)
        assert all(f.status == "suspected" for f in found.findings)
