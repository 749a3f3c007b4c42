r"""The tool channel: measured tool positions compared with forward kinematics of measured joint positions.

    R m + p - T(q) = frame + J zero + sum of effects' tool columns + noise

The measuring device's frame is first aligned with the robot's (Kabsch 1976), so that the residual is small; the baseline then
refits that frame (three shifts, three turns) and each joint's zero, as far as they do not depend on each other (three equal
zeros of parallel guideways are a shift). The robot's geometry is taken as calibrated.

Logs sampled in time are low-passed like forces. Static poses, recognised by a sampling too slow to show motion, count one
by one; a joint's direction is that of its travel from the previous pose, on which it is assumed not to reverse.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tau_dyn.diagnose.measured_channel import (
    POSE_S,
    MeasuredChannel,
    MeasuredSegment,
    build_measured_channel,
    build_measured_scene,
    cut_stretches,
    find_directions,
)
from tau_dyn.diagnose.preparation import choose_diagnosis_preparation
from tau_dyn.effects import (
    EFFECTS,
    GUIDE_ACROSS,
    SENSITIVITY,
    SIDE_FORCE,
    DisplacementEffect,
    Effect,
    Motion,
    Scene,
    get_measured_signals,
)
from tau_dyn.evidence import (
    name_by_joint,
)
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify import MIN_RATE_HZ, Preparation
from tau_dyn.log import Log, compute_attenuation, differentiate, lowpass, resample_segments
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters

OUTPUTS = ("x_tool", "y_tool", "z_tool")
_MAX_RESTING_SHARE = 1e-4  # of a joint's range: it has not moved
_STILL = 1e-9
"""Speed [m/s or rad/s] that rounding alone gives a joint at rest without noise."""
_MAX_RELATIVE_DISTANCE = 0.05
"""Distance from forward kinematics divided by the positions' own spread, above which the two do not match."""
_LINE = 1e-6
"""Squared width over squared length of all positions, below which they are on a line and do not determine the turn about it;
the frames then have to agree beforehand."""


@dataclass(frozen=True, eq=False)
class ToolSegment(MeasuredSegment):
    """A stretch with the tool measured, in the robot's frame as far as known; `predicted` is forward kinematics.

    Attributes:
        jacobian: Tool velocity per actuated speed (N, 3, na).
    """

    jacobian: np.ndarray


def cut(log: Log) -> list[Log]:
    """Return a log's even stretches, or the log itself if it holds poses."""
    missing = [c for c in OUTPUTS if c not in log.channels]
    if missing:
        raise InputError(
            "missing_column", f"{log.name} has no column {missing[0]}; the tool channel needs {', '.join(OUTPUTS)} [m]"
        )
    seen = np.all([np.isfinite(log.channels[c]) for c in OUTPUTS], axis=0)
    if is_static(log):
        return [replace(log, t=log.t[seen], channels={key: x[seen] for key, x in log.channels.items()})]
    if not seen.all():
        raise InputError("bad_sample", f"{log.name}: the tool is missing in {np.sum(~seen)} samples; cut the log there")
    return resample_segments(log)


def is_static(log: Log) -> bool:
    """Return whether a log holds poses: sampled too slowly to show motion."""
    return log.rate_hz < MIN_RATE_HZ


