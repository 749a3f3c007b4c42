"""Errors of a robot, each within a given bound, and their effect on the robot's rods.

An actuator's error is the displacement of the point that it moves, within an ellipsoid around the intended point (thesis A.2,
Table 4.2), or an angle for a turning joint. A rod has errors of its length and of the positions of its two joints (A.3). All
sources together are `e` (m,), divided into `balls`: an interval is a ball of one number, an ellipsoid one of three. Rod k has

    A_k = A_k(q + Q e) + S_k e,   b_k = b_k + P_k e,   L_k = L_k(q + Q e) + l_k e,

base point, joint on the plate and length (thesis 4.3 and A.1). A cart that carries several rods shifts all of them equally.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.files import read_yaml
from tau_dyn.mechanism import Rods
from tau_dyn.results import to_plain

MAX_ERROR_SIZE = 0.5
"""[m or rad] Larger errors indicate a wrong unit."""
_AXES = ("x", "y", "z")
_ROD = ("length", "base", "plate")


@dataclass(frozen=True)
class ActuatorError:
    """Bound on one actuator's error.

    Attributes:
        along: Error along its motion [m or rad].
        across: Error in both directions across a guideway [m]; None if only the motion itself is uncertain.
        axes: Semi-axes along x, y, z of the base [m] instead of `along` and `across`, as in Table 4.2; None otherwise.
    """

    along: float = 0.0
    across: float | None = None
    axes: tuple[float, float, float] | None = None

    def to_dict(self) -> dict[str, float]:
        """Return the error in the form of an errors file."""
        if self.axes is not None:
            return dict(zip(_AXES, self.axes, strict=True))
        return {"along": self.along} | ({} if self.across is None else {"across": self.across})

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
        length: Error of its length [m], to either side.
        base: Error of the joint on the base's side, in any direction [m].
        plate: Error of the joint on the plate, in any direction [m].
    """

    length: float = 0.0
    base: float = 0.0
    plate: float = 0.0


@dataclass(frozen=True)
class ErrorBounds:
    """All errors assumed for a robot, by actuated joint and by rod; parts that are not named are exact."""

    actuators: Mapping[str, ActuatorError] = field(default_factory=dict)
    rods: Mapping[str, RodError] = field(default_factory=dict)

    @property
    def largest(self) -> float:
        """Largest bound [m or rad], 0 without any error."""
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
        """Return the errors in the form of an errors file."""
        return to_plain({"actuators": self.actuators, "rods": self.rods})


