"""What a result shows beside the robot, whichever command it comes from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tau_dyn.modes import ShapesOnRobot


@dataclass(frozen=True)
class ViewedFinding:
    """What a result says of some parts.

    Attributes:
        title: The cause and how sure it is.
        sentence: What a colleague would say, or ''.
        parts: Names of the joints, links or rods that it is about.
    """

    title: str
    sentence: str
    parts: tuple[str, ...]


@dataclass(frozen=True)
class Findings:
    """All findings of a result, and the sentence above them."""

    headline: str
    rows: tuple[ViewedFinding, ...]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points in space, with numbers to colour them by.

    Attributes:
        name: What it is.
        points: (n, 3) [m].
        values: What may colour them (n,), by its name with the unit.
        note: What is to be said of it, or ''.
        box: Two corners (2, 3) [m] around all of it, or None.
        flat: Whether it is a section, whose points are drawn side by side.
    """

    name: str
    points: np.ndarray
    values: dict[str, np.ndarray] = field(default_factory=dict)
    note: str = ""
    box: np.ndarray | None = None
    flat: bool = False


@dataclass(frozen=True, eq=False)
class ErrorVectors:
    """Measured minus predicted places of the tool.

    Attributes:
        points: Where (n, 3) [m], in the robot's base frame.
        models: Error vectors (n, 3) [m] by model, from the one with the file's dimensions to the chosen one.
    """

    points: np.ndarray
    models: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How well each part's mass is known: relative standard error by link; nan where the data cannot tell."""

    links: dict[str, float]


Content = Findings | Cloud | ErrorVectors | Uncertainty | ShapesOnRobot