def build_tool_segment(model: Model, log: Log, preparation: Preparation | None) -> ToolSegment:
    """Return a stretch with directions of motion, signals for effects and forward kinematics; poses are not low-passed."""
    joints, mechanism = model.robot.actuated, model.mechanism
    tool = np.column_stack([log.channels[c] for c in OUTPUTS])
    q = log.joint("q", joints)
    if is_static(log) or preparation is None:
        rest, t, cutoff, factor = np.zeros_like(q), None, None, 1
        v, a = rest, rest
        sign, travel = _approach(q)
        signals, usable = {"reversal": travel}, np.arange(len(q)) > 0
    else:
        t, cutoff, factor = log.t, preparation.force_cutoff_hz, preparation.factor(log.rate_hz)
        q = lowpass(q, preparation.position_cutoff_hz, log.rate_hz)
        v = differentiate(q, log.dt, accuracy=4)
        a = differentiate(v, log.dt, accuracy=4)
        signals = get_measured_signals(log, joints, q, v, preparation.speed_threshold)
        sign, _ = find_directions(v, np.maximum(preparation.speed_threshold, _STILL))
        turned = np.any(np.diff(sign, axis=0, prepend=sign[:1]) != 0, axis=1)
        half = int(np.ceil(preparation.window_s * log.rate_hz))
        usable = np.convolve(turned, np.ones(2 * half + 1), mode="same") < 0.5
    across = mechanism.guide_across()
    signals |= {
        SENSITIVITY: mechanism.cart_sensitivity(q),
        SIDE_FORCE: mechanism.guide_force(q, v, a),
        GUIDE_ACROSS: np.broadcast_to(across, (len(q), *across.shape)),
    }
    motion = model.motion(q, v, a, sign, t=t, signals=signals, needs=("force", "rigid_force"))
    predicted, jacobian = mechanism.tool_position(q), mechanism.tool_jacobian(q)
    return ToolSegment(log, motion, tool, predicted, usable, cutoff, factor, jacobian)


