"""Simulated measurements of a robot with known dimensions: for tests, studies and dry runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.frames import DeviceFrames, Frame
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.measured import LOADS, POSITION, QUATERNION, PoseSet
from tau_dyn.mechanism import convert_to_quaternions

TRACKER = DeviceFrames(
    (Frame(Rotation.from_euler("zyx", [137.9, -0.5, 0.4], degrees=True).as_matrix(), np.array([1.8, -4.3, -0.1])),),
    (Frame(Rotation.from_euler("zyx", [30.0, 4.0, -7.0], degrees=True).as_matrix(), np.array([0.02, -0.01, 0.08])),),
)
"""A laser tracker some metres away and a target on the tool, about as in the thesis' table 5.8."""


def simulate_poses(
    geometry: Geometry,
    theta: np.ndarray,
    q: np.ndarray,
    rng: np.random.Generator,
    *,
    frames: DeviceFrames = TRACKER,
    noise: tuple[float, float] = (10e-6, 20e-6),
    turned: bool = True,
    backlash: np.ndarray | None = None,
    campaign: np.ndarray | None = None,
    target: np.ndarray | None = None,
    device: np.ndarray | None = None,
    loads: np.ndarray | None = None,
    source: str = "simulated poses",
) -> PoseSet:
    """Return noisy poses of a robot.

    Args:
        geometry: The robot.
        theta: Its true parameters (p,).
        q: Commanded positions (N, na) [m or rad], in the order of measuring.
        rng: Source of the noise.
        frames: Device and target.
        noise: Standard deviations of position [m] and orientation [rad], each axis.
        turned: Whether the device measures orientation.
        backlash: Backlash of the actuated joints (na,) [m or rad].
        campaign: Campaign of each pose (N,).
        target: Target of each pose (N,); without it the campaign's.
        device: Device of each pose (N,), with its kind and length in `frames`; then there is one campaign. The robot must
            reach a touched fixture at `q`.
        loads: Loads at the tool (N, 7) as in `PoseSet`; no load by default.
        source: Name, for messages.
    """
    campaign = np.zeros(len(q), int) if campaign is None else campaign
    of_target = np.zeros(len(q), int) if target is None else target
    step = np.sign(np.diff(q, axis=0, prepend=q[:1]))
    real = q if backlash is None else q - 0.5 * step * backlash
    loads = np.zeros((len(q), 7)) if loads is None else loads
    found = geometry.under(loads).forward(theta, real)
    first, second = (campaign, campaign) if device is None else (device, np.zeros(len(q), int))
    setup = np.column_stack([first, second if target is None else target])
    seen, keep, kinds = frames.measured(found.poses, setup), found.ok, frames.kinds or ("pose",)
    position = seen.position[keep] + noise[0] * rng.standard_normal((int(keep.sum()), 3))
    which = first[keep] if device is not None else np.zeros(int(keep.sum()), int)
    for k, kind in enumerate(kinds):
        own = which == k
        if kind == "distance":
            away = np.linalg.norm(seen.position[keep][own], axis=1) + noise[0] * rng.standard_normal(int(own.sum()))
            position[own] = np.column_stack([away + frames.lengths[k], np.zeros((len(away), 2))])
        elif kind != "pose":
            position[own] = 0.0
    turn = Rotation.from_rotvec(noise[1] * rng.standard_normal((int(keep.sum()), 3))).as_matrix()
    return PoseSet(
        q=q[keep],
        position=position,
        rotation=turn @ seen.rotation[keep] if turned else None,
        campaign=campaign[keep],
        campaigns=tuple(str(k + 1) for k in range(int(campaign.max(initial=0)) + 1)),
        target=of_target[keep],
        targets=tuple(str(k + 1) for k in range(int(of_target.max(initial=0)) + 1)),
        device=which,
        devices=tuple(str(k + 1) for k in range(len(kinds))),
        kinds=kinds,
        approach=step[keep],
        loads=loads[keep],
        source=source,
    )


def format_csv(poses: PoseSet, actuated: Sequence[str]) -> str:
    """Return poses as a CSV file's text."""
    columns = [f"q_{joint}" for joint in actuated]
    columns += POSITION
    data = [poses.q, poses.position]
    if poses.rotation is not None:
        columns += QUATERNION
        data.append(convert_to_quaternions(poses.poses))
    if poses.approach.any():
        columns += [f"v_{joint}" for joint in actuated]
        data.append(poses.approach)
    if poses.loads.any():
        columns += LOADS
        data.append(poses.loads)
    if len(poses.campaigns) > 1:
        columns.append("campaign")
        data.append(poses.campaign[:, None] + 1)
    if len(poses.targets) > 1:
        columns.append("target")
        data.append(poses.target[:, None] + 1)
    rows = [",".join(f"{x:.9g}" for x in row) for row in np.column_stack(data)]
    return "\n".join([",".join(columns), *rows]) + "\n"
