"""SO-101: five joints and a gripper on hobby servos, commands and positions at 50 Hz; every second motion by name trains."""

from collections.abc import Iterator

from comparison_parts.case import DATA, MAPS, Case
from tau_dyn.log import read_log
from tau_dyn.robot import load_robot


def read() -> Iterator[Case]:
    folder = DATA / "so101"
    logs = [read_log(path, MAPS / "columns" / "so101.yaml") for path in sorted(folder.glob("*.parquet"))]
    yield Case(
        "SO-101", "servo", logs[::2], logs[1::2], load_robot(folder / "so101_new_calib.urdf", tool="gripper_frame_link"),
        law=MAPS / "controllers" / "sts3215.yaml", published="none of held-out error", origin="SAGE project",
    )  # fmt: skip
