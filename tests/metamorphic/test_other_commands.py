"""The same relations for what hides in a log, what resonates, and how long the links are."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate import PoseSet, fit_geometry_to_poses
from tau_dyn.calibrate.simulated import simulate_poses
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.diagnose import diagnose
from tau_dyn.evidence import Diagnosis
from tau_dyn.log import Log
from tau_dyn.modes import find_modes
from tau_dyn.robot import load_robot, load_robot_from_urdf
from tau_dyn.simulate import build_named_motion

TOOTH = 0.0209
"""Distance after which the hidden force repeats [m]."""


@pytest.fixture(scope="module")
def axis():
    return load_robot("linear_axis")


@pytest.fixture(scope="module")
def rippled(axis, make) -> Log:
    """A drive that is pushed by 6 N once a tooth."""
    truth = make.friction(axis, (20.0,))
    log = make.recorded(truth, build_named_motion("fourier", truth, 24.0, 0), (2.0,), name="day.csv")
    ripple = 6 * np.sin(2 * np.pi * log.channels["q_axis"] / TOOTH)
    return make.remade(log, tau_axis=log.channels["tau_axis"] + ripple)


@pytest.fixture(scope="module")
def diagnosed(axis, rippled) -> Diagnosis:
    found = diagnose(axis, rippled)
    assert [(f.cause, f.status) for f in found.findings if f.status == "confirmed"] == [("cyclic_ripple", "confirmed")]
    return found


def same_findings(one: Diagnosis, other: Diagnosis, rtol: float, force: float = 1.0) -> None:
    """Check that two diagnoses say the same, forces being so many times as large."""
    assert other.verdict == one.verdict
    assert [(f.cause, f.joints, f.status) for f in other.findings] == [
        (f.cause, f.joints, f.status) for f in one.findings
    ]
    for a, b in zip(one.findings, other.findings, strict=True):
        assert_allclose(b.score, a.score, rtol=rtol)
        assert b.indistinguishable_from == a.indistinguishable_from
    for a, b in ((one.baseline, other.baseline), (one.extended, other.extended), (one.noise_floor, other.noise_floor)):
        assert_allclose(b.rms, force * a.rms, rtol=rtol)


def test_a_diagnosis_knows_no_clock_and_no_order(axis, rippled, diagnosed, make) -> None:
    """Another time origin, other columns beside, another order of columns: the same findings with the same scores."""
    channels = dict(reversed({**rippled.channels, "room": np.full(rippled.n_samples, 20.0)}.items()))
    same_findings(diagnosed, diagnose(axis, Log(rippled.t + 500.0, channels, rippled.name)), 1e-5)


@pytest.mark.parametrize("factor", [0.01, 30.0])
def test_a_diagnosis_does_not_change_with_the_unit_of_force(axis, rippled, diagnosed, make, factor: float) -> None:
    """A robot as many times as strong and heavy has the same faults as many times as large; scores have no unit."""
    larger = re.sub(
        r'(effort|mass value|i[xyz]{2})="([^"]*)"', lambda m: f'{m[1]}="{factor * float(m[2])!r}"', axis.urdf
    )
    strong = load_robot_from_urdf(larger, axis.name)
    assert strong.parameters["carriage_link.mass"].value == pytest.approx(
        factor * axis.parameters["carriage_link.mass"].value
    )
    again = diagnose(strong, make.remade(rippled, tau_axis=factor * rippled.channels["tau_axis"]))
    same_findings(diagnosed, again, 1e-3, factor)


HZ, DAMPING, DT = (7.4, 11.5), (0.02, 0.015), 0.01


@pytest.fixture(scope="module")
def bench() -> Log:
    """A structure of two modes shaken at two places: 25 s of random binary forces [N], displacements [m] with 1 % noise."""
    rng = np.random.default_rng(3)
    shapes = np.linalg.qr(np.random.default_rng(5).normal(size=(2, 2)))[0]
    w, zeta = 2 * np.pi * np.array(HZ), np.array(DAMPING)
    u = np.repeat(rng.choice([-1.0, 1.0], (1250, 2)), 2, axis=0)
    y = np.zeros(u.shape)
    for k in range(2):
        A = np.array([[0, 1], [-(w[k] ** 2), -2 * zeta[k] * w[k]]])
        held = expm(np.block([[A, np.array([[0.0], [1.0]])], [np.zeros((1, 3))]]) * DT)
        a, b = held[:2, :2], held[:2, 2]
        poles = np.poly(a)
        gain = [0.0, b[0], a[0, 1] * b[1] - a[1, 1] * b[0]]
        y += np.outer(lfilter(gain, poles, u @ shapes[k]), shapes[k])
    y += 0.01 * y.std(axis=0) * rng.normal(size=y.shape)
    channels = {"f1": u[:, 0], "f2": u[:, 1], "x1": y[:, 0], "x2": y[:, 1]}
    return Log(DT * np.arange(len(u)), channels, "bench.csv")


@pytest.fixture(scope="module")
def modes(bench):
    found = find_modes(bench, ["f1", "f2"], ["x1", "x2"], order=4).to_dict()
    assert_allclose([m["frequency_hz"] for m in found["modes"]], HZ, rtol=2e-3)
    assert found["mdk"]["status"] == "identified"
    return found


def numbers(found: dict, key: str) -> np.ndarray:
    return np.array([m[key] for m in found["modes"]])


def test_modes_do_not_change_with_units(bench, modes, make) -> None:
    """Millimetres and kilonewtons: frequencies and damping stay with their errors; M, D, K = force / displacement scale."""
    force, length = 1e-3, 1e3
    named = {k: (force if k[0] == "f" else length) * x for k, x in bench.channels.items()}
    again = find_modes(make.remade(bench, **named), ["f1", "f2"], ["x1", "x2"], order=4).to_dict()
    for key, rtol in (
        ("frequency_hz", 1e-6),
        ("damping_ratio", 1e-4),
        ("frequency_stderr", 1e-3),
        ("damping_stderr", 1e-3),
    ):
        assert_allclose(numbers(again, key), numbers(modes, key), rtol=rtol)
    for key in "MDK":
        before = np.array(modes["mdk"][key])
        assert_allclose(
            np.array(again["mdk"][key]),
            before * force / length,
            rtol=0,
            atol=1e-4 * np.abs(before).max() * force / length,
        )


def test_modes_do_not_change_with_the_order_of_channels(bench, modes) -> None:
    """Which shaker is called the first is a name: matrices are permuted, nothing else, the clock's origin aside."""
    moved = Log(bench.t + 77.0, bench.channels, bench.name)
    again = find_modes(moved, ["f2", "f1"], ["x2", "x1"], order=4).to_dict()
    assert_allclose(numbers(again, "frequency_hz"), numbers(modes, "frequency_hz"), rtol=1e-5)
    assert_allclose(numbers(again, "damping_ratio"), numbers(modes, "damping_ratio"), rtol=1e-3)
    for key in "MDK":
        before = np.array(modes["mdk"][key])
        assert_allclose(np.array(again["mdk"][key])[::-1, ::-1], before, rtol=0, atol=1e-3 * np.abs(before).max())


