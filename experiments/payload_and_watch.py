"""Does `payload` find half a kilogram, and `watch` a friction that rises, and nothing where nothing changed?

    python experiments/payload_and_watch.py [--sets 40] [--equal 100] [--hours 200] [--seed 0] [--out DIR]

In: nothing. UR5 of `example-robot-data` and the L1 Gantry-Tau, with asymmetric friction; logs of 20 s at 250 Hz along Fourier
motions, forces of the model with noise that is coloured (autoregressive, 0.9) and encoder noise, no controller. Payload: 0.5 kg,
60 mm off the tool's joint, a sphere's inertia; empty and loaded along motions of their own, `--equal` pairs without a payload.
Watch: a minute of reference, then friction of one joint 10 % higher, in logs of a minute; false alarms on block scores of
`--hours` hours of noise drawn as a reference's own. Out: one row a robot, and `payload_and_watch.csv`.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.signal import lfilter
from spoiled_logs_parts.machines import build_robot

from tau_dyn.diagnose import find_end_link
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.files import write_whole
from tau_dyn.identify import build_model
from tau_dyn.log import Log
from tau_dyn.mechanism import build_mechanism
from tau_dyn.model import Model
from tau_dyn.monitor import BLOCK_S, BlockScore, ChangeDetector, identify_payload, watch_logs
from tau_dyn.robot import INERTIAL, load_robot
from tau_dyn.simulate import build_fourier_motion

RATE_HZ, COLOUR = 250.0, 0.9
MASS_KG, PLACE = 0.5, np.array([0.0, 0.0, 0.06])


def build_true_model(name: str) -> Model:
    """Return a robot with friction of a few per cent of its forces."""
    robot = build_robot(name) if name == "ur5" else load_robot(name)
    model = build_model(robot, "asymmetric")
    size = {
        joint: 3.0 if unit == "N m" else 30.0 for joint, unit in zip(robot.actuated, robot.force_units, strict=True)
    }
    values = {}
    for parameter in model.effect_parameters:
        joint, quantity = parameter.name.split(".")
        values[parameter.name] = size[joint] * (1.0 if quantity.startswith("coulomb") else 2.0)
    return model.with_values(values)


def compute_payload_forces(model: Model, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return the forces (N, na) that the payload adds."""
    body = find_end_link(model.robot)
    names = [f"{body.link}.{quantity}" for quantity in INERTIAL]
    robot = model.robot.untied(names)
    own = body.map @ model.robot.parameters.select(body.names).values
    inertia = MASS_KG * (PLACE @ PLACE * np.eye(3) - np.outer(PLACE, PLACE)) + 2e-4 * np.eye(3)
    more = np.array([MASS_KG, *(MASS_KG * PLACE), *inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])
    values = {p.name: p.value for p in model.robot.parameters}
    with_it, without = (
        build_mechanism(
            robot.with_parameters(robot.parameters.with_values(values | dict(zip(names, pi, strict=True))))
        ).inverse_dynamics(q, v, a)
        for pi in (own + more, own)
    )
    return with_it - without


def make_log(model: Model, seconds: float, seed: int, name: str, *, loaded: bool = False, motion_seed: int = 0) -> Log:
    """Return a log along a Fourier motion."""
    rng = np.random.default_rng(seed)
    motion = build_fourier_motion(model.steady(), seconds, motion_seed).resampled(RATE_HZ)
    tau = model.torque(motion.q, motion.v, motion.a)
    if loaded:
        tau = tau + compute_payload_forces(model, motion.q, motion.v, motion.a)
    size = 0.01 * np.sqrt(np.mean(tau**2, axis=0))
    noise = lfilter([np.sqrt(1 - COLOUR**2)], [1, -COLOUR], rng.standard_normal(tau.shape), axis=0)
    tau = tau + size * noise
    q = motion.q + 1e-5 * rng.standard_normal(tau.shape)
    channels = {f"q_{j}": q[:, k] for k, j in enumerate(model.robot.actuated)}
    channels |= {f"tau_{j}": tau[:, k] for k, j in enumerate(model.robot.actuated)}
    return Log(motion.t, channels, name)


