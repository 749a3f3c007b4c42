"""CPU time of short commands, start included: the table of docs/results/benchmarks.md.

    python experiments/benchmarks/commands.py [--repeat N]

Each command runs once to fill the caches, then N times; the median of its CPU time (user and system) is printed. CPU time hardly
depends on what else the machine does.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile

import numpy as np

from tau_dyn.log import Log

COMMANDS = ("--version", "--help", "robots", "causes", "fk gantry_tau --q 0.5 0.5 0.5", "check log.csv")
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
    repeat = parser.parse_args().repeat
    print("| command | CPU [s] |\n|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        t = np.arange(0, 20, 0.002)
        Log(t, {"q_axis": np.sin(t), "tau_axis": np.cos(t)}).to_csv(f"{folder}/log.csv")
        for command in COMMANDS:
            times = [measure(command.split(), folder) for _ in range(repeat + 1)][1:]
            print(f"| `{command}` | {statistics.median(times):.2f} |")


if __name__ == "__main__":
    main()
