r"""What a loop says, as numbers: the gap between its two points, the gap's Jacobian, and its acceleration at rest.

Pinocchio gives each joint's column of the tree's Jacobian as the spatial motion `(v_o, w)` seen at the world's origin; a point
`p` of a link then moves with `v_o + w x p`, summed over the joints that carry the link. All in world axes, all loops at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from tau_dyn.robot import Loop

_CROSS = np.zeros((3, 3, 3))  # (a x b)_i = _CROSS[i, j, k] a_j b_k
_CROSS[[0, 1, 2], [1, 2, 0], [2, 0, 1]], _CROSS[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = 1.0, -1.0
_WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class Constraints:
    """The loops of one tree: the first half of all points are the loops' ends A, the second half their ends B."""

    def __init__(self, model: pin.Model, data: pin.Data, loops: Sequence[Loop]) -> None:
        """Find where the points sit and which joints carry them."""
        self.model, self.data, self._n = model, data, len(loops)
        self._frames = [*(loop.frame_a for loop in loops), *(loop.frame_b for loop in loops)]
        frames = [model.frames[k] for k in self._frames]
        joints, self._at = np.unique([f.parentJoint for f in frames], return_inverse=True)
        self._joints = joints.tolist()  # Pinocchio's vectors take Python's integers only
        self._local = np.array([[*f.placement.translation, 1.0] for f in frames]).reshape(-1, 4, 1)
        self._carries = np.zeros((len(frames), model.nv))
        for row, frame in zip(self._carries, frames, strict=True):
            for joint in model.supports[frame.parentJoint].tolist()[1:]:
                row[model.joints[joint].idx_v :][: model.joints[joint].nv] = 1.0

    def gap(self, q: np.ndarray) -> np.ndarray:
        """Return `p_A - p_B` of all loops (3 * loops,) [m]."""
        pin.forwardKinematics(self.model, self.data, q)
        return self._difference(self._points()).ravel()

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the gap's derivative (3 * loops, nv)."""
        tree = pin.computeJointJacobians(self.model, self.data, q)
        turned = (self._points() @ _CROSS.reshape(9, 3).T).reshape(-1, 3) @ tree[3:]  # w x p
        rows = (turned.reshape(-1, 3, self.model.nv) + tree[:3]) * self._carries[:, None]
        return self._difference(rows).reshape(-1, self.model.nv)

    def acceleration_at_rest(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the gap's acceleration (3 * loops,) [m/s^2] at velocity `v` (nv,) without joint acceleration."""
        model, data, of = self.model, self.data, pin.getFrameClassicalAcceleration
        pin.forwardKinematics(model, data, q, v, np.zeros(model.nv))
        return self._difference(np.array([of(model, data, k, _WORLD).linear for k in self._frames])).ravel()

    def _points(self) -> np.ndarray:
        oMi = self.data.oMi
        places = np.array([oMi[j].homogeneous for j in self._joints])
        return (places[self._at] @ self._local)[:, :3, 0]

    def _difference(self, x: np.ndarray) -> np.ndarray:
        return x[: self._n] - x[self._n :]
