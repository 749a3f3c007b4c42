"""Inputs and outputs of a vibration record on a robot, and the pose of the record.

| column | quantity |
|---|---|
| `fx_PLACE` | input: force at a frame or link, in base axes [N] |
| `tau_J` | input: force of a drive [N or N m]; a drive without this input is held |
| `x_PLACE`, `vx_PLACE`, `ax_PLACE` | output: displacement, velocity, acceleration of a place in base axes [m, m/s, m/s^2] |
| `q_J`, `v_J`, `a_J` | output: the same of an actuated joint with a force input |

`PLACE` is `tool`, a frame, or a link without its ending `_link`. Lines of the discrete Fourier transform are used up to
`MAX_BAND` of the sampling rate, where the inputs have power: forces and responses count as filtered alike.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.log import Log
from tau_dyn.modes.contact import find_contact, find_least_force
from tau_dyn.modes.record import Record, prepare_records
from tau_dyn.robot import Robot

MAX_BAND = 0.25
"""Share of the sampling rate up to which lines are used: anti-aliasing filters act above it."""
MIN_INPUT_POWER = 1e-4
"""Power of the inputs relative to their strongest line from which a line is used: -40 dB, as in usual hammer practice."""
FIRST_LINE = 3
"""First used line: an error of the rest level concerns the lines before it."""

BEGIN_SHARE = 1e-3
"""Share of the inputs' energy before the sample that counts as their begin."""

RINGING = 40
"""Samples before and after contact in which a steep anti-aliasing filter rings: half the length of usual ones."""
MAX_GROUPS = 128
"""Groups of the samples of one contact, whose force noise is common. Large groups leave out noise of high frequencies, which
biases the springs of stiff rods: of a Delta's intervals 73 instead of 91 % held with 32 groups."""


@dataclass(frozen=True)
class RecordChannel:
    """One column's role.

    Attributes:
        joint: Actuated joint that it belongs to; empty for a place.
        place: Frame that it belongs to; empty for a joint.
        axis: 0, 1 or 2 of a place.
        order: Derivatives by time of an output.
    """

    joint: str
    place: str
    axis: int
    order: int = 0


@dataclass(frozen=True, eq=False)
class PosedRecord:
    """Stretches of one record at one pose; lines of their Fourier transforms follow from `Record`.

    Attributes:
        name: Name of the log.
        q: Actuated positions (na,) [m or rad].
        pieces: Stretches: one blow and its decay each, or a driven record.
        inputs: Roles of the inputs (m,).
        outputs: Roles of the outputs (p,).
    """

    name: str
    q: np.ndarray
    pieces: tuple[Record, ...]
    inputs: tuple[RecordChannel, ...]
    outputs: tuple[RecordChannel, ...]

    @property
    def free(self) -> tuple[str, ...]:
        """Joints whose drives are moved by known forces; the others are held."""
        return tuple(c.joint for c in self.inputs if c.joint)


def build_posed_record(
    robot: Robot, log: Log, inputs: Sequence[str], outputs: Sequence[str], pose: Mapping[str, float] | None
) -> PosedRecord:
    """Return a log's stretches with its pose and the roles of its columns.

    Args:
        robot: The robot.
        log: One record at one pose.
        inputs: Columns that excite; those that the log lacks count as at rest if at least one is there.
        outputs: Columns that respond.
        pose: Position by actuated joint; None takes the means of the log's columns `q_J`.

    Raises:
        InputError: A column's name has no role on the robot, or the pose is not known.
    """
    there = [name for name in inputs if name in log.channels] or list(inputs)
    roles = tuple(_read_input(robot, name) for name in there)
    free = {c.joint for c in roles if c.joint}
    responses = tuple(_read_output(robot, name, free) for name in outputs)
    data = prepare_records([log], there, list(outputs))
    pieces = data.whole or data.train
    return PosedRecord(
        log.name, _read_pose(robot, log, pose), _window(pieces) if data.kind == "impulse" else pieces, roles, responses
    )


def _window(blows: Sequence[Record]) -> tuple[Record, ...]:
    """Return blows whose force is zero out of contact and out of the ringing that anti-aliasing filters add to it."""
    least = find_least_force(np.vstack([r.u for r in blows]))
    near = [binary_dilation(find_contact(r.u, least), np.ones((2 * RINGING + 1, 1), bool)) for r in blows]
    free = np.vstack([np.where(touched, np.nan, r.u) for r, touched in zip(blows, near, strict=True)])
    noise = np.sqrt(np.nanmean(free**2, axis=0))
    return tuple(
        replace(r, u=np.where(touched, r.u, 0.0), input_noise=noise) for r, touched in zip(blows, near, strict=True)
    )


def _read_input(robot: Robot, name: str) -> RecordChannel:
    if match := re.fullmatch(r"f([xyz])(?:_(\w+))?", name):
        return RecordChannel("", find_frame(robot, match[2] or "tool"), "xyz".index(match[1]))
    if name.startswith("tau_") and name[4:] in robot.actuated:
        return RecordChannel(name[4:], "", 0)
    raise InputError(
        "bad_option", f"input '{name}' has no place on {robot.name}: name it fx_PLACE, fy_PLACE, fz_PLACE or tau_JOINT"
    )


