"""Does an exported program ever answer with a number that no drive should take?

    python experiments/fuzz_exports.py [--calls 1000000] [--seed 1] [--out docs/results/data/exported_programs.csv]

Feedforward, kinematics, FMU, observers, learning filters and lead-through in C, with hostile inputs, under the address and
undefined-behaviour sanitizers; the feedforward in Python with a five-hundredth of the calls. Status 0 must come with numbers
within limits, and positions of `ik` that lead to the pose; an error must leave outputs and state alone. A program that breaks
a promise ends the run. The table counts statuses: of an FMU, and of Python, 1 is an error. Ten minutes on one core.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd
from fuzz_parts.exported_programs import (
    FILTERS,
    build_model,
    fuzz_feedforward,
    fuzz_filter,
    fuzz_fmu,
    fuzz_kinematics,
    fuzz_lead_through,
    fuzz_python,
)

from tau_dyn.robot import load_robot

ROBOTS = {"linear_axis": 1, "gantry_tau": 1, "stewart": 2, "ur5": 2, "delta": 10, "gantry_tau_f1": 10}
"""Robots, and the part of the calls that each gets: loops of many rods take a hundred times as long."""
CAUSES = {"gantry_tau": ("stribeck", "load_friction", "thermal_drift", "quadratic_drag")}
PYTHON = 500  # a call in Python takes that many times as long


def main(calls: int, seed: int, out: Path) -> None:
    rows: list[dict] = []

    def keep(program: str, robot: str, counts: list[int]) -> None:
        rows.append({"program": program, "robot": robot, "calls": sum(counts)})
        rows[-1] |= {f"status_{k}": n for k, n in enumerate([*counts, 0, 0, 0][:5])}
        print(*rows[-1].values(), flush=True)
        pd.DataFrame(rows).to_csv(out, index=False, lineterminator="\n")

    with TemporaryDirectory() as folder:
        for kind in FILTERS:
            keep(kind, "", fuzz_filter(kind, Path(folder), calls, seed))
        for task in ("surface", "peg"):
            keep(f"lead-through {task}", "", fuzz_lead_through(task, Path(folder), calls, seed))
        for name, part in ROBOTS.items():
            robot = load_robot(name)
            model = build_model(robot, *CAUSES.get(name, ()))
            keep("feedforward", name, fuzz_feedforward(model, Path(folder), calls // part, seed))
            for function, counts in fuzz_kinematics(robot, Path(folder), calls // part, seed).items():
                keep(function, name, counts)
            keep("FMU", name, fuzz_fmu(model, Path(folder), calls // part, seed))
            keep("feedforward in Python", name, fuzz_python(model, calls // PYTHON // part, seed))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("docs/results/data/exported_programs.csv"))
    main(**vars(parser.parse_args()))
