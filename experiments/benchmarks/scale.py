"""Does the work leave one process well: a Monte Carlo study and one identification on one worker, two, and with one killed.

    python experiments/benchmarks/scale.py [--seeds 40] [--samples 1000000] [--folder DIR] [--out DIR]

The study is `experiments/recovery.py`'s standard scenario with 20 s of motion. Workers are processes of Dask's embedded
scheduler, started before the clock. In the last row a worker is killed (SIGKILL) a third of the way through. `same` compares
every number with the first row's.
"""

import argparse
import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench import made_recording, show

from tau_dyn.identify import BlockExecutor, identify
from tau_dyn.log import open_log
from tau_dyn.robot import load_robot
from tau_dyn.scale import run_many
from tau_dyn.scale.runner import connect_client

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


def warmed(items: list) -> None:
    """Drive every plant once; each worker keeps what it drove, and that is not the study's time."""
    import recovery

    for item in items:
        recovery.trial(item)


def study(client, seeds: int, kill: bool) -> tuple[float, np.ndarray]:
    """Return the time [s] and all estimates of a Monte Carlo study on a client's cluster."""
    import recovery

    scenario, address = replace(recovery.STANDARD, duration=20.0), client.scheduler.address
    client.run(warmed, [(scenario, s) for s in range(recovery.PLANTS)])
    victim = next(iter(client.run(os.getpid).values()))
    began, values = time.perf_counter(), []
    items = [(scenario, seed) for seed in range(seeds)]
    for number, rows in enumerate(run_many(recovery.trial, items, cluster=address)):
        values += [row["value"] for row in rows]
        if kill and number == seeds // 3:
            os.kill(victim, signal.SIGKILL)
    return time.perf_counter() - began, np.array(values)


def identification(client, path: Path) -> tuple[float, np.ndarray]:
    """Return the time [s] and the estimates from a recording."""
    began = time.perf_counter()
    engine = BlockExecutor(cluster=client.scheduler.address)
    found = identify(load_robot("gantry_tau", prototype="l1"), open_log(path), estimator="wls", engine=engine)
    return time.perf_counter() - began, np.concatenate([found.estimate.beta, found.estimate.stderr])


def main(seeds: int, samples: int, folder: Path, out_dir: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    path = made_recording(folder / f"gantry_{samples}.parquet", samples)
    rows, first = [], {}
    for label, workers, kill in (("1 worker", 1, False), ("2 workers", 2, False), ("2 workers, one killed", 2, True)):
        with connect_client(None, workers) as client:
            runs = {"Monte Carlo study": study(client, seeds, kill)}
            if not kill:
                runs["identification"] = identification(client, path)
        for name, (wall, values) in runs.items():
            before, reference = first.setdefault(name, (wall, values))
            rows.append([name, label, wall, before / wall, bool(np.array_equal(values, reference))])
            print(rows[-1], flush=True)
    show(f"Scale-out: {seeds} seeds, {samples} samples", ["what", "where", "wall s", "faster", "same"], rows,
         out_dir / "benchmark_scale.md")  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--folder", type=Path, default=Path("out") / "recordings", metavar="DIR")
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    args = parser.parse_args()
    main(args.seeds, args.samples, args.folder, args.out)
