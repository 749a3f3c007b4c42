r"""The tool channel: measured tool positions against forward kinematics of measured joint positions.

    R m + p - T(q) = frame + J zero + sum of effects' tool columns + noise

The measuring device's frame is first laid on the robot's (Kabsch 1976), so that the rest is small; the baseline then refits
that frame (three shifts, three turns) and each joint's zero, as far as they do not depend on each other (three equal zeros
of parallel guideways are a shift). The robot's geometry is taken as calibrated.

Logs sampled in time are low-passed like forces. Poses held still, recognised by a sampling too slow to show motion, count one
by one; a joint's direction is that of its way from the pose before, on which it is taken not to turn back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.force import BAND_FACTOR, POSITION_FACTOR
from tau_dyn.diagnose.ground import Ground, gains
from tau_dyn.diagnose.parts import divide
from tau_dyn.diagnose.trials import one_sided
from tau_dyn.effects import EFFECTS, Effect, Motion, Scene
from tau_dyn.effects.cart_shift import SENSITIVITY
from tau_dyn.effects.cart_tilt import CartTilt
from tau_dyn.effects.displacement import DisplacementEffect
from tau_dyn.effects.guideway_compliance import SIDE_FORCE, GuidewayCompliance
from tau_dyn.estimate import Run
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify.preparation import SLOWEST_HZ, Preparation, choose_preparation
from tau_dyn.identify.regression import even_pieces, measured_signals
from tau_dyn.log import Log, decimate, differentiate, edge_samples, lowpass
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters

OUTPUTS = ("x_tool", "y_tool", "z_tool")
POSE_S = 1.0
"""Poses held still count one by one, whatever the time between them: each stands for this long [s]."""
_SAME = 1e-4  # of a joint's range: it has not moved
_DEPENDENT = 1e-6
_FASTEST = 0.98
_CHUNK = 32
_ROLL_OFF = 8  # power of the two-way low-pass of fourth order
_LINE = 1e-6
"""Squared width over squared length of all positions, below which they lie on a line and leave the turn about it open; the
frames then have to agree beforehand."""


@dataclass(frozen=True, eq=False)
class Piece:
    """One stretch of a log with the tool measured.

    Attributes:
        log: The stretch.
        motion: Motion of the encoders, at the log's rate, with the signals that effects feel.
        tool: Measured tool positions (N, 3) [m], in the robot's frame as far as known.
        predicted: Forward kinematics (N, 3) [m].
        jacobian: Tool velocity per actuated speed (N, 3, na).
        usable: Samples whose directions of motion are sure (N,).
        cutoff_hz: Low-pass on both sides [Hz]; None for poses.
        factor: Decimation.
    """

    log: Log
    motion: Motion
    tool: np.ndarray
    predicted: np.ndarray
    jacobian: np.ndarray
    usable: np.ndarray
    cutoff_hz: float | None
    factor: int

    def passed(self, x: np.ndarray) -> np.ndarray:
        """Return an array (N, ...) as the fit sees it (n, ...)."""
        if self.cutoff_hz is None:
            return x
        return decimate(lowpass(x, self.cutoff_hz, self.log.rate_hz), self.factor)

    @property
    def seen(self) -> np.ndarray:
        """Which of the fit's samples count (n,)."""
        mask = self.usable[:: self.factor].copy()
        if self.cutoff_hz is not None:
            edge = int(np.ceil(edge_samples(self.cutoff_hz, self.log.rate_hz) / self.factor))
            mask[:edge] = mask[len(mask) - edge :] = False
        return mask

    @property
    def t(self) -> np.ndarray:
        """Time of the fit's samples (n,) [s]."""
        return POSE_S * np.arange(len(self.tool)) if self.cutoff_hz is None else decimate(self.log.t, self.factor)