def build_isotropic_error(size: float) -> ActuatorError:
    """Return the error of a point within a ball of this radius [m], or of a turning joint [rad]."""
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
        InputError: The file is not an errors file, or a name, a key or a number is wrong.
    """
    where, content = str(path), read_yaml(path)
    if not isinstance(content, dict) or not content or not set(content) <= {"actuators", "rods"}:
        raise InputError("file_format", f"{where}: an errors file holds the mappings 'actuators' and 'rods' only")
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


@dataclass(frozen=True, eq=False)
class Sources:
    """Effect of one unit of each source.

    Attributes:
        balls: Slice of each source in `e`.
        labels: Description of each source, for a person.
        actuator: `Q` (na, m) [m or rad].
        shift: `S` (n, 3, m) of the base points, in the world [m].
        plate: `P` (n, 3, m) of the joints on the plate, in its frame [m].
        length: `l` (n, m) [m].
        along: Largest error of each actuator along its own motion (na,) [m or rad].
        axes: For each rod the principal axes of its base point's ellipsoid (n, 3, 3), columns.
        radii: Its semi-axes (n, 3) [m], enlarged by the errors that are equal in all directions (A.3).
        own: Whether every source touches one rod only, so that rods err independently.
    """

    balls: tuple[slice, ...]
    labels: tuple[str, ...]
    actuator: np.ndarray
    shift: np.ndarray
    plate: np.ndarray
    length: np.ndarray
    along: np.ndarray
    axes: np.ndarray
    radii: np.ndarray
    own: bool

    @property
    def m(self) -> int:
        """Number of numbers in `e`."""
        return self.actuator.shape[1]


@dataclass(frozen=True, eq=False)
class _Source:
    label: str
    size: int
    actuator: np.ndarray
    shift: np.ndarray
    plate: np.ndarray
    length: np.ndarray


def build_rod_sources(rods: Rods, errors: ErrorBounds) -> Sources:
    """Return the sources of a parallel robot's errors.

    Raises:
        InputError: An error across the motion is given for a joint that does not slide points along a fixed line.
    """
    lines = _guideways(rods)
    found = [*_actuators(rods, errors, lines), *_rods(rods, errors)]
    ends = np.cumsum([0, *(s.size for s in found)])
    axes, radii = _ellipsoids(rods, errors, lines)
    return Sources(
        balls=tuple(slice(int(a), int(b)) for a, b in zip(ends[:-1], ends[1:], strict=True)),
        labels=tuple(s.label for s in found),
        actuator=_joined([s.actuator for s in found], (rods.robot.na,)),
        shift=_joined([s.shift for s in found], (len(rods.names), 3)),
        plate=_joined([s.plate for s in found], (len(rods.names), 3)),
        length=_joined([s.length for s in found], (len(rods.names),)),
        along=np.array([_along(errors.actuators.get(j), lines[j]) for j in rods.robot.actuated]),
        axes=axes,
        radii=radii,
        own=all(_touched(s, rods) <= 1 for s in found),
    )


def _joined(parts: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    return np.concatenate(parts, axis=-1) if parts else np.zeros((*shape, 0))


def _guideways(rods: Rods) -> dict[str, tuple[np.ndarray, np.ndarray] | None]:
    """Return for each actuated joint its unit direction and the rods that it shifts; None if its points move on curves."""
    home = rods.robot.home[None]
    here, there = rods.base_jacobian(home)[0], rods.base_jacobian(home + 0.1)[0]
    lines: dict[str, tuple[np.ndarray, np.ndarray] | None] = {}
    for j, (joint, kind) in enumerate(zip(rods.robot.actuated, rods.robot.joint_kinds, strict=True)):
        moved = np.linalg.norm(here[:, :, j], axis=1) > 1e-9
        straight = kind == "prismatic" and moved.any() and np.allclose(here[:, :, j], there[:, :, j], atol=1e-9)
        lines[joint] = (here[np.argmax(moved), :, j], moved) if straight else None
    return lines


def _along(error: ActuatorError | None, line: tuple[np.ndarray, np.ndarray] | None) -> float:
    if error is None:
        return 0.0
    return float(np.linalg.norm(error.ellipsoid(line[0]).T @ line[0])) if line is not None else error.along


def _actuators(rods: Rods, errors: ErrorBounds, lines: dict) -> Iterator[_Source]:
    n, na = len(rods.names), rods.robot.na
    for joint, error in errors.actuators.items():
        line, j = lines[joint], rods.robot.actuated.index(joint)
        if line is None:
            if error.axes is not None:
                raise InputError(
                    "unsupported",
                    f"{joint}: x, y and z are for a joint that slides on a fixed guideway; give one number",
                )
            if error.along:
                turned = np.zeros((na, 1))
                turned[j] = error.along
                yield _Source(joint, 1, turned, np.zeros((n, 3, 1)), np.zeros((n, 3, 1)), np.zeros((n, 1)))
            continue
        direction, moved = line
        M = error.ellipsoid(direction)
        M = (
            M[:, np.linalg.norm(M, axis=0) > 0]
            if error.axes is not None or error.across
            else error.along * direction[:, None]
        )
        if M.size and np.any(M):
            shift = np.where(moved[:, None, None], M, 0.0)
            k = M.shape[1]
            yield _Source(joint, k, np.zeros((na, k)), shift, np.zeros((n, 3, k)), np.zeros((n, k)))


def _rods(rods: Rods, errors: ErrorBounds) -> Iterator[_Source]:
    n, na = len(rods.names), rods.robot.na
    for name, error in errors.rods.items():
        i = rods.names.index(name)
        only = np.zeros((n, 1, 1))
        only[i] = 1.0
        none, ball = np.zeros((n, 3, 3)), only * np.eye(3)
        if error.length:
            yield _Source(
                f"{name} length", 1, np.zeros((na, 1)), none[..., :1], none[..., :1], error.length * only[:, 0]
            )
        if error.base:
            yield _Source(f"{name} base joint", 3, np.zeros((na, 3)), error.base * ball, none, none[:, 0])
        if error.plate:
            yield _Source(f"{name} plate joint", 3, np.zeros((na, 3)), none, error.plate * ball, none[:, 0])


def _touched(source: _Source, rods: Rods) -> int:
    """Return how many rods a source acts on; a turning actuator by all rods whose base point or length it moves."""
    direct = np.any(source.shift, axis=(1, 2)) | np.any(source.plate, axis=(1, 2)) | np.any(source.length, axis=1)
    turned = np.flatnonzero(np.any(source.actuator, axis=1))
    home = rods.robot.home[None]
    for j in turned:
        direct |= np.any(rods.base_jacobian(home)[0, :, :, j], axis=1) | (rods.leg_rates(home)[0, :, j] != 0)
    return int(direct.sum())


def _ellipsoids(rods: Rods, errors: ErrorBounds, lines: dict) -> tuple[np.ndarray, np.ndarray]:
    """Return principal axes (n, 3, 3) and semi-axes (n, 3) of each rod's base point; nan if its error is no ellipsoid."""
    n = len(rods.names)
    axes, radii = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    for joint, error in errors.actuators.items():
        line = lines[joint]
        if line is None:
            radii[:] = np.nan
            break
        size, turned = np.linalg.eigh(error.ellipsoid(line[0]))
        for i in np.flatnonzero(line[1]):
            axes[i] = turned if not radii[i].any() else axes[i]
            radii[i] = np.abs(size) if not radii[i].any() else np.nan  # two actuators in a row: no ellipsoid
    for name, error in errors.rods.items():
        radii[rods.names.index(name)] += error.length + error.base + error.plate
    return axes, radii
