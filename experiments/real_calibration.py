"""Real arms calibrated with default options, beside what others publish for the same poses.

    git clone https://github.com/pauljac7700/serial_robots_datasets FOLDER/serial_robots_datasets
    git clone https://github.com/Jmeyer1292/robot_cal_tools FOLDER/robot_cal_tools
    python experiments/real_calibration.py FOLDER [--only ur5 wam positioner] [--pybotics] [--out DIR]

Out: a line a set; robots and poses as `tau-dyn calibrate` reads them. `--pybotics` fits the same
poses with the package of that name (`pip install pybotics`; minutes): all Denavit-Hartenberg parameters, target and base.

Published: P. Jacobi, "A hybrid error compensation method for enhancing the pose accuracy of serial industrial robots", Tsinghua
University 2025 (README of its data: laser tracker, dimensions and a neural network); robot_cal_tools, pull request 79 (camera).
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import yaml

from tau_dyn.calibrate import PoseSet, calibrate, read_poses
from tau_dyn.robot import load_robot_from_urdf

HALF = np.pi / 2
UR5 = (
    (0, HALF, 0.089159),
    (-0.425, 0, 0),
    (-0.39225, 0, 0),
    (0, HALF, 0.10915),
    (0, -HALF, 0.09465),
    (0, 0, 0.0823),
)
"""Denavit-Hartenberg rows a [m], alpha [rad], d [m] of the makers; so are those that follow."""
WAM = (
    (0, -HALF, 0),
    (0, HALF, 0),
    (0.045, -HALF, 0.55),
    (-0.045, HALF, 0),
    (0, -HALF, 0.3),
    (0, HALF, 0),
    (0, 0, 0.06),
)
POSITIONER = ((0, -HALF, 0), (0, 0, -0.475))
TARGET = {"ur5": 0.031, "wam": 0.044}  # [m] along the flange's z, where the commanded positions are of
MILLI = 1e3  # mm a metre, mrad a radian
Table = tuple[tuple[float, ...], ...]


class Case(NamedTuple):
    """A robot, its poses, those held out (none: a quarter of the poses), and what others publish."""

    table: Table
    poses: pd.DataFrame
    holdout: pd.DataFrame | None
    published: str


def write_urdf(table: Table) -> str:
    """Return Denavit-Hartenberg rows as a robot file whose joints j1 .. turn about z."""
    rows, origin = ['<robot name="arm"><link name="l0"/>'], '<origin xyz="0 0 0"/>'
    for k, (a, alpha, d) in enumerate(table, start=1):
        rows.append(
            f'<link name="l{k}"/><joint name="j{k}" type="revolute"><parent link="l{k - 1}"/><child link="l{k}"/>{origin}'
            '<axis xyz="0 0 1"/><limit lower="-6.3" upper="6.3" velocity="1" effort="1"/></joint>'
        )
        origin = f'<origin xyz="{a} 0 {d}" rpy="{alpha} 0 0"/>'
    last = f'<parent link="l{len(table)}"/><child link="tool0"/>{origin}'
    return "".join(rows) + f'<link name="tool0"/><joint name="flange" type="fixed">{last}</joint></robot>'


def read_jacobi(folder: Path, name: str, part: str) -> pd.DataFrame:
    """Return poses of the laser tracker's data: the target is where it was meant to be plus the difference."""
    table = pd.read_csv(folder / "serial_robots_datasets" / name / f"3D_{name}_uncalibrated_{part}_cleaned.csv")
    joints = [c for c in table if c.startswith("joint_")]
    poses = {f"q_j{k}": np.deg2rad(table[joint]) for k, joint in enumerate(joints, start=1)}
    return pd.DataFrame(poses | {f"{a}_tool": (table[f"{a}_t"] + table[f"{a}_dif"]) / MILLI for a in "xyz"})


def read_ur5(folder: Path) -> Case:
    """Universal Robots UR5, 1000 poses on a grid and 20 random ones."""
    published = "dimensions and a neural network, compensated: 0.155 mm"
    return Case(UR5, read_jacobi(folder, "UR5", "grid"), read_jacobi(folder, "UR5", "random"), published)


