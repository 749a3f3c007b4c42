"""Files that guides take for given, small and simulated: `write_inputs` writes them into the current folder.

Forces are those of the equations of motion on a named motion, with white noise; no loop is simulated, which would take longer.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from tau_dyn import Log, Model, forward_kinematics, load_robot
from tau_dyn.cli import main
from tau_dyn.effects import build_friction_model
from tau_dyn.modes import Actuator
from tau_dyn.robot import Robot
from tau_dyn.simulate import build_named_motion

LAB = """
obstacles:
- name: table
  box: {centre: [1.0, -1.2, 0.1], size: [0.4, 0.3, 0.2]}
"""
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
    Path("lab.yaml").write_text(LAB, encoding="utf-8")


def write_poses() -> None:
    """Write measured poses of a Gantry-Tau with a rod 3 mm too long, and positions that a controller computed."""
    built = load_robot("gantry_tau", **{"simplified.arms.1.rods.1.length": 2.053})
    robot, rng = load_robot("gantry_tau"), np.random.default_rng(1)
    joints = [f"q_{joint}" for joint in robot.actuated]
    for name in ("verify.csv", "poses.csv"):
        q = robot.home + rng.uniform(-0.3, 0.3, (24, 3))
        place = forward_kinematics(built, q).poses.position + 1e-5 * rng.standard_normal((24, 3))
        table = pd.DataFrame(np.hstack([q, place]), columns=[*joints, "x_tool", "y_tool", "z_tool"])
        table.to_csv(name, index=False)
    pd.DataFrame(q[:5] * 0.9 + 0.1 * robot.home, columns=joints).to_csv("wanted.csv", index=False)


def write_track() -> None:
    """Write the tool of `monday.csv` as a camera 2 m away sees it, 50 images a second."""
    log, robot = pd.read_csv("monday.csv"), load_robot("gantry_tau")
    rows = log.iloc[::2]
    q = rows[[f"q_{joint}" for joint in robot.actuated]].to_numpy()
    place = Rotation.from_euler("xyz", [1.5, 0.2, 0.1]).apply(forward_kinematics(robot, q).poses.position) + [0, 0, 2.0]
    names = ["x_tool", "y_tool", "z_tool"]
    table = pd.DataFrame(place + 2e-5 * np.random.default_rng(3).standard_normal(place.shape), columns=names)
    table.insert(0, "t", rows["t"].to_numpy())
    table.assign(**{f"{name}_stderr": 2e-5 for name in names}).to_csv("track.csv", index=False)


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

    The tool's place is measured as `x_gauge` as well, and a model from the drive's place to the tool's is fitted to a shaken one.
    """
    t = 0.004 * np.arange(1000)
    reference = 0.05 * (1 - np.cos(np.pi * np.clip((t - 1) / 1.5, 0, 1)))  # the one of docs/how_to/learning.md
    command, rng = reference, np.random.default_rng(0)
    for name in ("t1.csv", "t2.csv"):
        place, acceleration = swing(command, 0.004)
        q, x, x_gauge = (signal + 1e-6 * rng.standard_normal(len(t)) for signal in (command, command, place))
        channels = {"q_ref_axis": command, "q_axis": q, "x_tool": x, "ax_tool": acceleration, "x_gauge": x_gauge}
        Log(t, channels).to_csv(name)
        command = command + 0.5 * (reference - place)
    shaken = np.repeat(rng.choice([-1e-3, 1e-3], 300), 5)
    gauge = swing(shaken, 0.004)[0] + 1e-7 * rng.standard_normal(1500)
    Log(0.004 * np.arange(1500), {"x_tool": shaken, "x_gauge": gauge}).to_csv("shaken.csv")
    main("modes shaken.csv --inputs x_tool --outputs x_gauge --order 2 --delay 0 --out kalman.yaml --quiet".split())


def write_axis() -> None:
    """Write a log of a linear axis with unequal friction, 25 s."""
    robot = load_robot("linear_axis")
    model = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    drive = {"coulomb_pos": 20.0, "coulomb_neg": 15.0, "viscous_pos": 200.0, "viscous_neg": 180.0}
    record(model.with_values({f"axis.{name}": value for name, value in drive.items()}), 25.0, 6).to_csv("axis.csv")


