"""How well are commands and positions alone simulated, on motions and gains that were not used; do the parameters hold?

    python experiments/without_torque.py [--only so101 free xl330 pairs causes spring speed] [--sets N] [--out DIR]

so101: every second motion by name trains (a rule fixed before any result), with the servo's law; free: without one. xl330:
each gain from the others, mean absolute error. pairs: simulated arms of one to three joints, each at two servo gains: how
many pairs of parameters agree within their 95 % intervals, and how often an interval holds the true value, one mass known.
causes: arms of one or two joints whose law the file gives, a third of them with nothing hidden; causes confirmed, and
whether the hidden one, or a twin, is among them.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent / "identification"), str(HERE.parent)]
import so101  # noqa: E402
import xl330  # noqa: E402
from tests.servo.arms import build_arm, build_law, build_truth, record  # noqa: E402

from tau_dyn.exceptions import CannotAnswer  # noqa: E402
from tau_dyn.identify import Choices  # noqa: E402
from tau_dyn.servo import LoopIdentification, diagnose_loop, identify_loop  # noqa: E402
from tau_dyn.simulate import ServoLaw, read_servo_law  # noqa: E402

GAINS = (2.65, 5.3)
TRUE = {
    "armature": 0.012,
    "coulomb": 0.06,
    "viscous": 0.02,
    "load_friction": 0.2,
    "stiction": 0.01,
    "command_delay": 0.012,
}
Z95 = 1.96
HIDDEN = {
    "command_delay": {"command_delay": 0.02},
    "stiction": {"stiction": 0.05},
    "dead_band": {"dead_band": 0.02},
    "load_friction": {"load_friction": 0.25},
    "supply_sag": {"supply_sag": 0.3},
    "back_emf": {"back_emf": 0.3},
}
"""Causes -> entries of the law that hide them."""


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
    """Return the mean absolute error at each gain, from the others [mrad]."""
    logs, rows = xl330.read_logs(xl330.DATA / "xl330"), []
    law = read_servo_law(xl330.HERE / "controllers" / "xl330.yaml", xl330.ROBOT)
    for gain in xl330.GAINS:
        found = xl330.identify_at(logs, [g for g in xl330.GAINS if g != gain], [gain], law)
        rows.append({"held_out": gain, "mean_absolute_error_mrad": 1e3 * xl330.compute_mean_error(found)})
    return pd.DataFrame(rows)


def identify_made(joints: int, gain: float, seed: int) -> LoopIdentification:
    """Return the identification of a simulated arm at one servo gain, its first mass known."""
    arm = build_arm(joints)
    log = record(arm, build_truth(arm), build_law(arm, gain), seed)
    law = ServoLaw.of(arm.actuated, position_gain=gain, force_per_unit=2.9, back_emf=0.17)
    return identify_loop(arm, log, law=law, holdout=log.split(0.9)[1], choices=Choices(fix=("j1_link.mass",)))


def tabulate_pairs(sets: int) -> pd.DataFrame:
    """Return every parameter of every pair: both estimates, whether they agree, and whether each holds the true value."""
    rows = []
    for seed in range(sets):
        joints = 1 + seed % 3
        one, other = (
            {p.name: p for p in identify_made(joints, g, 2 * seed + k).parameters} for k, g in enumerate(GAINS)
        )
        for name, p in one.items():
            q, true = other.get(name), TRUE.get(name.split(".")[1])
            if q is None or p.stderr is None or q.stderr is None or true is None or p.at_bound or q.at_bound:
                continue
            apart = abs(p.value - q.value) / np.hypot(p.stderr, q.stderr)
            rows.append({
                "set": seed, "name": name, "first": p.value, "second": q.value, "agree": apart < Z95,
                "covered": abs(p.value - true) < Z95 * p.stderr,
            })  # fmt: skip
    return pd.DataFrame(rows)


def tabulate_causes(sets: int) -> pd.DataFrame:
    """Return what is hidden and what is confirmed in each set; two logs of 30 s, the causes at all joints."""
    rows, names = [], list(HIDDEN)
    for seed in range(sets):
        arm = build_arm(1 + seed % 2)
        plain = build_law(arm, load_friction=0.0, stiction=0.0, command_delay=0.0)
        hidden = "" if seed % 3 == 0 else names[(seed // 3 * 2 + seed % 3 - 1) % len(names)]
        true = (
            plain
            if not hidden
            else build_law(arm, **({"load_friction": 0.0, "stiction": 0.0, "command_delay": 0.0} | HIDDEN[hidden]))
        )
        logs = [record(arm, build_truth(arm), true, 1000 + 2 * seed + k, 30.0) for k in range(2)]
        try:
            findings = diagnose_loop(arm, logs, law=plain).findings
        except CannotAnswer as fault:
            rows.append(
                {"set": seed, "hidden": hidden or "nothing", "confirmed": fault.missing, "right": False, "false": False}
            )
            continue
        told = [(f.cause, f.twins) for f in findings if f.status == "confirmed"]
        right = any(cause == hidden or hidden in twins for cause, twins in told)
        false = any(cause != hidden and hidden not in twins for cause, twins in told)
        confirmed = " ".join(cause for cause, _ in told)
        rows.append(
            {"set": seed, "hidden": hidden or "nothing", "confirmed": confirmed, "right": right, "false": false}
        )
        print(rows[-1], flush=True)
    return pd.DataFrame(rows)


def main() -> None:
    """Print and write the tables asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=["so101", "free", "xl330", "pairs"])
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    tables: dict[str, Callable[[], pd.DataFrame]] = {
        "so101": lambda: tabulate_motions(True),
        "free": lambda: tabulate_motions(False),
        "xl330": tabulate_gains,
        "pairs": lambda: tabulate_pairs(options.sets),
        "causes": lambda: tabulate_causes(options.sets),
    }
    for name in options.only:
        table = tables[name]()
        print(name, table.to_string(index=False), sep="\n")
        if name == "pairs":
            print(f"agree {table['agree'].mean():.3f}, covered {table['covered'].mean():.3f}")
        if options.out:
            options.out.mkdir(parents=True, exist_ok=True)
            table.to_csv(options.out / f"without_torque_{name}.csv", index=False)


if __name__ == "__main__":
    main()
