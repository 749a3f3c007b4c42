"""`run_many` on two processes, of which one dies at each item named: `python lost_worker.py 3 11`."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np

from tau_dyn.scale import run_many

ITEMS = 20


def draw(item: tuple[int, bool]) -> float:
    """Return a number that depends on the item alone; die once where asked."""
    seed, dies = item
    mark = Path(f"died_at_{seed}")
    if dies and not mark.exists():
        mark.touch()
        os._exit(9)
    return float(np.random.default_rng(seed).standard_normal(2000).sum())


if __name__ == "__main__":
    import lost_worker  # under its own name, so that other processes find its functions

    victims = {int(word) for word in sys.argv[1:]}
    os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    found = list(run_many(lost_worker.draw, [(seed, seed in victims) for seed in range(ITEMS)], jobs=2))
    assert all(Path(f"died_at_{seed}").exists() for seed in victims), "nobody died"
    assert found == [draw((seed, False)) for seed in range(ITEMS)], "other results than an undisturbed run's"
