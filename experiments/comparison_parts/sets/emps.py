"""EMPS: one linear drive, 1 kHz, 25 s."""

from collections.abc import Iterator

from comparison_parts.case import DATA, MAPS, Case, split_in_time
from tau_dyn.log import read_log
from tau_dyn.robot import load_robot


def read() -> Iterator[Case]:
    train, held = split_in_time(read_log(DATA / "emps" / "DATA_EMPS.csv", MAPS / "columns" / "emps.yaml"))
    yield Case(
        "EMPS", "force", train, held, load_robot("linear_axis"),
        known={"axis.mass": (95.11, 0.05), "axis.viscous": (203.5, 1.0), "axis.coulomb": (20.39, 0.1)},
        causes={"delay": "the controller holds its force for 1 ms and logs it at the start",
                "cyclic_ripple": "2.5 mm is half a turn of the 5 mm screw"},
        refuted={"stribeck": "its authors"},
        published="relative error 3.11 % (asymmetric friction), of the fit",
        origin="Janot, Gautier & Brunot 2019",
    )  # fmt: skip
