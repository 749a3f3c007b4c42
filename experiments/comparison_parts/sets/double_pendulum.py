"""DFKI double pendulum: two builds of an arm with quasi-direct drives; the last two runs of each by name are held out."""

from collections.abc import Iterator

import pandas as pd
import yaml

from comparison_parts.case import DATA, Case
from tau_dyn.log import Log
from tau_dyn.robot import load_robot_from_urdf


def read() -> Iterator[Case]:
    folder = DATA / "double_pendulum"
    for build, file in (("A.0", "published_A.0_model_2.0.yml"), ("C.0", "published_C.0_model_3.0.yml")):
        about = yaml.safe_load((folder / file).read_text())
        logs = [_renamed(pd.read_parquet(path), path.stem) for path in sorted(folder.glob(f"{build}_*.parquet"))]
        yield Case(
            f"double pendulum {build}", "force", logs[:-2], logs[-2:], load_robot_from_urdf(_arm(about), build),
            known={f"j{k}.coulomb": (about[f"cf{k}"], 0.0) for k in (1, 2)},
            published="none of held-out error", origin="DFKI",
        )  # fmt: skip


def _renamed(table: pd.DataFrame, name: str) -> Log:
    pairs = [
        (f"{ours}_j{k}", f"{theirs}{k}") for k in (1, 2) for ours, theirs in (("q", "pos_meas"), ("tau", "tau_meas"))
    ]
    return Log(table["time"].to_numpy(), {ours: table[theirs].to_numpy() for ours, theirs in pairs}, name)


def _arm(about: dict) -> str:
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
