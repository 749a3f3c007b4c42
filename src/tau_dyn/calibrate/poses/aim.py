r"""Joint positions at which a camera on the tool sees a stationary pattern.

Positions drawn from the joints' travel look at the pattern by chance alone. So from each position in front of the pattern the
camera is turned to it by Newton's method. With `b` the pattern's middle, `c` the camera, `g` the direction from `c` to `b`, and
`a` the direction in which the camera shall see the pattern, drawn in the picture and turned with the camera, a twist `v, w` of
the camera satisfies

    w x a + (1 - g g') v / |b - c| = g - a.

Each step of the joints also asks for `v = 0`, so that the camera stays in front of the pattern if enough joints turn it.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.poses.camera import ToolCamera
from tau_dyn.calibrate.poses.devices import SEEN, move_joints, transform_to_device
from tau_dyn.calibrate.poses.reachable import MeasurablePoses, Reachable, Safety, find_visible
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.kinematics import Surroundings
from tau_dyn.kinematics.workspace import WorkspaceModel, get_travel

_SMALL = 1e-2  # ratio of singular values below which a direction is left alone
_AIMED = 1e-3  # [rad] at which the iteration ends
_MIDDLE = 0.6  # share of the picture's width and height in which the pattern's middle is drawn
_DRAWS = 3  # directions drawn for each pose in front of the pattern


def turn_camera(
    camera: ToolCamera, geometry: Geometry, q: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint positions (N, na) nearest to those given from which the pattern is seen, and whether it is seen (N,).

    Args:
        camera: The camera on the tool.
        geometry: The mechanism at its nominal parameters.
        q: Start positions (N, na).
        rng: Random generator of the places in the picture.
    """
    theta, n = geometry.parameters.values, len(q)
    pixel = np.array(camera.centre) + _MIDDLE * (rng.random((n, 2)) - 0.5) * np.array(camera.image)
    ray = np.column_stack([(pixel - np.array(camera.centre)) / np.array(camera.focal), np.ones(n)])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)

    def find_gap(q: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found, setup = geometry.forward(theta, q), np.zeros(len(q), int)
        at = camera.frames.measured(found.poses, setup)  # the camera in the pattern's frame
        twist = camera.frames.carried(found.poses, geometry.tool_by_joint(theta, q, found.poses), setup)
        away = np.maximum(np.linalg.norm(at.position, axis=1, keepdims=True), 1e-9)
        g, a = -at.position / away, np.einsum("nij,nj->ni", at.rotation, ray[index])
        across = np.eye(3) - g[:, :, None] * g[:, None]
        shift = twist[:, :3] / away[:, :, None]
        slope = np.concatenate([np.cross(twist[:, 3:], a[:, :, None], axis=1) + across @ shift, shift], axis=1)
        return np.where(found.ok[:, None], np.concatenate([g - a, np.zeros_like(g)], axis=1), np.nan), slope

    return move_joints(q, find_gap, _AIMED, _SMALL)


def find_aimed(
    camera: ToolCamera,
    geometry: Geometry,
    reach: Reachable,
    around: Surroundings,
    machine: WorkspaceModel | None,
    safety: Safety,
    seed: int,
) -> MeasurablePoses:
    """Return joint positions from which a camera on the tool sees the pattern, from those in reach.

    Args:
        camera: The camera on the tool.
        geometry: The mechanism at its nominal parameters.
        reach: Poses from which the search starts.
        around: Obstacles that may block the view.
        machine: The robot, whose own solids may hide the pattern; None leaves them out.
        safety: Margins of the travel.
        seed: Seed of the places in the picture.

    Raises:
        CannotAnswer: The pattern is not seen; the message names the most frequent reason.
    """
    at = transform_to_device(camera.frames, reach.tool).position
    away = np.linalg.norm(at, axis=1)
    before = at[:, 2] > np.cos(camera.incidence) * away
    start = np.flatnonzero(before & (away > camera.distance[0]) & (away < camera.distance[1]))
    why = Counter({"not in front of the pattern": reach.n - len(start)})
    start = np.tile(start, _DRAWS)
    q, ok = turn_camera(camera, geometry, reach.q[start], np.random.default_rng(seed))
    low, high = get_travel(reach.check.machine.robot)
    room = safety.travel * (high - low)
    said = np.where(ok, SEEN, "the camera cannot be turned to it").astype(object)
    left = np.flatnonzero(ok)
    inside = ((q[left] >= low + room) & (q[left] <= high - room)).all(axis=1)
    said[left[~inside]] = "actuator limit"
    left = left[inside]
    said[left] = reach.check.reasons(q[left])
    why.update(said[said != SEEN].tolist())
    good = np.flatnonzero(said == SEEN)
    if not len(good):
        place, (word, count) = ", ".join(f"{x:g}" for x in camera.pose.translation), why.most_common(1)[0]
        raise CannotAnswer(
            "not_visible",
            f"the camera cannot be turned to the pattern at ({place}) m from any of {reach.n} poses (mostly: {word}, {count})",
            "another place for the pattern or for the camera, or wider limits of distance and angle",
        )
    tool = geometry.forward(geometry.parameters.values, q[good]).poses
    visible = find_visible(camera, Reachable(q[good], tool, reach.check, ()), around, machine)
    why.update(visible.reasons)
    index = good[visible.index]
    tool = tool.take(visible.index)
    return MeasurablePoses(q[index], q[index], tool, camera.covariance(tool), start[index], dict(why.most_common()))
