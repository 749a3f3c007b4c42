"""CPU time of commands, start included: the table of docs/results/benchmarks.md.

    python experiments/benchmarks/commands.py [--repeat N] [--long]

Each command runs once to fill the caches, then N times; the median of its CPU time (user and system) is printed. CPU time hardly
depends on what else the machine does. `--long` adds simulations of two robots (seed 1), their identification and diagnosis, and
those of EMPS where `$TAU_DYN_DATA` has it.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from comparison_parts.case import DATA, MAPS  # noqa: E402

from tau_dyn.log import Log  # noqa: E402

COMMANDS = ("--version", "--help", "robots", "causes", "fk gantry_tau --q 0.5 0.5 0.5", "check log.csv")
L1 = "gantry_tau --set prototype=l1"
LONG = (
    f"simulate {L1} --duration 120 --seed 1 --out l1.csv",
    "simulate ur5 --duration 60 --log-rate 250 --force-noise 0.5 --seed 1 --out ur5.csv",
    f"identify {L1} l1.csv",
    "identify ur5 ur5.csv",
    f"diagnose {L1} l1.csv",
    "diagnose ur5 ur5.csv",
)
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def measure(words: list[str], folder: str) -> float:
    """Return the CPU time of one call [s]."""
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    call = [sys.executable, "-m", "tau_dyn", *words]
    subprocess.run(call, cwd=folder, env=kept | ONE_THREAD, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--long", action="store_true", help="simulations, identifications and diagnoses, too")
    options = parser.parse_args()
    print("| command | CPU [s] |\n|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        t = np.arange(0, 20, 0.002)
        Log(t, {"q_axis": np.sin(t), "tau_axis": np.cos(t)}).to_csv(f"{folder}/log.csv")
        commands = COMMANDS + LONG if options.long else COMMANDS
        if options.long and (DATA / "emps").is_dir():
            shutil.copy(DATA / "emps" / "DATA_EMPS.csv", f"{folder}/emps.csv")
            shutil.copy(MAPS / "columns" / "emps.yaml", f"{folder}/emps.yaml")
            commands += ("diagnose linear_axis emps.csv --columns emps.yaml",)
        for command in commands:
            times = [measure(command.split(), folder) for _ in range(options.repeat + 1)][1:]
            print(f"| `{command}` | {statistics.median(times):.2f} |", flush=True)


if __name__ == "__main__":
    main()
