"""How much does the answer depend on the factors by which a log is filtered and masked?

    python experiments/preparation_sensitivity.py [OUT_DIR]

In: EMPS and TX40 from $TAU_DYN_DATA. Each factor of `tau_dyn.identify.preparation` is multiplied by 0.5 to 2, the others left
alone. Out: `preparation_sensitivity.csv`, one row a robot, factor, multiple and parameter: deviation from the published value
in % (for TX40 from the published weighted least squares), relative error, samples used. The answer is printed as a table;
the factors stand on a plateau if its columns hardly change. About 1 minute on one core.
"""

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import pandas as pd

from tau_dyn.effects import AsymmetricFriction, ReducerCoupling, SymmetricFriction, TorqueOffset
from tau_dyn.estimate import combine_parameters, solve_least_squares
from tau_dyn.identify import Choices, build_force_errors, build_regression, preparation as rule
from tau_dyn.log import Log, read_log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("TAU_DYN_DATA", ROOT.parent / "shared" / "data"))
COLUMNS = ROOT / "identification" / "columns"
FACTORS = ("BAND_FACTOR", "POSITION_FACTOR", "RATE_FACTOR", "NOISE_FACTOR", "MEMORY")
MULTIPLES = (0.5, 0.71, 1.0, 1.41, 2.0)
EMPS = {"M": (("carriage_link.mass",), 95.1540)} | {  # name: our parameters, whose sum is compared; kg, N, N/(m/s)
    short: ((f"axis.{name}",), published)
    for short, name, published in [
        ("Fc+", "coulomb_pos", 20.1440),
        ("Fv+", "viscous_pos", 166.7061),
        ("Fc-", "coulomb_neg", 20.6277),
        ("Fv-", "viscous_neg", 240.4236),
    ]
}
TX40_VISCOUS = (8.08729, 5.593924, 1.98261, 1.112374, 1.854047, 0.647663)  # N m/(rad/s)
TX40_COULOMB = (7.014425, 8.134077, 6.282682, 2.490079, 3.041052)  # N m
SHARED = ("joint_5+joint_6.viscous",)  # their fv5 and fv6 hold the shared motor's as well; see identification/tx40.py
TX40 = {f"fv{k}": ((f"joint_{k}.viscous", *(SHARED if k > 4 else ())), x) for k, x in enumerate(TX40_VISCOUS, 1)} | {
    f"fs{k}": ((f"joint_{k}.coulomb",), x) for k, x in enumerate(TX40_COULOMB, 1)
}


def emps() -> tuple[Model, Log]:
    robot = load_robot("linear_axis")
    log = read_log(DATA / "emps" / "DATA_EMPS.csv", COLUMNS / "emps.yaml")
    return Model.of(robot, [AsymmetricFriction(robot.actuated, robot.force_units)]), log


def tx40() -> tuple[Model, Log]:
    robot = load_robot(DATA / "tx40" / "tx40.urdf")
    joints, units = robot.actuated, robot.force_units
    effects = [SymmetricFriction(joints, units), TorqueOffset(joints, units), ReducerCoupling(joints[4:], units[4:])]
    model = Choices(free=("*.armature",)).apply(Model.of(robot, effects))
    return model, read_log(DATA / "tx40", COLUMNS / "tx40.yaml")


def deviations(model: Model, log: Log, published: dict) -> Iterator[dict]:
    """Yield one row a parameter at the rule's present factors."""
    regression = build_regression(model, [log])
    estimate = solve_least_squares(regression)
    settings = {
        "force_cutoff_hz": regression.preparation.force_cutoff_hz,
        "n_samples": regression.n_samples,
        "relative_error_percent": build_force_errors(regression, estimate.theta).relative_error_percent,
    }
    for name, (ours, theirs) in published.items():
        value, stderr = combine_parameters(estimate, dict.fromkeys(ours, 1.0))
        percent = {"deviation_percent": 100 * (value / theirs - 1), "stderr_percent": 100 * stderr / theirs}
        yield settings | {"parameter": name} | percent


def main(out_dir: Path) -> None:
    rows = []
    for name, load, published in (("EMPS", emps, EMPS), ("TX40", tx40, TX40)):
        model, log = load()
        for factor in FACTORS:
            chosen = getattr(rule, factor)
            for multiple in MULTIPLES:
                with patch.object(rule, factor, multiple * chosen):
                    key = {"robot": name, "factor": factor, "multiple": multiple}
                    rows += [key | row for row in deviations(model, log, published)]
    out_dir.mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame(rows)
    table.to_csv(out_dir / "preparation_sensitivity.csv", index=False)
    for name, part in table.groupby("robot"):
        keys = ["factor", "multiple", "force_cutoff_hz", "n_samples", "relative_error_percent"]
        wide = part.pivot(index=keys, columns="parameter", values="deviation_percent").reset_index()
        print(
            f"\n{name}: deviation from the published value in %\n{wide.to_string(index=False, float_format='{:.2f}'.format)}"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("out"))
