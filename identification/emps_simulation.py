"""EMPS simulated under its own controller, beside the recording and the published errors.

    python identification/emps_simulation.py [DATA_EMPS.csv [OUT_DIR]]

In: the EMPS log (Janot, Gautier & Brunot 2019), by default in $TAU_DYN_DATA/emps, and `controllers/emps.yaml`. Both friction
models are identified from it; each then drives along the log's reference, and positions, speeds, accelerations and forces
are compared with the measured ones. Out: `emps_simulation.csv`, errors in per cent, ours and theirs, and
`emps_simulation.json`. How the authors filtered is not said; here errors are given without any filter, and with the low-pass
that `replay` chooses for speeds and accelerations. Last, how well the law alone makes the recorded force of the recorded
positions: this says that gains, timing and the way it takes the speed are the rig's, whatever the plant.
"""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from tau_dyn.identify import identify
from tau_dyn.log import Log, read_log
from tau_dyn.robot import load_robot
from tau_dyn.simulate import CascadeController, CascadeLaw, Trajectory, read_law_file, replay

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parents[1] / "shared" / "data"))
PUBLISHED = {"position": 0.01375, "speed": 0.229, "acceleration": 8.60, "force": 5.85, "following": np.nan}
"""Errors of the published simulation, symmetric model [%]; EMPS_Description.pdf."""


def main(log_path: Path, out_dir: Path) -> pd.DataFrame:
    if not log_path.is_file():
        sys.exit(
            f"{log_path} is absent; `tau-dyn data emps` fetches the log: then name emps/DATA_EMPS.mat (or set TAU_DYN_DATA)"
        )
    out_dir.mkdir(parents=True, exist_ok=True)
    robot = load_robot("linear_axis")
    log = read_log(log_path, HERE / "columns" / "emps.yaml")
    law = read_law_file(HERE / "controllers" / "emps.yaml", robot)
    table, details = pd.DataFrame({"published_symmetric": PUBLISHED}), {}
    for friction in ("symmetric", "asymmetric"):
        model = identify(robot, log, model=friction).model
        filtered = replay(model, log, law)
        for how, found in (("unfiltered", filtered.with_cutoff(np.inf)), ("filtered", filtered)):
            details[f"{friction}_{how}"] = found.to_dict()
            table[f"{friction}_{how}"] = {s: found.relative_error_percent(s)[0] for s in found.measured}
    details["law_alone_percent"] = law_alone(log, law)
    table = table.rename_axis("signal").reset_index()
    table.to_csv(out_dir / "emps_simulation.csv", index=False)
    (out_dir / "emps_simulation.json").write_text(json.dumps(details, indent=2) + "\n")
    print(table.to_string(index=False, float_format="{:.4g}".format))
    print(f"force of the law along the recorded positions: {details['law_alone_percent']:.3g} % from the recorded one")
    return table


def law_alone(log: Log, law: CascadeLaw) -> float:
    """Return the relative error [%] of the law's force, computed from the recorded references and positions."""
    reference, q = Trajectory.from_log(log, ["axis"]), log.joint("q", ["axis"])
    controller, rest = CascadeController(law), np.zeros(1)
    controller.reset(reference)
    force = np.array([controller.force(k, log.t[k], reference.q[k], rest, rest, q[k])[0] for k in range(log.n_samples)])
    measured = log.channels["tau_axis"]
    return float(100 * np.linalg.norm((force - measured)[2:]) / np.linalg.norm(measured[2:]))


if __name__ == "__main__":
    main(
        Path(sys.argv[1]) if len(sys.argv) > 1 else DATA / "emps" / "DATA_EMPS.csv",
        Path(sys.argv[2]) if len(sys.argv) > 2 else Path("out"),
    )
