"""A Monte Carlo study of 12 runs with a journal, which `faults.py` kills: how well a mean is known."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pandas as pd

from tau_dyn.files import write_whole
from tau_dyn.scale import run_journaled


def trial(seed: int) -> dict[str, float]:
    """Return one run's estimate; about a tenth of a second of work."""
    begun, draws = time.process_time(), []
    rng = np.random.default_rng(seed)
    for _ in range(20):
        draws.append(rng.normal(size=1000).mean())
    while time.process_time() - begun < 0.1:
        pass
    return {"seed": seed, "mean": float(np.mean(draws)), "third": seed / 3}


if __name__ == "__main__":
    rows = list(run_journaled(trial, range(12), Path("study.jsonl"), about={"what": "means"}))
    write_whole("table.csv", pd.DataFrame(rows).to_csv(index=False))
    Path("study.jsonl").unlink()
