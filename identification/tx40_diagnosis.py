"""What a model of the Staubli TX40 without its wrist coupling gets wrong, and why.

    python identification/tx40_diagnosis.py [TX40_FOLDER [OUT_DIR]]

In: the folder with `tx40.urdf`, `pos_read_data.csv` and `curr_data.csv` (figaroh), by default $TAU_DYN_DATA/tx40. Out:
`tx40_diagnosis.json`, `tx40_diagnosis.html`, and `tx40_extended.yaml`, the model with the causes found.
"""

import json
import os
import sys
from pathlib import Path

from tau_dyn.diagnose import diagnose
from tau_dyn.evidence import Diagnosis
from tau_dyn.identify import Choices
from tau_dyn.log import read_log
from tau_dyn.robot import load_robot

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parents[1] / "shared" / "data"))


def main(folder: Path, out_dir: Path) -> Diagnosis:
    from rich.console import Console

    from tau_dyn.render import print_result, write_report

    if not (folder / "tx40.urdf").is_file():
        sys.exit(f"{folder} holds no tx40.urdf; set TAU_DYN_DATA to the folder that holds tx40/, or name the folder")
    out_dir.mkdir(parents=True, exist_ok=True)
    robot = load_robot(folder / "tx40.urdf")
    log = read_log(folder, HERE / "columns" / "tx40.yaml")
    found = diagnose(robot, log, model="symmetric", choices=Choices(free=("*.armature",)))
    (out_dir / "tx40_diagnosis.json").write_text(json.dumps(found.to_dict(), indent=2) + "\n")
    found.extended_model.save(out_dir / "tx40_extended.yaml")
    write_report(out_dir / "tx40_diagnosis.html", found)
    print_result(Console(), found, {})
    return found


if __name__ == "__main__":
    main(
        Path(sys.argv[1]) if len(sys.argv) > 1 else DATA / "tx40",
        Path(sys.argv[2]) if len(sys.argv) > 2 else Path("out"),
    )
