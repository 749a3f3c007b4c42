"""How well are commands and positions alone simulated, on motions and gains that were not used; do the parameters hold?

    python experiments/without_torque.py [--only so101 free xl330 pairs causes laws spring speed named] [--sets N] [--out DIR]

so101: every second motion by name trains (a rule fixed before any result), with the servo's law; free: without one. xl330:
each gain from the others and from all of them, mean absolute error. pairs: simulated arms of one to three joints, each at two
servo gains: how many pairs of parameters agree within their 95 % intervals, and how often an interval holds the true value, one
mass known.
causes: arms of one or two joints whose law the file gives, a third of them with nothing hidden; causes confirmed, whether the
hidden one, or a twin, is among them, lambda (what the fitted baseline misses of the true motion, in variances of the
encoder's noise, summed over samples and joints: a noncentrality), and the error on a further log over that of the true model.
laws: simulated arms of one to three joints identified with the true law and with a wrong one (a gain of 0.5 to 0.75 or 1.33 to
2 times the true one, or no back EMF): how often `poor_fit` is reported. named: the causes found on all SO-101 motions.
spring: see spring_in_the_loop.py. speed: an arm of
twelve joints, 120 s at 200 Hz.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.interpolate import interp1d

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent / "identification"), str(HERE.parent)]
import so101  # noqa: E402
import xl330  # noqa: E402
from spring_in_the_loop import summarise_springs, tabulate_springs  # noqa: E402
from tests.servo.arms import build_arm, build_commands, build_law, build_truth, record  # noqa: E402

from tau_dyn import load_robot, read_log  # noqa: E402
from tau_dyn.exceptions import CannotAnswer  # noqa: E402
from tau_dyn.identify import Choices  # noqa: E402
from tau_dyn.log import Log  # noqa: E402
from tau_dyn.robot import Robot  # noqa: E402
from tau_dyn.servo import LoopIdentification, diagnose_loop, identify_loop, simulate_loop_log  # noqa: E402
from tau_dyn.servo.data import BASELINE, fit_coupled, keep_kinds  # noqa: E402
from tau_dyn.servo.identification import predict  # noqa: E402
from tau_dyn.servo.preparation import prepare_loop, read_loop_logs  # noqa: E402
from tau_dyn.servo.records import WARM_UP_S  # noqa: E402
from tau_dyn.servo.residual_structure import compute_noise_floor  # noqa: E402
from tau_dyn.servo.waves import SPRING_STEP_S  # noqa: E402
from tau_dyn.simulate import ServoLaw, build_servo_law, read_servo_law  # noqa: E402

GAINS = (2.65, 5.3)
FRICTION = {"armature": 0.012, "coulomb": 0.06, "viscous": 0.02}
RANGES = {"load_friction": (0.1, 0.3), "stiction": (0.005, 0.02), "command_delay": (0.005, 0.02)}
"""What simulated pairs of logs have: medians that spread by 40 %, and ranges."""
Z95 = 1.96
MIN_LAMBDA = 120.0  # from which a cause is to be named in 95 of 100
HIDDEN = {
    "command_delay": {"command_delay": 0.02},
    "stiction": {"stiction": 0.05},
    "dead_band": {"dead_band": 0.02},
    "load_friction": {"load_friction": 0.25},
    "supply_sag": {"supply_sag": 0.3},
    "back_emf": {"back_emf": 0.3},
    "gain_error": {"gain": 3.2},
    "drive_law": {"drive_exponent": 0.8},
    "delay": {"torque_delay": 0.015},
    "joint_compliance": {"joint_compliance": 0.1, "joint_damping": 0.005},
    "backlash": {"backlash": 0.03, "encoder": "motor"},
}
"""Causes -> entries of the law that hide them; of a play the motor's side is logged, as the link's hardly shows it."""
NOTHING = {"load_friction": 0.0, "stiction": 0.0, "command_delay": 0.0}


def tabulate_motions(law: bool) -> pd.DataFrame:
    """Return the held-out error of each motion [mrad]: five arm joints, and the command itself."""
    found = so101.identify_so101(so101.DATA / "so101", law)
    held = found.holdout
    assert held is not None
    rows = []
    for log, rms, command in zip(held.logs, held.rms, held.command_rms, strict=True):
        model, plain = (1e3 * float(np.sqrt(np.nanmean(x[so101.ARM] ** 2))) for x in (rms, command))
        rows.append({"motion": log, "model_mrad": model, "command_mrad": plain})
    return pd.DataFrame(rows)


def tabulate_gains() -> pd.DataFrame:
    """Return the mean absolute error at each gain, of fits to the other gains and to all of them [mrad]."""
    logs, rows = xl330.read_logs(xl330.DATA / "xl330"), []
    law = read_servo_law(xl330.HERE / "controllers" / "xl330.yaml", xl330.ROBOT)
    every = xl330.identify_best(logs, list(xl330.GAINS), [], law)
    for gain in xl330.GAINS:
        others = xl330.identify_best(logs, [g for g in xl330.GAINS if g != gain], [gain], law)
        held, own = xl330.compute_mean_error(others, gain), xl330.compute_mean_error(every, gain, held_out=False)
        rows.append({"gain": gain, "from_others_mrad": 1e3 * held, "from_all_gains_mrad": 1e3 * own})
    return pd.DataFrame(rows)


def draw_truth(joints: int, seed: int) -> dict[str, np.ndarray]:
    """Return numbers of each joint (joints,): bodies a quarter off their nominal ones, the first mass known, and friction."""
    rng = np.random.default_rng([77, seed])
    while True:
        mass = 0.15 * (1 + 0.25 * np.clip(rng.normal(size=joints), -2, 2))
        mass[0] = 0.15
        mx, iyy = 0.0105 * (1 + 0.25 * rng.normal(size=joints)), 0.000935 * (1 + 0.25 * rng.normal(size=joints))
        if np.all(iyy - mx**2 / mass > 2e-5):
            break
    about = {key: x * np.exp(0.4 * rng.normal(size=joints)) for key, x in FRICTION.items()}
    ranges = {key: rng.uniform(*x, joints) for key, x in RANGES.items()}
    return {"mass": mass, "mx": mx, "mz": np.zeros(joints), "iyy": iyy, "offset": np.zeros(joints), **about, **ranges}


def identify_made(joints: int, gain: float, seed: int) -> tuple[LoopIdentification, dict[str, float]]:
    """Return the identification of a simulated arm at one servo gain, its first mass known, and the true values by name."""
    arm, truth = build_arm(joints), draw_truth(joints, seed)
    values = {}
    for j, joint in enumerate(arm.actuated):
        values |= {f"{joint}.{key}": float(x[j]) for key, x in truth.items() if key in (*FRICTION, *RANGES, "offset")}
        values |= {f"{joint}_link.{key}": float(truth[key][j]) for key in ("mass", "mx", "mz", "iyy")}
    model = build_truth(arm)
    model = model.with_values({key: x for key, x in values.items() if key in model.parameters})
    law = build_law(arm, gain, **{key: truth[key] for key in RANGES})
    log = record(arm, model, law, 10 * seed + int(gain))
    known = ServoLaw.of(arm.actuated, position_gain=gain, force_per_unit=2.9, back_emf=0.17)
    found = identify_loop(arm, log, law=known, holdout=log.split(0.9)[1], choices=Choices(fix=("j1_link.mass",)))
    return found, values


def tabulate_pairs(sets: Iterable[int]) -> pd.DataFrame:
    """Return every parameter of every pair: both estimates, whether they agree, and whether each holds the true value."""
    rows = []
    for seed in sets:
        (one, true), (other, _) = (identify_made(1 + seed % 3, gain, seed) for gain in GAINS)
        second = {p.name: p for p in other.parameters}
        for p in one.parameters:
            q = second.get(p.name)
            if q is None or p.stderr is None or q.stderr is None or p.name not in true or p.at_bound or q.at_bound:
                continue
            held = [abs(x.value - true[p.name]) < Z95 * x.stderr for x in (p, q)]
            rows.append({
                "set": seed, "name": p.name, "true": true[p.name], "first": p.value, "second": q.value,
                "agree": abs(p.value - q.value) < Z95 * np.hypot(p.stderr, q.stderr), "covered": np.mean(held),
            })  # fmt: skip
    return pd.DataFrame(rows)


def tabulate_causes(sets: Iterable[int]) -> pd.DataFrame:
    """Return what is hidden and what is confirmed in each set; two logs of 30 s, the causes at all joints."""
    rows, names = [], list(HIDDEN)
    for seed in sets:
        hidden = "" if seed % 3 == 0 else names[(seed // 3 * 2 + seed % 3 - 1) % len(names)]
        rows.append({"set": seed, "hidden": hidden or "nothing"} | judge_causes(seed, hidden))
        print({key: round(x, 4) if isinstance(x, float) else x for key, x in rows[-1].items()}, flush=True)
    return pd.DataFrame(rows)


def judge_causes(seed: int, hidden: str) -> dict[str, object]:
    """Return what is told of one arm, whether it is right, and the error on a further log over the true model's."""
    arm, extra = build_arm(1 + seed % 2), HIDDEN.get(hidden, {})
    model = build_truth(arm)
    plain = build_law(arm, encoder=extra.get("encoder", "link"), **NOTHING)
    true = build_law(arm, **(NOTHING | extra))
    logs = [record(arm, model, true, 1000 + 2 * seed + k, 30.0) for k in range(2)]
    try:
        found = diagnose_loop(arm, logs, law=plain)
    except CannotAnswer as fault:
        return {"confirmed": fault.missing, "right": False, "false": False}
    told = [(f.cause, f.indistinguishable_from) for f in found.findings if f.status == "confirmed"]
    motion = build_commands(arm, 50_000 + seed, 20.0)
    measured = record(arm, model, true, 50_000 + seed, 20.0)
    law = build_servo_law(dict(found.extended_model.controller), arm, "the extended model")
    truth, ours = (
        measured.joint("q", arm.actuated) - simulate_loop_log(m, x, motion).joint("q", arm.actuated)
        for m, x in ((model, true), (found.extended_model, law))
    )
    clean = [record(arm, model, true, 1000 + 2 * seed + k, 30.0, clean=True) for k in range(2)]
    return {
        "confirmed": " ".join(cause for cause, _ in told),
        "right": any(cause == hidden or hidden in twins for cause, twins in told),
        "false": any(cause != hidden and hidden not in twins for cause, twins in told),
        "lambda": measure_noncentrality(arm, plain, logs, clean),
        "error_over_true": float(np.sqrt(np.mean(ours**2)) / np.sqrt(np.mean(truth**2))),
        "unexplained": len(found.unexplained),
    }


