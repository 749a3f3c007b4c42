"""The plant that learns: it repeats but for its noise, and stands where its kinematics say when it moves slowly."""

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.mechanism import L1_DRIVES, FlexibleModel, build_mechanism
from tau_dyn.robot import load_robot
from tau_dyn.simulate import VibrationSensors

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from ilc_parts.learning_plant import LearningPlant, Unrepeatable, square_path

QUIET = {"sensors": VibrationSensors(), "unrepeatable": Unrepeatable(drive=0.0, push=0.0)}


@pytest.fixture(scope="module")
def parts() -> tuple:
    flexible = load_robot("gantry_tau", arms="complete", flexible="true", wrist="serial2")
    near = FlexibleModel(flexible).at(tool="gauge_block_link", pushed="tool")
    return near, build_mechanism(load_robot("gantry_tau")), L1_DRIVES


def test_square_is_closed_and_keeps_its_limits() -> None:
    """Twice round 10 mm, back where it began, below 100 mm/s and 1 m/s^2, at rest in every corner."""
    path = square_path(1400, 0.004)
    assert_allclose(path[-1], 0, atol=1e-12)
    assert_allclose([np.ptp(path[:, 0]), np.ptp(path[:, 1])], 0.01, atol=1e-9)
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / 0.004
    assert 0.08 < speed.max() < 0.1
    assert np.abs(np.diff(path, 2, axis=0)).max() / 0.004**2 < 1.02
    assert np.all(np.min(np.abs(path - np.round(path / 0.01) * 0.01), axis=1) < 1e-9)
    with raises_code("invalid_value", "2"):
        square_path(500, 0.004)


def test_trials_repeat_without_disturbance_and_differ_with_it(parts) -> None:
    """The same reference gives the same trial; noise and wander are other ones in every trial."""
    still = LearningPlant(*parts, **QUIET)
    q = still.actuators(still.rest + square_path(1000, 0.004, start=0.1, rounds=1))
    assert_allclose(still.run(q, 0).tool, still.run(q, 1).tool, atol=0)
    rough = LearningPlant(*parts)
    assert 1e-6 < np.std(rough.run(q, 0).tool - rough.run(q, 1).tool) < 1e-4


def test_held_still_the_tool_is_where_the_kinematics_have_it(parts) -> None:
    """At rest away from the pose nothing deflects but by weight; reference, computed tool and tool agree."""
    plant = LearningPlant(*parts, velocity_share=0.5, **QUIET)
    target = np.tile(plant.rest, (1500, 1))
    target[50:] += [0.004, -0.003, 0.0]
    trial = plant.run(plant.actuators(target))
    assert_allclose(trial.kinematic[-1], target[-1], atol=1e-7)
    assert_allclose(trial.tool[-200:].mean(axis=0), target[-1], atol=3e-5)


def test_speed_fed_forward_makes_up_for_the_drives_lag(parts) -> None:
    """On a ramp a drive of first order is late by its time constant, and not at all where its speed is fed forward."""
    ramp = 0.01 * np.clip(0.004 * np.arange(800) - 0.4, 0, None)
    late = []
    for share in (0.0, 1.0):
        plant = LearningPlant(*parts, velocity_share=share, **QUIET)
        target = plant.rest + ramp[:, None] * np.array([1.0, 0.0, 0.0])
        late.append((target - plant.run(plant.actuators(target)).kinematic)[-200:, 0].mean() / 0.01)
    assert (
        abs(late[1]) < 0.2 * late[0] and min(parts[2].time_constants) < late[0] < max(parts[2].time_constants) + 0.004
    )


def test_references_that_leave_the_pose_are_refused(parts) -> None:
    """The linear model is not asked about half a metre."""
    plant = LearningPlant(*parts, **QUIET)
    with raises_code("invalid_value"):
        plant.run(np.tile(plant.flexible.q + 0.5, (10, 1)))
