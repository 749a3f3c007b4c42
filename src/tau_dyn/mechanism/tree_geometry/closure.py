"""Loops of a tree closed at other dimensions than the robot file's, and how the tool moves with dimensions and joints.

A parameter of joint j moves all that the joint carries: `origin` shifts it along its parent's axes, a rotation vector
`r` turns it about the joint's origin at `R_j J_r(r) dr` (`J_r`: right Jacobian of the rotation group; Chirikjian 2012).
With loops `c(x_a, x_p, theta) = 0`,

    dx_p = -J_p^+ (dc/dtheta dtheta + J_a dx_a),    tool twist = T_theta dtheta + T_a dx_a + T_p dx_p

(implicit function theorem; thesis (4.14), Khalil & Dombre 2002, ch. 7 and 11). Arrays have components first and samples
last.

The nominal closure (`mechanism/loop_arrays.py`) gives the assembly mode and the start; Newton steps on the passive
joints do the rest. Two kinds of deficiency belong to a mechanism and not to a configuration: a rod between two ball
joints spins freely, and ball constraints in a planar loop require motions that its joints do not have. So the rank of `J_p` is
that of the nominal robot at home: singular directions beyond it are left alone (the rod does not spin), and only that
part of the gaps is closed which the nominal robot's joints can close at the same `q` (`U' c = 0`, U a basis of the
range of its `J_p`); the rest stays open, as in the clearance of real bearings. `U` does not depend on the parameters,
so derivatives are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import LoopClosureError
from tau_dyn.mechanism import (
    Frames,
    LoopArrays,
    LoopSolver,
    compute_cross_product,
    compute_frames,
    measure_column_lengths,
    transform_point,
    yield_columns,
)
from tau_dyn.mechanism.tree_geometry.dimensions import Knob, TreeNumbers, TreeShape


class OpenRates(NamedTuple):
    """Derivatives before the loops pass them on.

    Attributes:
        gap_by_parameter: Derivative by the parameters (3 * loops, p, N).
        gap_by_position: Derivative by all joints' positions (3 * loops, nv, N).
        tool_by_parameter: Twist (6, p, N), linear first.
        tool_by_position: Twist (6, nv, N).
        position_by_parameter: Positions of the actuated joints (na, p, N).
    """

    gap_by_parameter: np.ndarray
    gap_by_position: np.ndarray
    tool_by_parameter: np.ndarray
    tool_by_position: np.ndarray
    position_by_parameter: np.ndarray


def compute_loop_gaps(shape: TreeShape, numbers: TreeNumbers, at: Frames) -> np.ndarray:
    """Return `p_A - p_B` of all loops (3 * loops, N) [m]."""
    places = _places(shape, numbers, at)
    return np.concatenate([places[k] - places[k + 1] for k in range(0, len(places), 2)])


def compute_gap_by_position(shape: TreeShape, numbers: TreeNumbers, at: Frames) -> np.ndarray:
    """Return the gaps' derivative by all joints' positions (3 * loops, nv, N)."""
    n = at.rotation[0].shape[2]
    out = np.zeros((3 * shape.n_loops, shape.robot.model.nv, n))
    for k, (end, place) in enumerate(zip(shape.ends, _places(shape, numbers, at), strict=True)):
        rows = slice(3 * (k // 2), 3 * (k // 2) + 3)
        for joint, column, _ in yield_columns(at, (numbers.joints[index - 1] for index in end.carriers), place):
            out[rows, joint.v] += _sign(k) * column
    return out


def compute_open_rates(
    shape: TreeShape, numbers: TreeNumbers, knobs: Sequence[Knob], at: Frames, x: np.ndarray, q: np.ndarray
) -> OpenRates:
    """Return all derivatives at closed configurations.

    Args:
        shape: The tree.
        numbers: Its numbers.
        knobs: The parameters.
        at: Frames of its joints.
        x: Positions of its joints (nv, N).
        q: Actuated positions as the encoders show them (na, N).
    """
    n, p = x.shape[1], len(knobs)
    places = _places(shape, numbers, at)
    tool = transform_point(at, shape.tool.joint, numbers.tool)
    by_parameter = np.zeros((3 * shape.n_loops, p, n))
    twist = np.zeros((6, p, n))
    active = np.zeros((len(shape.active), p, n))
    for c, knob in enumerate(knobs):
        if knob.kind in ("gain", "offset"):
            active[knob.at, c] = q[knob.at] if knob.kind == "gain" else 1.0
        elif knob.kind == "tool":
            twist[:3, c] = _vector(at, shape.tool.joint, knob.direction)
        elif knob.kind in ("anchor", "length"):
            rows = slice(3 * (knob.at // 2), 3 * (knob.at // 2) + 3)
            by_parameter[rows, c] = _sign(knob.at) * _vector(at, shape.ends[knob.at].joint, knob.direction)
        else:
            linear, angular, pivot = _pushed(numbers, knob, at, x)
            index = numbers.joints[knob.at].index
            for k, (end, place) in enumerate(zip(shape.ends, places, strict=True)):
                if index in end.carriers:
                    rows = slice(3 * (k // 2), 3 * (k // 2) + 3)
                    by_parameter[rows, c] += _sign(k) * _moved(linear, angular, place - pivot)
            if index in shape.tool.carriers:
                twist[:3, c] = _moved(linear, angular, tool - pivot)
                twist[3:, c] = 0.0 if angular is None else angular
    return OpenRates(
        by_parameter,
        compute_gap_by_position(shape, numbers, at),
        twist,
        _tool_by_position(shape, numbers, at, tool),
        active,
    )


def propagate_twists(
    shape: TreeShape, found: OpenRates, inverse: np.ndarray, gain: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the tool's twist per parameter (N, 6, p) and per encoder's position (N, 6, na), loops closed.

    Args:
        shape: The tree.
        found: Derivatives before the loops.
        inverse: `J_p^+` (N, passive, 3 * loops).
        gain: Gain of the actuated joints (na,).
    """
    by_active = _samples_first(shape.gather(found.tool_by_position))
    by_parameter = _samples_first(found.tool_by_parameter) + by_active @ _samples_first(found.position_by_parameter)
    by_encoder = by_active * gain
    if shape.n_loops:
        by_passive = _samples_first(found.tool_by_position[:, shape.passive])
        own, driven = propagate_passive(shape, found, inverse, gain)
        by_parameter, by_encoder = by_parameter + by_passive @ own, by_encoder + by_passive @ driven
    return by_parameter, by_encoder


