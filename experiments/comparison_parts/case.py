"""What a data set is to the comparison: training and held-out logs, and what is known of the machine."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tau_dyn.log import Log
from tau_dyn.robot import Robot

HERE = Path(__file__).resolve().parent
MAPS = HERE.parents[1] / "identification"
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parents[2] / "shared" / "data"))
TRAIN_SHARE = 0.7
"""Share of a single recording that trains, from its start; the library's own rule for held-out data."""


@dataclass(frozen=True, eq=False)
class Case:
    """One data set, divided.

    Attributes:
        name: Its name in the table.
        kind: `force`: torques from motions; `servo`: positions from commands; `vibration`: outputs from inputs.
        train: Logs that the tools see.
        held: Logs that judge; tools see their motion, commands or inputs alone.
        robot: The robot as a user has it; None for vibration sets.
        inputs: Columns that drive (vibration).
        outputs: Columns that respond (vibration).
        known: Parameters that are published, or true, by name: (value, standard error or 0).
        simulated: Whether `known` is true, so that intervals can be counted.
        causes: Hidden causes that are known here and from where; a tool is to name them.
        refuted: Causes that are known not to act, and from where.
        law: Controller file of a servo.
        fixed: Parameters that were weighed, by pattern.
        order: Published order of a vibration set's model; 0 for none.
        published: Published figure, in words.
        origin: Who recorded it.
    """

    name: str
    kind: Literal["force", "servo", "vibration"]
    train: list[Log]
    held: list[Log]
    robot: Robot | None = None
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    known: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    simulated: bool = False
    causes: Mapping[str, str] = field(default_factory=dict)
    refuted: Mapping[str, str] = field(default_factory=dict)
    law: Path | None = None
    fixed: tuple[str, ...] = ()
    order: int = 0
    published: str = ""
    origin: str = ""

    @property
    def channels(self) -> tuple[str, ...]:
        """What is predicted: joints, or output columns."""
        return self.robot.actuated if self.robot else self.outputs


def split_in_time(log: Log) -> tuple[list[Log], list[Log]]:
    """Return the first 70 % of a recording and the rest."""
    train, held = log.split(TRAIN_SHARE)
    return [train], [held]
