"""KUKA KR300: a heavy arm, encoders on both sides of three axes; run A trains, run B is held out."""

from collections.abc import Iterator

from comparison_parts.case import DATA, MAPS, Case
from tau_dyn.log import read_log
from tau_dyn.robot import load_robot


def read() -> Iterator[Case]:
    a, b = (read_log(DATA / "kr300" / f"rec_{run}.csv", MAPS / "columns" / "kr300.yaml") for run in "AB")
    yield Case(
        "KR300", "force", [a], [b], load_robot(MAPS / "robots" / "kr300.urdf"),
        causes={"clock_offset": "an independent regression finds 3.09 ms"},
        published="none of held-out error", origin="Weigand 2021",
    )  # fmt: skip
