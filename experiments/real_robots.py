"""What does `diagnose` say of real robots with its default options, and does it keep to its own rules?

    python experiments/real_robots.py [--only emps tx40 kr300 double_pendulum simple_pendulum so101] [--out DIR]

In: the logs of `$TAU_DYN_DATA` (by default `../shared/data`), recorded by others. Out: `real_robots.csv`, a row a finding with
its status, joints, amplitudes, gain and its interval; `real_robots.json`, the whole results. Logs are held out where there are
several.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import pandas as pd
from comparison_parts.case import DATA, MAPS
from comparison_parts.sets import SETS

from tau_dyn.diagnose import diagnose
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.files import write_whole
from tau_dyn.log import Log, read_log
from tau_dyn.robot import Robot, load_robot

Case = tuple[str, Robot, list[Log], list[Log]]


def emps() -> Iterator[Case]:
    """One linear drive, 25 s."""
    yield (
        "emps",
        load_robot("linear_axis"),
        [read_log(DATA / "emps" / "DATA_EMPS.csv", MAPS / "columns" / "emps.yaml")],
        [],
    )


def tx40() -> Iterator[Case]:
    """A six-axis arm with a coupled wrist, 9 s."""
    yield "tx40", load_robot(DATA / "tx40" / "tx40.urdf"), [read_log(DATA / "tx40", MAPS / "columns" / "tx40.yaml")], []


def _divided(name: str) -> Callable[[], Iterator[Case]]:
    """Return the reader of a set whose logs are held out by file."""

    def read() -> Iterator[Case]:
        for case in SETS[name]():
            assert case.robot is not None
            yield case.name, case.robot, case.train, case.held

    return read


def so101() -> Iterator[Case]:
    """A hobby arm whose logs hold positions and an unsigned load, and no force."""
    robot = load_robot(DATA / "so101" / "so101_new_calib.urdf")
    names = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
    ours = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
    table = pd.read_parquet(DATA / "so101" / "multisine.parquet")
    channels = {
        f"{key}_{j}": table[f"{key}_{n}"].to_numpy() for key in ("q", "cmd") for j, n in zip(ours, names, strict=True)
    }
    yield "so101", robot, [Log(table["t"].to_numpy(), channels, "multisine")], []


BY_FILE = ("kr300", "double_pendulum", "simple_pendulum")
CASES: dict[str, Callable[[], Iterator[Case]]] = {
    "emps": emps,
    "tx40": tx40,
    **{name: _divided(name) for name in BY_FILE},
    "so101": so101,
}


def main(only: list[str], out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    rows, results = [], {}
    for key in only:
        for name, robot, train, held in CASES[key]():
            start = time.perf_counter()
            try:
                found = diagnose(robot, train, holdout=held)
            except (InputError, CannotAnswer) as fault:
                rows.append({"robot": name, "status": f"exit {fault.exit_status}", "cause": str(fault)})
                print(f"{name}: exit {fault.exit_status}: {fault}", flush=True)
                continue
            results[name] = found.to_dict()
            took = time.perf_counter() - start
            print(f"{name}: {found.verdict}, {found.recommendation}: {found.recommendation_why} [{took:.0f} s]")
            errors = (e.relative_error_percent for e in (found.baseline, found.extended, found.noise_floor))
            print("   baseline {:.2f}, extended {:.2f}, noise floor {:.2f} %".format(*errors))
            for warning in found.warnings:
                print("   warning:", warning[:160])
            for f in found.findings:
                gain = asdict(f.gain) if f.gain else {}
                values = "; ".join(f"{p.name}={p.value:.4g}+-{p.stderr or float('nan'):.2g}" for p in f.parameters)
                rows.append({"robot": name, "status": f.status, "cause": f.cause, "joints": "+".join(f.joints), "values": values,
                             "why_not_confirmed": f.why_not_confirmed, **gain})  # fmt: skip
                print(
                    "  ",
                    f.status,
                    f.cause,
                    f.joints,
                    values[:150],
                    gain.get("ci95", ""),
                    f.why_not_confirmed,
                    flush=True,
                )
            write_whole(out / "real_robots.json", json.dumps(results, indent=1, default=float))
            write_whole(out / "real_robots.csv", pd.DataFrame(rows).to_csv(index=False, float_format="%.4g"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--out", type=Path, default=Path("out"))
    args = parser.parse_args()
    main(args.only, args.out)