def read_wam(folder: Path) -> Case:
    """Barrett WAM, seven joints driven by cables, 216 poses on a grid and 20 random ones."""
    published = "dimensions and a neural network, compensated: 2.92 mm"
    return Case(WAM, read_jacobi(folder, "WAM", "grid"), read_jacobi(folder, "WAM", "random"), published)


def read_positioner(folder: Path) -> Case:
    """Return the two-axis positioner seen by a camera, 205 poses with orientation."""
    path = folder / "robot_cal_tools" / "rct_examples" / "data" / "positioner_kinematic_measurements.yaml"
    rows = []
    for seen in yaml.safe_load(path.read_text()).values():
        joints = {f"q_j{k}": q for k, q in enumerate(seen["target_joints"], start=1)}
        rows.append(joints | {f"{name}_tool": value for name, value in seen["pose"].items()})
    return Case(POSITIONER, pd.DataFrame(rows), None, "all poses fitted: 1.74 mm, 3.23 mrad")


READERS: dict[str, Callable[[Path], Case]] = {"ur5": read_ur5, "wam": read_wam, "positioner": read_positioner}


def run_pybotics(table: Table, target: float, train: PoseSet, held: PoseSet) -> float:
    """Return the mean held-out error [m] of pybotics with everything free, from the makers' dimensions."""
    from pybotics.optimization import OptimizationHandler, optimize_accuracy
    from pybotics.robot import Robot as Peer
    from scipy.optimize import least_squares

    before = [(0.0, 0.0), *((alpha, a) for a, alpha, _ in table)]
    rows = [(alpha, a * MILLI, 0.0, d * MILLI) for (alpha, a), (_, _, d) in zip(before, table, strict=False)]
    robot = Peer.from_parameters(np.array(rows).ravel())
    robot.tool.position = np.array([0, 0, target * MILLI])
    mask = [True] * 3 + [False] * 3
    handler = OptimizationHandler(robot, kinematic_chain_mask=True, tool_mask=mask, world_mask=True)
    start = handler.generate_optimization_vector()
    given = (handler, train.q, train.position * MILLI)  # mm beside rad: without scales the descent hardly gets on
    found = least_squares(optimize_accuracy, start, args=given, x_scale="jac", max_nfev=150)
    handler.apply_optimization_vector(found.x)
    off = [handler.robot.fk(q)[:3, 3] / MILLI - p for q, p in zip(held.q, held.position, strict=True)]
    return float(np.mean(np.linalg.norm(off, axis=1)))


def main() -> None:
    """Calibrate what was asked for and print a line a set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", choices=READERS, default=list(READERS))
    parser.add_argument("--pybotics", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("real_calibration"))
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    for name in asked.only:
        case = READERS[name](asked.folder)
        urdf = write_urdf(case.table)
        (asked.out / f"{name}.urdf").write_text(urdf)
        robot, sets = load_robot_from_urdf(urdf, name), []
        for part, table in (("poses", case.poses), ("holdout", case.holdout)):
            if table is not None:
                path = asked.out / f"{name}_{part}.csv"
                table.to_csv(path, index=False)
                sets.append(read_poses(path, robot.actuated))
        found = calibrate(robot, *sets)
        held, turned = found.errors(found.chosen), found.errors(found.chosen).orientation_size
        said = f"{MILLI * held.position_size.mean:.3g} mm (rms {MILLI * held.position_size.rms:.3g})"
        said += "" if turned is None else f", {MILLI * turned.mean:.3g} mrad"
        print(f"{name}: published: {case.published}; held out: {said}; {found.chosen.name}", flush=True)
        for one in found.findings:
            print(f"   {one.status} {one.cause} {' '.join(one.joints)}: {one.gain.reduction_percent:.1f} %")
        if asked.pybotics and name in TARGET:
            print(f"   pybotics: {MILLI * run_pybotics(case.table, TARGET[name], *sets):.3g} mm", flush=True)


if __name__ == "__main__":
    main()
