"""Cross-sections of a workspace: every point of a plane judged on its own, with the quantities of maps where it belongs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.workspace.lattice import INSIDE
from tau_dyn.kinematics.workspace.maps import Quality
from tau_dyn.kinematics.workspace.result import Workspace

_AXES = "xyz"
_MAX_SECTION_POINTS = 220
"""Points along the longer side of a section."""


@dataclass(frozen=True, eq=False)
class Section:
    """A plane through a workspace.

    Attributes:
        axis: Index of the axis that it is across (0, 1, 2).
        at: Where [m].
        across: Index of the axis drawn to the right.
        up: Index of the axis drawn upwards.
        u: Coordinates to the right (nu,) [m].
        v: Coordinates upwards (nv,) [m].
        code: Codes (nu, nv), 0 where a pose belongs.
        maps: Quantities by name (nu, nv), nan where a pose does not belong.
        area: Of the part that belongs [m^2].
    """

    axis: int
    at: float
    across: int
    up: int
    u: np.ndarray
    v: np.ndarray
    code: np.ndarray
    area: float
    maps: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Such as `x = 1.75 m`."""
        return f"{_AXES[self.axis]} = {self.at:.4g} m"

    @property
    def inside(self) -> np.ndarray:
        """Whether each point belongs (nu, nv)."""
        return self.code == INSIDE


def parse_section(text: str) -> tuple[int, float]:
    """Return axis and place of a section such as `x=1.75`.

    Raises:
        InputError: It is written otherwise.
    """
    axis, equals, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = np.nan
    if axis.strip().lower() not in tuple(_AXES) or not equals or not abs(value) < 1e6:
        raise InputError("invalid_value", f"a section is an axis and a place, such as x=1.75, not '{text}'")
    return _AXES.index(axis.strip().lower()), value


def judge_section(found: Workspace, axis: int, at: float, quality: Quality, names: Sequence[str] = ()) -> Section:
    """Judge a plane across an axis.

    Args:
        found: The workspace.
        axis: Index of the axis.
        at: Where [m].
        quality: Evaluates the maps.
        names: Of the maps.

    Raises:
        InputError: The plane misses what was searched, or the tool does not move in it.
    """
    across, up = [k for k in range(3) if k != axis]
    low, high = found.lattice.low, found.lattice.points(np.array(found.lattice.shape) - 1)
    if not low[axis] - 1e-9 <= at <= high[axis] + 1e-9:
        raise InputError(
            "unreachable",
            f"section {_AXES[axis]}={at:g} misses the searched box, {low[axis]:.3g} to {high[axis]:.3g} m",
        )
    if found.lattice.shape[across] < 2 or found.lattice.shape[up] < 2:
        raise InputError("unsupported", f"the tool does not move along both axes of a section across {_AXES[axis]}")
    step = max(found.lattice.step, max(high[across] - low[across], high[up] - low[up]) / _MAX_SECTION_POINTS)
    u, v = (_along(low[k], high[k], step) for k in (across, up))
    places = np.zeros((len(u), len(v), 3))
    places[..., axis], places[..., across], places[..., up] = at, u[:, None], v[None, :]
    places = places.reshape(-1, 3)
    judged = found.judge.judge(found.poses(places))
    code = _also_of_lattice(found, places, judged.code)
    inside = code == INSIDE
    maps = {}
    for name, value in quality.values(list(names), judged.q[inside], found.poses(places[inside])).items():
        maps[name] = np.full(len(code), np.nan)
        maps[name][inside] = value
    shape = (len(u), len(v))
    return Section(
        axis, at, across, up, u, v, code.reshape(shape), float(inside.sum()) * step**2,
        {name: value.reshape(shape) for name, value in maps.items()},
    )  # fmt: skip


def _along(low: float, high: float, step: float) -> np.ndarray:
    return low + step * np.arange(int(np.floor((high - low) / step + 1e-9)) + 1)


def _also_of_lattice(found: Workspace, places: np.ndarray, code: np.ndarray) -> np.ndarray:
    """Return codes with what only the whole lattice knows: connection with home, distance from the border."""
    index = np.rint((places - found.lattice.low) / found.lattice.step).astype(int)
    index = np.clip(index, 0, np.array(found.lattice.shape) - 1)
    near = found.code[tuple(index.T)]
    wider = {c for c, kind, _ in found.reasons.items() if kind in ("not connected to home", "too close to the border")}
    return np.where((code == INSIDE) & np.isin(near, list(wider)), near, code)


def choose_usual_sections(found: Workspace) -> list[tuple[int, float]]:
    """Return the planes through home across x, y and z, of those in which the tool moves."""
    wide = [n > 1 for n in found.lattice.shape]
    home = found.machine.home.position[0]
    return [(k, float(home[k])) for k in range(3) if all(wide[i] for i in range(3) if i != k)]
