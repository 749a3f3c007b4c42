"""`identify` and `diagnose` report the same error of the same model on the same samples."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.diagnose import diagnose
from tau_dyn.estimate import RegressionRun
from tau_dyn.evidence import TEST, Diagnosis, TimeTrace
from tau_dyn.identify import build_force_errors, build_regression, choose_preparation, identify
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

ARM = """<robot name="arm"><link name="base_link"/>
<link name="upper_link"><inertial><origin xyz="0.2 0.02 0"/><mass value="6"/>
<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
<link name="fore_link"><inertial><origin xyz="0.15 0 0.02"/><mass value="3"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.05"/></inertial></link>
<joint name="lift" type="revolute"><parent link="base_link"/><child link="upper_link"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" velocity="9" effort="900"/></joint>
<joint name="bend" type="revolute"><parent link="upper_link"/><child link="fore_link"/><axis xyz="0 1 0"/>
<origin xyz="0.4 0 0"/><limit lower="-3" upper="3" velocity="9" effort="900"/></joint>
<transmission name="a"><type>transmission_interface/SimpleTransmission</type><joint name="lift"/>
<actuator name="m"/></transmission>
<transmission name="b"><type>transmission_interface/SimpleTransmission</type><joint name="bend"/>
<actuator name="n"/></transmission>
</robot>"""
ROBOTS: dict[str, Callable[[], Robot]] = {
    "arm": lambda: load_robot_from_urdf(ARM, "arm"),
    "axis": lambda: load_robot("linear_axis"),
}
COULOMB, NOISE = 0.03, 0.05
"""Coulomb friction and white noise, as shares of the force's rms; most of the noise lies above the band of an identification."""


def record(robot: Robot, seed: int, name: str) -> Log:
    """Return 30 s of motion below 1 Hz with white noise on the forces."""
    rng, model = np.random.default_rng(seed), Model.of(robot)
    t = np.arange(0, 30, 0.004)
    q, v, a = np.zeros((3, len(t), robot.na))
    for k in range(robot.na):
        for h in range(1, 6):
            w, size, phase = 2 * np.pi * 0.13 * h * rng.uniform(0.9, 1.1), rng.uniform(0.1, 0.3) / h, rng.uniform(0, 6)
            q[:, k] += size * np.sin(w * t + phase)
            v[:, k] += size * w * np.cos(w * t + phase)
            a[:, k] -= size * w**2 * np.sin(w * t + phase)
    tau = model.mechanism.inverse_dynamics(q, v, a)
    size = np.sqrt(np.mean(tau**2, axis=0))
    tau = tau + size * (COULOMB * np.sign(v) + NOISE * rng.standard_normal(tau.shape))
    q = q + 2e-6 * rng.standard_normal(q.shape)
    columns = {f"q_{j}": q[:, k] for k, j in enumerate(robot.actuated)}
    return Log(t, columns | {f"tau_{j}": tau[:, k] for k, j in enumerate(robot.actuated)}, name)


def cut_test_blocks(runs: tuple[RegressionRun, ...], traces: tuple[TimeTrace, ...]) -> tuple[RegressionRun, ...]:
    """Return the stretches of runs whose nearest sample in the diagnosis belongs to the test data."""
    found = []
    for run in runs:
        trace = next(one for one in traces if one.log == run.name)
        nearest = np.abs(trace.t[None] - run.t[:, None]).argmin(axis=1)
        inside = np.concatenate([[False], trace.part[nearest] == TEST, [False]])
        starts, stops = (
            np.flatnonzero(np.diff(inside.astype(int)) == 1),
            np.flatnonzero(np.diff(inside.astype(int)) == -1),
        )
        found += [run.window(slice(a, b)) for a, b in zip(starts, stops, strict=True)]
    return tuple(found)


@pytest.fixture(scope="module", params=sorted(ROBOTS))
def case(request) -> tuple[Robot, list[Log], Log, Diagnosis]:
    """A robot, training logs, a held-out log, and their diagnosis."""
    robot = ROBOTS[request.param]()
    train, held = [record(robot, 1, "one"), record(robot, 2, "two")], record(robot, 3, "three")
    return robot, train, held, diagnose(robot, train, holdout=held)


def test_the_error_of_a_model_on_a_log_is_one_number(case) -> None:
    """The refitted model of a diagnosis, judged on its test samples by the rows of an identification: rms and percent agree."""
    robot, train, held, found = case
    model = found.model
    regression = build_regression(model, held, preparation=choose_preparation(robot, train))
    test = replace(regression, runs=cut_test_blocks(regression.runs, found.traces))
    errors = build_force_errors(test, model.parameters.values)
    assert_allclose(found.baseline.rms, errors.rms, rtol=1e-6)
    assert_allclose(found.baseline.relative_error_percent, errors.relative_error_percent, rtol=1e-6)
    assert errors.all_samples is not None and found.baseline.all_samples is not None
    assert_allclose(found.baseline.all_samples.rms, errors.all_samples.rms, rtol=1e-6)


def test_an_identification_reports_the_error_of_its_model(case) -> None:
    """What `identify` reports of held-out logs is what its model misses of them, with the filters of the training logs."""
    robot, train, held, _ = case
    found = identify(robot, train, holdout=held)
    regression = build_regression(found.model, held, preparation=choose_preparation(robot, train))
    errors = build_force_errors(regression, found.model.parameters.values)
    assert found.holdout is not None
    assert_allclose(found.holdout.rms, errors.rms, rtol=1e-6)
    assert_allclose(found.holdout.relative_error_percent, errors.relative_error_percent, rtol=1e-6)


def test_both_commands_report_the_same_error_but_for_the_samples(case) -> None:
    """Both refits miss the noise in the band of an identification; half of the held-out samples tell it to a few per cent."""
    robot, train, held, found = case
    identified = identify(robot, train, holdout=held).holdout
    assert identified is not None
    assert_allclose(found.baseline.rms, identified.rms, rtol=0.15)
    assert found.search_band is not None
    assert (found.search_band.baseline.rms > 1.5 * found.baseline.rms).all()  # the search looks at a wider band
