"""Mass and friction of the EMPS drive, beside the published values.

    python identification/emps.py [DATA_EMPS.csv [OUT_DIR]]

In: the EMPS log (Janot, Gautier & Brunot 2019), by default in $TAU_DYN_DATA/emps. Out, for the asymmetric and the symmetric
friction model: `emps_MODEL.yaml` (the model), `emps_MODEL.json` (the whole result), `emps_MODEL.html` (the report), and
`emps.csv`, our values and theirs.
"""

import json
import os
import sys
from pathlib import Path

import pandas as pd

from tau_dyn.identify import identify
from tau_dyn.log import read_log
from tau_dyn.robot import load_robot

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parents[1] / "shared" / "data"))
PUBLISHED = {  # kg, N, N/(m/s), %; EMPS_Description.pdf
    "asymmetric": {"carriage_link.mass": 95.1540, "axis.viscous_pos": 166.7061, "axis.coulomb_pos": 20.1440,
                   "axis.viscous_neg": 240.4236, "axis.coulomb_neg": 20.6277, "relative_error": 3.1117},
    "symmetric": {"carriage_link.mass": 95.1089, "axis.viscous": 203.5034, "axis.coulomb": 20.3935,
                  "axis.offset": -3.1648, "relative_error": 4.0834},
}  # fmt: skip


def main(log_path: Path, out_dir: Path) -> pd.DataFrame:
    from tau_dyn.render import write_report

    if not log_path.is_file():
        sys.exit(
            f"{log_path} is absent; `tau-dyn data emps` fetches the log: then name emps/DATA_EMPS.mat (or set TAU_DYN_DATA)"
        )
    out_dir.mkdir(parents=True, exist_ok=True)
    log = read_log(log_path, HERE / "columns" / "emps.yaml")
    rows = []
    for friction, published in PUBLISHED.items():
        found = identify(load_robot("linear_axis"), log, model=friction)
        found.model.save(out_dir / f"emps_{friction}.yaml")
        (out_dir / f"emps_{friction}.json").write_text(json.dumps(found.to_dict(), indent=2) + "\n")
        write_report(out_dir / f"emps_{friction}.html", found)
        values = {p.name: (p.value, p.stderr, p.unit) for p in found.parameters if p.free}
        values["relative_error"] = (found.train.relative_error_percent, None, "%")
        rows += [(friction, name, *values[name], theirs) for name, theirs in published.items()]
    table = pd.DataFrame(rows, columns=["model", "name", "value", "stderr", "unit", "published"])
    table["deviation_percent"] = 100 * (table.value / table.published - 1)
    table.to_csv(out_dir / "emps.csv", index=False)
    print(table.to_string(index=False, float_format="{:.5g}".format))
    return table


if __name__ == "__main__":
    main(
        Path(sys.argv[1]) if len(sys.argv) > 1 else DATA / "emps" / "DATA_EMPS.csv",
        Path(sys.argv[2]) if len(sys.argv) > 2 else Path("out"),
    )
