"""The start system of the assembly modes: all 40 solutions of one general hexapod, by monodromy.

One solution and a complex hexapod that fits it are drawn; the hexapod's numbers then run round closed loops, which carry a
solution to another one, until 40 are known (Duff et al. 2019, IMA J. Numer. Anal. 39, 1421).

    python experiments/assembly_start.py [--seed 1] [--out FILE]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from tau_dyn.exceptions import TauDynError
from tau_dyn.files import write_whole
from tau_dyn.kinematics.assembly.equations import (
    N_SOLUTIONS,
    START_FILE,
    Hexapod,
    build_quadrics,
    draw_general_hexapod,
    draw_normal,
)
from tau_dyn.kinematics.assembly.homotopy import track_homotopy


def find_all_solutions(rng: np.random.Generator, max_loops: int = 60) -> tuple[Hexapod, np.ndarray]:
    """Draw a hexapod and find its 40 solutions by monodromy.

    Raises:
        TauDynError: Fewer came to light in `max_loops` loops.
    """
    hexapod, found = _fitting_pair(rng)
    for _ in range(max_loops):
        if len(found) == N_SOLUTIONS:
            return hexapod, found
        a, b = draw_general_hexapod(rng), draw_general_hexapod(rng)
        moved = found
        for start, end in ((hexapod, a), (a, b), (b, hexapod)):
            paths = track_homotopy(start, end, moved)
            moved = paths.x[paths.regular]
        found = select_distinct(np.concatenate([found, moved]))
    raise TauDynError(
        "no_solution", f"monodromy found {len(found)} of {N_SOLUTIONS} solutions in {max_loops} loops; try another seed"
    )


def select_distinct(x: np.ndarray, tolerance: float = 1e-9) -> np.ndarray:
    """Return points (m, 8) of norm one that differ from all before them by more than a factor."""
    same = 1 - np.abs(x.conj() @ x.T) < tolerance
    return x[[k for k in range(len(x)) if not same[k, :k].any()]]


def _fitting_pair(rng: np.random.Generator) -> tuple[Hexapod, np.ndarray]:
    """Return a hexapod and one solution (1, 8): the offsets enter linearly and can be chosen to fit."""
    e, h = draw_normal(rng, 4), draw_normal(rng, 4)
    h -= e * (e @ h) / (e @ e)
    x = np.concatenate([e, h])
    hexapod = draw_general_hexapod(rng)
    missing = np.einsum("i,kij,j->k", x, build_quadrics(hexapod), x)[:6]
    missing[1:] += missing[0]  # quadrics are differences
    return hexapod._replace(offset=hexapod.offset - missing / (e @ e)), x[None] / np.linalg.norm(x)


def _text(hexapod: Hexapod, solutions: np.ndarray, seed: int) -> str:
    """Return the file: every complex number as two columns, with all digits."""
    rows = np.concatenate([hexapod.base, hexapod.plate, hexapod.offset[:, None]], axis=1)
    lines = [
        f"# A general complex hexapod and its {len(solutions)} solutions",
        f"# python experiments/assembly_start.py --seed {seed}",
        "# rod: base x y z, plate x y z, |A|^2 + |B|^2 - L^2; solution: e (scalar first), h; each as real, imaginary",
    ]
    for kind, block in (("rod", rows), ("solution", solutions)):
        pairs = np.ascontiguousarray(block).view(float)
        lines += [",".join([kind, *(repr(float(v)) for v in pair)]) for pair in pairs]
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> None:
    """Write the file anew."""
    parser = argparse.ArgumentParser(description="find and store the start system of assembly_modes")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=START_FILE)
    options = parser.parse_args(arguments)
    hexapod, solutions = find_all_solutions(np.random.default_rng(options.seed))
    write_whole(options.out, _text(hexapod, solutions, options.seed))


if __name__ == "__main__":
    main()