@dataclass(frozen=True, eq=False)
class ToolChannel(Channel):
    """Tool positions; outputs are the tool's coordinates in the robot's base frame [m].

    Attributes:
        pieces: The stretches.
        separate: Whether each joint shows in outputs of its own, so that what joints explain adds up; a tool mixes them.
    """

    pieces: tuple[Piece, ...]
    separate: ClassVar[bool] = False

    @property
    def poses(self) -> bool:
        """Whether some of the logs are poses held still."""
        return any(piece.cutoff_hz is None for piece in self.pieces)

    def columns(self, effect: Effect) -> list[np.ndarray]:
        """Return an effect's columns (n, 3, k) of each run; see `Channel.columns`."""
        if not isinstance(effect, DisplacementEffect):
            raise InputError(f"effect {effect.name} does not displace the tool")
        return [piece.passed(effect.tool_columns(piece.motion, piece.jacobian)) for piece in self.pieces]

    def scan(self, effects: Sequence[Effect], ground: Ground, both: np.ndarray) -> np.ndarray | None:
        """Scan thousands of periods on decimated motion, each sample weakened as the low-pass weakens its local frequency."""
        if not getattr(effects[0], "dense", False):
            return None
        found = []
        for start in range(0, len(effects), _CHUNK):
            part = effects[start : start + _CHUNK]
            made = [
                np.concatenate([self._quick(effect, piece, motion) for effect in part], axis=2)
                for piece, motion in zip(self.pieces, self.thinned, strict=True)
            ]
            C = ground.rows(made)
            shape = len(part), C.shape[1] // len(part)
            A = (ground.Q.T @ C).reshape(-1, *shape)
            s, C = (C.T @ both).reshape(*shape, both.shape[1]), C.reshape(-1, *shape)
            G = np.einsum("rgk,rgl->gkl", C, C) - np.einsum("rgk,rgl->gkl", A, A)
            found.append(gains(s, G, np.einsum("rgk,rgk->gk", C, C), one_sided(part[0])))
        return np.concatenate(found)

    @cached_property
    def thinned(self) -> tuple[Motion, ...]:
        """The motions at the regression's rate."""
        found = []
        for p in self.pieces:
            q, v, a, sign = (x[:: p.factor] for x in (p.motion.q, p.motion.v, p.motion.a, p.motion.sign))
            signals = {key: x[:: p.factor] for key, x in p.motion.signals.items()}
            found.append(Motion.of(p.motion.joints, q, v, a, sign, t=p.t, signals=signals))
        return tuple(found)

    def _quick(self, effect: Effect, piece: Piece, motion: Motion) -> np.ndarray:
        assert isinstance(effect, DisplacementEffect)
        columns = effect.tool_columns(motion, piece.jacobian[:: piece.factor])
        if piece.cutoff_hz is None:
            return columns
        f = effect.local_frequency(motion)[:, :1, None]  # type: ignore[attr-defined]
        return columns / (1 + (f / piece.cutoff_hz) ** _ROLL_OFF)

    def variables(self) -> list[Mapping[str, np.ndarray]]:
        """Return positions, speeds (of poses: the way from the one before), accelerations and time of each run."""
        found = []
        for piece in self.pieces:
            q, v, a = (x[:: piece.factor] for x in (piece.motion.q, piece.motion.v, piece.motion.a))
            if piece.cutoff_hz is None:
                v = np.diff(q, axis=0, prepend=q[:1]) / POSE_S
            kinds = zip("qva", (q, v, a), strict=True)
            row = {f"{key}_{j}": x[:, k] for key, x in kinds for k, j in enumerate(piece.motion.joints)}
            found.append(row | {"t": piece.t})
        return found


