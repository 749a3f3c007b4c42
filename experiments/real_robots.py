"""What does `diagnose` say of real robots with its default options, and does it keep to its own rules?

    python experiments/real_robots.py [--only emps tx40 kr300 double_pendulum simple_pendulum so101] [--out DIR]

In: the logs of `$TAU_DYN_DATA` (by default `../shared/data`), recorded by others. Out: `real_robots.csv`, a row a finding with
its status, joints, amplitudes, gain and its interval; `real_robots.json`, the whole results. Logs are held out where there are
several.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import pandas as pd
import yaml

from tau_dyn.diagnose import diagnose
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.files import write_whole
from tau_dyn.log import Log, read_log
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

HERE = Path(__file__).resolve().parent
MAPS = HERE.parent / "identification"
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parents[1] / "shared" / "data"))
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


def kr300() -> Iterator[Case]:
    """A heavy arm with encoders on both sides of three axes, two runs of 10 s."""
    logs = [read_log(DATA / "kr300" / f"rec_{run}.csv", MAPS / "columns" / "kr300.yaml") for run in "AB"]
    yield "kr300", load_robot(MAPS / "robots" / "kr300.urdf"), logs[:1], logs[1:]


def double_pendulum() -> Iterator[Case]:
    """Two builds of an arm with quasi-direct drives, seven runs trained on, two held out."""
    folder = DATA / "double_pendulum"
    for build, file in (("A.0", "published_A.0_model_2.0.yml"), ("C.0", "published_C.0_model_3.0.yml")):
        about = yaml.safe_load((folder / file).read_text())
        logs = [_renamed(pd.read_parquet(path), path.stem) for path in sorted(folder.glob(f"{build}_*.parquet"))]
        yield f"double_pendulum {build}", load_robot_from_urdf(_pendulum(about), build), logs[:-2], logs[-2:]


def _renamed(table: pd.DataFrame, name: str) -> Log:
    pairs = [
        (f"{ours}_j{k}", f"{theirs}{k}") for k in (1, 2) for ours, theirs in (("q", "pos_meas"), ("tau", "tau_meas"))
    ]
    return Log(table["time"].to_numpy(), {ours: table[theirs].to_numpy() for ours, theirs in pairs}, name)


def _pendulum(about: dict) -> str:
    """Return the arm that hangs at zero, with the published masses; inertias are about the joints there."""
    parts = []
    for k in (1, 2):
        m, r, inertia = about[f"m{k}"], about[f"r{k}"], about[f"I{k}"]
        own = max(inertia - m * r**2, 1e-4)
        parts.append(
            f'<link name="l{k}_link"><inertial><origin xyz="0 0 {-r}"/><mass value="{m}"/><inertia ixx="{own}" iyy="{own}" '
            f'izz="{own / 10}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
    for k, (parent, z) in enumerate((("base_link", 0.0), ("l1_link", -about["l1"])), 1):
        parts.append(
            f'<joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="l{k}_link"/><origin xyz="0 0 {z}"/>'
            '<axis xyz="0 1 0"/><limit lower="-7" upper="7" velocity="30" effort="10"/></joint>'
            f'<transmission name="t{k}"><type>x</type><joint name="j{k}"/><actuator name="m{k}"/></transmission>'
        )
    return f'<robot name="double_pendulum"><link name="base_link"/>{"".join(parts)}</robot>'


def simple_pendulum() -> Iterator[Case]:
    """One quasi-direct drive with a weight; one run trained on, another held out."""
    urdf = (
        '<robot name="simple_pendulum"><link name="base_link"/><link name="rod_link"><inertial><origin xyz="0 0 -0.5"/>'
        '<mass value="0.62"/><inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="j1" type="revolute"><parent link="base_link"/><child link="rod_link"/><axis xyz="0 1 0"/>'
        '<limit lower="-20" upper="20" velocity="30" effort="20"/></joint>'
        '<transmission name="t"><type>x</type><joint name="j1"/><actuator name="m"/></transmission></robot>'
    )
    logs = []
    for name in ("energy_shaping", "pd_system_identification", "fft"):
        table = pd.read_csv(DATA / "simple_pendulum" / f"{name}.csv").rename(columns={"pos": "position"})
        channels = {"q_j1": table["position"].to_numpy(), "tau_j1": table["torque"].to_numpy()}
        logs.append(Log(table["time"].to_numpy(), channels, name))
    yield "simple_pendulum", load_robot_from_urdf(urdf, "simple_pendulum"), logs[:1], logs[2:]


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


CASES: dict[str, Callable[[], Iterator[Case]]] = {
    f.__name__: f for f in (emps, tx40, kr300, double_pendulum, simple_pendulum, so101)
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
