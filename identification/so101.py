"""SO-101: masses, friction and servos from commands and positions, judged on motions that were not used.

    python identification/so101.py [FOLDER] [--out DIR]

FOLDER holds `so101/` of the data (by default `$TAU_DYN_DATA`). Every second motion by name trains, the others are held out:
a rule that was fixed before any result. Prints the held-out error of each motion beside that of the command itself; writes
`model.yaml` and `report.html`.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np

from tau_dyn import load_robot, read_log
from tau_dyn.servo import LoopIdentification, identify_loop
from tau_dyn.simulate import read_servo_law

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parents[1] / "shared" / "data"))
ARM = slice(0, 5)  # the five joints of the arm, without the gripper


def identify_so101(folder: Path, law: bool = True) -> LoopIdentification:
    """Return the identification from every second motion, with the servo's law or without."""
    robot = load_robot(folder / "so101_new_calib.urdf", tool="gripper_frame_link")
    logs = [read_log(path, HERE / "columns" / "so101.yaml") for path in sorted(folder.glob("*.parquet"))]
    given = read_servo_law(HERE / "controllers" / "sts3215.yaml", robot) if law else None
    return identify_loop(robot, logs[::2], law=given, holdout=logs[1::2], progress=print)


def main() -> None:
    """Print the table and write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=DATA / "so101")
    parser.add_argument("--out", type=Path, default=Path("so101"))
    options = parser.parse_args()
    from tau_dyn.render import write_report

    found = identify_so101(options.folder)
    assert found.holdout is not None
    for log, rms, command in zip(found.holdout.logs, found.holdout.rms, found.holdout.command_rms, strict=True):
        model, plain = (1e3 * np.sqrt(np.nanmean(x[ARM] ** 2)) for x in (rms, command))
        print(f"{log:32s} {model:6.1f} mrad, the command itself {plain:6.1f} mrad")
    print(*found.warnings, sep="\n")
    options.out.mkdir(parents=True, exist_ok=True)
    found.model.save(options.out / "model.yaml")
    write_report(found, options.out / "report.html")


if __name__ == "__main__":
    main()
