"""Are causes in logs of commands named, and is nothing named where nothing hides, on arms of a simulator of its own?

    python experiments/servo_sets.py [--rate 30] [--sets 100] [--first 0] [--seed 0] [--out DIR]

In: nothing. Each set is a planar arm of one to three servos (`servo_sets_parts/plant.py` shares no code with the library),
bodies up to 25 % off the robot file's, three logs of 30 s with 12 bit encoders: two to train on, one held out. At 30 Hz each
sample is up to 6 ms early or late, and stamps are true; at 50 Hz samples are even. In a third of the sets nothing hides. `lambda`
is that of `without_torque.py`. Where nothing hides, the 95 % intervals of friction, rotors and bodies are compared with the
truth. Out: `servo_sets.csv`, a row a set, and the counts.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from servo_sets_parts.plant import Arm, Servo, move
from without_torque import measure_noncentrality

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.log import Log
from tau_dyn.robot import Robot, load_robot_from_urdf
from tau_dyn.servo import diagnose_loop, identify_loop
from tau_dyn.simulate import ServoLaw

SECONDS, NOISE_RAD, STEP_RAD, JITTER_S = 30.0, 3e-4, 2 * np.pi / 4096, 6e-3
STRONG = 120.0
HIDDEN: dict[str, tuple[str, float, float]] = {
    "command_delay": ("command_delay", 0.01, 0.03),
    "stiction": ("stiction", 0.03, 0.08),
    "dead_band": ("dead_band", 0.01, 0.03),
    "load_friction": ("load_friction", 0.15, 0.35),
    "supply_sag": ("supply_sag", 0.15, 0.4),
    "back_emf": ("back_emf", 0.25, 0.4),
    "gain_error": ("gain", 2.9, 3.6),
    "drive_law": ("exponent", 0.7, 0.9),
    "delay": ("torque_delay", 0.008, 0.02),
    "goal_profile": ("acceleration", 15.0, 50.0),
    "backlash": ("play", 0.015, 0.04),
}
"""Causes, the entry of the law that hides them, and its range."""


def draw_arm(rng: np.random.Generator, hidden: str) -> Arm:
    """Return an arm as it is; the file states 0.15 kg at 0.07 m and 2e-4 kg m^2 for each link."""
    n = int(rng.integers(1, 4))
    entry, low, high = HIDDEN.get(hidden, ("", 0.0, 0.0))
    servo = replace(Servo(), **{entry: float(rng.uniform(low, high))}) if entry else Servo()
    rotor, coulomb, viscous = (x * np.exp(0.3 * rng.normal(size=n)) for x in (0.012, 0.06, 0.02))
    mass, centre, inertia = (x * (1 + rng.uniform(-0.25, 0.25, n)) for x in (0.15, 0.07, 2e-4))
    return Arm(mass, centre, inertia, rotor, coulomb, viscous, servo=servo)


def write_robot(n: int) -> Robot:
    """Return the robot file's arm."""
    parts = ['<robot name="arm"><link name="base_link"/>']
    for k in range(1, n + 1):
        parent = "base_link" if k == 1 else f"j{k - 1}_link"
        parts.append(
            f'<link name="j{k}_link"><inertial><origin xyz="0.07 0 0"/><mass value="0.15"/><inertia ixx="1e-5" ixy="0" ixz="0" '
            f'iyy="2e-4" iyz="0" izz="2e-4"/></inertial></link><joint name="j{k}" type="revolute"><parent link="{parent}"/>'
            f'<child link="j{k}_link"/><origin xyz="{0 if k == 1 else 0.12} 0 0"/><axis xyz="0 1 0"/>'
            '<limit lower="-3" upper="3" velocity="8" effort="3"/></joint>'
        )
    return load_robot_from_urdf("".join(parts) + "</robot>", "arm.urdf")


def record(arm: Arm, rate_hz: float, rng: np.random.Generator, name: str) -> tuple[Log, Log]:
    """Return a log of commands and positions as the encoder shows them, and as they are."""
    n, count = len(arm.mass), int(SECONDS * rate_hz)
    jitter = rng.uniform(-JITTER_S, JITTER_S, count) if rate_hz < 50 else np.zeros(count)
    stamps = (np.arange(count) + 0.5) / rate_hz + jitter
    commands = np.zeros((count, n))
    for j in range(n):
        for f in rng.uniform(0.05, 0.9, 4):
            commands[:, j] += rng.uniform(0.05, 0.25) * np.sin(2 * np.pi * f * stamps + rng.uniform(0, 6))
        steps = np.repeat(rng.choice([-0.15, 0.15], count), int(1.2 * rate_hz))[:count]
        commands[:, j] += np.where(stamps > SECONDS / 2, steps, 0.0)
    links, rotors = move(arm, stamps, commands)
    true = rotors if arm.servo.play else links
    noisy = STEP_RAD * np.round((true + NOISE_RAD * rng.normal(size=true.shape)) / STEP_RAD)
    sent = {f"cmd_j{j + 1}": commands[:, j] for j in range(n)}
    noisy, exact = (
        Log(stamps - stamps[0], sent | {f"q_j{j + 1}": q[:, j] for j in range(n)}, name=name) for q in (noisy, true)
    )
    return noisy, exact


