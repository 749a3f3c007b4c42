"""What may be wrong with a robot: actuators, rod lengths, rod joints, each within a stated bound.

An actuator's error is where it really puts the point that it moves: within an ellipsoid around the intended point (thesis A.2,
Table 4.2), or off by an angle for a turning joint. A rod's error is its length's and the places of its two joints (A.3).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.files import read_yaml

MAX_ERROR_SIZE = 0.5
"""[m or rad] Larger errors are a slip of units."""
_AXES = ("x", "y", "z")
_ROD = ("length", "base", "plate")


@dataclass(frozen=True)
class ActuatorError:
    """Bound on one actuator's error.

    Attributes:
        along: Along its motion [m or rad].
        across: In both directions across a guideway [m]; None where only the motion itself is uncertain.
        axes: Semi-axes along x, y, z of the base [m] instead of both, as Table 4.2 has them; None otherwise.
    """

    along: float = 0.0
    across: float | None = None
    axes: tuple[float, float, float] | None = None

    def ellipsoid(self, direction: np.ndarray) -> np.ndarray:
        """Return `M` (3, 3) [m] for a guideway's unit direction (3,): the error is `M w` with `|w| <= 1`."""
        if self.axes is not None:
            return np.diag(self.axes)
        across = self.across or 0.0
        return across * np.eye(3) + (self.along - across) * np.outer(direction, direction)


@dataclass(frozen=True)
class RodError:
    """Bounds on one rod's errors.

    Attributes:
        length: Of its length [m], to either side.
        base: Of the joint on the base's side, in any direction [m].
        plate: Of the joint on the plate, in any direction [m].
    """

    length: float = 0.0
    base: float = 0.0
    plate: float = 0.0


@dataclass(frozen=True)
class ErrorBounds:
    """All errors assumed of a robot, by actuated joint and by rod; what is not named is exact."""

    actuators: Mapping[str, ActuatorError] = field(default_factory=dict)
    rods: Mapping[str, RodError] = field(default_factory=dict)

    @property
    def largest(self) -> float:
        """Largest bound [m or rad], 0 where everything is exact."""
        sizes = [s for a in self.actuators.values() for s in (a.along, a.across or 0.0, *(a.axes or ()))]
        return max([0.0, *sizes, *(s for r in self.rods.values() for s in (r.length, r.base, r.plate))])

    def scaled(self, factor: float) -> ErrorBounds:
        """Return the same errors, all larger by a factor."""
        actuators = {
            j: ActuatorError(
                factor * a.along,
                None if a.across is None else factor * a.across,
                None if a.axes is None else (factor * a.axes[0], factor * a.axes[1], factor * a.axes[2]),
            )
            for j, a in self.actuators.items()
        }
        rods = {n: RodError(factor * r.length, factor * r.base, factor * r.plate) for n, r in self.rods.items()}
        return ErrorBounds(actuators, rods)

    def to_dict(self) -> dict[str, Any]:
        """Return the errors as they stand in an errors file."""
        rods = {n: {"length": r.length, "base": r.base, "plate": r.plate} for n, r in self.rods.items()}
        return {"actuators": {j: _as_dict(a) for j, a in self.actuators.items()}, "rods": rods}


def _as_dict(error: ActuatorError) -> dict[str, float]:
    if error.axes is not None:
        return dict(zip(_AXES, error.axes, strict=True))
    return {"along": error.along} | ({} if error.across is None else {"across": error.across})


def build_isotropic_error(size: float) -> ActuatorError:
    """Return the error of a point that lies within a ball of this radius [m]; of a turning joint, [rad]."""
    return ActuatorError(size, size)


def read_actuator_errors(texts: Sequence[str], actuated: Sequence[str]) -> dict[str, ActuatorError]:
    """Read command-line words: one size for all actuators, or `JOINT=SIZE`, or `JOINT=ALONG:ACROSS`.

    Raises:
        InputError: A word is not of this kind, or names no actuated joint.
    """
    found: dict[str, ActuatorError] = {}
    for text in texts:
        name, equals, sizes = text.rpartition("=")
        along, colon, across = sizes.partition(":")
        where = f"--actuator-error {text}"
        size = _size(along, where)
        error = ActuatorError(size, _size(across, where) if colon else size)
        if equals and name not in actuated:
            raise UnknownName("actuated joint", name, actuated, "--actuator-error")
        found |= dict.fromkeys([name] if equals else actuated, error)
    return found


def read_errors_file(path: str | Path, actuated: Sequence[str], rods: Sequence[str]) -> ErrorBounds:
    """Read an errors file.

    Args:
        path: YAML with `actuators` and `rods`, each from a name (or `all`) to a size or a mapping of sizes.
        actuated: Names of the actuated joints.
        rods: Names of the rods; empty for a serial arm.

    Raises:
        InputError: The file is not such a file; a name, a key or a number is wrong.
    """
    where, content = str(path), read_yaml(path)
    if not isinstance(content, dict) or not content or not set(content) <= {"actuators", "rods"}:
        raise InputError(
            "file_format", f"{where}: an errors file holds 'actuators' and 'rods', mappings, and nothing else"
        )
    actuators = {
        joint: _actuator(row, f"{where}: {joint}")
        for joint, row in _rows(content.get("actuators"), actuated, "actuated joint", where).items()
    }
    return ErrorBounds(actuators, {
        rod: _rod(row, f"{where}: {rod}") for rod, row in _rows(content.get("rods"), rods, "rod", where).items()
    })  # fmt: skip


def _rows(content: object, names: Sequence[str], kind: str, where: str) -> dict[str, Any]:
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError("file_format", f"{where}: write a mapping from each {kind} to its error in metres (radians)")
    rows: dict[str, Any] = {}
    for name, row in sorted(content.items(), key=lambda item: item[0] != "all"):
        if name != "all" and name not in names:
            raise UnknownName(kind, str(name), [*names, "all"], where)
        rows |= dict.fromkeys(names if name == "all" else [name], row)
    return rows


def _actuator(row: object, where: str) -> ActuatorError:
    if not isinstance(row, dict):
        return build_isotropic_error(_size(row, where))
    if set(row) == set(_AXES):
        x, y, z = (_size(row[a], f"{where}, {a}") for a in _AXES)
        return ActuatorError(axes=(x, y, z))
    if "along" in row and set(row) <= {"along", "across"}:
        across = _size(row["across"], f"{where}, across") if "across" in row else None
        return ActuatorError(_size(row["along"], f"{where}, along"), across)
    raise InputError("file_format", f"{where}: an actuator's error is one number, or along and across, or x, y and z")


def _rod(row: object, where: str) -> RodError:
    if not isinstance(row, dict):
        return RodError(length=_size(row, where))
    if not row or not set(row) <= set(_ROD):
        raise InputError(
            "file_format", f"{where}: a rod's error is one number (its length's), or any of length, base and plate"
        )
    return RodError(**{key: _size(value, f"{where}, {key}") for key, value in row.items()})


def _size(value: object, where: str) -> float:
    try:
        size = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InputError(
            "file_format", f"{where}: '{value}' is no number; write metres (radians for a turning joint)"
        ) from None
    if isinstance(value, bool) or not isfinite(size) or size < 0:
        raise InputError(
            "file_format", f"{where}: an error is a bound to both sides, zero or a positive number, not {value}"
        )
    if size > MAX_ERROR_SIZE:
        raise InputError(
            "wrong_unit",
            f"{where}: {value} is more than {MAX_ERROR_SIZE} m (rad); errors are given in metres, not micrometres",
        )
    return size
