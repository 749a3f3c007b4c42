"""Forces of rods on the carts of a robot at rest, in all directions: those across a guideway bend it, no drive supports them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tau_dyn.mechanism import Poses, Rods, forward_kinematics


class RodLoads:
    """Loads of the rods of one nominal robot on carts; remembers the last requested positions.

    The plate is in equilibrium, `J_X' f = w`, with `J_X` the gaps' derivative by the plate's twist and `w` the wrench of its
    weight, of half of each rod's weight at its end and of loads at the tool (rods uniform, so the other half rests on the cart
    and never changes). Thesis, end of 5.3.
    """

    def __init__(self, rods: Rods) -> None:
        """Read masses and gravity from the robot."""
        self.rods = rods
        masses = {link.link: link.nominal for link in rods.robot.links}
        plate = masses.get(rods.plate, np.zeros(10))
        self.plate_mass = float(plate[0])
        self.centre = plate[1:4] / plate[0] if plate[0] > 0 else np.zeros(3)
        self.half = np.array([0.5 * _mass(n, rods.names, masses) for n in rods.names])
        self.gravity = rods.robot.model.gravity.linear
        self._remembered: tuple[bytes, np.ndarray] | None = None

    def __call__(self, q: np.ndarray, loads: np.ndarray | None = None) -> np.ndarray:
        """Return the force of the rods on each slide (N, na, 3) [N], zero if the nominal robot cannot reach `q`.

        Args:
            q: Positions (N, na) [m or rad].
            loads: Mass at the tool [kg], force [N] and moment [N m] on it in base axes (N, 7), or None.
        """
        loads = np.zeros((len(q), 7)) if loads is None else loads
        key = q.tobytes() + loads.tobytes()
        if self._remembered is None or self._remembered[0] != key:
            self._remembered = (key, self._force(q, loads))
        return self._remembered[1]

    def _force(self, q: np.ndarray, loads: np.ndarray) -> np.ndarray:
        plate = self.rods.plate_poses(forward_kinematics(self.rods, q).poses)
        out = np.zeros((*q.shape, 3))
        ok = np.asarray(np.isfinite(plate.position).all(axis=1))
        at, where = plate.take(ok), q[ok]
        f, unit = self._axial(where, at, loads[ok]), self.rods.rod_directions(where, at)
        for k, carrier in enumerate(self.rods.numbers.carried.carrier):
            joints = self.rods.numbers.joints
            while carrier >= 0:
                out[ok, joints[carrier].actuator] += -f[:, k, None] * unit[:, k]
                carrier = joints[carrier].parent
        return out

    def _axial(self, q: np.ndarray, plate: Poses, loads: np.ndarray) -> np.ndarray:
        """Return the rods' tensions (N, n) [N]."""
        by_pose = self.rods.gap_by_pose(q, plate)
        wrench = np.zeros((len(q), 6))
        weight = self.gravity * self.plate_mass
        wrench[:, :3] = weight + self.gravity * self.half.sum()
        arms = self.rods.plate_points(plate) - plate.position[:, None]
        wrench[:, 3:] = np.cross(plate.rotation @ self.centre, weight)
        wrench[:, 3:] += np.cross(arms, self.half[:, None] * self.gravity).sum(axis=1)
        force = loads[:, :1] * self.gravity + loads[:, 1:4]  # acts at the tool
        wrench[:, :3] += force
        wrench[:, 3:] += loads[:, 4:] + np.cross(plate.rotation @ self.rods.tool.translation, force)
        rows = 3 if self.rods.translates else 6
        j = np.swapaxes(by_pose[:, :, :rows], 1, 2)  # a rod's pull at the plate is f u = -f d gap / d X
        return np.einsum("nij,nj->ni", np.linalg.pinv(j), wrench[:, :rows])


def _mass(rod: str, rods: Sequence[str], masses: Mapping[str, np.ndarray]) -> float:
    """Return a rod's mass [kg]; a link with several balls is several numbered rods, which share its mass equally."""
    link, number = f"{rod}_link", 1
    stem, _, index = rod.rpartition("_")
    if link not in masses and index.isdigit():
        link, number = f"{stem}_link", sum(other.rpartition("_")[0] == stem for other in rods)
    return float(masses[link][0]) / number if link in masses else 0.0
