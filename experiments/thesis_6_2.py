"""Does section 6.2 of Dressler 2012 come out on a simulated L1, and why does the thesis find two masses?

    python experiments/thesis_6_2.py [OUT_DIR]

In: nothing; all logs are simulated, their noise from seed 62. Out, in OUT_DIR (default out/thesis_6_2): Tables 6.1 to 6.3 and
the studies of masses as CSV, Figures 6.2 to 6.7 and two more as PNG and SVG, and `summary.csv`, every number beside the
thesis', which is also printed. The answer stands in docs/results/thesis.md. Needs matplotlib
(`pip install tau_dyn[experiments]`). About 4 minutes on one core. Its parts are in thesis_6_2_parts/
"""

import sys
from pathlib import Path

from thesis_6_2_parts import figures, friction, gravity, masses, models
from thesis_6_2_parts.plant import closed_form, robot_l1
from thesis_6_2_parts.summary import summary, tables


def main(out_dir: Path) -> None:
    mechanism = closed_form(robot_l1(gravity=True))
    step("gravity (Table 6.2)")
    weight = gravity.study(mechanism)
    step("15 speeds at five positions (Table 6.1)")
    strokes = friction.study(weight.fitted)
    step("models 1 to 4 (Table 6.3)")
    fits = models.table_6_3()
    step("1 cm circle")
    circles = {share: models.circle(share) for share in (models.STRIBECK_SHARE, 0.0)}
    step("two masses")
    two = masses.two_masses()
    step("asymmetric friction")
    freed = {"along x": masses.free_asymmetry(), "all axes": masses.free_asymmetry(masses.WELL)}
    step("link masses")
    rods = masses.link_masses()
    step("tables and figures")
    out_dir.mkdir(parents=True, exist_ok=True)
    result = summary(weight, strokes, fits, circles, two, freed, rods)
    for name, table in (tables(weight, strokes, fits, rods) | {"summary": result}).items():
        table.to_csv(out_dir / f"{name}.csv", index=False, float_format="%.6g")
    figures.draw_all(out_dir, mechanism, weight, strokes, fits, circles[models.STRIBECK_SHARE])
    print(result.to_string(index=False, float_format="{:.5g}".format, na_rep=""))


def step(what: str) -> None:
    print(f"... {what}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out/thesis_6_2"))
