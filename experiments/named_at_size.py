"""Is a fault of a stated size called by its name, with default options?

    python experiments/named_at_size.py [--what zero saturation gravity guideway] [--sets 30] [--seed 0] [--jobs 1] [--out DIR]

In: nothing. `zero`: the encoder of a joint whose zero forces can tell is 5 to 300 mrad off (a cart's 1 to 20 mm).
`saturation`: one joint's logged force exceeds the true one by 10 % at the largest force, with the third power. `gravity`: the
forces that hold the robot still are subtracted. All three on the robots, motions and sensors of `hidden_effects_parts/`.
`guideway`: one guideway of the L1 Gantry-Tau is 1 mrad out of parallel; 300 positions of the tool with 40 um of noise, closed by
Newton's method on three spheres. A fault is named if the first confirmed finding has its name, or has it as a twin, at its
joint; gravity if its warning is there. Faults of forces are drawn until they are stronger than lambda = 120 (`strength.py`).
Other confirmed causes are counted, too. Out: `named_at_size.csv`, a row a set; the counts on the screen.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from hidden_effects_parts.forms import either, log_uniform, one
from hidden_effects_parts.recording import Recording, draw_motion, draw_sensing
from hidden_effects_parts.robots import DRAWS, Rig, draw_rig
from hidden_effects_parts.sets import hidden_force
from hidden_effects_parts.strength import Ruler, base_columns

from tau_dyn.diagnose import diagnose
from tau_dyn.evidence import Diagnosis
from tau_dyn.files import write_whole
from tau_dyn.log import Log
from tau_dyn.mechanism import GantryTauMechanism
from tau_dyn.message_codes import get_code
from tau_dyn.robot import load_robot
from tau_dyn.scale import run_many

SECONDS = (70.0, 40.0)
"""Length of the training log and of the held-out log [s]."""
TOOL_NOISE_M = 4e-5
STRONG = 120.0
"""Strength lambda from which a fault is to be named: the error of its size is below 9 %."""
TOLD = {"l1": (0, 1, 2), "arm": (1,), "geared": (1, 2, 3, 4)}
"""Joints whose zero a force log can tell: a vertical first axis and the last link's centre of mass are exact aliases."""
SATURATION_SHARE = 0.1


def spoil_zero(rig: Rig, runs: list[Recording], rng: np.random.Generator) -> tuple[list[Recording], str, str]:
    """Return the runs as an encoder with another zero shows them, the cause and the joint."""
    joint, sign = int(rng.choice(TOLD[rig.name])), either(rng)
    turns = rig.robot.joint_kinds[joint] == "revolute"
    size = log_uniform(rng, 5e-3, 0.3) if turns else log_uniform(rng, 1e-3, 20e-3)
    shift = np.zeros(len(rig.joints))
    shift[joint] = sign * size
    return [replace(run, q=run.q + shift) for run in runs], "joint_zero", rig.joints[joint]


def spoil_saturation(rig: Rig, runs: list[Recording], rng: np.random.Generator) -> tuple[list[Recording], str, str]:
    """Return the runs with one joint's logged force too large at its peaks, the cause and the joint."""
    joint = one(rig, rng)
    largest = max(np.abs(run.tau[:, joint]).max() for run in runs)  # one law for both logs

    def excess(run: Recording) -> np.ndarray:
        return run.column(joint, SATURATION_SHARE * largest * (run.tau[:, joint] / largest) ** 3)

    return [run.plus(excess(run)) for run in runs], "torque_saturation", rig.joints[joint]


def spoil_gravity(rig: Rig, runs: list[Recording], rng: np.random.Generator) -> tuple[list[Recording], str, str]:
    """Return the runs without the force that holds the robot of the file still, and the warning's code."""
    still = [rig.mechanism.inverse_dynamics(run.q, 0 * run.v, 0 * run.a) for run in runs]
    return [run.plus(-force) for run, force in zip(runs, still, strict=True)], "gravity_subtracted", ""


class Trial(NamedTuple):
    """An answer, the robot, the name of the fault and its joint, and its strength lambda; see `strength.py`."""

    found: Diagnosis
    robot: str
    name: str
    joint: str
    strength: float = np.inf


SPOILED: dict[str, tuple[Callable, str]] = {
    "zero": (spoil_zero, "several"),
    "saturation": (spoil_saturation, "any"),
    "gravity": (spoil_gravity, "several"),
}


def diagnose_forces(what: str, number: int, seed: int) -> Trial:
    """Return the answer for a spoiled force log, drawn until the fault is strong enough."""
    rng = np.random.default_rng([seed, number, sum(map(ord, what))])
    while True:
        trial = draw_forces(what, number, rng)
        if trial is not None:
            return trial


