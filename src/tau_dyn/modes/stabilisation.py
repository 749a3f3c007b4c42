"""The stabilisation diagram: the modes of models of many orders, with standard errors.

A resonance of the structure appears at nearly the same frequency and damping in every model that is large enough;
what noise makes of spare states wanders. A mode is `stable` where the model before it had one within their joint
uncertainty (and at least 1 % in frequency and 20 % in damping, as is usual), `frequency` where only the frequency
agrees, and `new` where nothing does (van der Auweraer & Peeters 2004). Unlike the usual diagram this one shows how
well each point is known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.modes.modal import Mode

# relative difference of a stable mode's frequency from order to order (Peeters & De Roeck 1999)
FREQUENCY_TOLERANCE = 0.01
DAMPING_TOLERANCE = 0.20  # relative difference of a stable mode's damping from order to order (Peeters & De Roeck 1999)
SIGMAS = 2.0  # joint standard errors within which two orders' modes agree
OVERDAMPED = 0.7
"""Modes with more damping ring less than one period; the diagram leaves them out."""


@dataclass(frozen=True)
class StabilityPoint:
    """One mode of one order.

    Attributes:
        order: Number of states of its model.
        frequency_hz: Undamped natural frequency [Hz].
        damping_ratio: Damping over critical damping.
        frequency_stderr: Standard error [Hz]; nan where unknown.
        damping_stderr: Standard error; nan where unknown.
        kind: `stable`, `frequency` or `new`.
    """

    order: int
    frequency_hz: float
    damping_ratio: float
    frequency_stderr: float
    damping_stderr: float
    kind: str

    def to_dict(self) -> dict[str, Any]:
        """Return it for the JSON result."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


def build_stabilisation_diagram(modes: Mapping[int, Sequence[Mode]]) -> tuple[StabilityPoint, ...]:
    """Return the diagram.

    Args:
        modes: Modes by order of their model.
    """
    points: list[StabilityPoint] = []
    before: Sequence[Mode] = ()
    for order in sorted(modes):
        here = [m for m in modes[order] if m.damping_ratio < OVERDAMPED]
        points += [
            StabilityPoint(
                order, m.frequency_hz, m.damping_ratio, m.frequency_stderr, m.damping_stderr, _kind(m, before)
            )
            for m in here
        ]
        before = here
    return tuple(points)


def _kind(mode: Mode, before: Sequence[Mode]) -> str:
    close = [m for m in before if _near(mode.frequency_hz, mode.frequency_stderr, m.frequency_hz, m.frequency_stderr)]
    if not close:
        return "new"
    return "stable" if any(_damped_alike(mode, m) for m in close) else "frequency"


def _near(f: float, sf: float, g: float, sg: float) -> bool:
    joint = SIGMAS * float(np.nan_to_num(np.hypot(sf, sg)))
    return abs(f - g) <= max(FREQUENCY_TOLERANCE * g, min(joint, 0.05 * g))


def _damped_alike(a: Mode, b: Mode) -> bool:
    joint = SIGMAS * float(np.nan_to_num(np.hypot(a.damping_stderr, b.damping_stderr)))
    gap = abs(a.damping_ratio - b.damping_ratio)
    return gap <= max(DAMPING_TOLERANCE * abs(b.damping_ratio), min(joint, 0.5 * abs(b.damping_ratio)))
