"""Does lead-through with two force sensors hold a force, find a hole, and where does it oscillate? Dressler 2012, chapter 8.

    python experiments/lead_through.py [OUT_DIR] [--runs 4] [--seed 8] [--only limits,surface,peg] [--exported] [--figure PNG]

In: nothing; arm, works and operator are simulated (lead_through_parts/scene.py), noise and the operator's stray come from the
seed. With --exported the surface and the peg are led by the controller's exported C. Out, in OUT_DIR (default
out/lead_through): one CSV a table, printed too, and the figure. The results are in docs/results/control.md. Needs matplotlib
(`pip install tau_dyn[experiments]`), and a C compiler for --exported. About 3 minutes on one core.
"""

import argparse
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd
from lead_through_parts import figure, limits, peg, surface
from lead_through_parts.exported import ExportedLaw

from tau_dyn.control.lead_through import LeadThrough

PARTS = ("limits", "surface", "peg")


def main(out_dir: Path, runs: int, seed: int, only: tuple[str, ...], exported: bool, picture: Path | None) -> None:
    folder = TemporaryDirectory()
    law = partial(ExportedLaw, folder=Path(folder.name)) if exported else LeadThrough
    tables, tracked, pegged = {}, None, None
    if "limits" in only:
        tables |= {"limits": limits.study(), "what_gives_68": limits.what_gives_68()}
    if "surface" in only:
        tables["surface"], tracked = surface.study(runs, seed, law)
    if "peg" in only:
        tables["peg"], pegged = peg.study(runs, seed, law)
    out_dir.mkdir(parents=True, exist_ok=True)
    for name, table in tables.items():
        table.to_csv(out_dir / f"{name}.csv", index=False, float_format="%.6g")
        print(f"\n{name}\n{table.to_string(index=False, float_format='{:.4g}'.format)}", flush=True)
    if tracked is not None and pegged is not None:
        figure.draw(picture or out_dir / "lead_through.png", tracked, pegged)


if __name__ == "__main__":
    pd.set_option("display.width", 200)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out_dir", type=Path, nargs="?", default=Path("out/lead_through"))
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--seed", type=int, default=8)
    parser.add_argument("--only", type=lambda text: tuple(text.split(",")), default=PARTS, help="limits, surface, peg")
    parser.add_argument("--exported", action="store_true", help="with the exported C")
    parser.add_argument("--figure", type=Path, metavar="FILE.png", help="where the figure goes")
    given = parser.parse_args()
    main(given.out_dir, given.runs, given.seed, given.only, given.exported, given.figure)
