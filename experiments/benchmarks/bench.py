"""What the benchmarks share: the machine and its versions, a stop watch, and made recordings of the simplified Gantry-Tau.

Set OMP_NUM_THREADS=1 and OPENBLAS_NUM_THREADS=1. Times are wall clock and processor time; on a busy machine only the second
and the ratios within one run mean anything.
"""

import os
import platform
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tau_dyn.cli.demo import build_true_model
from tau_dyn.robot import load_robot

PACKAGES = ("tau_dyn", "numpy", "scipy", "pin", "pyarrow", "dask", "figaroh")
CHUNK = 2**17


class Watch:
    """Wall and processor time of a stretch of code [s]."""

    wall = cpu = 0.0


@contextmanager
def stop_watch() -> Iterator[Watch]:
    """Measure what happens inside."""
    watch, wall, cpu = Watch(), time.perf_counter(), time.process_time()
    yield watch
    watch.wall, watch.cpu = time.perf_counter() - wall, time.process_time() - cpu


def machine() -> str:
    """Return the machine and the versions in two lines."""
    names = [line.split(":")[1].strip() for line in _lines("/proc/cpuinfo") if line.startswith("model name")]
    load = ", ".join(f"{x:.1f}" for x in os.getloadavg())
    found = [f"{name} {_version(name)}" for name in PACKAGES if _version(name)]
    return (
        f"{names[0] if names else platform.processor()}, {len(os.sched_getaffinity(0))} cores, load {load}\n"
        f"Python {platform.python_version()}, {', '.join(found)}"
    )


def show(title: str, header: Sequence[str], rows: Sequence[Sequence[object]], out: Path | None) -> None:
    """Print a table, and write it as Markdown where asked."""
    text = [[f"{x:.3g}" if isinstance(x, float) else str(x) for x in row] for row in rows]
    lines = [f"| {' | '.join(row)} |" for row in [list(header), ["---"] * len(header), *text]]
    page = "\n".join([f"# {title}", "", *lines, "", machine(), ""])
    print(page)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(page)


def made_recording(path: Path, samples: int, seed: int = 0) -> Path:
    """Write a recording at 1 kHz of the simplified L1 with 5 N and 5 um of noise, unless it is there already.

    The motion is a sum of five sines a cart around home; the plant is `tau-dyn demo`'s.
    """
    if path.exists():
        return path
    robot = load_robot("gantry_tau", prototype="l1")
    truth, rng = build_true_model(robot, 1), np.random.default_rng(seed)
    f, phase = rng.uniform(0.1, 1.2, (5, 3)), rng.uniform(0, 6, (5, 3))
    amplitude, omega = 0.072 * f.min() / f, 2 * np.pi * f
    names = ["t", *(f"{s}_{j}" for s in ("q", "tau") for j in robot.actuated)]
    schema = pa.schema([(name, pa.float64()) for name in names])
    temporary = path.with_suffix(".part")
    with pq.ParquetWriter(temporary, schema, compression="snappy") as writer:
        for start in range(0, samples, CHUNK):
            t = 1e-3 * np.arange(start, min(samples, start + CHUNK))
            angle = omega * t[:, None, None] + phase
            q = robot.home + (amplitude * np.sin(angle)).sum(axis=1)
            v = (amplitude * omega * np.cos(angle)).sum(axis=1)
            tau = truth.torque(q, v, -(amplitude * omega**2 * np.sin(angle)).sum(axis=1))
            tau += 5.0 * rng.standard_normal(q.shape)
            q += 5e-6 * rng.standard_normal(q.shape)
            writer.write_table(pa.table(dict(zip(names, [t, *q.T, *tau.T], strict=True)), schema=schema))
    temporary.rename(path)
    return path


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _lines(path: str) -> list[str]:
    return Path(path).read_text().splitlines() if Path(path).exists() else []
