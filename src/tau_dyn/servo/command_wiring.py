"""Commands in another unit, with another sign, or that stand still: found before a fit, from the positions that they command.

A servo follows its command. Where positions and commands are correlated, the ratio of their standard deviations is about one,
less where friction and gravity let a proportional servo droop. A ratio far from one is a unit, a negative correlation a sign.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.servo.records import LoopRecord
from tau_dyn.simulate import COMMANDS

MIN_CORRELATION = 0.9
"""Correlation of commands and what they command from which their ratio is a scale; slow servos under fast commands have less."""
MAX_RATIO = 5.0
"""Ratio of standard deviations, or its inverse, beyond which a unit differs; a drooping servo stays above a half."""
MIN_MOTION = 0.05
"""Range of a joint [rad or m] from which it counts as moving; a loaded servo creeps by less."""
MIN_OFFSET = 0.5
"""Offset [rad or m] beyond any droop: the zero of an encoder."""
UNITS = {
    "degrees": np.pi / 180,
    "thousandths": 1e-3,
    "turns": 2 * np.pi,
    **{f"steps of {n} a turn": 2 * np.pi / n for n in (1024, 4096, 16384, 65536)},
}
UNIT_TOLERANCE = 0.1
"""Relative difference of a ratio from a unit's that friction and droop may cause."""


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
        if not np.ptp(command, axis=0).any() and moves.max() > MIN_MOTION:
            j = int(np.argmax(moves))
            raise InputError(
                "poor_excitation",
                f"{record.name}: the commands never change, while q_{joints[j]} moves by {moves[j]:.3g}; log the commands that "
                "the servo receives",
            )
        for j, joint in enumerate(joints):
            if said := _describe_ratio(command[:, j], followed[:, j], joint, moves[j]):
                raise InputError("wrong_unit", f"{record.name}: {said}")


def _find_followed(record: LoopRecord) -> np.ndarray | None:
    """Return the quantity (N, na) that follows the commands; None for currents and PWM, which no motion follows."""
    if record.told == COMMANDS[0]:
        return record.q
    return record.motion[1] if record.told == "speed" else None


def _describe_ratio(command: np.ndarray, followed: np.ndarray, joint: str, moved: float) -> str:
    """Return a sentence about a command in another unit or with another sign; empty if it is plausible or tells nothing."""
    sizes = np.std(followed), np.std(command)
    if moved <= MIN_MOTION or min(sizes) <= 0:
        return ""
    correlation = float(np.corrcoef(command, followed)[0, 1])
    ratio = float(np.sign(correlation) * sizes[0] / sizes[1])
    if abs(correlation) < MIN_CORRELATION or 1 / MAX_RATIO < ratio < MAX_RATIO:
        return ""
    size = abs(ratio)
    unit = next((name for name, of in UNITS.items() if abs(size / of - 1) < UNIT_TOLERANCE), "")
    scale = 1.0 if 1 / MAX_RATIO < size < MAX_RATIO else UNITS.get(unit, float(f"{size:.2g}"))
    scale *= np.sign(ratio)
    offset = float(np.mean(followed) - scale * np.mean(command))
    shift = f", offset: {offset:.3g}" if abs(offset) > MIN_OFFSET else ""
    what = f"runs against q_{joint}" if ratio < 0 else f"is {1 / size:.3g} times q_{joint}"
    what += f", {1 / size:.3g} times its size" if ratio < 0 and abs(scale) != 1 else ""
    what += f", as if in {unit}" if unit and abs(scale) != 1 else ""
    return (
        f"cmd_{joint} {what}; write `cmd_{joint}: {{column: cmd_{joint}, scale: {scale:.6g}{shift}}}` into a column map"
    )
