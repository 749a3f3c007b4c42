# pyright: strict, reportMissingTypeStubs=false
"""A program that uses the public face, checked by pyright in strict mode: every name at the top, the results and their parts.

Nothing here runs. A type that is missing or partly unknown on the face, or that is not what this says, fails the check.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, assert_type

import numpy as np
import pandas as pd
from numpy.typing import NDArray

import tau_dyn as td
from tau_dyn.calibrate import Calibration, PoseSet
from tau_dyn.estimate import Regression
from tau_dyn.evidence import Diagnosis, Finding
from tau_dyn.identify import Identification
from tau_dyn.log import CheckFinding, LogCheck
from tau_dyn.mechanism import ForwardResult, InverseResult, Mechanism, Poses
from tau_dyn.modes import Mode, Modes
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.results import Presentation
from tau_dyn.robot import Robot
from tau_dyn.simulate import Trajectory


def look_around() -> None:
    """Lists, the version, faults."""
    assert_type(td.list_robots(), dict[str, Path])
    assert_type(td.list_causes(), list[dict[str, str]])
    assert_type(td.__version__, str)
    try:
        assert_type(td.load_robot("gantry_tau", prototype="l1"), Robot)
    except td.CannotAnswer as fault:
        assert_type(fault.experiment, str)
    except td.InputError as fault:
        assert_type(fault.code, str)
    except td.TauDynError as fault:
        assert_type(fault.exit_status, int)


def use_robot(robot: Robot) -> None:
    """A robot, its kinematics and its dynamics."""
    assert_type(robot.name, str)
    assert_type(robot.actuated, tuple[str, ...])
    assert_type(robot.parameters, Parameters)
    found = td.forward_kinematics(robot, robot.home)
    assert_type(found, ForwardResult)
    assert_type(found.poses, Poses)
    assert_type(found.poses.position, NDArray[Any])
    back = td.inverse_kinematics(robot, found.poses)
    assert_type(back, InverseResult)
    assert_type(back.q, NDArray[Any])
    assert_type(back.ok, NDArray[Any])
    mechanism = td.build_mechanism(robot)
    assert_type(mechanism, Mechanism)
    assert_type(mechanism.inverse_dynamics(back.q, 0 * back.q, 0 * back.q), NDArray[Any])


def use_log(log: td.Log, robot: Robot) -> None:
    """A log, its parts and its check."""
    assert_type(log["q_axis"], NDArray[np.float64])
    assert_type(log[10:20], td.Log)
    assert_type(log[1.0:2.0].select_time(1.0, 1.5), td.Log)
    assert_type(len(log), int)
    assert_type(log.channels, Mapping[str, NDArray[np.float64]])
    assert_type(log.to_pandas(), pd.DataFrame)
    assert_type(td.read_log("monday.csv", "map.yaml"), td.Log)
    checked = td.check_log(log, robot)
    assert_type(checked, LogCheck)
    assert_type(checked.findings, tuple[CheckFinding, ...])
    assert_type(checked.findings[0].sentence, str)


def use_model(robot: Robot, log: td.Log, motion: Trajectory) -> None:
    """Regression, identification, simulation, feedforward."""
    model = td.Model.of(robot).with_values({"carriage_link.mass": 90.0})
    assert_type(model.torque(robot.home, robot.home, robot.home), NDArray[Any])
    regression = td.build_regression(model, log)
    assert_type(regression, Regression)
    found = td.identify(robot, [log], holdout=log, choices=td.Choices(fix=("*.armature",)))
    assert_type(found, Identification)
    assert_type(found.parameters["carriage_link.mass"], Parameter)
    assert_type(found.parameters["carriage_link.mass"].stderr, float | None)
    assert_type(found.parameters.select("*.mass"), Parameters)
    assert_type(found.parameters[:3].to_pandas(), pd.DataFrame)
    assert_type(found.train.relative_error_percent, float)
    assert_type(found.to_dict(), dict[str, Any])
    assert_type(found.warnings, tuple[str, ...])
    assert_type(found.present(), Presentation)
    assert_type(td.simulate(found.model, motion, seed=1), td.Log)
    feedforward = td.Feedforward.load("model.yaml")
    assert_type(feedforward(robot.home, robot.home, robot.home), NDArray[Any])
    assert_type(feedforward.model, td.Model)
    assert_type(feedforward.warnings, tuple[str, ...])
    td.write_report("report.html", found)


def use_results(robot: Robot, log: td.Log, poses: PoseSet) -> None:
    """Diagnosis, calibration, modes."""
    why = td.diagnose(robot, log)
    assert_type(why, Diagnosis)
    assert_type(why.findings, tuple[Finding, ...])
    assert_type(why.findings[0].joints, tuple[str, ...])
    assert_type(why.extended_model, td.Model)
    assert_type(why.to_pandas(), pd.DataFrame)
    fitted = td.calibrate(robot, poses)
    assert_type(fitted, Calibration)
    assert_type(fitted.chosen.name, str)
    assert_type(fitted.to_dict(), dict[str, object])
    modes = td.find_modes(log, ["u"], ["y"])
    assert_type(modes, Modes)
    assert_type(modes.modes, tuple[Mode, ...])
    assert_type(modes.modes[0].frequency_hz, float)
