"""Resonances of the DaISy flexible robot arm, and how well black-box models follow it.

    python identification/daisy_robot_arm.py [robot_arm.dat [OUT_DIR]]

In: the DaISy log 96-009 (De Moor, KU Leuven), by default in $TAU_DYN_DATA/daisy_robot_arm: 1024 samples of reaction torque
and arm acceleration under a periodic sweep, without a clock; times are counted in samples, frequencies per sample. Out:
`robot_arm.csv` (the log with a clock), `robot_arm_model.yaml`, `robot_arm.html` (the page of the automatic choice) and
`robot_arm_fits.csv`, the fits of three models.
"""

import os
import sys
from pathlib import Path

import numpy as np
import pandas as pd

from tau_dyn.log import Log
from tau_dyn.modes import find_modes, save_state_space
from tau_dyn.modes.hankel import arx
from tau_dyn.modes.record import build_records
from tau_dyn.modes.residuals import fit_of
from tau_dyn.modes.state_space import simulate

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parents[1] / "shared" / "data"))
COLUMNS = (["torque"], ["acceleration"])


def read(path: Path) -> Log:
    """Return the log, one sample a second."""
    u, y = np.loadtxt(path).T
    return Log(np.arange(float(len(u))), {"torque": u, "acceleration": y}, path.name)


def in_sample(log: Log) -> tuple[float, float]:
    """Return the fit of order 4 to all samples, judged on them, and its largest pole."""
    found = find_modes(log, *COLUMNS, holdout=log, order=4, sensor="acceleration")
    return found.train.mean, found.model.spectral_radius()


def half_and_half(log: Log) -> float:
    """Return how well an ARX model of order 8 of the first half simulates the second."""
    first, second = (build_records(part, *COLUMNS)[0] for part in log.split(0.5))
    return float(fit_of([second.y], [simulate(arx([first], 8, direct=True), second)])[0])


def main(log_path: Path, out_dir: Path) -> pd.DataFrame:
    from tau_dyn.render import build_page

    if not log_path.is_file():
        sys.exit(f"{log_path} is absent; set TAU_DYN_DATA to the folder that holds daisy_robot_arm/robot_arm.dat")
    out_dir.mkdir(parents=True, exist_ok=True)
    log = read(log_path)
    log.to_csv(out_dir / "robot_arm.csv")
    found = find_modes(log, *COLUMNS, sensor="acceleration")
    save_state_space(out_dir / "robot_arm_model.yaml", found.model_file([{"path": log_path.name}]))
    (out_dir / "robot_arm.html").write_text(build_page(found, logs=[(log_path.name, "")]), encoding="utf-8")
    fit, radius = in_sample(log)
    rows = [
        ("order 4, in sample", fit, f"largest pole {radius:.5f}"),
        ("ARX(8) of the first half, on the second", half_and_half(log), "simulated"),
        (f"chosen order {found.order}, on the last 30 %", found.judged.mean, f"delay {found.delay}, {found.method}"),
    ]
    table = pd.DataFrame(rows, columns=["model", "fit_percent", "remark"])
    table.to_csv(out_dir / "robot_arm_fits.csv", index=False)
    print(table.to_string(index=False, float_format="{:.2f}".format))
    for m in found.modes:
        print(f"{m.frequency_hz:.5f} ± {m.frequency_stderr:.5f} per sample, damping {100 * m.damping_ratio:.3f} %")
    return table


if __name__ == "__main__":
    main(
        Path(sys.argv[1]) if len(sys.argv) > 1 else DATA / "daisy_robot_arm" / "robot_arm.dat",
        Path(sys.argv[2]) if len(sys.argv) > 2 else Path("out"),
    )
