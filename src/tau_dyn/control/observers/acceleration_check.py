"""Accelerations of a tool in another unit, with another sign or with gravity in them, from the motion of its actuators.

Below its resonances a tool moves as its actuators, so its slow acceleration is that of the computed position. From rest to rest
the mean of an acceleration is zero; of an accelerometer that measures gravity it is gravity.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.log import describe_other_scale, differentiate, lowpass

SLOW_HZ = 3.0
"""Low-pass below the resonances of tools on robots [Hz]."""
MIN_CORRELATION = 0.8
"""Correlation of both slow accelerations from which their ratio is a scale: springs and noise leave some difference."""
_KEYS = ("ax_tool", "ay_tool", "az_tool")  # accelerations in a column map
GRAVITY_M_S2, GRAVITY_TOLERANCE = 9.81, 0.1


def refuse_odd_accelerations(
    columns: Sequence[str], measured: np.ndarray, names: Sequence[str], computed: np.ndarray, dt: float
) -> None:
    """Reject accelerations that no tool on these actuators has.

    Args:
        columns: Names of the accelerations.
        measured: Accelerations (N, n), from rest to rest [m/s^2].
        names: Names of the computed positions.
        computed: Positions of the tool from its actuators (N, n) [m].
        dt: Time between samples [s].

    Raises:
        InputError: A column has another unit or sign, or holds gravity; the sentence gives the column map's line.
    """
    if 1 / dt > 2.5 * SLOW_HZ and len(computed) * dt > 2 / SLOW_HZ:
        slow = lowpass(measured, SLOW_HZ, 1 / dt)
        moved = differentiate(differentiate(lowpass(computed, SLOW_HZ, 1 / dt), dt), dt)
        for key, column, x, name, y in zip(_KEYS, columns, slow.T, names, moved.T, strict=False):
            what = f"the acceleration of {name}"
            if said := describe_other_scale(column, x, what, y, correlated=MIN_CORRELATION, key=key):
                raise InputError("wrong_unit", f"{said} (--acceleration {key})")
    mean = measured.mean(axis=0)
    if abs(np.linalg.norm(mean) / GRAVITY_M_S2 - 1) < GRAVITY_TOLERANCE:
        k = int(np.argmax(np.abs(mean)))
        line = f"`{_KEYS[k]}: {{column: {columns[k]}, offset: {-mean[k]:.4g}}}`"
        raise InputError(
            "invalid_value",
            f"{columns[k]} has the mean {mean[k]:.4g} m/s^2 from rest to rest: the accelerometer measures gravity too; subtract "
            f"it, such as by {line} in a column map where the tool does not turn",
        )
