"""What must change with the experiment, and by exactly how much: more data, larger forces, a slower film, the other direction."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.identify import Preparation, identify
from tau_dyn.log import Log
from tau_dyn.message_codes import get_code
from tau_dyn.robot import load_robot, load_robot_from_urdf
from tau_dyn.simulate import build_named_motion


def values(found) -> np.ndarray:
    return np.array([(row["value"], row["stderr"]) for row in found.base_rows()]).T


@pytest.fixture(scope="module")
def long_log(gantry_truth, make) -> Log:
    """Forty seconds of L1."""
    return make.recorded(gantry_truth, build_named_motion("fourier", gantry_truth, 40.0, 4), (5.0, 5.0, 5.0), seed=3)


def test_the_same_samples_twice_count_once(l1, long_log, make) -> None:
    """A copy of a log is no further evidence: values and standard errors stay, and the copy is named."""
    once = identify(l1, long_log)
    twice = identify(l1, [make.remade(long_log, name=name) for name in "ab"])
    (beta, sigma), (beta2, sigma2) = values(once), values(twice)
    assert_allclose(sigma2, sigma)
    assert_allclose(beta2, beta)
    assert "copied_data" in map(get_code, twice.warnings)


def test_the_same_file_twice_is_one_file(case, make) -> None:
    """A recording repeated is no evidence: it counts once, and that is said."""
    named = Log(case.log.t, case.log.channels, case.log.name, sha256="a" * 64)
    again = identify(case.robot, [named, named])
    assert_allclose(values(again), values(case.found), rtol=1e-12)
    assert any("given twice" in sentence for sentence in again.warnings)


def test_new_noise_on_twice_the_data(l1, gantry_truth, long_log, make) -> None:
    """Two recordings of one motion with noise of their own: errors shrink by root 2, but for the blocks' scatter, 5 %."""
    motion = build_named_motion("fourier", gantry_truth, 40.0, 4)
    other = make.recorded(gantry_truth, motion, (5.0, 5.0, 5.0), seed=9, name="other")
    sigma, sigma2 = (values(identify(l1, x, estimator="ml"))[1] for x in ([long_log], [long_log, other]))
    assert_allclose(np.median(sigma / sigma2), np.sqrt(2), rtol=0.05)


@pytest.mark.parametrize("factor", [1e-3, 7.0, 1e4])
def test_all_forces_scaled(case, make, factor: float) -> None:
    """Forces are linear in masses and friction: all of them s times as large is a robot s times as heavy, equally well known.

    Its drives' limits, at which samples are left out, scale along. 5e-3 of a standard error: bodies are kept physical by a conic
    solver, whose own tolerance is not relative.
    """
    limits = re.sub(r'effort="([^"]*)"', lambda m: f'effort="{factor * float(m[1])!r}"', case.robot.urdf)
    strong = load_robot_from_urdf(limits, case.robot.name, actuated=case.robot.actuated)
    forces = {f"tau_{j}": factor * case.log.channels[f"tau_{j}"] for j in case.robot.actuated}
    again = identify(strong, make.remade(case.log, **forces))
    make.same(case.found, again, 5e-3, factor=lambda name: factor)


@pytest.fixture(scope="module")
def axis():
    """A drive without gravity."""
    return load_robot("linear_axis")


@pytest.fixture(scope="module")
def axis_truth(axis, make):
    return make.friction(axis, (20.0,))


@pytest.fixture(scope="module")
def axis_log(axis_truth, make) -> Log:
    return make.recorded(axis_truth, build_named_motion("fourier", axis_truth, 15.0, 0), (2.0,))


def test_a_film_at_half_speed(axis, axis_log, make) -> None:
    """Time stretched by k with the same forces: masses (force / acceleration) grow by k^2, viscosity by k, Coulomb stays.

    Filters and masks, which are in hertz and m/s, are stretched along. The blocks from which standard errors are had are not:
    they stay 2 s long, which moves these by some percent.
    """
    k = 2.0
    found = identify(axis, axis_log, estimator="wls")
    p = found.estimate.regression.preparation
    slow = Preparation(
        p.position_cutoff_hz / k, p.force_cutoff_hz / k, p.rate_hz / k, p.speed_threshold / k, p.window_s * k, p.exclude
    )
    again = identify(axis, make.remade(axis_log, t=k * axis_log.t), estimator="wls", preparation=slow)

    def factor(name: str) -> float:
        return k**2 if "mass" in name or "armature" in name else k if "viscous" in name else 1.0

    for ours, theirs in zip(found.base_rows(), again.base_rows(), strict=True):
        assert abs(theirs["value"] / factor(ours["name"]) - ours["value"]) < 1e-6 * ours["stderr"], ours["name"]
        assert theirs["stderr"] / factor(ours["name"]) == pytest.approx(ours["stderr"], rel=0.25), ours["name"]
    assert again.train.relative_error_percent == pytest.approx(found.train.relative_error_percent, rel=1e-6)


def test_the_other_direction(axis, axis_log, make) -> None:
    """Positions and forces with the other sign: masses stay, and what was friction forward is friction backward."""
    found = identify(axis, axis_log)
    back = {name: -values for name, values in axis_log.channels.items()}
    swap = {"pos": "neg", "neg": "pos"}

    def called(name: str) -> str:
        head, _, tail = name.rpartition("_")
        return f"{head}_{swap[tail]}" if tail in swap else name

    make.same(found, identify(axis, make.remade(axis_log, **back)), 1e-6, called=called)


def test_heavier_by_what_was_added(l1, gantry_truth, make) -> None:
    """5 kg on the plate are 5 kg more plate, and nothing else, within four standard errors of the difference."""
    heavy = gantry_truth.with_values({"plate_link.mass": gantry_truth.parameters["plate_link.mass"].value + 5.0})
    motion = build_named_motion("fourier", gantry_truth, 15.0, 3)
    logs = [make.recorded(m, motion, (2.0, 2.0, 2.0), seed) for seed, m in enumerate((gantry_truth, heavy))]
    before, after = ({row["name"]: row for row in identify(l1, log).base_rows()} for log in logs)
    for name, row in before.items():
        added = 5.0 if name == "plate_link.mass" else 0.0
        moved = after[name]["value"] - row["value"] - added
        assert abs(moved) < 4 * np.hypot(row["stderr"], after[name]["stderr"]), name


def test_a_force_that_is_not_in_the_model_is_in_the_residual(axis, axis_log, make) -> None:
    """Errors are of the force: a push known to be orthogonal to nothing raises the residual by no more than itself."""
    push = 3.0 * np.sin(40.0 * axis_log.t)
    pushed = make.remade(axis_log, tau_axis=axis_log.channels["tau_axis"] + push)
    before, after = identify(axis, axis_log, estimator="wls"), identify(axis, pushed, estimator="wls")
    assert before.train.rms[0] < after.train.rms[0] < np.hypot(before.train.rms[0], 3.0 / np.sqrt(2)) * 1.01
