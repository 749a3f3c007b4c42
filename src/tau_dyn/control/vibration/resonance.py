"""Resonances with their intervals, from a result of `modes` or a state-space model that it wrote."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.files import read_bytes
from tau_dyn.modes import Z95, find_resonances, load_state_space

_MAX_FILE_BYTES = 2**28  # a result with its traces is a few megabytes
MAX_DAMPING_RATIO = 0.9
"""Damping ratio beyond which a mode hardly rings and nothing is gained by shaping."""


@dataclass(frozen=True)
class Resonance:
    """A mode of second order, s^2 + 2 z w s + w^2.

    Attributes:
        frequency_hz: Undamped frequency w / (2 pi) [Hz].
        damping_ratio: z.
        frequency_stderr: Standard error of the frequency [Hz]; 0 where it is not known.
        damping_stderr: Standard error of the damping ratio; 0 where it is not known.
    """

    frequency_hz: float
    damping_ratio: float
    frequency_stderr: float = 0.0
    damping_stderr: float = 0.0

    def __post_init__(self) -> None:
        """Refuse numbers that are no resonance.

        Raises:
            InputError: The frequency is not positive, or the damping ratio not between 0 and 0.9.
        """
        if not (0 < self.frequency_hz < 1e9 and 0 <= self.damping_ratio <= MAX_DAMPING_RATIO):
            raise InputError(
                "invalid_value",
                f"a mode of {self.frequency_hz:g} Hz with the damping ratio {self.damping_ratio:g} does not ring; "
                f"give a positive frequency and a damping ratio from 0 to {MAX_DAMPING_RATIO:g}",
            )

    @property
    def frequency_interval(self) -> tuple[float, float]:
        """95 % interval of the frequency [Hz]."""
        away = Z95 * self.frequency_stderr
        return max(self.frequency_hz - away, 1e-3 * self.frequency_hz), self.frequency_hz + away

    @property
    def damping_interval(self) -> tuple[float, float]:
        """95 % interval of the damping ratio, within 0 and 0.9."""
        low, high = np.clip(self.damping_ratio + Z95 * self.damping_stderr * np.array([-1, 1]), 0, MAX_DAMPING_RATIO)
        return float(low), float(high)


def read_resonances(path: Path) -> list[Resonance]:
    """Return the resonances in a file, slowest first, without those that hardly ring.

    Args:
        path: A result of `modes` (--json), whose modes have standard errors; or a model that it wrote (--out), without.

    Raises:
        InputError: The file is neither.
        CannotAnswer: It has no mode that rings.
    """
    found = list(_list_modes(path))
    ringing = [Resonance(*map(float, row)) for row in found if 0 <= row[1] <= MAX_DAMPING_RATIO and row[0] > 0]
    if not ringing:
        raise CannotAnswer(
            "no_solution",
            f"{path.name} has no mode that rings",
            "a log of a structure that vibrates, and `modes` of it",
        )
    return sorted(ringing, key=lambda r: r.frequency_hz)


def _list_modes(path: Path) -> Iterator[tuple[float, float, float, float]]:
    """Yield frequency [Hz], damping ratio and their standard errors, 0 where there are none."""
    if path.suffix.lower() in (".yaml", ".yml"):
        for mode in find_resonances(load_state_space(path).model):
            yield mode.frequency_hz, mode.damping_ratio, 0.0, 0.0
        return
    try:
        content = json.loads(read_bytes(path, _MAX_FILE_BYTES))
    except OSError as fault:
        raise InputError("file_not_found", f"{path}: {fault.strerror or 'cannot be read'}") from fault
    except (ValueError, RecursionError) as fault:
        raise InputError(
            "file_format", f"{path}: no result of modes (--json), nor a model that it wrote (.yaml)"
        ) from fault
    rows = content.get("modes") if isinstance(content, dict) else None
    if not isinstance(rows, list) or content.get("command") != "modes":
        raise InputError(
            "file_format", f"{path}: not a result of modes; write one with: tau-dyn modes LOG .. --json FILE"
        )
    for row in rows:
        yield (
            _number(path, row, "frequency_hz"),
            _number(path, row, "damping_ratio"),
            _number(path, row, "frequency_stderr", missing=0.0),
            _number(path, row, "damping_stderr", missing=0.0),
        )


def _number(path: Path, row: Any, key: str, missing: float | None = None) -> float:
    value = row.get(key) if isinstance(row, dict) else None
    if value is None and missing is not None:
        return missing
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e9:
        raise InputError("file_format", f"{path}: a mode's '{key}' has to be a number from zero up")
    return float(value)