@pytest.fixture(scope="module")
def poses(elbow):
    """The 3R arm's geometry, 40 poses of an arm that is off by millimetres and milliradians, and what is found."""
    geometry = build_tree_geometry(elbow)
    rng = np.random.default_rng(11)
    theta = geometry.parameters.values + 1e-3 * rng.standard_normal(len(geometry.parameters))
    measured = simulate_poses(geometry, theta, rng.uniform(-1.2, 1.2, (40, 3)), rng, noise=(2e-5, 1e-4))
    return geometry, measured, fit_geometry_to_poses(geometry, measured)


def own(geometry, found) -> np.ndarray:
    """Return the robot's own numbers, frames left out."""
    return np.array([found.parameters[name].value for name in geometry.parameters.names])


def test_a_calibration_knows_no_order_of_poses(poses) -> None:
    """Poses are evidence alike: measured in another order they give the same dimensions. 1e-9 m: where iterations stop."""
    geometry, measured, found = poses
    again = fit_geometry_to_poses(geometry, measured.take(np.random.default_rng(1).permutation(measured.n)))
    assert_allclose(own(geometry, again), own(geometry, found), rtol=0, atol=1e-9)
    assert_allclose(again.noise, found.noise, rtol=1e-6)


def test_a_calibration_does_not_know_where_the_tracker_stands(poses) -> None:
    """Moved rigidly, the tracker sees the same robot: its dimensions stay, its own frame alone goes along."""
    geometry, measured, found = poses
    turn = Rotation.from_euler("xyz", [0.4, -0.2, 1.9])
    moved = PoseSet(
        measured.q,
        turn.apply(measured.position) + [3.0, -2.0, 0.5],
        turn.as_matrix() @ measured.rotation,
        approach=measured.approach,
        source="moved",
    )
    again = fit_geometry_to_poses(geometry, moved)
    assert_allclose(own(geometry, again), own(geometry, found), rtol=0, atol=1e-8)
    assert_allclose(again.noise, found.noise, rtol=1e-5)
