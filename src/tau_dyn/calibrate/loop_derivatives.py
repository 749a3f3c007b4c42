r"""How a tree's points move with its joints and with its geometric parameters, and how the loops pass both on to the tool.

A parameter of joint j moves all that the joint carries: `origin` shifts it along its parent's axes, a rotation vector
`r` turns it about the joint's origin at `R_j J_r(r) dr` (`J_r`: right Jacobian of the rotation group; Chirikjian 2012).
With loops `c(x_a, x_p, theta) = 0`,

    dx_p = -J_p^+ (dc/dtheta dtheta + J_a dx_a),    tool twist = T_theta dtheta + T_a dx_a + T_p dx_p

(implicit function theorem; thesis (4.14), Khalil & Dombre 2002, ch. 7 and 11). Arrays have components first and samples
last.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.tree_shape import Knob, TreeNumbers, TreeShape
from tau_dyn.mechanism import Frames, compute_cross_product, transform_point


class OpenRates(NamedTuple):
    """Derivatives before the loops pass them on.

    Attributes:
        gap_by_parameter: (3 * loops, p, N).
        gap_by_position: By all joints' positions (3 * loops, nv, N).
        tool_by_parameter: Twist (6, p, N), linear first.
        tool_by_position: Twist (6, nv, N).
        position_by_parameter: Of the actuated joints (na, p, N).
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
        for index in end.carriers:
            joint = numbers.joints[index - 1]
            out[rows, joint.v] += _sign(k) * _swept(numbers, at, index, place)
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
        gain: Of the actuated joints (na,).
    """
    by_active = _samples_first(found.tool_by_position[:, shape.active])
    by_parameter = _samples_first(found.tool_by_parameter)
    moving = _samples_first(found.position_by_parameter)
    if shape.n_loops:
        follows = _samples_first(found.tool_by_position[:, shape.passive]) @ inverse
        by_active = by_active - follows @ _samples_first(found.gap_by_position[:, shape.active])
        by_parameter = by_parameter - follows @ _samples_first(found.gap_by_parameter)
    return by_parameter + by_active @ moving, by_active * gain


def _places(shape: TreeShape, numbers: TreeNumbers, at: Frames) -> list[np.ndarray]:
    return [transform_point(at, end.joint, local) for end, local in zip(shape.ends, numbers.points, strict=True)]


def _sign(end: int) -> float:
    return 1.0 if end % 2 == 0 else -1.0


def _swept(numbers: TreeNumbers, at: Frames, index: int, place: np.ndarray) -> np.ndarray:
    """Return how a point (3, N) moves with a joint's position."""
    axis = at.axis[index]
    return axis if numbers.joints[index - 1].slides else compute_cross_product(axis, place - at.origin[index])


def _tool_by_position(shape: TreeShape, numbers: TreeNumbers, at: Frames, tool: np.ndarray) -> np.ndarray:
    out = np.zeros((6, shape.robot.model.nv, tool.shape[1]))
    for index in shape.tool.carriers:
        joint = numbers.joints[index - 1]
        out[:3, joint.v] = _swept(numbers, at, index, tool)
        if not joint.slides:
            out[3:, joint.v] = at.axis[index]
    return out


def _pushed(
    numbers: TreeNumbers, knob: Knob, at: Frames, x: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray]:
    """Return how a placement's parameter moves what the joint carries: shift (3, N), turn (3, N) and the turn's pivot (3, N)."""
    joint = numbers.joints[knob.at]
    origin = at.origin[joint.index]
    if knob.kind == "origin":
        return _vector(at, joint.parent, knob.direction), None, origin
    if joint.slides:  # the frame's origin slid away from where the joint sits
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
