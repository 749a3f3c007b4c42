"""Is a load that one log alone carries named with its mass, and nothing else, and are equal logs left alone?

    python experiments/changed_loads.py [--robot fivebar] [--sets 10] [--seed 0] [--clean] [--against both]

`fivebar`: a planar five-bar in the vertical plane with 1.5 kg at the end. Its forces follow from closed-form kinematics and
d'Alembert's principle. `ur5`: the arm of example-robot-data with 0.5 kg off the flange. Its torques are Pinocchio's. Both have
Coulomb and viscous friction; encoders round, and forces have white noise of 0.5 % of their rms. Every set has three logs with
motions of their own. `logs`: the loaded one is drawn at random, and the third is trained on or held out by turns. `model`: the
extended model of two unloaded logs is given with the third log, which is loaded. `--clean`: none is loaded. Prints one line a set
and the counts.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin

from tau_dyn.diagnose import diagnose
from tau_dyn.evidence import Diagnosis
from tau_dyn.identify import build_model
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot
from tau_dyn.simulate import build_fourier_motion

NOISE_SHARE = 0.005
RATE_HZ = 250.0
FRICTION_NM = {"fivebar": 0.3, "ur5": np.array([6.0, 6.0, 4.0, 1.5, 1.5, 1.5])}
"""Coulomb friction [N m]; a tenth of typical forces."""
VISCOUS_S = 0.3
"""Viscous over Coulomb friction [s/rad]."""
LOADS_KG = {"fivebar": 1.5, "ur5": 0.5}
UPPER_M, FORE_M, HALF_BASE_M = 0.22, 0.34, 0.12
HOME_RAD = np.radians([130.0, 50.0])
MASSES_KG = {"arm1": 1.2, "arm2": 1.2, "fore1": 0.5, "fore2": 0.5, "plate": 0.8}
COUNT_RAD = 2 * np.pi / (30 * 16384)


def write_fivebar(folder: Path) -> Robot:
    """Return the five-bar: two cranks and two forearms of one mass each, a plate at the end."""
    first, second = HOME_RAD
    elbow = HALF_BASE_M + UPPER_M * np.cos(second)
    inner, outer = np.arccos(elbow / FORE_M), np.arccos(-elbow / FORE_M)

    def bar(name: str, length: float) -> str:
        m = MASSES_KG[name]
        return (
            f'<link name="{name}_link"><inertial><origin xyz="{length / 2} 0 0"/><mass value="{m}"/><inertia ixx="1e-4" ixy="0" '
            f'ixz="0" iyy="{m * length**2 / 12}" iyz="0" izz="{m * length**2 / 12}"/></inertial></link>'
            f'<tau_dyn:link name="{name}_link" parameters="mass"/>'
        )

    def hinge(name: str, parent: str, child: str, x: float, angle: float, reach: float) -> str:
        return (
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}_link"/>'
            f'<origin xyz="{x} 0 0" rpy="0 {-angle} 0"/><axis xyz="0 -1 0"/>'
            f'<limit lower="{-reach}" upper="{reach}" velocity="10" effort="40"/></joint>'
        )

    drives = "".join(
        f'<transmission name="{j}_drive"><type>transmission_interface/SimpleTransmission</type><joint name="{j}"/>'
        f'<actuator name="{j}_motor"/></transmission>'
        for j in ("motor1", "motor2")
    )
    text = (
        '<robot name="fivebar" xmlns:drake="http://drake.mit.edu" xmlns:tau_dyn="urn:tau_dyn"><link name="base_link"/>'
        + bar("arm1", UPPER_M) + bar("arm2", UPPER_M) + bar("fore1", FORE_M) + bar("fore2", FORE_M)
        + hinge("motor1", "base_link", "arm1", -HALF_BASE_M, first, 0.6)
        + hinge("motor2", "base_link", "arm2", HALF_BASE_M, second, 0.6)
        + hinge("elbow1", "arm1_link", "fore1", UPPER_M, inner - first, 2.0)
        + hinge("elbow2", "arm2_link", "fore2", UPPER_M, outer - second, 2.0)
        + '<drake:ball_constraint><drake:ball_constraint_body_A name="fore1_link"/>'
        '<drake:ball_constraint_body_B name="fore2_link"/>'
        f'<drake:ball_constraint_p_AP value="{FORE_M} 0 0"/><drake:ball_constraint_p_BQ value="{FORE_M} 0 0"/>'
        '</drake:ball_constraint><link name="plate_link"><inertial><mass value="0.8"/><inertia ixx="1e-4" ixy="0" ixz="0" '
        'iyy="1e-4" iyz="0" izz="1e-4"/></inertial></link><tau_dyn:link name="plate_link" parameters="mass"/>'
        '<joint name="tool" type="fixed"><parent link="fore1_link"/><child link="plate_link"/>'
        f'<origin xyz="{FORE_M} 0 0"/></joint>{drives}</robot>'
    )  # fmt: skip
    path = folder / "fivebar.urdf"
    path.write_text(text, encoding="utf-8")
    return load_robot(path)


def place_bodies(q: np.ndarray) -> list[tuple[str, float, np.ndarray]]:
    """Return name, length and `x z angle` (n, 3) of the centre of every bar and of the plate, of positions (n, 2) from home."""
    angle = q + HOME_RAD
    bases = np.array([[-HALF_BASE_M, 0.0], [HALF_BASE_M, 0.0]])
    elbows = [bases[k] + UPPER_M * np.stack([np.cos(angle[:, k]), np.sin(angle[:, k])], axis=1) for k in (0, 1)]
    across = elbows[1] - elbows[0]
    half = np.linalg.norm(across, axis=1, keepdims=True) / 2
    along = across / (2 * half)
    end = elbows[0] + half * along + np.sqrt(FORE_M**2 - half**2) * np.stack([-along[:, 1], along[:, 0]], axis=1)
    found = [(f"arm{k + 1}", UPPER_M, np.column_stack([(bases[k] + elbows[k]) / 2, angle[:, k]])) for k in (0, 1)]
    for k in (0, 1):
        d = end - elbows[k]
        found.append((f"fore{k + 1}", FORE_M, np.column_stack([(end + elbows[k]) / 2, np.arctan2(d[:, 1], d[:, 0])])))
    return [*found, ("plate", 0.0, np.column_stack([end, np.zeros(len(q))]))]


def compute_fivebar_forces(q: np.ndarray, v: np.ndarray, a: np.ndarray, load: float) -> np.ndarray:
    """Return torques (n, 2) by d'Alembert's principle: Jacobians and their drift by central differences."""
    masses = MASSES_KG | {"plate": MASSES_KG["plate"] + load}
    step, tau = 1e-4, np.zeros_like(q)
    here, before, after = (place_bodies(q + s * 1e-3 * v) for s in (0, -1, 1))
    J = [
        [(one[2] - other[2]) / (2 * step) for one, other in zip(place_bodies(q + d), place_bodies(q - d), strict=True)]
        for d in step * np.eye(2)
    ]
    for k, (name, length, place) in enumerate(here):
        m = masses[name]
        drift = (after[k][2] - 2 * place + before[k][2]) / 1e-6
        wrench = drift + J[0][k] * a[:, :1] + J[1][k] * a[:, 1:] + np.array([0.0, 9.81, 0.0])
        wrench *= np.array([m, m, m * length**2 / 12])
        tau += np.stack([np.sum(wrench * J[joint][k], axis=1) for joint in (0, 1)], axis=1)
    return tau


def compute_arm_forces(robot: Robot, q: np.ndarray, v: np.ndarray, a: np.ndarray, load: float) -> np.ndarray:
    """Return torques (n, na) of Pinocchio's recursive Newton-Euler, with a body off the flange."""
    model = pin.Model(robot.model)
    if load:
        last = model.njoints - 1
        model.inertias[last] = model.inertias[last] + pin.Inertia(
            load, np.array([0.02, 0.03, 0.08]), 2e-3 * load * np.eye(3)
        )
    data = model.createData()
    return np.array([pin.rnea(model, data, *row).copy() for row in zip(q, v, a, strict=True)])


