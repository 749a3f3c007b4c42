"""Base parameters of the Staubli TX40, beside the published ones.

    python identification/tx40.py [TX40_FOLDER [OUT_DIR]]

In: the folder with `tx40.urdf`, `pos_read_data.csv`, `curr_data.csv` and `reference_TX40_bp_5.csv` (figaroh), by default
$TAU_DYN_DATA/tx40. Out: `tx40.yaml` (the model), `tx40.json` (the whole result), `tx40.html` (the report) and `tx40.csv`: each
published base parameter from their weighted least squares and from ours. `z` is the difference in standard deviations of
both together. Both used the same log, so that |z| << 1 says that the two computations agree, not that either is right.

Their wrist coupling puts the shared motor's inertia `Iam6` and viscous friction `fvm6` across only (row 5 gets a6, row 6 gets
a5); ours turns it with the sum of both joints. So their own-joint terms of joints 5 and 6 hold the shared ones as well.
Ours has a drive inertia of joint 6 besides, which their table lacks.
"""

import json
import os
import re
import sys
from pathlib import Path

import pandas as pd

from tau_dyn.effects import ReducerCoupling, SymmetricFriction, TorqueOffset
from tau_dyn.estimate import combine_parameters
from tau_dyn.identify import Choices, identify
from tau_dyn.log import read_log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parents[1] / "shared" / "data"))
SHARED = "joint_5+joint_6"
LINK = {"m": "mass", **{q.lower(): q.lower() for q in "mx my mz Ixx Ixy Iyy Ixz Iyz Izz".split()}}
JOINT = {"ia": "armature", "fv": "viscous", "fs": "coulomb", "off": "offset"}
MOTOR = {"Iam6": f"{SHARED}.inertia", "fvm6": f"{SHARED}.viscous", "fsm6": f"{SHARED}.coulomb"}
ALSO = {"Ia5": f"{SHARED}.inertia", "fv5": f"{SHARED}.viscous", "fv6": f"{SHARED}.viscous"}  # what theirs hold besides


def weights(expression: str) -> dict[str, float]:
    """Return our parameters and their factors in one of their expressions, such as `Izz2 + 1.0*Ia2 + 0.05*m3`."""
    found: dict[str, float] = {}
    for sign, factor, symbol in re.findall(r"([+-]?) ?(?:([\d.]+)\*)?([A-Za-z]+\d)", expression):
        letters, number = symbol[:-1].lower(), symbol[-1]
        own = f"link_{number}.{LINK[letters]}" if letters in LINK else f"joint_{number}.{JOINT.get(letters)}"
        for name in filter(None, [MOTOR.get(symbol, own), ALSO.get(symbol)]):
            found[name] = found.get(name, 0.0) + float(factor or 1) * (-1 if sign == "-" else 1)
    return found


def main(folder: Path, out_dir: Path) -> pd.DataFrame:
    from tau_dyn.render import write_report

    if not (folder / "tx40.urdf").is_file():
        sys.exit(f"{folder} holds no tx40.urdf; set TAU_DYN_DATA to the folder that holds tx40/, or name the folder")
    out_dir.mkdir(parents=True, exist_ok=True)
    robot = load_robot(folder / "tx40.urdf")
    joints, units = robot.actuated, robot.force_units
    effects = [SymmetricFriction(joints, units), TorqueOffset(joints, units), ReducerCoupling(joints[4:], units[4:])]
    log = read_log(folder, HERE / "columns" / "tx40.yaml")
    found = identify(robot, log, model=Model.of(robot, effects), choices=Choices(free=("*.armature",)))
    found.model.save(out_dir / "tx40.yaml")
    (out_dir / "tx40.json").write_text(json.dumps(found.to_dict(), indent=2) + "\n")
    write_report(out_dir / "tx40.html", found)

    columns = ["published_as", "ols", "ols_sd_percent", "published", "published_sd_percent"]
    table = pd.read_csv(folder / "reference_TX40_bp_5.csv", header=None, names=columns)[[columns[0], *columns[3:]]]
    ours = [combine_parameters(found.estimate, weights(expression)) for expression in table.published_as]
    table["value"], table["stderr"] = zip(*ours, strict=True)
    theirs = table.published.abs() * table.published_sd_percent / 100
    table["deviation_percent"] = 100 * (table.value / table.published - 1)
    table["z"] = (table.value - table.published) / (table.stderr**2 + theirs**2) ** 0.5
    table.to_csv(out_dir / "tx40.csv", index=False)
    print(table.assign(published_as=table.published_as.str.slice(0, 28)).to_string(float_format="{:.4g}".format))
    z_rms = (table.z**2).mean() ** 0.5
    print(
        f"relative torque error {found.train.relative_error_percent:.2f} %, rank {found.estimate.base.rank}, z rms {z_rms:.2f}"
    )
    return table


if __name__ == "__main__":
    main(
        Path(sys.argv[1]) if len(sys.argv) > 1 else DATA / "tx40",
        Path(sys.argv[2]) if len(sys.argv) > 2 else Path("out"),
    )
