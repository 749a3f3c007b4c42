"""Dynamixel XL330 with a pendulum: the drive's law from logs at some gains, judged on a gain that was not used.

    python identification/xl330.py [FOLDER]

FOLDER holds `xl330/` of the data (by default `$TAU_DYN_DATA`). With a linear drive law the fits at each gain alone disagree, and
a warning names the missing entry. Three laws with a drive exponent are fitted: the controller file's, and two with further
entries; the one with the smallest training residual predicts the gain that was left out. A fit of all gains measures the error
of the law itself. The pendulum is weighed: its mass is fixed.
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


MORE = ((), ("carried_friction",), ("carried_friction", "supply_sag"))
"""Further entries that each law estimates."""


def identify_best(logs: dict[str, list[Log]], train: list[str], held: list[str], law: ServoLaw) -> LoopIdentification:
    """Return the identification whose law, with further entries or without, has the smallest training residual."""
    laws = [replace(law, estimated=law.estimated | set(more)) for more in MORE]
    found = [identify_at(logs, train, held, one) for one in laws]
    return min(found, key=lambda one: float(one.train.rms_per_joint[0]))


def compute_mean_error(found: LoopIdentification, gain: str, held_out: bool = True) -> float:
    """Return the mean absolute error of the logs of one gain [rad], held-out or training ones, each counting the same."""
    errors = [
        np.mean(np.abs(record.measured - q))
        for record, q, held in found.shown
        if held == held_out and record.name.startswith(gain)
    ]
    return float(np.mean(errors))


def main() -> None:
    """Print what each law says."""
    logs = read_logs(Path(sys.argv[1]) if len(sys.argv) > 1 else DATA / "xl330")
    bent = read_servo_law(HERE / "controllers" / "xl330.yaml", ROBOT)
    linear = replace(bent.with_values(drive_exponent=np.ones(1)), estimated=bent.estimated - {"drive_exponent"})
    print(*(w for w in identify_at(logs, list(GAINS), [], linear).warnings if "disagree" in w), sep="\n")
    every = identify_best(logs, list(GAINS), [], bent)
    for gain in GAINS:
        others = identify_best(logs, [g for g in GAINS if g != gain], [gain], bent)
        error, own = 1e3 * compute_mean_error(others, gain), 1e3 * compute_mean_error(every, gain, held_out=False)
        print(f"{gain}: mean absolute error {error:.1f} mrad from the other gains, {own:.1f} mrad from all gains")


if __name__ == "__main__":
    main()