def tool_channel(model: Model, train: Sequence[Log], held: Sequence[Log] = ()) -> ToolChannel:
    """Build the channel.

    Args:
        model: Gives geometry, and the loads and forces that some effects feel.
        train: Logs with `q_J` of every actuated joint and `x_tool y_tool z_tool`.
        held: Held-out logs.

    Raises:
        InputError: A log has no tool, or the robot file has none.
        CannotAnswer: Too few measurements for three parts.
    """
    stretches = [(piece, out) for logs, out in ((train, False), (held, True)) for log in logs for piece in _cut(log)]
    if not stretches:
        raise InputError("no log was given")
    if model.robot.tool_frame is None:
        raise InputError(f"{model.robot.source}: the robot file has no frame named tool")
    moving = [log for log, _ in stretches if not _held_still(log)]
    preparation = (
        choose_preparation(model.robot, moving, band_factor=BAND_FACTOR, position_factor=POSITION_FACTOR)
        if moving
        else None
    )
    pieces = _aligned([_piece(model, log, preparation) for log, _ in stretches])
    scene = _scene(model, pieces, preparation)
    parameters, columns = _baseline(scene, pieces)
    runs = tuple(_run(piece, W) for piece, W in zip(pieces, columns, strict=True))
    out = [out for _, out in stretches]
    cutoff = preparation.force_cutoff_hz if preparation else None
    gap = 0.0 if cutoff is None else 0.5 * edge_samples(cutoff, moving[0].rate_hz) / moving[0].rate_hz
    parts = tuple(divide(runs, out, any(out), gap))
    causes = tuple(cls for cls in EFFECTS.values() if cls.cause and issubclass(cls, DisplacementEffect))
    causes = tuple(dict.fromkeys((*causes, GuidewayCompliance, CartTilt)))
    units = ("m",) * len(OUTPUTS)
    channel = ToolChannel("tool", OUTPUTS, units, parameters, runs, parts, scene, causes, tuple(pieces))
    for part, what in ((0, "train on"), (1, "confirm on"), (2, "measure the gain on")):
        if sum(int(mask.sum()) for mask in channel.masks(part)) < 3 * len(parameters):
            raise CannotAnswer(
                f"too few tool positions are left to {what}: {sum(len(run.t) for run in runs)} in all",
                "measure a hundred poses or more, spread over the workspace and approached from both directions",
            )
    return channel


def _cut(log: Log) -> list[Log]:
    """Return a log's even stretches, or the log itself where it holds poses."""
    missing = [c for c in OUTPUTS if c not in log.channels]
    if missing:
        raise InputError(f"{log.name} has no column {missing[0]}; the tool channel needs {', '.join(OUTPUTS)} [m]")
    return [log] if _held_still(log) else even_pieces(log)


def _held_still(log: Log) -> bool:
    """Tell whether a log holds poses: sampled too slowly to show motion."""
    return log.rate_hz < SLOWEST_HZ


def _piece(model: Model, log: Log, preparation: Preparation | None) -> Piece:
    joints, mechanism = model.robot.actuated, model.mechanism
    tool = np.column_stack([log.channels[c] for c in OUTPUTS])
    q = log.joint("q", joints)
    if _held_still(log) or preparation is None:
        rest, t, cutoff, factor = np.zeros_like(q), None, None, 1
        v, a = rest, rest
        sign, travel = _approach(q)
        signals, usable = {"reversal": travel}, np.arange(len(q)) > 0
    else:
        t, cutoff, factor = log.t, preparation.force_cutoff_hz, preparation.factor(log.rate_hz)
        q = lowpass(q, preparation.position_cutoff_hz, log.rate_hz)
        v = differentiate(q, log.dt, accuracy=4)
        a = differentiate(v, log.dt, accuracy=4)
        signals = measured_signals(log, joints, q, v, preparation.speed_threshold)
        sign = np.column_stack([_kept(v[:, k], preparation.speed_threshold[k]) for k in range(len(joints))])
        turned = np.any(np.diff(sign, axis=0, prepend=sign[:1]) != 0, axis=1)
        half = int(np.ceil(preparation.window_s * log.rate_hz))
        usable = np.convolve(turned, np.ones(2 * half + 1), mode="same") < 0.5
    signals |= {SENSITIVITY: mechanism.cart_sensitivity(q), SIDE_FORCE: mechanism.guide_force(q, v, a)}
    motion = model.motion(q, v, a, sign, t=t, signals=signals, needs=("force",))
    predicted, jacobian = mechanism.tool_position(q), mechanism.tool_jacobian(q)
    return Piece(log, motion, tool, predicted, jacobian, usable & np.isfinite(tool).all(axis=1), cutoff, factor)


