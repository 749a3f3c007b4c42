"""DFKI torque-limited pendulum: one quasi-direct drive with a weight; one run trains, another is held out."""

from collections.abc import Iterator

import pandas as pd

from comparison_parts.case import DATA, Case
from tau_dyn.log import Log
from tau_dyn.robot import load_robot_from_urdf

URDF = (
    '<robot name="simple_pendulum"><link name="base_link"/><link name="rod_link"><inertial><origin xyz="0 0 -0.5"/>'
    '<mass value="0.62"/><inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="j1" type="revolute"><parent link="base_link"/><child link="rod_link"/><axis xyz="0 1 0"/>'
    '<limit lower="-20" upper="20" velocity="30" effort="20"/></joint>'
    '<transmission name="t"><type>x</type><joint name="j1"/><actuator name="m"/></transmission></robot>'
)


def read() -> Iterator[Case]:
    logs = []
    for name in ("energy_shaping", "fft"):
        table = pd.read_csv(DATA / "simple_pendulum" / f"{name}.csv").rename(columns={"pos": "position"})
        channels = {"q_j1": table["position"].to_numpy(), "tau_j1": table["torque"].to_numpy()}
        logs.append(Log(table["time"].to_numpy(), channels, name))
    yield Case(
        "simple pendulum", "force", logs[:1], logs[1:], load_robot_from_urdf(URDF, "simple_pendulum"),
        published="none of held-out error", origin="DFKI",
    )  # fmt: skip