def list_truth(arm: Arm) -> dict[str, float]:
    """Return the true values by the names of the parameters."""
    truth = {}
    for k in range(len(arm.mass)):
        joint = f"j{k + 1}"
        truth |= {
            f"{joint}.coulomb": arm.coulomb[k],
            f"{joint}.viscous": arm.viscous[k],
            f"{joint}.armature": arm.rotor[k],
        }
        moment = arm.mass[k] * arm.centre[k]
        truth |= {f"{joint}_link.mx": moment, f"{joint}_link.mz": 0.0, f"{joint}_link.mass": arm.mass[k]}
        truth[f"{joint}_link.iyy"] = arm.inertia[k] + moment * arm.centre[k]
    return truth


def judge(number: int, rate_hz: float, seed: int) -> dict[str, object]:
    """Return the row of a set."""
    rng, begin = np.random.default_rng([seed, number, int(rate_hz)]), time.process_time()
    hidden = "" if number % 3 == 0 else list(HIDDEN)[(2 * (number // 3) + number % 3 - 1) % len(HIDDEN)]
    arm = draw_arm(rng, hidden)
    robot = write_robot(len(arm.mass))
    logs, exact = zip(*(record(arm, rate_hz, rng, f"{name}.csv") for name in "abc"), strict=True)
    plain = {"position_gain": 2.65, "force_per_unit": 2.9, "back_emf": 0.17, "load_friction": 0.0, "stiction": 0.0}
    law = ServoLaw.of(robot.actuated, encoder="motor" if hidden == "backlash" else "link", **plain, command_delay=0.0)
    row: dict[str, object] = {"set": number, "hidden": hidden or "nothing", "joints": len(arm.mass)}
    try:
        found = diagnose_loop(robot, list(logs[:2]), law=law, holdout=[logs[2]])
    except CannotAnswer as fault:
        return row | {"confirmed": f"- {fault.code}", "right": False, "false": False, "lambda": 0.0}
    shown = [(f.cause, f.indistinguishable_from) for f in found.findings if f.status == "confirmed"]
    fit = identify_loop(robot, list(logs[:2]), law=law, holdout=[logs[2]])
    row |= {
        "verdict": found.verdict,
        "confirmed": " ".join(cause for cause, _ in shown),
        "right": any(hidden in (cause, *twins) for cause, twins in shown),
        "false": any(hidden not in (cause, *twins) for cause, twins in shown),
        "lambda": round(measure_noncentrality(robot, law, list(logs[:2]), list(exact[:2])), 1),
        "poor_fit": len(fit.poor_fits),
    }
    if not hidden:
        truth = list_truth(arm)
        rows = [p for p in fit.parameters if p.name in truth and p.stderr is not None]
        row |= {"intervals": len(rows), "covered": sum(abs(p.value - truth[p.name]) < 1.96 * p.stderr for p in rows)}
    return row | {"cpu_s": round(time.process_time() - begin, 1)}


def main() -> None:
    """Print a line a set and the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rate", type=float, default=30.0, choices=(30.0, 50.0), help="rate of commands and log [Hz]")
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first set")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for number in range(options.first, options.first + options.sets):
        rows.append(judge(number, options.rate, options.seed))
        print(rows[-1], flush=True)
    table = pd.DataFrame(rows)
    strong = table[(table["hidden"] != "nothing") & (table["lambda"] >= STRONG)]
    print(
        f"{options.rate:g} Hz: a false cause in {table['false'].sum()} of {len(table)} sets; named {strong['right'].sum()} of "
        f"{len(strong)} at lambda >= {STRONG:g}"
    )
    if "covered" in table:
        print(f"intervals hold the truth in {table['covered'].sum():.0f} of {table['intervals'].sum():.0f}")
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        table.to_csv(options.out / "servo_sets.csv", index=False)


if __name__ == "__main__":
    main()
