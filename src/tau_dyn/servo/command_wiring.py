"""Commands in another unit, with another sign, or that stand still: found before a fit, from the positions that they command.

A servo follows its command. Where positions and commands are correlated, the ratio of their standard deviations is about one,
less where friction and gravity let a proportional servo droop. A ratio far from one is a unit, a negative correlation a sign.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.log import describe_other_scale
from tau_dyn.servo.records import LoopRecord
from tau_dyn.simulate import COMMANDS

MIN_MOTION = 0.05
"""Range of a joint [rad or m] from which it counts as moving; a loaded servo creeps by less."""


_ARRIVED = 0.5
"""Distance from a command that never changes in the second half of a log, over that at its start, below which the joint obeys."""


def refuse_odd_commands(records: Sequence[LoopRecord], joints: Sequence[str]) -> None:
    """Reject commands of position or speed that no servo with these positions can have followed.

    Raises:
        InputError: A column of commands has another unit or sign, which the sentence names with a line for the column map, or
            all commands of a log stand still while a joint moves.
    """
    for record in records:
        followed = _find_followed(record)
        on = record.used & (record.enabled > 0)
        if followed is None or on.sum() < 2:
            continue
        command, followed = record.command[on], followed[on]
        moves = np.ptp(record.q[on], axis=0)
        away = np.abs(followed - command)
        # a log of one step holds one command throughout
        arrives = away[len(away) // 2 :].max(axis=0) < _ARRIVED * away[0]
        odd = np.where(arrives, 0.0, moves)
        if not np.ptp(command, axis=0).any() and odd.max() > MIN_MOTION:
            j = int(np.argmax(odd))
            raise InputError(
                "poor_excitation",
                f"{record.name}: the commands never change, while q_{joints[j]} moves by {moves[j]:.3g}; log the commands that "
                "the servo receives",
            )
        for j, joint in enumerate(joints):
            said = describe_other_scale(f"cmd_{joint}", command[:, j], f"q_{joint}", followed[:, j])
            if said and moves[j] > MIN_MOTION:
                raise InputError("wrong_unit", f"{record.name}: {said}")


def _find_followed(record: LoopRecord) -> np.ndarray | None:
    """Return the quantity (N, na) that follows the commands; None for currents and PWM, which no motion follows."""
    if record.told == COMMANDS[0]:
        return record.q
    return record.motion[1] if record.told == "speed" else None
