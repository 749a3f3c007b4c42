"""Masses and friction of a Gantry-Tau from its own logs.

    python identification/gantry_tau.py monday.csv [tuesday.csv ...] [--holdout friday.csv ...] [--out DIR]

In: CSV logs with `t`, and `q_J` and `tau_J` of cart1, cart2, cart3 (SI; other names or units: a column map in COLUMNS). Out, in
DIR: `gantry_tau.yaml` (the model, for simulation and feedforward), `gantry_tau.json` (the whole result), `gantry_tau.html`
(the report). Change the constants to describe your machine; a mass that you have weighed belongs into FIX.
"""

import argparse
import json
import sys
from pathlib import Path

from tau_dyn.exceptions import TauDynError
from tau_dyn.identify import Choices, identify
from tau_dyn.log import read_log
from tau_dyn.robot import load_robot

PROTOTYPE = "l1"  # l1, l2, d1 or t1: dimensions in urdf/prototypes
MODEL = "asymmetric"  # friction: rigid, symmetric or asymmetric
COLUMNS = None  # a column map such as identification/columns/emps.yaml
FIX = ()  # what was weighed, such as ("plate_link.mass=9.13+-0.05",) [kg]


def main(log_paths: list[Path], out_dir: Path, holdout: list[Path] = ()) -> None:
    from tau_dyn.render import write_report

    robot = load_robot("gantry_tau", prototype=PROTOTYPE)
    train, held = ([read_log(path, COLUMNS) for path in paths] for paths in (log_paths, holdout))
    found = identify(robot, train, holdout=held, model=MODEL, choices=Choices(fix=FIX))
    out_dir.mkdir(parents=True, exist_ok=True)
    found.model.save(out_dir / "gantry_tau.yaml")
    (out_dir / "gantry_tau.json").write_text(json.dumps(found.to_dict(), indent=2) + "\n")
    write_report(out_dir / "gantry_tau.html", found)

    for row in found.rows():
        known = f"+- {row['stderr']:.2g}" if row["stderr"] is not None else "(nominal: these logs do not tell it)"
        print(f"{row['name']:22} {row['value']:10.5g} {known} {row['unit']}")
    print(f"relative error {found.train.relative_error_percent:.2f} % in training")
    if found.holdout is not None:
        print(f"relative error {found.holdout.relative_error_percent:.2f} % on {found.holdout_how}")
    for sentence in found.warnings:
        print(f"warning: {sentence}", file=sys.stderr)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("logs", nargs="+", type=Path)
    parser.add_argument("--holdout", nargs="+", type=Path, default=[])
    parser.add_argument("--out", type=Path, default=Path("out"))
    args = parser.parse_args()
    try:
        main(args.logs, args.out, args.holdout)
    except TauDynError as fault:
        sys.exit(str(fault))