def _read_output(robot: Robot, name: str, free: set[str]) -> RecordChannel:
    orders = {"": 0, "q": 0, "v": 1, "a": 2}
    if match := re.fullmatch(r"([av]?)([xyz])(?:_(\w+))?", name):
        return RecordChannel("", find_frame(robot, match[3] or "tool"), "xyz".index(match[2]), orders[match[1]])
    if (match := re.fullmatch(r"([qva])_(\w+)", name)) and match[2] in robot.actuated:
        if match[2] not in free:
            raise InputError(
                "bad_option", f"output '{name}' is that of a held drive; name tau_{match[2]} as an input too"
            )
        return RecordChannel(match[2], "", 0, orders[match[1]])
    raise InputError(
        "bad_option", f"output '{name}' has no place on {robot.name}: name it x_PLACE, vx_PLACE, ax_PLACE or q_JOINT"
    )


def find_frame(robot: Robot, place: str) -> str:
    """Return the frame that a place denotes.

    Raises:
        UnknownName: There is none.
    """
    if place == "tool" and robot.tool:
        return robot.tool
    known = [name for name in (place, f"{place}_link") if robot.model.existFrame(name)]
    if not known:
        raise UnknownName("frame", place, [f.name for f in robot.model.frames[1:]], robot.source)
    return known[-1]


def _read_pose(robot: Robot, log: Log, pose: Mapping[str, float] | None) -> np.ndarray:
    found = dict(pose or {})
    for joint in set(found) - set(robot.actuated):
        raise UnknownName("actuated joint", joint, robot.actuated)
    for joint in robot.actuated:
        if joint not in found and f"q_{joint}" in log.channels:
            found[joint] = float(np.mean(log.channels[f"q_{joint}"]))
    missing = [joint for joint in robot.actuated if joint not in found]
    if missing:
        raise InputError(
            "missing_column",
            f"{log.name}: its pose is unknown; add column(s) {', '.join(f'q_{j}' for j in missing)}, or a --poses file",
        )
    q = np.array([found[joint] for joint in robot.actuated], float)
    if not np.isfinite(q).all():
        raise InputError("invalid_value", f"{log.name}: its pose {q} is not finite")
    return q


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Laplace transforms of a stretch along `s = sigma + j w`.

    Attributes:
        s: Points (F,) [1/s].
        u: Inputs (F, m).
        y: Outputs (F, p).
        duration: Length of the stretch [s].
        errors: Transforms of one standard deviation of the forces' noise in contact (F, e).
        error_inputs: The input that each of these concerns (e,).
    """

    s: np.ndarray
    u: np.ndarray
    y: np.ndarray
    duration: float
    errors: np.ndarray
    error_inputs: np.ndarray


def transform(piece: Record, sigma: float = 0.0) -> Spectrum:
    """Return a stretch's transform where its inputs have power.

    `int y exp(-s t) dt` by the rectangle rule at the lines of the Fourier transform. With `sigma` above zero `t` begins with the
    force, before which an exponential window would enlarge the noise, and lines are a third of a windowed resonance's width
    apart.
    """
    n, dt = piece.u.shape[0], piece.dt
    begin = _find_begin(piece) if sigma > 0 else 0
    decay = (np.exp(-sigma * dt * (np.arange(n) - begin)) * (np.arange(n) >= begin))[:, None]
    u, y = (np.fft.rfft(x * decay, axis=0) * dt for x in (piece.u, piece.y))
    w = 2 * np.pi * np.fft.rfftfreq(n, dt)
    power = np.sum(np.abs(u) ** 2 / np.maximum(np.max(np.abs(u) ** 2, axis=0), 1e-300), axis=1)
    last = int(MAX_BAND * n)
    step = max(1, int(sigma * n * dt / (2 * np.pi) / 3))
    lines = np.arange(FIRST_LINE, last, step)
    lines = lines[power[lines] > MIN_INPUT_POWER * power[FIRST_LINE:last].max()]
    points = sigma + 1j * w[lines]
    return Spectrum(points, u[lines], y[lines], n * dt, *_transform_force_noise(piece, points))


def _transform_force_noise(piece: Record, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the transforms (F, e) of the noise of forces in contact, in groups of samples, and their inputs (e,)."""
    columns, inputs = [np.zeros((len(s), 0))], []
    for k, noise in enumerate([] if piece.input_noise is None else piece.input_noise):
        pushed = np.flatnonzero(piece.u[:, k])
        if noise > 0 and len(pushed):
            for part in np.array_split(pushed, min(MAX_GROUPS, len(pushed))):
                each = np.exp(-np.outer(s, part) * piece.dt).sum(axis=1)
                columns.append((noise / np.sqrt(len(part)) * piece.dt * each)[:, None])
                inputs.append(k)
    return np.hstack(columns), np.array(inputs, int)


def _find_begin(piece: Record) -> int:
    """Return the sample at which the inputs begin to act: a thousandth of their energy lies before it."""
    energy = np.cumsum(np.sum(piece.u**2, axis=1))
    return max(0, int(np.searchsorted(energy, BEGIN_SHARE * energy[-1])) - 2)
