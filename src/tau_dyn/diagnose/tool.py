r"""The tool channel: measured tool positions against forward kinematics of measured joint positions.

    R m + p - T(q) = frame + J zero + sum of effects' tool columns + noise

The measuring device's frame is first laid on the robot's (Kabsch 1976), so that the rest is small; the baseline then refits
that frame (three shifts, three turns) and each joint's zero, as far as they do not depend on each other (three equal zeros
of parallel guideways are a shift). The robot's geometry is taken as calibrated. `tool_pieces.py` prepares the logs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tau_dyn.diagnose.channel import Channel, refuse_scarce
from tau_dyn.diagnose.data_split import split_by_blocks
from tau_dyn.diagnose.filters import choose_diagnosis_preparation, compute_border_gap_s
from tau_dyn.diagnose.scenes import build_scene, find_shared_signals
from tau_dyn.diagnose.tool_pieces import (
    OUTPUTS,
    POSE_S,
    ToolSegment,
    align_tool_frame,
    build_tool_segment,
    cut,
    is_static,
)
from tau_dyn.effects import EFFECTS, DisplacementEffect, Effect, Motion, Scene
from tau_dyn.estimate import RegressionRun
from tau_dyn.exceptions import InputError
from tau_dyn.identify import Preparation
from tau_dyn.log import Log, compute_attenuation
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters

_DEPENDENT = 1e-6  # relative norm that is left of a dependent column by rounding


@dataclass(frozen=True, eq=False)
class ToolChannel(Channel):
    """Tool positions; outputs are the tool's coordinates in the robot's base frame [m].

    Attributes:
        pieces: The stretches.
    """

    has_unnamed_structures = False  # of a tool's axes, which no single joint moves

    pieces: tuple[ToolSegment, ...]

    @property
    def poses(self) -> bool:
        """Whether some of the logs are poses held still."""
        return any(piece.cutoff_hz is None for piece in self.pieces)

    def run_columns(self, effect: Effect, run: int) -> np.ndarray:
        """Return an effect's columns (n, 3, k) of one run; see `Channel.run_columns`."""
        if not isinstance(effect, DisplacementEffect):
            raise InputError("unsupported", f"effect {effect.name} does not displace the tool")
        piece = self.pieces[run]
        return piece.passed(effect.tool_columns(piece.motion, piece.jacobian))

    @cached_property
    def thinned(self) -> tuple[Motion, ...]:
        """The motions at the regression's rate."""
        found = []
        for p in self.pieces:
            q, v, a, sign = (x[:: p.factor] for x in (p.motion.q, p.motion.v, p.motion.a, p.motion.sign))
            signals = {key: x[:: p.factor] for key, x in p.motion.signals.items()}
            found.append(Motion.of(p.motion.joints, q, v, a, sign, t=p.t, signals=signals))
        return tuple(found)

    def quick_columns(self, effect: Effect) -> Sequence[np.ndarray] | None:
        """Return a dense effect's columns on decimated motion, weakened as the low-pass weakens each sample's local frequency."""
        if not effect.dense or not isinstance(effect, DisplacementEffect):
            return None
        found = []
        for piece, motion in zip(self.pieces, self.thinned, strict=True):
            columns = effect.tool_columns(motion, piece.jacobian[:: piece.factor])
            if piece.cutoff_hz is not None:
                f = effect.local_frequency(motion)[:, :1, None]  # type: ignore[attr-defined]
                columns = columns / compute_attenuation(f, piece.cutoff_hz)
            found.append(columns)
        return found

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


def build_tool_channel(model: Model, train: Sequence[Log], held: Sequence[Log] = ()) -> ToolChannel:
    """Build the channel.

    Args:
        model: Gives geometry, and the loads and forces that some effects feel.
        train: Logs with `q_J` of every actuated joint and `x_tool y_tool z_tool`.
        held: Held-out logs.

    Raises:
        InputError: A log has no tool, or the robot file has none.
        CannotAnswer: Too few measurements for three parts.
    """
    stretches = [(piece, out) for logs, out in ((train, False), (held, True)) for log in logs for piece in cut(log)]
    if not stretches:
        raise InputError("missing_input", "no log was given")
    if model.robot.tool_frame is None:
        raise InputError("unsupported", f"{model.robot.source}: the robot file has no frame named tool")
    moving = [log for log, _ in stretches if not is_static(log)]
    preparation = choose_diagnosis_preparation(model.robot, moving, ()) if moving else None
    pieces = align_tool_frame([build_tool_segment(model, log, preparation) for log, _ in stretches])
    scene = _scene(model, pieces, preparation)
    parameters, columns = _baseline(scene, pieces)
    runs = tuple(_run(piece, W) for piece, W in zip(pieces, columns, strict=True))
    out = [out for _, out in stretches]
    gap = compute_border_gap_s(preparation.force_cutoff_hz, moving[0].rate_hz) if preparation else 0.0
    parts = tuple(split_by_blocks(runs, out, any(out), gap))
    displacing = [cls for cls in EFFECTS.values() if cls.cause and issubclass(cls, DisplacementEffect)]
    causes = tuple(restrict_to_group(group, cls) for cls in displacing for group in cls.groups(scene) or [()])
    units = ("m",) * len(OUTPUTS)
    channel = ToolChannel("tool", OUTPUTS, units, parameters, runs, parts, scene, causes, tuple(pieces))
    refuse_scarce(
        channel,
        3 * len(parameters),
        "too few tool positions are left",
        f"{sum(len(run.t) for run in runs)} in all",
        "measure a hundred poses or more, spread over the workspace and approached from both directions",
    )
    return channel


def restrict_to_group(group: tuple[str, ...], cls: type[Effect]) -> type[Effect]:
    """Return a cause that is tried on one group of joints only.

    The search adds up what a cause explains on several joints. Forces show each joint apart; the tool shows their sum, so here
    each joint counts as a cause of its own, and a further joint is found in a further round.
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


def _run(piece: ToolSegment, W: np.ndarray) -> RegressionRun:
    y = piece.passed(piece.tool - piece.predicted)
    usable = np.repeat(piece.seen[:, None], len(OUTPUTS), axis=1)
    signals = {"tool": piece.passed(piece.tool), "q": piece.motion.q[:: piece.factor]}
    return RegressionRun(piece.log.name, piece.t, W, y, usable, W, y, signals)


def _scene(model: Model, pieces: Sequence[ToolSegment], preparation: Preparation | None) -> Scene:
    motions = [p.motion for p in pieces]
    return build_scene(
        motions,
        model.robot.actuated,
        model.robot.force_units,
        slow=preparation.speed_threshold if preparation else np.zeros(model.robot.na),
        cutoff_hz=preparation.force_cutoff_hz if preparation else np.inf,
        duration=sum(float(p.t[-1] - p.t[0]) for p in pieces),
        signals=find_shared_signals(motions) | {"tool"},
    )