def draw_forces(what: str, number: int, rng: np.random.Generator) -> Trial | None:
    """Return the answer for a spoiled force log; None where the fault is weak."""
    spoil, robots = SPOILED[what]
    rig = draw_rig(DRAWS[robots](rng), str(rng.choice(("asymmetric", "symmetric"))), rng, off=0.02)
    sensing = draw_sensing(rig, rng)
    runs = [Recording.of(rig, draw_motion(rig, s, rng), sensing.rate_hz, k) for k, s in enumerate(SECONDS)]
    spoiled, name, joint = spoil(rig, runs, rng)
    ruler = Ruler.of(runs[:1], [base_columns(runs[0])], sensing, 1.0)
    strength = ruler.strength([hidden_force(runs[0], spoiled[0])])
    if strength < STRONG:
        return None
    train, held = (run.log(sensing, rng, f"log{run.number + 1}.csv") for run in spoiled)
    found = diagnose(rig.nominal, [train], holdout=[held], model=rig.model, seed=number)
    return Trial(found, rig.name, name, joint, strength)


def diagnose_guideway(number: int, seed: int) -> Trial:
    """Return the answer for tool positions of a Gantry-Tau with a guideway 1 mrad out of parallel."""
    rng = np.random.default_rng([seed, number, 7])
    robot = load_robot("gantry_tau", prototype="l1")
    mechanism = GantryTauMechanism(robot)
    cart, angle = int(rng.integers(3)), 1e-3
    along = mechanism.direction[cart] / np.linalg.norm(mechanism.direction[cart])
    across = np.cross(along, rng.standard_normal(3))
    q = robot.home + rng.uniform(-0.25, 0.25, (300, 3))
    u = np.zeros((len(q), 3, 3))
    u[:, cart] = angle * q[:, cart, None] * across / np.linalg.norm(across)
    carts, tool = mechanism.origin + q[:, :, None] * mechanism.direction + u, mechanism.tool_position(q)
    for _ in range(6):  # Newton
        D = tool[:, None] - carts
        tool = tool - np.linalg.solve(D, 0.5 * (np.sum(D**2, axis=2) - mechanism.length**2)[:, :, None])[:, :, 0]
    seen = tool + TOOL_NOISE_M * rng.standard_normal(tool.shape)
    columns = {f"q_{j}": q[:, k] for k, j in enumerate(robot.actuated)}
    columns |= dict(zip(("x_tool", "y_tool", "z_tool"), seen.T, strict=True))
    log = Log(np.cumsum(rng.uniform(2, 6, len(q))), columns, "tool.csv")
    return Trial(diagnose(robot, [log], seed=number), "l1", "guideway_nonparallel", robot.actuated[cart])


def make_row(item: tuple[str, int, int]) -> dict[str, object]:
    """Return the row of one set."""
    what, number, seed = item
    start = time.perf_counter()
    trial = diagnose_guideway(number, seed) if what == "guideway" else diagnose_forces(*item)
    found, name, joint = trial.found, trial.name, trial.joint
    confirmed = [f for f in found.findings if f.status == "confirmed"]
    codes = sorted({get_code(w) for w in found.warnings})
    first = confirmed[0] if confirmed else None
    named = name in codes if what == "gravity" else bool(
        first and name in {first.cause, *first.indistinguishable_from} and joint in first.joints
    )  # fmt: skip
    others = [f for f in confirmed if name not in {f.cause, *f.indistinguishable_from}]
    row: dict[str, object] = {
        "lambda": trial.strength,
        "what": what,
        "number": number,
        "robot": trial.robot,
        "joint": joint,
        "verdict": found.verdict,
        "named": named,
    }
    row |= {"exactly": bool(first and first.cause == name) or (what == "gravity" and named), "others": len(others)}
    row |= {"findings": "; ".join(f"{f.cause}@{'+'.join(f.joints)}:{f.status}" for f in found.findings)}
    row |= {"unexplained": "; ".join(f"{u.joint}:{u.status}" for u in found.unexplained), "codes": " ".join(codes)}
    return row | {"seconds": round(time.perf_counter() - start, 1)}


def main(what: list[str], sets: int, seed: int, jobs: int, out: Path) -> None:
    """Run the sets and write their table."""
    import named_at_size  # under its own name, so that other processes find its functions

    items = [(kind, number, seed) for kind in what for number in range(sets)]
    out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, object]] = []
    for row in run_many(named_at_size.make_row, items, jobs=jobs):
        rows.append(row)
        print(
            *(row[key] for key in ("what", "number", "robot", "joint", "lambda", "named", "findings", "codes")),
            flush=True,
        )
        write_whole(out / "named_at_size.csv", pd.DataFrame(rows).to_csv(index=False))
    table = pd.DataFrame(rows)
    for kind, rows in table.groupby("what"):
        named, exactly, others = (int(rows[key].sum()) for key in ("named", "exactly", "others"))
        print(f"{kind}: {named} of {len(rows)} named, {exactly} not as a twin; {others} other causes confirmed")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--what", nargs="+", choices=[*SPOILED, "guideway"], default=[*SPOILED, "guideway"], metavar="KIND"
    )
    parser.add_argument("--sets", type=int, default=30, help="sets of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    args = parser.parse_args()
    main(args.what, args.sets, args.seed, args.jobs, args.out)