def measure_noncentrality(arm: Robot, law: ServoLaw, logs: list[Log], clean: list[Log]) -> float:
    """Return the squared distance of a fitted baseline's motions to the true ones, in variances of the noise."""
    given = read_loop_logs(arm, logs, {"law": law})
    data = prepare_loop(given, given.kept)
    data = replace(data, unknowns=keep_kinds(data, (*BASELINE, *law.estimated)), whole=True, step=SPRING_STEP_S)
    data, fit = fit_coupled(data)
    motions = predict(data, fit, given.kept)
    moved, measured, true = [], [], []
    for log, exact, kept, motion in zip(logs, clean, given.kept, motions, strict=True):
        late = (log.t - log.t[0] > WARM_UP_S) & (log.t <= kept.t[-1])
        stamps = kept.t if kept.apart is None else kept.t + kept.apart * kept.dt
        moved.append(interp1d(stamps, motion.q, axis=0)(log.t[late]))
        for rows, one in ((measured, log), (true, exact)):
            rows.append(one.joint("q", arm.actuated)[late])
    moved, measured, true = (np.concatenate(rows) for rows in (moved, measured, true))
    noise = np.var(measured - true, axis=0)
    return float(np.sum((moved - true) ** 2 / noise))


def summarise_causes(table: pd.DataFrame) -> str:
    """Return false claims, right names and held-out errors."""
    shown = table[(table["hidden"] != "nothing") & (table["lambda"] >= MIN_LAMBDA)]
    return (
        f"false claims in {table['false'].sum()} of {len(table)} sets; named in {shown['right'].sum()} of {len(shown)} at lambda "
        f">= {MIN_LAMBDA:g}; held-out error over the true model's, median {table['error_over_true'].median():.3f}"
    )


