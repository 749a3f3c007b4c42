r"""Logs with a measured tool, made ready for the tool channel: directions of motion, what effects feel, one frame.

Logs sampled in time are low-passed like forces. Poses held still, recognised by a sampling too slow to show motion, count one
by one; a joint's direction is that of its way from the pose before, on which it is taken not to turn back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.diagnose.pieces import find_directions, mask_filter_edges
from tau_dyn.effects import GUIDE_ACROSS, SENSITIVITY, SIDE_FORCE, Motion
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify import MIN_RATE_HZ, Preparation, get_measured_signals
from tau_dyn.log import Log, decimate, differentiate, lowpass, resample_segments
from tau_dyn.model import Model

OUTPUTS = ("x_tool", "y_tool", "z_tool")
POSE_S = 1.0
"""Poses held still count one by one, whatever the time between them: each stands for this long [s]."""
_MAX_RESTING_SHARE = 1e-4  # of a joint's range: it has not moved
_STILL = 1e-9
"""Speed [m/s or rad/s] that rounding alone gives a joint which stands still without any noise."""
_MAX_RELATIVE_DISTANCE = 0.05
"""Distance from forward kinematics over the positions' own spread, above which the two do not belong together."""
_LINE = 1e-6
"""Squared width over squared length of all positions, below which they lie on a line and leave the turn about it open; the
frames then have to agree beforehand."""


@dataclass(frozen=True, eq=False)
class ToolSegment:
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
        if self.cutoff_hz is None:
            return self.usable
        return mask_filter_edges(self.usable, self.cutoff_hz, self.log.rate_hz, self.factor)

    @property
    def t(self) -> np.ndarray:
        """Time of the fit's samples (n,) [s]."""
        return POSE_S * np.arange(len(self.tool)) if self.cutoff_hz is None else decimate(self.log.t, self.factor)


def cut(log: Log) -> list[Log]:
    """Return a log's even stretches, or the log itself where it holds poses."""
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
    """Tell whether a log holds poses: sampled too slowly to show motion."""
    return log.rate_hz < MIN_RATE_HZ


def build_tool_segment(model: Model, log: Log, preparation: Preparation | None) -> ToolSegment:
    """Return a stretch with directions of motion, what effects feel, and forward kinematics; low-passed unless of poses."""
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
    return ToolSegment(log, motion, tool, predicted, jacobian, usable, cutoff, factor)


def _approach(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return from which side each pose was approached (N, na), and the way since the last reversal (N, na)."""
    way = np.diff(q, axis=0, prepend=q[:1])
    way = np.where(np.abs(way) > _MAX_RESTING_SHARE * np.ptp(q, axis=0), way, 0.0)
    sign, travel = np.zeros_like(q), np.zeros_like(q)
    for k in range(1, len(q)):
        goes = np.sign(way[k])
        sign[k] = np.where(goes == 0, sign[k - 1], goes)  # a joint that stands stays on its side
        onward = np.where((goes == 0) | (goes == sign[k - 1]), travel[k - 1], 0.0)
        travel[k] = onward + np.abs(way[k])
    return sign, travel


def align_tool_frame(pieces: Sequence[ToolSegment]) -> list[ToolSegment]:
    """Lay the measuring frame on the robot's, over all pieces at once."""
    measured = np.concatenate([p.tool[p.usable] for p in pieces])
    predicted = np.concatenate([p.predicted[p.usable] for p in pieces])
    if len(measured) < 3:
        raise CannotAnswer(
            "too_little_data", "there are fewer than three tool positions", "measure a hundred poses or more"
        )
    m, p = measured.mean(axis=0), predicted.mean(axis=0)
    U, s, Vt = np.linalg.svd((predicted - p).T @ (measured - m))
    turned = s[1] > _LINE * s[0]
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt if turned else np.eye(3)
    found = [replace(piece, tool=(piece.tool - m) @ R.T + p) for piece in pieces]
    off, spread = (measured - m) @ R.T - (predicted - p), predicted - p
    if np.linalg.norm(off) > _MAX_RELATIVE_DISTANCE * np.linalg.norm(spread):
        size = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
        raise InputError(
            "wrong_unit",
            f"the measured tool is {size:.2g} m from forward kinematics however the frames are laid; "
            "were all logs measured in one frame, in m, and with this robot?",
        )
    return found
