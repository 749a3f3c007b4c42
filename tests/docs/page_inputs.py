"""Files that guides take for given, small and simulated: `write_inputs` writes them into the current folder.

Forces are those of the equations of motion on a named motion, with white noise; no loop is simulated, which would take longer.
"""

from __future__ import annotations

import shutil

import numpy as np
import pandas as pd

from tau_dyn import Log, Model, forward_kinematics, load_robot
from tau_dyn.cli import main
from tau_dyn.effects import build_friction_model
from tau_dyn.simulate import build_named_motion

PLATE_KG = 2.0
"""Payload in `loaded.csv`."""


def build_gantry(payload: float = 0.0) -> Model:
    """Return a Gantry-Tau with friction, and a payload on its plate [kg]."""
    robot = load_robot("gantry_tau")
    model = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    drives = {"coulomb_pos": 60.0, "coulomb_neg": 50.0, "viscous_pos": 90.0, "viscous_neg": 80.0}
    values = {f"{joint}.{name}": value for joint in robot.actuated for name, value in drives.items()}
    return model.with_values(values | {"plate_link.mass": model.parameters["plate_link.mass"].value + payload})


def record(model: Model, seconds: float, seed: int) -> Log:
    """Return a log of a model that follows a motion exactly, 100 Hz, 1 N and 1 um of noise."""
    robot, rng = model.robot, np.random.default_rng(seed)
    motion = build_named_motion("fourier", model, seconds, seed).resampled(100.0)
    tau = model.torque(motion.q, motion.v, motion.a)
    columns = {
        "q": motion.q + 1e-6 * rng.standard_normal(motion.q.shape),
        "tau": tau + rng.standard_normal(tau.shape),
        "q_ref": motion.q,
    }
    channels = {f"{signal}_{joint}": x[:, k] for signal, x in columns.items() for k, joint in enumerate(robot.actuated)}
    return Log(0.01 * np.arange(len(tau)), channels)


def write_logs() -> None:
    """Write logs of the Gantry-Tau with and without a payload, and its model."""
    model = build_gantry()
    model.save("model.yaml")
    for seed, name in enumerate(("monday", "tuesday", "a", "b", "c", "d", "empty", "new"), start=1):
        record(model, 12.0, seed).to_csv(f"{name}.csv")
    record(build_gantry(PLATE_KG), 12.0, 9).to_csv("loaded.csv")
    for seed, name in enumerate(("shift1", "shift2", "today"), start=20):
        record(model, 80.0, seed).to_csv(f"{name}.csv")
    shutil.copy("monday.csv", "log.csv")


def write_poses() -> None:
    """Write measured poses of the Gantry-Tau, and positions that a controller computed."""
    robot, rng = load_robot("gantry_tau"), np.random.default_rng(1)
    q = robot.home + rng.uniform(-0.3, 0.3, (24, 3))
    place = forward_kinematics(robot, q).poses.position + 1e-5 * rng.standard_normal((24, 3))
    joints = [f"q_{joint}" for joint in robot.actuated]
    pd.DataFrame(np.hstack([q, place]), columns=[*joints, "x_tool", "y_tool", "z_tool"]).to_csv(
        "poses.csv", index=False
    )
    pd.DataFrame(q[:5] * 0.9 + 0.1 * robot.home, columns=joints).to_csv("wanted.csv", index=False)


def swing(drive: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return position and acceleration of a tool on a spring, 6 Hz and 5 % of damping, that follows a drive; from rest."""
    w, x, v, states = 2 * np.pi * 6.0, float(drive[0]), 0.0, []
    for goal in drive:
        a = w**2 * (goal - x) - 0.1 * w * v
        v += dt * a
        x += dt * v
        states.append((x, a))
    place, acceleration = np.array(states).T
    return place, acceleration


def rise(t: np.ndarray, start: float, seconds: float) -> np.ndarray:
    """Return a smooth step from 0 to 1."""
    share = np.clip((t - start) / seconds, 0, 1)
    return share**3 * (10 - 15 * share + 6 * share**2)


def write_trials() -> None:
    """Write two trials of a linear axis whose tool swings, the second corrected by half of the first one's error.

    The tool's place is measured as `x_gauge` as well, and a model from the drive's place to the tool's is fitted to it.
    """
    t = 0.004 * np.arange(1000)
    reference = 0.3 * rise(t, 1.0, 0.4)
    command, rng = reference, np.random.default_rng(0)
    for name in ("t1.csv", "t2.csv"):
        place, acceleration = swing(command, 0.004)
        q, x, x_gauge = (signal + 1e-6 * rng.standard_normal(len(t)) for signal in (command, command, place))
        channels = {"q_ref_axis": command, "q_axis": q, "x_tool": x, "ax_tool": acceleration, "x_gauge": x_gauge}
        Log(t, channels).to_csv(name)
        command = command + 0.5 * (reference - place)
    main("modes t1.csv --inputs x_tool --outputs x_gauge --order 2 --delay 0 --out kalman.yaml --quiet".split())


def write_inputs() -> None:
    """Write all files."""
    write_logs()
    write_poses()
    write_trials()
