"""What every adapter shares: samples in, predictions out. It needs NumPy alone and runs in the tool's own environment.

    python ADAPTER.py SAMPLES OUT

SAMPLES holds `set.json`, `robot.urdf`, raw training logs in `logs/`, `train_*.npz` and `held_*.npz`; OUT gets `held_*.npy`, a
prediction of each held-out stretch, and `answer.json`.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np


class DoesNotApply(Exception):
    """The tool has no answer for this kind of data; the reason goes into the table."""


def read_samples(folder: Path) -> SimpleNamespace:
    """Return the set: `kind`, `channels`, `urdf`, `train` and `held` as lists of arrays by name."""
    case = SimpleNamespace(folder=folder, **json.loads((folder / "set.json").read_text()))
    case.train, case.held = (
        [dict(np.load(p)) for p in sorted(folder.glob(f"{part}_*.npz"))] for part in ("train", "held")
    )
    case.urdf = (folder / "robot.urdf").read_text() if (folder / "robot.urdf").is_file() else ""
    return case


def run(package: str, predict: Callable[[SimpleNamespace], tuple[list[np.ndarray], dict[str, Any]]]) -> None:
    """Call an adapter on the set that the command line names, and write what it answers, its time and its memory.

    `predict` returns the held-out predictions (N, n) and what was said: `parameters` as {name: [value, standard error or None]},
    `causes` as [cause, ..], `note`.
    """
    folder, out = map(Path, sys.argv[1:3])
    out.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    try:
        predicted, said = predict(read_samples(folder))
    except DoesNotApply as reason:
        predicted, said = [], {"skipped": str(reason)}
    for k, x in enumerate(predicted):
        np.save(out / f"held_{k:02d}.npy", np.asarray(x, dtype=float))
    used = resource.getrusage(resource.RUSAGE_SELF)
    said |= {"version": version(package) if predicted else "", "seconds": time.perf_counter() - began}
    said |= {"cpu_s": used.ru_utime + used.ru_stime, "memory_mb": used.ru_maxrss / 1024}
    (out / "answer.json").write_text(json.dumps(said, indent=1, default=float))
