"""Dynamixel XL330 with a pendulum: one servo at three gains; each gain is held out from the other two."""

from collections.abc import Iterator

from comparison_parts.case import DATA, MAPS, Case
from tau_dyn.log import read_log
from tau_dyn.robot import load_robot

GAINS = ("kp100", "kp200", "kp800")


def read() -> Iterator[Case]:
    logs = {
        gain: [read_log(p, MAPS / "columns" / "xl330.yaml") for p in sorted((DATA / "xl330").glob(f"{gain}_*.csv"))]
        for gain in GAINS
    }
    for held in GAINS:
        yield Case(
            f"XL330 {held}", "servo", [log for gain in GAINS if gain != held for log in logs[gain]], logs[held],
            load_robot(MAPS / "robots" / "xl330_pendulum.urdf"), law=MAPS / "controllers" / "xl330.yaml", fixed=("arm_link.*",),
            causes={"load_friction": "BAM's models whose friction follows the load predict unseen gains better"},
            published="BAM: 39 to 63 mrad of mean error at a gain unseen", origin="Rhoban",
        )  # fmt: skip