def propagate_passive(
    shape: TreeShape, found: OpenRates, inverse: np.ndarray, gain: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return how passive joints move per parameter (N, passive, p) and per encoder's position (N, passive, na), loops closed.

    `dx_p = -J_p^+ (dc/dtheta dtheta + J_a dx_a)`. Arguments are those of `propagate_twists`.
    """
    by_active = _samples_first(shape.gather(found.gap_by_position))
    by_parameter = _samples_first(found.gap_by_parameter) + by_active @ _samples_first(found.position_by_parameter)
    return -inverse @ by_parameter, -inverse @ by_active * gain


def _places(shape: TreeShape, numbers: TreeNumbers, at: Frames) -> list[np.ndarray]:
    return [transform_point(at, end.joint, local) for end, local in zip(shape.ends, numbers.points, strict=True)]


def _sign(end: int) -> float:
    return 1.0 if end % 2 == 0 else -1.0


def _tool_by_position(shape: TreeShape, numbers: TreeNumbers, at: Frames, tool: np.ndarray) -> np.ndarray:
    out = np.zeros((6, shape.robot.model.nv, tool.shape[1]))
    for joint, linear, angular in yield_columns(at, (numbers.joints[index - 1] for index in shape.tool.carriers), tool):
        out[:3, joint.v], out[3:, joint.v] = linear, 0.0 if angular is None else angular
    return out


def _pushed(
    numbers: TreeNumbers, knob: Knob, at: Frames, x: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray]:
    """Return a joint's motion per parameter of its placement: shift (3, N), turn (3, N) and the turn's pivot (3, N)."""
    joint = numbers.joints[knob.at]
    origin = at.origin[joint.index]
    if knob.kind == "origin":
        return _vector(at, joint.parent, knob.direction), None, origin
    if joint.slides:  # the frame's origin has moved away from the joint's placement
        origin = origin - at.axis[joint.index] * x[joint.v]
    turn = _vector(at, joint.parent, joint.rotation @ numbers.turned[knob.at] @ knob.direction)
    return None, turn, origin


def _moved(linear: np.ndarray | None, angular: np.ndarray | None, arm: np.ndarray) -> np.ndarray:
    if linear is not None:
        return linear
    return compute_cross_product(angular, arm) if angular is not None else np.zeros_like(arm)


def _vector(at: Frames, joint: int, local: np.ndarray) -> np.ndarray:
    return np.einsum("ijn,j->in", at.rotation[joint], local)


def _samples_first(x: np.ndarray) -> np.ndarray:
    return np.moveaxis(x, -1, 0)


_MAX_ITERATIONS = 40  # Newton steps to closed loops
_DONE = 1e-12  # [m or rad] Newton's last step
_STEP = 0.3  # [m or rad] longest step at once
_MAX_PASSIVE_MOTION = 0.8
"""[m or rad] largest motion of passive joints from the nominal closure; more is another assembly mode."""
_SINGULAR = 1e-7  # smallest kept singular value relative to the largest, columns scaled to unit length at home
_OPEN = 1e-8  # [m] largest remaining gap of a loop that can close


@dataclass(frozen=True, eq=False)
class ClosedConfigurations:
    """Closed configurations.

    Attributes:
        x: Positions of all joints (nv, N), nan where not `ok`.
        inverse: `(U' J_p)^+ U'` (N, passive, 3 * loops).
        open: Largest gap left [m] (N,); zero but for rounding where the loops are not over-constrained.
        ok: (N,).
        reason: Why not (N,).
    """

    x: np.ndarray
    inverse: np.ndarray
    open: np.ndarray
    ok: np.ndarray
    reason: np.ndarray


class _Nominal(NamedTuple):
    """The robot file's closures: positions (nv, N), reasons for failure (N,), range of `J_p` (N, 3 * loops, rank)."""

    x: np.ndarray
    reason: np.ndarray
    basis: np.ndarray | None


class TreeClosure:
    """Closes one robot's loops. Its cache saves time and changes no result: a closure depends on its own numbers alone."""

    def __init__(self, shape: TreeShape) -> None:
        """Find the rank and scale of the passive Jacobian at the nominal robot's home."""
        self.shape = shape
        self._arrays = LoopArrays(LoopSolver(shape.robot), list(shape.joints))
        self._nominal: dict[bytes, _Nominal] = {}
        self._last: tuple[bytes, ClosedConfigurations] = (b"", ClosedConfigurations(*[np.zeros(0)] * 5))
        self.rank, self.scale = 0, np.ones(len(shape.passive))
        if shape.n_loops:
            J = self._arrays.jacobian(self._arrays.close(shape.robot.home[None]).at)
            self.scale = measure_column_lengths(J)[0]
            s = np.linalg.svd(J[0] / self.scale, compute_uv=False)
            self.rank = int(np.sum(s > 1e-9 * s[0]))

    @property
    def over_constrained(self) -> int:
        """Number of conditions that no motion of the passive joints can meet: one a planar loop, across its plane."""
        return 3 * self.shape.n_loops - self.rank

    def close(self, numbers: TreeNumbers, q: np.ndarray) -> ClosedConfigurations:
        """Return closed configurations at actuated positions `q` (N, na)."""
        n, wanted = len(q), numbers.gain[:, None] * q.T + numbers.offset[:, None]
        if not self.shape.n_loops:
            x = np.zeros((self.shape.robot.model.nv, n))
            self.shape.place(x, wanted)
            return ClosedConfigurations(x, np.zeros((n, 0, 0)), np.zeros(n), np.ones(n, bool), np.full(n, "", object))
        key = q.tobytes() + numbers.key
        if key != self._last[0]:  # derivatives are asked for where the poses just were
            nominal = self._nominal_closure(q)
            start = nominal.x.copy()
            self.shape.place(start, wanted)
            self._last = key, self._newton(numbers, start, nominal)
        return self._last[1]

    def _nominal_closure(self, q: np.ndarray) -> _Nominal:
        key = q.tobytes()
        if key not in self._nominal:
            if len(self._nominal) >= 8:
                self._nominal.pop(next(iter(self._nominal)))
            try:
                x, reason = self._arrays.close(q).x, np.full(len(q), "", object)
            except LoopClosureError:
                x, reason = self._one_by_one(q)
            self._nominal[key] = _Nominal(x, reason, self._range(x) if self.over_constrained else None)
        return self._nominal[key]

    def _range(self, x: np.ndarray) -> np.ndarray:
        """Return the gaps that the nominal joints can close: an orthonormal basis (N, 3 * loops, rank) of the range of `J_p`."""
        J = self._arrays.jacobian(compute_frames(self._arrays.joints, np.where(np.isfinite(x), x, 0.0)))
        return np.linalg.svd(J / self.scale, full_matrices=False)[0][:, :, : self.rank]

    def _one_by_one(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, reason = np.full((self.shape.robot.model.nv, len(q)), np.nan), np.full(len(q), "", object)
        for k in range(len(q)):
            try:
                x[:, k] = self._arrays.close(q[k : k + 1]).x[:, 0]
            except LoopClosureError:
                reason[k] = "out of reach"
        return x, reason

    def _newton(self, numbers: TreeNumbers, start: np.ndarray, nominal: _Nominal) -> ClosedConfigurations:
        shape, n = self.shape, start.shape[1]
        x, reason = start.copy(), nominal.reason.copy()
        inverse = np.full((n, len(shape.passive), 3 * shape.n_loops), np.nan)
        small, opened, unclosed = np.full(n, np.inf), np.full(n, np.nan), np.full(n, np.nan)
        left = np.flatnonzero(reason == "")
        reason[left] = "not converged"
        for _ in range(_MAX_ITERATIONS):
            if not left.size:
                break
            at = compute_frames(numbers.joints, x[:, left])
            gap = compute_loop_gaps(shape, numbers, at)
            opened[left], closable = np.abs(gap).max(axis=0), gap
            J = np.moveaxis(compute_gap_by_position(shape, numbers, at)[:, shape.passive], 2, 0)
            if nominal.basis is None:
                inverse[left], small[left] = self._inverse(J)
            else:
                back = np.swapaxes(nominal.basis[left], 1, 2)
                reduced, small[left] = self._inverse(back @ J)
                inverse[left], closable = reduced @ back, np.einsum("nrc,cn->rn", back, gap)
            unclosed[left] = np.abs(closable).max(axis=0)
            step = -np.einsum("npc,cn->pn", inverse[left], gap)
            size = np.abs(step).max(axis=0)
            x[shape.passive[:, None], left] += step * np.minimum(1.0, _STEP / np.maximum(size, 1e-300))
            reason[left[size < _DONE]] = ""
            left = left[~(size < _DONE) & np.isfinite(size)]
        reason[(reason == "") & (small < _SINGULAR)] = "singular"
        reason[(reason == "") & ~(unclosed < _OPEN)] = "out of reach"
        moved = np.abs(x - nominal.x)[shape.passive].max(axis=0)
        reason[(reason == "") & ~(moved < _MAX_PASSIVE_MOTION)] = "branch change"
        ok = reason == ""
        x[:, ~ok] = np.nan
        return ClosedConfigurations(x, inverse, opened, ok, reason)

    def _inverse(self, J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the inverse of rank `rank` (N, passive, rows), and the smallest kept singular value by the largest (N,)."""
        sound = np.asarray(np.isfinite(J).all(axis=(1, 2)))
        scaled = np.where(sound[:, None, None], J / self.scale, 0.0)
        if self.rank == J.shape[1] == J.shape[2]:
            with np.errstate(all="ignore"):
                try:
                    inverse = np.linalg.inv(scaled)
                    size = np.linalg.norm(scaled, axis=(1, 2)) * np.linalg.norm(inverse, axis=(1, 2))
                    if np.all(size < 1e6):
                        return inverse / self.scale[:, None], 1 / size
                except np.linalg.LinAlgError:
                    pass
        u, s, vt = np.linalg.svd(scaled, full_matrices=False)
        kept = s[:, : self.rank]
        weight = np.divide(1.0, kept, out=np.zeros_like(kept), where=kept > 1e-14)
        out = (vt[:, : self.rank].transpose(0, 2, 1) * weight[:, None]) @ u[:, :, : self.rank].transpose(0, 2, 1)
        smallest = kept[:, -1] / np.maximum(kept[:, 0], 1e-300) if self.rank else np.ones(len(J))
        return out / self.scale[:, None], np.where(sound, smallest, 0.0)