ARM = """<robot name="arm"><link name="base_link"/><link name="arm_link"><inertial><origin xyz="0 0 -0.1"/><mass value="0.3"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="lift" type="revolute">
<parent link="base_link"/><child link="arm_link"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="3" velocity="6"/></joint>
</robot>
"""


def write_servo() -> Robot:
    """Write a log of commands and positions of an arm with the servo of `law.yaml`, and return the arm."""
    Path("arm.urdf").write_text(ARM, encoding="utf-8")
    main("simulate arm.urdf --controller law.yaml --duration 12 --out chirp.csv --quiet".split())
    return load_robot("arm.urdf")


def write_drives() -> None:
    """Write drives of the Gantry-Tau that lag behind their references, and the file of them."""
    robot, t = load_robot("gantry_tau"), 0.004 * np.arange(1000)
    moved = robot.home + np.outer(rise(t, 1.0, 0.5) - rise(t, 2.5, 0.5), [0.1, -0.08, 0.06])
    drive, rng = Actuator(1.0, 0.007, 0.0105), np.random.default_rng(5)
    channels = {}
    for k, joint in enumerate(robot.actuated):
        channels[f"q_ref_{joint}"] = moved[:, k]
        channels[f"q_{joint}"] = drive.simulate(moved[:, k], 0.004) + 1e-6 * rng.standard_normal(len(t))
    Log(t, channels).to_csv("lag.csv")
    main("actuators lag.csv --out actuators.yaml --quiet".split())


def write_guideways() -> None:
    """Write measured points of the carts of a Gantry-Tau of type D1, and orientations of its plate."""
    robot, rng = load_robot("gantry_tau", prototype="d1"), np.random.default_rng(3)
    for k, joint in enumerate(robot.actuated, start=1):
        along = np.linspace(0.0, 1.0, 12)
        bend = 2e-5 * rng.standard_normal((12, 3)) + along[:, None] * [1.0, 0.0, 0.0]
        table = pd.DataFrame(bend, columns=["x_tool", "y_tool", "z_tool"])
        table.insert(0, f"q_{joint}", along)
        table.to_csv(f"c{k}.csv", index=False)
    q = robot.home + rng.uniform(-0.1, 0.1, (6, robot.na))
    turned = Rotation.from_rotvec(2e-5 * rng.standard_normal((6, 3))).as_quat()
    place = forward_kinematics(robot, q).poses.position
    names = ["x_tool", "y_tool", "z_tool", "qx_tool", "qy_tool", "qz_tool", "qw_tool"]
    columns = [*(f"q_{joint}" for joint in robot.actuated), *names]
    pd.DataFrame(np.hstack([q, place, turned]), columns=columns).to_csv("orientation.csv", index=False)


def write_bench() -> None:
    """Write two axes that swing at 9 and 14 Hz under forces, and their answer to noise alone."""
    t, rng = 0.002 * np.arange(4000), np.random.default_rng(4)
    pushes = np.repeat(rng.choice([-20.0, 20.0], (800, 2)), 5, axis=0)
    x = np.zeros((4000, 2))
    for k, hertz in enumerate((9.0, 14.0)):
        pole = np.exp(0.002 * 2 * np.pi * hertz * (-0.02 + 1j))
        x[:, k] = lfilter([0.0, 1e-7], [1.0, -2 * pole.real, abs(pole) ** 2], pushes[:, k])
    x += 1e-7 * rng.standard_normal(x.shape)
    Log(t, {"force_x": pushes[:, 0], "force_y": pushes[:, 1], "x_tool": x[:, 0], "y_tool": x[:, 1]}).to_csv("bench.csv")
    swaying = np.gradient(np.gradient(x, 0.002, axis=0), 0.002, axis=0) @ np.array([[1, 1, 0.5], [1, -1, 0.3]])
    Log(t, {f"a{k + 1}": swaying[:, k] for k in range(3)}).to_csv("ambient.csv")


def write_inputs() -> None:
    """Write all files."""
    write_logs()
    write_poses()
    write_track()
    write_trials()
    write_drives()
    write_guideways()
    write_bench()