def tabulate_laws(sets: Iterable[int]) -> pd.DataFrame:
    """Return whether a poor fit is reported with the true law and with a wrong one, and the residuals over the noise."""
    rows = []
    for seed in sets:
        rng, arm = np.random.default_rng([78, seed]), build_arm(1 + seed % 3)
        gain = float(rng.choice(GAINS))
        law = build_law(arm, gain, **{key: rng.uniform(*x, arm.na) for key, x in RANGES.items()})
        log = record(arm, build_truth(arm), law, 10 * seed, 30.0)
        factor = float(np.exp(rng.uniform(np.log(4 / 3), np.log(2))))
        kind, changed = (
            ("gain too low", {"position_gain": gain / factor}),
            ("gain too high", {"position_gain": gain * factor}),
            ("no back EMF", {"back_emf": 0.0}),
        )[seed // 3 % 3]
        known = {"position_gain": gain, "force_per_unit": 2.9, "back_emf": 0.17}
        for name, entries in (("true", known), (kind, known | changed)):
            found = identify_loop(arm, log, law=ServoLaw.of(arm.actuated, **entries))
            over = found.train.rms_per_joint / compute_noise_floor([r for r, _, _ in found.shown])
            rows.append(
                {"set": seed, "law": name, "poor": len(found.poor_fits), "residual_over_noise": float(over.max())}
            )
        print(rows[-2], rows[-1], flush=True)
    return pd.DataFrame(rows)


def summarise_laws(table: pd.DataFrame) -> str:
    """Return how often a poor fit is reported, by law."""
    reported = table["poor"] > 0
    return ", ".join(
        f"{law}: {reported[table['law'] == law].sum()} of {(table['law'] == law).sum()} reported (residual over noise "
        f"{table['residual_over_noise'][table['law'] == law].min():.2f} to "
        f"{table['residual_over_noise'][table['law'] == law].max():.2f})"
        for law in table["law"].unique()
    )


def tabulate_speed() -> pd.DataFrame:
    """Return the seconds that a fit of twelve joints takes, 120 s at 200 Hz, held-out error included."""
    arm = build_arm(12, 0.03)
    law = build_law(arm)
    motion = build_commands(arm, 7, 120.0)
    log = simulate_loop_log(build_truth(arm), law, motion, rate_hz=200.0, encoder_noise=3e-4, seed=7)
    asked = ServoLaw.of(arm.actuated, position_gain=2.65, force_per_unit=2.9, back_emf=0.17)
    begin = time.perf_counter()
    found = identify_loop(arm, log, law=asked)
    held = found.holdout
    assert held is not None
    rms = 1e3 * float(np.sqrt(np.mean(held.rms_per_joint**2)))
    return pd.DataFrame([{"seconds": time.perf_counter() - begin, "held_out_mrad": rms, "unknowns": found.rank}])


def tabulate_diagnosis() -> pd.DataFrame:
    """Return the causes found on all fourteen SO-101 motions by the servo's law, and the CPU seconds that they took."""
    robot = load_robot(so101.DATA / "so101" / "so101_new_calib.urdf", tool="gripper_frame_link")
    columns = so101.HERE / "columns" / "so101.yaml"
    logs = [read_log(path, columns) for path in sorted((so101.DATA / "so101").glob("*.parquet"))]
    law = read_servo_law(so101.HERE / "controllers" / "sts3215.yaml", robot)
    begin = time.process_time()
    found = diagnose_loop(robot, logs, law=law)
    seconds = time.process_time() - begin
    print(found.sentence)
    return pd.DataFrame(
        [{"cause": f.cause, "joint": f.joints[0], "status": f.status, "cpu_s": seconds} for f in found.findings]
    )


def main() -> None:
    """Print and write the tables asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=["so101", "free", "xl330", "pairs"])
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first set, which draws it")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    sets = range(options.first, options.first + options.sets)
    tables: dict[str, Callable[[], pd.DataFrame]] = {
        "so101": lambda: tabulate_motions(True),
        "free": lambda: tabulate_motions(False),
        "xl330": tabulate_gains,
        "pairs": lambda: tabulate_pairs(sets),
        "causes": lambda: tabulate_causes(sets),
        "spring": lambda: tabulate_springs(sets),
        "laws": lambda: tabulate_laws(sets),
        "speed": tabulate_speed,
        "named": tabulate_diagnosis,
    }
    for name in options.only:
        table = tables[name]()
        print(name, table.to_string(index=False), sep="\n")
        if name == "pairs":
            print(f"agree {table['agree'].mean():.3f}, covered {table['covered'].mean():.3f}")
        if name in ("causes", "spring", "laws"):
            print({"causes": summarise_causes, "spring": summarise_springs, "laws": summarise_laws}[name](table))
        if options.out:
            options.out.mkdir(parents=True, exist_ok=True)
            table.to_csv(options.out / f"without_torque_{name}.csv", index=False)


if __name__ == "__main__":
    main()
