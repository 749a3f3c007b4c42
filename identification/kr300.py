"""What lies between the motor and the link of a KR300's first three axes, and how much of it is stiffness.

    python identification/kr300.py [FOLDER [OUT_DIR]]

In: runs A and B (Weigand 2021), by default in $TAU_DYN_DATA/kr300. Out, trained on one run and judged on the other, both ways:
`kr300_TRAIN_TEST.json` and `.html`; and `kr300_stiffness.csv`, the stiffness read with and without hysteresis and clock offset.
"""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from tau_dyn.diagnose.deflection_channel import build_deflection_channel, estimate_stiffness
from tau_dyn.diagnose.pipeline import diagnose_deflection
from tau_dyn.evidence import Diagnosis
from tau_dyn.log import read_log
from tau_dyn.robot import load_robot

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parents[1] / "shared" / "data"))
PUBLISHED = {"axis1": 4.58e6, "axis2": 7.52e6, "axis3": 4.10e6}  # [N m/rad], the authors' nominal stiffness


def main(folder: Path, out_dir: Path) -> tuple[dict[str, Diagnosis], pd.DataFrame]:
    from rich.console import Console

    from tau_dyn.render import print_result, write_report

    if not (folder / "rec_A.csv").is_file():
        sys.exit(f"{folder} holds no rec_A.csv; set TAU_DYN_DATA to the folder that holds kr300/, or name the folder")
    out_dir.mkdir(parents=True, exist_ok=True)
    robot = load_robot(HERE / "robots" / "kr300.urdf")
    logs = {run: read_log(folder / f"rec_{run}.csv", HERE / "columns" / "kr300.yaml") for run in "AB"}
    found, rows = {}, []
    for train, test in ("AB", "BA"):
        answer = found[train + test] = diagnose_deflection(robot, logs[train], holdout=logs[test])
        (out_dir / f"kr300_{train}_{test}.json").write_text(json.dumps(answer.to_dict(), indent=2) + "\n")
        write_report(out_dir / f"kr300_{train}_{test}.html", answer)
        print_result(Console(), answer, {})
        for reading in estimate_stiffness(build_deflection_channel(robot, [logs[train]], [logs[test]])):
            named = {"train": train, "test": test, "causes": " + ".join(reading.causes)}
            for k, joint in enumerate(reading.joints):
                error = reading.stderr[k] / 1e6
                row = {"joint": joint, "stiffness_MNm_per_rad": reading.stiffness[k] / 1e6, "stderr": error}
                row |= {"of_published": reading.stiffness[k] / PUBLISHED[joint], "left_urad": 1e6 * reading.rms[k]}
                rows.append(named | row | {"offset_ms": 1e3 * reading.values.get(f"{joint}.clock_offset", np.nan)})
    table = pd.DataFrame(rows)
    table.to_csv(out_dir / "kr300_stiffness.csv", index=False)
    print(table.to_string(index=False, float_format="%.3g"))
    return found, table


if __name__ == "__main__":
    main(
        Path(sys.argv[1]) if len(sys.argv) > 1 else DATA / "kr300",
        Path(sys.argv[2]) if len(sys.argv) > 2 else Path("out"),
    )
