"""What the symmetric model of the EMPS drive gets wrong, and why.

    python identification/emps_diagnosis.py [DATA_EMPS.csv [OUT_DIR]]

In: the EMPS log (Janot, Gautier & Brunot 2019), by default in $TAU_DYN_DATA/emps. Out, for the symmetric and the
asymmetric baseline: `emps_diagnosis_MODEL.json`, `emps_diagnosis_MODEL.html` and `emps_extended_MODEL.yaml`, the model with
the causes found.
"""

import json
import os
import sys
from pathlib import Path

from tau_dyn.diagnose import diagnose
from tau_dyn.evidence import Diagnosis
from tau_dyn.log import read_log
from tau_dyn.robot import load_robot

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parents[1] / "shared" / "data"))


def main(log_path: Path, out_dir: Path) -> dict[str, Diagnosis]:
    from rich.console import Console

    from tau_dyn.render import print_result, write_report

    if not log_path.is_file():
        sys.exit(
            f"{log_path} is absent; `tau-dyn data emps` fetches the log: then name emps/DATA_EMPS.mat (or set TAU_DYN_DATA)"
        )
    out_dir.mkdir(parents=True, exist_ok=True)
    log = read_log(log_path, HERE / "columns" / "emps.yaml")
    found = {}
    for friction in ("symmetric", "asymmetric"):
        found[friction] = diagnose(load_robot("linear_axis"), log, model=friction)
        (out_dir / f"emps_diagnosis_{friction}.json").write_text(json.dumps(found[friction].to_dict(), indent=2) + "\n")
        found[friction].extended_model.save(out_dir / f"emps_extended_{friction}.yaml")
        write_report(out_dir / f"emps_diagnosis_{friction}.html", found[friction])
        print_result(Console(), found[friction], {})
    return found


if __name__ == "__main__":
    main(
        Path(sys.argv[1]) if len(sys.argv) > 1 else DATA / "emps" / "DATA_EMPS.csv",
        Path(sys.argv[2]) if len(sys.argv) > 2 else Path("out"),
    )
