r"""A general complex hexapod with its 40 solutions, from which those of every real one are followed.

`monodromy.py` found it once and wrote `start.csv`. A straight line from general complex numbers to any real ones meets
no double solution before its end, with probability one, and every isolated solution is the end of a path (Morgan &
Sommese 1989, Appl. Math. Comput. 29, 123).
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from tau_dyn.kinematics.assembly.equations import Hexapod

N_SOLUTIONS = 40
"""Isolated solutions of the general hexapod: Ronga & Vust 1995, Lazard 1993, Mourrain 1993; an upper bound: Wampler 1996."""

START_FILE = Path(__file__).with_name("start.csv")


@lru_cache(maxsize=1)
def start_system() -> tuple[Hexapod, np.ndarray]:
    """Return the stored hexapod and its solutions (40, 8)."""
    lines = [
        line.split(",") for line in START_FILE.read_text(encoding="utf-8").splitlines() if not line.startswith("#")
    ]
    rods, solutions = (
        np.array([row[1:] for row in lines if row[0] == kind], float).view(complex) for kind in ("rod", "solution")
    )
    return Hexapod(rods[:, :3], rods[:, 3:6], rods[:, 6]), solutions


def draw_general_hexapod(rng: np.random.Generator) -> Hexapod:
    """Draw a complex hexapod of size one."""
    return Hexapod(draw_normal(rng, 6, 3), draw_normal(rng, 6, 3), draw_normal(rng, 6))


def draw_normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Draw complex numbers of mean square one."""
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)
