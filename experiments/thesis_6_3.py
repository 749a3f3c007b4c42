"""Does section 6.3 of Dressler 2012 come out on a flexible L1, and why are its M, D and K hard to interpret?

    python experiments/thesis_6_3.py [OUT_DIR] [--seed 63] [--keep identification/models]

In: nothing; all logs are simulated with the springs of urdf/prototypes/flexible_l1.yaml, their noise from the seed. Out, in
OUT_DIR (default out/thesis_6_3): Table 6.4 and Figures 6.9 to 6.13 as CSV, PNG and SVG, and `summary.csv`, every number beside
the thesis', which is also printed; with --keep the models (6.12) and (6.13) as YAML. The answer stands in
docs/results/modes.md. Needs matplotlib (`pip install tau_dyn[experiments]`). About 2 minutes on one core.
Its parts are in thesis_6_3_parts/; where the springs come from is experiments/l1_springs.py
"""

import argparse
import sys
from pathlib import Path

from thesis_6_3_parts import black_box, drives, figures, pushes, wristless
from thesis_6_3_parts.summary import summary, tables


def main(out_dir: Path, seed: int, keep: Path | None) -> None:
    step("drives (6.11)")
    actuators = drives.study(seed)
    step("pushes (Table 6.4)")
    table = pushes.study(seed)
    step("black-box models (6.12), (6.13)")
    models = black_box.study(seed)
    step("without wrist: 12th order, M-D-K")
    bare = wristless.study(seed)
    step("tables and figures")
    out_dir.mkdir(parents=True, exist_ok=True)
    result = summary(actuators, table, models, bare)
    for name, frame in (tables(table, models, bare) | {"summary": result}).items():
        frame.to_csv(out_dir / f"{name}.csv", index=False, float_format="%.6g")
    figures.draw_all(out_dir, actuators, table, models, bare)
    if keep is not None:
        black_box.keep(models, keep, seed)
    print(result.to_string(index=False, float_format="{:.5g}".format, na_rep=""))


def step(what: str) -> None:
    print(f"... {what}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out_dir", type=Path, nargs="?", default=Path("out/thesis_6_3"))
    parser.add_argument("--seed", type=int, default=63)
    parser.add_argument("--keep", type=Path, metavar="DIR", help="write the models (6.12) and (6.13) here")
    given = parser.parse_args()
    main(given.out_dir, given.seed, given.keep)
