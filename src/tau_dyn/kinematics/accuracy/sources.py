r"""Errors as a vector: independent sources, each within a unit ball, and what they do to a robot's rods.

All sources together are `e` (m,), cut into `balls`: an interval is a ball of one number, an ellipsoid one of three. Rod k
then has

    A_k = A_k(q + Q e) + S_k e,   b_k = b_k + P_k e,   L_k = L_k(q + Q e) + l_k e,

base point, joint on the plate and length (thesis 4.3 and A.1). A cart that carries several rods shifts them all alike.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.kinematics.accuracy.error_bounds import ActuatorError, ErrorBounds
from tau_dyn.mechanism import Rods


@dataclass(frozen=True, eq=False)
class Sources:
    """What each unit of each source does.

    Attributes:
        balls: Where each source's numbers stand in `e`.
        labels: What each source is, for a person.
        actuator: `Q` (na, m) [m or rad].
        shift: `S` (n, 3, m) of the base points, in the world [m].
        plate: `P` (n, 3, m) of the joints on the plate, in its frame [m].
        length: `l` (n, m) [m].
        along: Largest error of each actuator along its own motion (na,) [m or rad].
        axes: For each rod the principal axes of its base point's ellipsoid (n, 3, 3), columns.
        radii: Its semi-axes (n, 3) [m], enlarged by what acts alike in all directions (A.3).
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
        InputError: An error across the motion is asked of a joint that does not slide points along a fixed line.
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
    """Return for each actuated joint its unit direction and which rods it shifts; None where points do not run straight."""
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
    """Return principal axes (n, 3, 3) and semi-axes (n, 3) of each rod's base point; nan where that is no ellipsoid."""
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