def _approach(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return from which side each pose was approached (N, na), and the way since the last reversal (N, na)."""
    way = np.diff(q, axis=0, prepend=q[:1])
    way = np.where(np.abs(way) > _SAME * np.ptp(q, axis=0), way, 0.0)
    sign, travel = np.zeros_like(q), np.zeros_like(q)
    for k in range(1, len(q)):
        goes = np.sign(way[k])
        sign[k] = np.where(goes == 0, sign[k - 1], goes)  # a joint that stands stays on its side
        onward = np.where((goes == 0) | (goes == sign[k - 1]), travel[k - 1], 0.0)
        travel[k] = onward + np.abs(way[k])
    return sign, travel


def _kept(v: np.ndarray, threshold: float) -> np.ndarray:
    """Return the direction (N,) of the last motion that was surely one; before the first, that of the first."""
    sure = np.flatnonzero(np.abs(v) >= threshold)
    if not len(sure):
        return np.zeros_like(v)
    last = np.searchsorted(sure, np.arange(len(v)), side="right") - 1
    return np.sign(v[sure[np.maximum(last, 0)]])


def _aligned(pieces: Sequence[Piece]) -> list[Piece]:
    """Lay the measuring frame on the robot's, over all pieces at once."""
    measured = np.concatenate([p.tool[p.usable] for p in pieces])
    predicted = np.concatenate([p.predicted[p.usable] for p in pieces])
    if len(measured) < 3:
        raise CannotAnswer("there are fewer than three tool positions", "measure a hundred poses or more")
    m, p = measured.mean(axis=0), predicted.mean(axis=0)
    U, s, Vt = np.linalg.svd((predicted - p).T @ (measured - m))
    turned = s[1] > _LINE * s[0]
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt if turned else np.eye(3)
    return [replace(piece, tool=(piece.tool - m) @ R.T + p) for piece in pieces]


def _baseline(scene: Scene, pieces: Sequence[Piece]) -> tuple[Parameters, list[np.ndarray]]:
    """Return frame and joint zeros that do not depend on each other, and their columns (n, 3, p) of each run."""
    centre = np.concatenate([p.predicted for p in pieces]).mean(axis=0)
    names = [*((f"frame.{x}", "m") for x in "xyz"), *((f"frame.r{x}", "rad") for x in "xyz")]
    names += [(f"{j}.zero", "m" if u == "N" else "rad") for j, u in zip(scene.joints, scene.units, strict=True)]
    found = []
    for piece in pieces:
        arm = piece.predicted - centre
        turns = np.stack([np.cross(axis, arm) for axis in np.eye(3)], axis=2)
        shifts = np.broadcast_to(np.eye(3), turns.shape)
        found.append(piece.passed(np.concatenate([shifts, turns, piece.jacobian], axis=2)))
    rows = np.concatenate([W.reshape(-1, W.shape[2]) for W in found])
    keep, Q = [], np.zeros((len(rows), 0))
    for k, column in enumerate(rows.T):
        left = column - Q @ (Q.T @ column)
        left = left - Q @ (Q.T @ left)
        if np.linalg.norm(left) > _DEPENDENT * max(float(np.linalg.norm(column)), _DEPENDENT):
            keep.append(k)
            Q = np.column_stack([Q, left / np.linalg.norm(left)])
    parameters = Parameters(Parameter(names[k][0], 0.0, names[k][1], origin="baseline") for k in keep)
    return parameters, [W[:, :, keep] for W in found]


def _run(piece: Piece, W: np.ndarray) -> Run:
    y = piece.passed(piece.tool - piece.predicted)
    usable = np.repeat(piece.seen[:, None], len(OUTPUTS), axis=1)
    signals = {"tool": piece.passed(piece.tool), "q": piece.motion.q[:: piece.factor]}
    return Run(piece.log.name, piece.t, W, y, usable, W, y, signals)


def _scene(model: Model, pieces: Sequence[Piece], preparation: Preparation | None) -> Scene:
    q, v = (np.concatenate([getattr(p.motion, key) for p in pieces]) for key in ("q", "v"))
    signals = frozenset.intersection(*(frozenset(p.motion.signals) for p in pieces))
    slow = preparation.speed_threshold if preparation else np.zeros(model.robot.na)
    return Scene(
        model.robot.actuated,
        model.robot.force_units,
        q.min(axis=0),
        q.max(axis=0),
        slow,
        np.quantile(np.abs(v), _FASTEST, axis=0),
        preparation.force_cutoff_hz if preparation else np.inf,
        sum(float(p.t[-1] - p.t[0]) for p in pieces),
        signals | {"tool"},
    )