def study_payload(model: Model, sets: int, equal: int, seed: int) -> dict[str, float]:
    """Return errors and coverage of half a kilogram, and how often equal pairs are told apart."""
    errors, inside, refused, false = [], [], 0, 0
    for k in range(sets):
        logs = [
            make_log(model, 20.0, seed + 10 * k + i, f"{i}", loaded=bool(i), motion_seed=seed + 2 * k + i)
            for i in (0, 1)
        ]
        try:
            found = identify_payload(model.robot, logs[:1], logs[1:])
        except CannotAnswer:
            refused += 1
            continue
        value, stderr = float(found.mass.values[0]), float(found.mass.stderr[0])
        errors.append(value / MASS_KG - 1)
        inside.append(abs(value - MASS_KG) < 1.96 * stderr)
    for k in range(equal):
        logs = [make_log(model, 20.0, seed + 7000 + 10 * k + i, f"{i}", motion_seed=seed + 2 * k + i) for i in (0, 1)]
        try:
            false += identify_payload(model.robot, logs[:1], logs[1:]).differs
        except CannotAnswer:
            continue
    return {
        "sets": sets, "refused": refused, "rms error [%]": 100 * float(np.sqrt(np.mean(np.square(errors)))) if errors else np.nan,
        "within 3 %": float(np.mean(np.abs(errors) < 0.03)) if errors else np.nan,
        "coverage [%]": 100 * float(np.mean(inside)) if inside else np.nan, "equal pairs": equal, "false claims": false,
    }  # fmt: skip


def study_watch(model: Model, sets: int, seed: int) -> dict[str, float]:
    """Return how often a friction that is 10 % higher is named within a minute of motion, and alarms before it."""
    named, early = 0, 0
    joints = model.robot.actuated
    for k in range(sets):
        joint = joints[k % len(joints)]
        more = {
            n: 1.1 * model.effect_parameters[n].value
            for n in model.effect_parameters.names
            if n.startswith(f"{joint}.")
        }
        worn = model.with_values(more)
        logs = [
            make_log(model, 70.0, seed + 10 * k, "a", motion_seed=seed + k),
            make_log(worn, 75.0, seed + 10 * k + 1, "b", motion_seed=seed + k + 1),
        ]
        rows = watch_logs(model, logs).rows()
        early += any(row["log"] == "a" for row in rows)
        for row in rows:
            others = [(o["what"], o["joint"]) for o in row["indistinguishable_from"]]
            right = ("friction", joint) in [(row["what"], row["joint"]), *others]
            if row["log"] == "b" and right and row["detected_t"] <= 62.0:
                named += 1
                break
    return {"watch sets": sets, "named in 60 s": named / max(sets, 1), "alarms before": early}


def study_false_alarms(hours: float, directions: int, seed: int) -> dict[str, float]:
    """Return alarms in hours of normal block scores, each reference followed by four hours."""
    rng, alarms, watched = np.random.default_rng(seed), 0, 0.0
    blocks, L = 30, np.linalg.cholesky(0.3 * np.ones((directions,) * 2) + 0.7 * np.eye(directions))
    while watched < hours:
        detector = ChangeDetector(np.full(directions, 1e3), blocks)
        for k in range(blocks + 7200):
            G = rng.uniform(50, 150) * L @ L.T
            z = 1.5 * np.linalg.cholesky(G) @ rng.standard_normal(directions)
            detector.add(BlockScore((BLOCK_S * k, BLOCK_S * (k + 1)), "made", z, G))
        detector.settle()
        alarms, watched = alarms + len(detector.changes), watched + 4.0
    return {"hours": watched, "false alarms": alarms}


def main() -> None:
    """Run all studies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", default=["ur5", "gantry_tau"])
    parser.add_argument("--sets", type=int, default=40)
    parser.add_argument("--equal", type=int, default=100)
    parser.add_argument("--watched", type=int, default=20)
    parser.add_argument("--hours", type=float, default=200.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for name in options.robots:
        model = build_true_model(name)
        row = {"robot": name, **study_payload(model, options.sets, options.equal, options.seed)}
        row |= study_watch(model, options.watched, options.seed)
        rows.append(row)
        print(row, flush=True)
    print(study_false_alarms(options.hours, 14, options.seed), flush=True)
    if options.out:
        table = pd.DataFrame(rows)
        write_whole(options.out / "payload_and_watch.csv", lambda path: table.to_csv(path, index=False))


if __name__ == "__main__":
    main()