def _approach(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the direction from which each pose was approached (N, na), and the travel since the last reversal (N, na)."""
    way = np.diff(q, axis=0, prepend=q[:1])
    way = np.where(np.abs(way) > _MAX_RESTING_SHARE * np.ptp(q, axis=0), way, 0.0)
    sign, travel = np.zeros_like(q), np.zeros_like(q)
    for k in range(1, len(q)):
        goes = np.sign(way[k])
        sign[k] = np.where(goes == 0, sign[k - 1], goes)  # a joint at rest stays on its side
        onward = np.where((goes == 0) | (goes == sign[k - 1]), travel[k - 1], 0.0)
        travel[k] = onward + np.abs(way[k])
    return sign, travel


def align_tool_frame(pieces: Sequence[ToolSegment]) -> list[ToolSegment]:
    """Align the measuring frame with the robot's, over all pieces at once."""
    measured = np.concatenate([p.measured[p.usable] for p in pieces])
    predicted = np.concatenate([p.predicted[p.usable] for p in pieces])
    if len(measured) < 3:
        raise CannotAnswer(
            "too_little_data", "there are fewer than three tool positions", "measure a hundred poses or more"
        )
    m, p = measured.mean(axis=0), predicted.mean(axis=0)
    U, s, Vt = np.linalg.svd((predicted - p).T @ (measured - m))
    turned = s[1] > _LINE * s[0]
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt if turned else np.eye(3)
    found = [replace(piece, measured=(piece.measured - m) @ R.T + p) for piece in pieces]
    off, spread = (measured - m) @ R.T - (predicted - p), predicted - p
    if np.linalg.norm(off) > _MAX_RELATIVE_DISTANCE * np.linalg.norm(spread):
        size = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
        raise InputError(
            "wrong_unit",
            f"the measured tool is {size:.2g} m from forward kinematics however the frames are laid; "
            "were all logs measured in one frame, in m, and with this robot?",
        )
    return found


_DEPENDENT = 1e-6  # relative norm of a dependent column due to rounding


@dataclass(frozen=True, eq=False)
class ToolChannel(MeasuredChannel):
    """Tool positions; outputs are the tool's coordinates in the robot's base frame [m].

    Attributes:
        pieces: The stretches.
    """

    has_unnamed_structures = False  # of a tool's axes, which no single joint moves

    pieces: tuple[ToolSegment, ...]

    @property
    def poses(self) -> bool:
        """Whether some of the logs are static poses."""
        return any(piece.cutoff_hz is None for piece in self.pieces)

    def run_columns(self, effect: Effect, run: int) -> np.ndarray:
        """Return an effect's columns (n, 3, k) of one run; see `Channel.run_columns`."""
        if not isinstance(effect, DisplacementEffect):
            raise InputError("unsupported", f"effect {effect.name} does not displace the tool")
        piece = self.pieces[run]
        return piece.passed(effect.tool_columns(piece.motion, piece.jacobian))

    @cached_property
    def thinned(self) -> tuple[tuple[Motion, np.ndarray], ...]:
        """The motions at the regression's rate, and their tool Jacobians (n, 3, na), samples last in memory."""
        found = []
        for p in self.pieces:
            q, v, a, sign = (x[:: p.factor] for x in (p.motion.q, p.motion.v, p.motion.a, p.motion.sign))
            signals = {key: x[:: p.factor] for key, x in p.motion.signals.items()}
            jacobian = np.ascontiguousarray(p.jacobian[:: p.factor].transpose(1, 2, 0)).transpose(2, 0, 1)
            found.append((Motion.of(p.motion.joints, q, v, a, sign, t=p.t, signals=signals), jacobian))
        return tuple(found)

    def quick_columns(self, effect: Effect) -> Sequence[np.ndarray] | None:
        """Return a dense effect's columns on decimated motion, attenuated by the low-pass at each sample's local frequency."""
        if not effect.dense or not isinstance(effect, DisplacementEffect):
            return None
        found = []
        for piece, (motion, jacobian) in zip(self.pieces, self.thinned, strict=True):
            columns = effect.tool_columns(motion, jacobian)
            if piece.cutoff_hz is not None:
                f = effect.local_frequency(motion)[:, :1, None]  # type: ignore[attr-defined]
                columns = columns / compute_attenuation(f, piece.cutoff_hz)
            found.append(columns)
        return found

    def variables(self) -> list[Mapping[str, np.ndarray]]:
        """Return positions, speeds (for poses, the travel from the previous one), accelerations and time of each run."""
        found = []
        for piece in self.pieces:
            q, v, a = (x[:: piece.factor] for x in (piece.motion.q, piece.motion.v, piece.motion.a))
            if piece.cutoff_hz is None:
                v = np.diff(q, axis=0, prepend=q[:1]) / POSE_S
            found.append(name_by_joint(piece.motion.joints, q=q, v=v, a=a) | {"t": piece.t})
        return found


def build_tool_channel(model: Model, train: Sequence[Log], held: Sequence[Log] = ()) -> ToolChannel:
    """Build the channel.

    Args:
        model: Model for the geometry, and for the loads and forces that some effects depend on.
        train: Logs with `q_J` of every actuated joint and `x_tool y_tool z_tool`.
        held: Held-out logs.

    Raises:
        InputError: A log or the robot file has no tool.
        CannotAnswer: Too few measurements for three parts.
    """
    robot = model.robot
    stretches, held_out = cut_stretches(train, held, cut)
    if not stretches:
        raise InputError("missing_input", "no log was given")
    if robot.tool_frame is None:
        raise InputError("unsupported", f"{robot.source}: the robot file has no frame named tool")
    moving = [log for log in stretches if not is_static(log)]
    preparation = choose_diagnosis_preparation(robot, moving, ()) if moving else None
    pieces = align_tool_frame([build_tool_segment(model, log, preparation) for log in stretches])
    slow = preparation.speed_threshold if preparation else np.zeros(robot.na)
    scene = build_measured_scene(robot.actuated, robot.force_units, pieces, slow, "tool")
    displacing = [cls for cls in EFFECTS.values() if cls.cause and issubclass(cls, DisplacementEffect)]
    return build_measured_channel(
        ToolChannel,
        "tool",
        OUTPUTS,
        ("m",) * len(OUTPUTS),
        _baseline(scene, pieces),
        scene,
        [restrict_to_group(group, cls) for cls in displacing for group in cls.groups(scene) or [()]],
        pieces,
        held_out,
        per_parameter=3,
        refusal=(
            "too few tool positions are left",
            f"{sum(len(p.t) for p in pieces)} in all",
            "measure a hundred poses or more, spread over the workspace and approached from both directions",
        ),
    )


def restrict_to_group(group: tuple[str, ...], cls: type[Effect]) -> type[Effect]:
    """Return a cause that is tested on one group of joints only.

    The search adds the statistics of a cause over several joints. Forces show each joint separately; the tool shows their sum,
    so here each joint is a separate cause, and a further joint is found in a further step.
    """

    def groups(_: type[Effect], scene: Scene) -> list[tuple[str, ...]]:
        return [group] if group else []

    return type(cls.__name__, (cls,), {"groups": classmethod(groups), "__doc__": cls.__doc__})


def _baseline(scene: Scene, pieces: Sequence[ToolSegment]) -> tuple[Parameters, list[np.ndarray]]:
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