def record(model: Model, kind: str, seed: int, seconds: float, load: float, name: str) -> Log:
    """Return a log of one motion."""
    robot, rng = model.robot, np.random.default_rng(1000 + seed)
    if kind == "fivebar":
        t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
        w = 2 * np.pi * np.arange(1, 13) / 10
        q, v, a = np.zeros((3, len(t), 2))
        for k in (0, 1):
            c, s = rng.normal(size=(2, 12)) / np.arange(1, 13) ** 0.7
            phase = np.outer(t, w)
            sin, cos = np.sin(phase), np.cos(phase)
            path = sin @ s + cos @ c
            size = 0.42 / np.abs(path - path.mean()).max()
            q[:, k] = size * (path - path.mean())
            v[:, k] = size * (cos @ (w * s) - sin @ (w * c))
            a[:, k] = -size * (sin @ (w**2 * s) + cos @ (w**2 * c))
        tau = compute_fivebar_forces(q, v, a, load)
    else:
        motion = build_fourier_motion(model, seconds, seed).every(4)
        t, q, v, a = motion.t, motion.q, motion.v, motion.a
        tau = compute_arm_forces(robot, q, v, a, load)
    size = np.sqrt(np.mean(tau**2, axis=0))
    tau = tau + FRICTION_NM[kind] * (np.sign(v) + VISCOUS_S * v)
    tau += NOISE_SHARE * size * rng.standard_normal(tau.shape)
    q = COUNT_RAD * np.round(q / COUNT_RAD)
    columns = {f"q_{j}": q[:, k] for k, j in enumerate(robot.actuated)}
    return Log(t, columns | {f"tau_{j}": tau[:, k] for k, j in enumerate(robot.actuated)}, name)


