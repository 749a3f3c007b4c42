"""Does the MJCF that the arm's demo ends with reproduce the true robot's torques in MuJoCo?

    python experiments/exported_torques.py ur5_robot.urdf [--seed 0] [--states 1000]

In: a serial arm. The demo hides a payload and Stribeck friction in it, diagnoses, and its extended model is written as MJCF. Out,
printed: relative error of `mj_inverse` against the true rigid torques over random states within the joints' limits, all joints
and the worst one. Friction is left out on both sides, for MJCF has one value for both directions.
"""

import argparse
import contextlib
import io
import tempfile
from pathlib import Path

import mujoco
import numpy as np

from tau_dyn.cli import main as run_command
from tau_dyn.cli.demo import make_arm
from tau_dyn.exchange import build_mjcf
from tau_dyn.model import Model
from tau_dyn.robot import load_robot


def main(robot_file: str, seed: int, n_states: int) -> None:
    robot = load_robot(robot_file)
    truth = make_arm(robot, robot_file, seed).truth
    with tempfile.TemporaryDirectory() as folder:
        with contextlib.redirect_stdout(io.StringIO()):
            run_command(["demo", robot_file, "--out", folder, "--seed", str(seed)])
        found = Model.load(Path(folder) / "extended.yaml")
    theirs = mujoco.MjModel.from_xml_string(build_mjcf(found).text)
    theirs.dof_damping[:], theirs.dof_frictionloss[:] = 0.0, 0.0
    order = [theirs.joint(name).dofadr[0] for name in robot.actuated]
    rng = np.random.default_rng(seed)
    low, high = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    q = rng.uniform(low, high, (n_states, robot.na))
    v = rng.uniform(-1, 1, q.shape)
    a = rng.uniform(-3, 3, q.shape)
    ours = truth.mechanism.inverse_dynamics(q, v, a)
    data, made = mujoco.MjData(theirs), np.empty_like(q)
    for k in range(n_states):
        data.qpos[order], data.qvel[order], data.qacc[order] = q[k], v[k], a[k]
        mujoco.mj_inverse(theirs, data)
        made[k] = data.qfrc_inverse[order]
    error = made - ours
    each = 100 * np.linalg.norm(error, axis=0) / np.linalg.norm(ours, axis=0)
    print(
        f"{robot.name}: all joints {100 * np.linalg.norm(error) / np.linalg.norm(ours):.3f} %, worst joint {each.max():.3f} %"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--states", type=int, default=1000)
    args = parser.parse_args()
    main(args.robot, args.seed, args.states)
