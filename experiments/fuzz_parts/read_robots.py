"""Readers of robots, models and what goes with them: effects, controllers, surroundings, devices, lenses, corrections."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from fuzz_parts import seed_motions, seed_robots, seeds
from fuzz_parts.reader import TABLE, XML, YAML, Reader, beside, by_name, of, pendulum


def _robot(path: Path) -> None:
    from tau_dyn.exceptions import InputError
    from tau_dyn.mechanism import build_mechanism
    from tau_dyn.robot import load_robot

    robot = load_robot(path)
    if not np.isfinite(robot.home).all() or not np.isfinite(robot.parameters.values).all():
        raise AssertionError("a robot with numbers that are not finite")
    mechanism = build_mechanism(robot)
    q = robot.home[None]
    tau = mechanism.inverse_dynamics(q, 0 * q, 0 * q)
    if not np.isfinite(tau).all() and np.abs(robot.parameters.values).max(initial=0) < 1e9:
        raise InputError(
            "robot_structure", "forces are not finite"
        )  # huge dimensions; commands say it of their answers


def _xacro_table(path: Path) -> None:
    """Read a xacro that takes its dimensions from this table, as the prototypes of ours do."""
    _robot(beside(path.parent, f"of_{path.name}.urdf.xacro", lambda: seed_robots.with_table(path.name)))


def _xacro_include(path: Path) -> None:
    """Read a xacro that includes this file."""
    _robot(beside(path.parent, f"of_{path.name}.urdf.xacro", lambda: seed_robots.with_include(path.name)))


def _model(path: Path) -> None:
    """Load a model, ask it for forces, save it, and put its effects on another robot."""
    from tau_dyn.identify import build_model
    from tau_dyn.model import Model

    model = Model.load(path)
    q = np.tile(model.robot.home, (5, 1))
    signals = {"temperature": np.full(q.shape, 20.0)}
    model.torque(q, 0 * q, 0 * q, t=np.arange(5) * 0.01, signals=signals)
    model.save(path.with_suffix(".saved"))
    build_model(pendulum(), path)


def _effects(path: Path) -> None:
    from tau_dyn.simulate import read_effects_file

    model = read_effects_file(path, pendulum())
    q = np.zeros((5, 1))
    model.torque(q, q, q, t=np.arange(5) * 0.01, signals={"temperature": np.full(q.shape, 20.0)})


def _law(path: Path) -> None:
    from tau_dyn.simulate import read_law_file

    read_law_file(path, pendulum())


def _surroundings(path: Path) -> None:
    """Read what stands around, and ask how far away it is."""
    from tau_dyn.kinematics import read_surroundings

    around = read_surroundings(path)
    points = np.array([[0.0, 0.0, 0.0], [1.0, -2.0, 3.0]])
    for obstacle in around.obstacles:
        if np.isnan(obstacle.distance(points)).any():
            raise AssertionError("an obstacle that is nowhere")


def _calibration(path: Path) -> None:
    from tau_dyn.calibrate import load_calibration

    robot = load_calibration(path)
    seen = robot.seen(np.array([[0.1], [0.2]]))
    if not np.isfinite(seen.position).all() and np.abs(robot.theta).max(initial=0) < 1e9:
        raise AssertionError("a calibrated robot whose poses are not finite")


def _correction(path: Path) -> None:
    from tau_dyn.control import read_correction

    read_correction(path, ("axis",), period=0.01)


def _reference(path: Path) -> None:
    from tau_dyn.control import read_reference
    from tau_dyn.control.interface.reference import compute_digest

    compute_digest(read_reference(path, ("axis",), period=0.01))


ROBOTS = (
    Reader("urdf", ".urdf", of(seeds.PENDULUM.encode(), seeds.FOUR_BAR.encode()), XML, _robot, 3),
    Reader("xacro", ".urdf.xacro", of(seeds.XACRO.encode()), XML, _robot, 3),
    Reader("xacro_table", ".yaml", of(seed_robots.DIMENSIONS), YAML, _xacro_table, 3),
    Reader("xacro_include", ".xacro", of(seed_robots.MACROS), XML, _xacro_include, 2),
    Reader("model", ".yaml", lambda f: [seeds.model_file(f)], YAML, _model, 3),
    Reader("effects", ".yaml", of(seeds.EFFECTS), YAML, _effects),
    Reader("controller", ".yaml", of(seeds.LAW), YAML, _law),
    Reader("surroundings", ".yaml", of(seeds.SURROUNDINGS), YAML, _surroundings),
    Reader("camera", ".yaml", of(seeds.CAMERA), YAML, by_name("calibrate.poses.camera", "read_camera")),
    Reader("tracker", ".yaml", of(seeds.TRACKER), YAML, by_name("calibrate.poses.camera", "read_tracker")),
    Reader("fixtures", ".yaml", of(seeds.FIXTURES), YAML, by_name("calibrate.poses.fixtures", "read_fixtures")),
    Reader("errors", ".yaml", of(seeds.ERRORS), YAML,
           by_name("kinematics.accuracy.error_bounds", "read_errors_file", ("axis",), ("rod1", "rod2"))),
    Reader("cameras", ".yaml", of(seeds.CAMERAS), YAML, by_name("vision.cameras", "read_cameras")),
    Reader("state_space", ".yaml", of(seeds.STATE_SPACE), YAML, by_name("modes.state_space", "load_state_space")),
    Reader("compensation", ".yaml", lambda f: [seeds.compensation_file(f)], YAML,
           by_name("calibrate.saved", "load_compensation")),
    Reader("calibrated_robot", ".yaml", lambda f: [seeds.calibrated(f)], YAML, _calibration),
    Reader("correction", ".csv", lambda f: [seed_motions.correction()], TABLE, _correction),
    Reader("reference", ".csv", lambda f: [seeds.csv_of(seed_motions.reference())], TABLE, _reference),
)  # fmt: skip
"""Each with its share of time."""
