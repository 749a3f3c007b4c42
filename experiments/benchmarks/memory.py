"""Identification from Parquet: time and peak memory over the number of samples, which memory must not follow.

    python experiments/benchmarks/memory.py [--samples 1e6 1e7 1e8] [--jobs 2] [--folder DIR] [--out DIR]

Each size is identified by a process of its own (filters chosen, clock read, blocks filtered and regressed, estimate,
covariance, held-out errors); its largest resident memory counts. Recordings (66 bytes a sample) are made in `--folder`.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from bench import made_recording, show

CHILD = """
import json, resource, sys, time
began, cpu = time.perf_counter(), time.process_time()
from tau_dyn.identify import BlockExecutor, identify
from tau_dyn.log import open_log
from tau_dyn.robot import load_robot
ready = time.perf_counter() - began
found = identify(load_robot("gantry_tau", prototype="l1"), open_log(sys.argv[1]), model="symmetric", estimator="wls",
                 engine=BlockExecutor(int(sys.argv[2])))
print(json.dumps({"wall": time.perf_counter() - began - ready, "cpu": time.process_time() - cpu,
                  "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
                  "plate": found.parameters["plate_link.mass"].value,
                  "stderr": found.parameters["plate_link.mass"].stderr}))
"""


def main(sizes: list[int], jobs: int, folder: Path, out_dir: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for n in sizes:
        path = made_recording(folder / f"gantry_{n}.parquet", n)
        answer = subprocess.run(
            [sys.executable, "-c", CHILD, str(path), str(jobs)], capture_output=True, text=True, check=True
        )
        x = json.loads(answer.stdout)
        rows.append(
            [
                n,
                path.stat().st_size / 1e6,
                x["wall"],
                x["cpu"],
                n / x["wall"],
                n / x["cpu"],
                x["peak"],
                x["plate"],
                x["stderr"],
            ]
        )
        print(rows[-1], flush=True)
    header = [
        "samples",
        "file MB",
        "wall s",
        "cpu s",
        "samples/s",
        "samples/cpu s",
        "peak MiB",
        "plate kg",
        "stderr kg",
    ]
    show(f"Identification from Parquet, Gantry-Tau simplified, 16 columns, {jobs} threads", header, rows,
         out_dir / "benchmark_memory.md")  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=float, nargs="+", default=[1e6, 1e7])
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("out") / "recordings", metavar="DIR")
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    args = parser.parse_args()
    main([int(n) for n in args.samples], args.jobs, args.folder, args.out)
