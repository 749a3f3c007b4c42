r"""Commanded coordinates: which of a tool's six coordinates a mechanism lets one choose, and how a pose gives them.

The twists that the actuators give the tool at home span a space of r dimensions. Its r coordinates are chosen one by one
where the space reaches furthest, positions before rotations, the tool's place taken where a turn moves it least (on a plate,
the middle of its joints): six for a 6R arm, three positions for a plate that translates, three positions and a turn for a
SCARA, height and two tilts for a 3-PRS. Rotations are the components of the rotation vector after home's orientation, in
world axes. Reference: Merlet 2006, ch. 2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.mechanism.plate_arrays import log_of
from tau_dyn.mechanism.poses import Poses

_NAMES = ("x", "y", "z", "rx", "ry", "rz")
_RANK = 1e-6  # singular values relative to the largest; less moves nothing
_REACHES = 0.3  # share of a position that a space of twists must hold for it to be commanded before any rotation


@dataclass(frozen=True, eq=False)
class CommandedCoordinates:
    """What one commands of a tool.

    Attributes:
        index: Which of x, y, z, rx, ry, rz (k,).
        home: The tool's pose at home (1 sample), whose other coordinates stand where none are commanded.
    """

    index: tuple[int, ...]
    home: Poses

    @property
    def names(self) -> tuple[str, ...]:
        """Names: `x y z` and `rx ry rz`."""
        return tuple(_NAMES[k] for k in self.index)

    @property
    def units(self) -> tuple[str, ...]:
        """'m' or 'rad' each."""
        return tuple("m" if k < 3 else "rad" for k in self.index)

    @property
    def by_position(self) -> bool:
        """Whether all positions that the tool can be brought to are commanded: no turn stands for one."""
        return {0, 1, 2} <= set(self.index) or not any(k > 2 for k in self.index)

    def of(self, poses: Poses) -> np.ndarray:
        """Return the commanded coordinates (N, k) [m or rad] of tool poses."""
        turn = log_of(np.moveaxis(poses.rotation @ self.home.rotation[0].T, 0, 2)).T
        return np.concatenate([poses.position, turn], axis=1)[:, list(self.index)]

    def to_poses(self, values: np.ndarray) -> Poses:
        """Return tool poses with these coordinates (N, k); what is not commanded is home's."""
        values = np.atleast_2d(np.asarray(values, float))
        all_six = np.zeros((len(values), 6))
        all_six[:, :3] = self.home.position
        all_six[:, list(self.index)] = values
        turned = Rotation.from_rotvec(all_six[:, 3:]).as_matrix() @ self.home.rotation[0]
        return Poses(all_six[:, :3], turned)


def choose_commanded(twists: np.ndarray, home: Poses, length: float) -> CommandedCoordinates:
    """Choose coordinates at home.

    Args:
        twists: Per actuated speed (6, na), linear first, of the point whose place tells turns from shifts.
        home: The tool's pose (1 sample).
        length: What a turn counts [m] beside a shift.
    """
    scaled = twists * np.array([1.0, 1.0, 1.0, length, length, length])[:, None]
    u, s, _ = np.linalg.svd(scaled, full_matrices=False)
    left = u[:, : int(np.sum(s > _RANK * s[0]))]
    chosen: list[int] = []
    for _ in range(left.shape[1]):
        reach = np.linalg.norm(left, axis=1)
        k = int(np.argmax(np.round(reach[:3], 6)))
        if reach[k] < _REACHES:
            k = int(np.argmax(np.round(reach, 6)))
        chosen.append(k)
        way = left[k] / reach[k]
        left = left - np.outer(left @ way, way)
    return CommandedCoordinates(tuple(sorted(chosen)), home)