def judge(found: Diagnosis, loaded: str, load: float, logs: Sequence[str]) -> tuple[bool, str]:
    """Return whether a diagnosis of training logs is right, and a line about it; a finding without logs concerns them all."""
    payloads = [f for f in found.findings if f.cause == "payload" and f.status != "suspected"]
    bodies = [
        f for f in found.findings if f.cause in ("link_mass", "force_scale", "drive_gain") and f.status != "suspected"
    ]
    causes = sorted({f.cause for f in found.findings if f.status == "confirmed" and f.cause != "payload"})
    text = ", ".join(f"{f.cause} {' '.join(f.joints)}" for f in bodies) or "-"
    text = f"bodies: {text}; other causes: {', '.join(causes) or '-'}"
    if not load:
        return not payloads and not bodies, f"{len(payloads)} payloads; {text}"
    if len(payloads) != 1 or (payloads[0].logs or tuple(logs)) != (loaded,):
        return False, f"payloads {[(f.logs, f.status) for f in found.findings if f.cause == 'payload']}; {text}"
    mass = payloads[0].parameters[0]
    away = (mass.value - load) / (mass.stderr or np.inf)
    return abs(
        away
    ) < 3 and not bodies, f"{mass.value:.4f} +- {mass.stderr:.4f} kg ({away:+.1f} standard errors); {text}"


def run_set(
    kind: str, robot: Robot, seed: int, seconds: float, load: float, against: str, folder: Path
) -> tuple[bool, str]:
    """Return whether one set of logs is judged right, and a line about it."""
    model = build_model(robot, "asymmetric")
    which = int(np.random.default_rng(seed).integers(3))
    if against == "model":
        which = 2
    names = [f"log{k}" for k in range(3)]
    logs = [record(model, kind, 3 * seed + k, seconds, load * (k == which), names[k]) for k in range(3)]
    if against == "logs":
        out = seed % 2
        train = names[: 3 - out]
        found = diagnose(robot, logs[: 3 - out], holdout=logs[3 - out :], seed=seed)
    else:
        path = folder / f"{kind}{seed}.yaml"
        diagnose(robot, logs[:1], holdout=logs[1:2], seed=seed).extended_model.save(path)
        train = names[2:]
        found = diagnose(robot, logs[2:], model=path, seed=seed)
    return judge(found, names[which], load, train)


def main() -> None:
    """Run the sets and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", choices=sorted(LOADS_KG), default="fivebar")
    parser.add_argument("--sets", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--clean", action="store_true")
    parser.add_argument("--against", choices=("logs", "model", "both"), default="both")
    given = parser.parse_args()
    load = 0.0 if given.clean else LOADS_KG[given.robot]
    with tempfile.TemporaryDirectory() as folder:
        robot = write_fivebar(Path(folder)) if given.robot == "fivebar" else load_robot(given.robot)
        for against in ("logs", "model") if given.against == "both" else (given.against,):
            right = 0
            for seed in range(given.seed, given.seed + given.sets):
                start = time.perf_counter()
                good, line = run_set(given.robot, robot, seed, given.seconds, load, against, Path(folder))
                right += good
                print(
                    f"{against} {seed}: {'right' if good else 'WRONG'}; {line} ({time.perf_counter() - start:.0f} s)",
                    flush=True,
                )
            print(f"{given.robot}, {load:g} kg, against {against}: {right} of {given.sets} right", flush=True)


if __name__ == "__main__":
    main()
