"""Stäubli TX40: six axes with a coupled wrist, 5 kHz, 9 s."""

import csv
import re
from collections.abc import Iterator

from comparison_parts.case import DATA, MAPS, Case, split_in_time
from tau_dyn.log import read_log
from tau_dyn.robot import load_robot

FRICTION = {"fv": "viscous", "fs": "coulomb"}


def read() -> Iterator[Case]:
    train, held = split_in_time(read_log(DATA / "tx40", MAPS / "columns" / "tx40.yaml"))
    known = {}
    for name, _, _, value, percent in csv.reader((DATA / "tx40" / "reference_TX40_bp_5.csv").open()):
        if found := re.fullmatch(r"(fv|fs)([1-4])", name):  # the wrist's are divided in another way
            known[f"joint_{found[2]}.{FRICTION[found[1]]}"] = (float(value), abs(float(value)) * float(percent) / 100)
    yield Case(
        "TX40", "force", train, held, load_robot(DATA / "tx40" / "tx40.urdf"), known=known,
        causes={"reducer_coupling": "the maker's shared wrist motor", "delay": "another method finds 2 to 3.4 ms"},
        published="none of held-out error", origin="figaroh-examples",
    )  # fmt: skip
