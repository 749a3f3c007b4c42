"""Dynamixel XL330 with a pendulum: the drive's law from logs at some gains, judged on a gain that was not used.

    python identification/xl330.py [FOLDER]

FOLDER holds `xl330/` of the data (by default `$TAU_DYN_DATA`). With a linear drive law the fits at each gain alone disagree, and
what is missing is named; with the law that bends, every gain is predicted from the others. The pendulum is weighed: its mass is
fixed. Prints both.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from tau_dyn import Choices, Log, load_robot, read_log
from tau_dyn.servo import LoopIdentification, identify_loop
from tau_dyn.simulate import ServoLaw, read_servo_law

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parents[1] / "shared" / "data"))
GAINS = ("kp100", "kp200", "kp800")
ROBOT = load_robot(HERE / "robots" / "xl330_pendulum.urdf")


def read_logs(folder: Path) -> dict[str, list[Log]]:
    """Return the logs by gain."""
    return {g: [read_log(p, HERE / "columns" / "xl330.yaml") for p in sorted(folder.glob(f"{g}_*.csv"))] for g in GAINS}


def identify_at(logs: dict[str, list[Log]], train: list[str], held: list[str], law: ServoLaw) -> LoopIdentification:
    """Return the identification from logs at some gains, judged at others."""
    pick = [[log for g in gains for log in logs[g]] for gains in (train, held)]
    return identify_loop(ROBOT, pick[0], law=law, holdout=pick[1], choices=Choices(fix=("arm_link.*",)))


def compute_mean_error(found: LoopIdentification) -> float:
    """Return the mean absolute error of the held-out logs [rad], each log counting the same."""
    return float(np.mean([np.mean(np.abs(record.q - q)) for record, q, held in found.shown if held]))


def main() -> None:
    """Print what each law says."""
    logs = read_logs(Path(sys.argv[1]) if len(sys.argv) > 1 else DATA / "xl330")
    bent = read_servo_law(HERE / "controllers" / "xl330.yaml", ROBOT)
    linear = replace(bent.with_values(drive_exponent=np.ones(1)), estimated=bent.estimated - {"drive_exponent"})
    print(*(w for w in identify_at(logs, list(GAINS), [], linear).warnings if "disagree" in w), sep="\n")
    for gain in GAINS:
        found = identify_at(logs, [g for g in GAINS if g != gain], [gain], bent)
        print(f"{gain} from the other gains: mean absolute error {1e3 * compute_mean_error(found):.1f} mrad")


if __name__ == "__main__":
    main()
