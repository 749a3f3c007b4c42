"""Does `identify` say so when a log is not what it claims to be, and keep silent when it is?

    python experiments/spoiled_logs.py [--robots planar_2r ur5 panda linear_axis gantry_tau] [--seeds 3] [--clean 20] [--seed 0]
                                       [--corruptions NAME...] [--jobs 1] [--out DIR]

In: nothing; forces and positions come from `spoiled_logs_parts/machines.py` (Pinocchio's rnea, Lagrange's equations of the
Gantry-Tau), spoiled in the ways of `spoiled_logs_parts/corruptions.py`. Out: `spoiled_logs.csv`, a row a log: how many base
parameters are more than 5 stated standard errors off the truth, the warning codes, whether a true one is among them; and
`spoiled_logs.txt`, the table by corruption. Exact aliases (`ALIASES`) are listed with their reasons.
`check`'s tests are the same function.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
from spoiled_logs_parts.corruptions import ANY, CORRUPTIONS
from spoiled_logs_parts.machines import MACHINES, Made, make_log

from tau_dyn.exceptions import TauDynError
from tau_dyn.files import write_whole
from tau_dyn.identify import Choices, Identification, identify
from tau_dyn.log import Log
from tau_dyn.message_codes import UNCODED, get_code
from tau_dyn.scale import run_many

MAX_STDERRS_OFF = 5.0

_TURNED = "turned around, a lone axis is the same axis; forward and backward friction change places"

ALIASES = {
    ("linear_axis", "sign_both"): _TURNED,
    ("linear_axis", "sign_both_first"): _TURNED,
    (
        "linear_axis",
        "clock_x2",
    ): "half the speed at the same force is four times the mass and twice the viscous friction",
    ("linear_axis", "tau_x0.5"): "half the force is half the mass and friction; the file's mass is known to 25 % only",
    ("linear_axis", "tau_x2"): "twice the force is twice the mass and friction; the file's mass is known to 25 % only",
    (
        "linear_axis",
        "wall",
    ): "a weight along the axis is a constant force, as a difference of forward and backward friction is",
    ("linear_axis", "ceiling"): "gravity across the axis does no work",
    ("linear_axis", "slope"): "gravity across the axis does no work",
    (
        "planar_2r",
        "slope",
    ): "in the plane of the arm, gravity at 45 degrees out of it is a weaker gravity: lighter moments",
}
"""Corruptions that another machine would show exactly, with the reason."""


def make_row(item: tuple[str, str, int, int, float]) -> dict:
    """Return the row of one log."""
    machine, corruption, number, seed, spread = item
    made = make_log(machine, 1000 * seed + number, spread=spread)
    rng = np.random.default_rng([seed, number, sum(map(ord, corruption))])
    row = {"machine": machine, "corruption": corruption, "number": number, "spread": spread}
    if corruption == "clean":
        return row | judge(made, made.log, ())
    chosen = next(c for c in CORRUPTIONS if c.name == corruption)
    log = chosen.make(made, rng, machine, 1000 * seed + number)
    return row | ({"result": "none"} if log is None else judge(made, log, chosen.codes))


def judge(made: Made, log: Log, true_codes: tuple[str, ...]) -> dict:
    """Return what `identify` makes of a log."""
    began = time.monotonic()
    try:
        found = identify(made.robot, log, choices=_geared(made))
    except TauDynError as fault:
        return {"result": "refused", "why": str(fault)[:120], "off": 0, "named": True, "codes": "", "seconds": 0.0}
    off = count_stderrs_off(found, made)
    codes = sorted({get_code(w) for w in found.warnings} - {UNCODED})
    spoken = bool(set(codes) & set(true_codes)) or (true_codes == ANY and len(found.warnings) > 0)
    return {
        "result": "answer",
        "why": "",
        "off": int(np.count_nonzero(off > MAX_STDERRS_OFF)),
        "worst": float(off.max()),
        "named": spoken,
        "codes": " ".join(codes),
        "seconds": time.monotonic() - began,
    }


def count_stderrs_off(found: Identification, made: Made) -> np.ndarray:
    """Return how many stated standard errors each base parameter is off the truth (r,)."""
    e = found.estimate
    truth = e.base.combine(np.array([made.truth[name] for name in e.base.names]))
    return np.abs(e.beta - truth) / np.maximum(e.stderr, 1e-300)


def _geared(made: Made) -> Choices | None:
    """Return the choice that frees rotor inertia, for arms that have it."""
    return Choices(free=("*.armature",)) if any(made.truth[f"{j}.armature"] for j in made.robot.actuated) else None


def summarise(table: pd.DataFrame) -> str:
    """Return the table by corruption, the silent ones, and the false alarms."""
    clean = table[table.corruption == "clean"]
    spoiled = table[(table.corruption != "clean") & (table.result != "none")].copy()
    spoiled["alias"] = [(m, c) in ALIASES for m, c in zip(spoiled.machine, spoiled.corruption, strict=True)]
    spoiled["silent"] = (spoiled.off > 0) & ~spoiled.named.astype(bool) & ~spoiled.alias
    grouped = spoiled.groupby("corruption", sort=False)
    rows = grouped.agg(logs=("off", "size"), wrong=("off", lambda x: int((x > 0).sum())), named=("named", "sum"),
                       refused=("result", lambda x: int((x == "refused").sum())), silent=("silent", "sum"))  # fmt: skip
    lines = [rows.to_string(), "", f"spoiled logs {len(spoiled)}, wrong and silent {int(spoiled.silent.sum())}:"]
    lines += [
        f"  {r.machine} {r.corruption} {r.number}: {r.off} off, worst {r.worst:.3g}, codes: {r.codes or '-'}"
        for r in spoiled[spoiled.silent].itertuples()
    ]
    if len(clean):
        warned = clean[clean.codes.fillna("") != ""]
        lines += [f"clean logs {len(clean)}, warned {len(warned)}: {', '.join(warned.codes)}"]
        lines += [f"clean logs with a parameter more than 5 standard errors off: {int((clean.off > 0).sum())}"]
    lines += ["exact aliases:", *(f"  {m} {c}: {why}" for (m, c), why in ALIASES.items())]
    return "\n".join(lines)


def main(
    robots: list[str], corruptions: list[str], seeds: int, clean: int, seed: int, jobs: int, out_dir: Path
) -> None:
    out_dir.mkdir(parents=True, exist_ok=True)
    items = [(m, "clean", 100 + n, seed, 0.15 if n % 2 else 0.4) for m in robots for n in range(clean)]
    items += [(m, c, n, seed, 0.15) for m in robots for n in range(seeds) for c in corruptions]
    rows = []
    for row in run_many(make_row, items, jobs=jobs) if jobs > 1 else map(make_row, items):
        rows.append(row)
        print(
            *(row.get(k, "") for k in ("machine", "corruption", "number", "off", "named", "codes", "why")), flush=True
        )
        write_whole(out_dir / "spoiled_logs.csv", pd.DataFrame(rows).to_csv(index=False, float_format="%.4g"))
    text = summarise(pd.read_csv(out_dir / "spoiled_logs.csv"))
    (out_dir / "spoiled_logs.txt").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", choices=MACHINES, default=list(MACHINES))
    parser.add_argument("--corruptions", nargs="*", default=[c.name for c in CORRUPTIONS])
    parser.add_argument("--seeds", type=int, default=3, help="logs of each corruption and robot")
    parser.add_argument("--clean", type=int, default=20, help="sound logs of each robot")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out"))
    given = parser.parse_args()
    sys.exit(main(given.robots, given.corruptions, given.seeds, given.clean, given.seed, given.jobs, given.out))
