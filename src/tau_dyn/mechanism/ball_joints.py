"""How far rods lean in their ball joints, on the cart and on the plate.

A joint's axis is the direction, in the frame of the link that holds it, of a rod in the middle of the joint's range; both
axes are given from cart to plate. Where the robot file does not say, it is the rod's direction at home. The file may say

    <tau_dyn:ball_joint rod="rod1" side="cart" axis="1 0 0" angle="0.7"/>

with side cart or plate and the largest angle in rad; axis or angle may be left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from defusedxml.ElementTree import fromstring

from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.mechanism import chains
from tau_dyn.mechanism.legs import Legs
from tau_dyn.mechanism.poses import Poses

SIDES = ("cart", "plate")
DEFAULT_ANGLE = np.deg2rad(45.0)
_TAG = "{urn:tau_dyn}ball_joint"


@dataclass(frozen=True, eq=False)
class BallJoints:
    """The ball joints of a robot's rods.

    Attributes:
        rods: The robot.
        axes: Unit vectors (2, n, 3): of the joints on carts, in the carts' frames, then on the plate, in its frame.
        limits: Largest angles (2, n) [rad]; inf where there is no ball joint.
        given: Whether the file gives the axis (2, n).
    """

    rods: Legs
    axes: np.ndarray
    limits: np.ndarray
    given: np.ndarray

    def angles(self, q: np.ndarray, plate: Poses) -> np.ndarray:
        """Return the angles (N, 2, n) [rad] between rods and joint axes at positions `q` (N, na) and the plate's poses."""
        along = -self.rods.rod_directions(q, plate)
        cart, rotation = _in_carts(self.rods, q, along), np.swapaxes(plate.rotation, 1, 2)
        local = np.stack([cart, np.einsum("nij,nkj->nki", rotation, along)], axis=1)
        return np.arctan2(
            np.linalg.norm(np.cross(self.axes, local), axis=-1), np.einsum("ski,nski->nsk", self.axes, local)
        )


def find_ball_joints(rods: Legs, *, angle: float | None = None) -> BallJoints:
    """Return a robot's ball joints.

    Args:
        rods: The robot.
        angle: Largest angle [rad] of every joint; by default the file's, and 45 degrees where it gives none.

    Raises:
        InputError: A hint of the robot file is at fault.
    """
    home = rods.robot.home[None]
    along = -rods.rod_directions(home, rods.home)
    axes = np.stack([_in_carts(rods, home, along)[0], along[0] @ rods.home.rotation[0]])
    limits, given = np.full((2, rods.n), DEFAULT_ANGLE), np.zeros((2, rods.n), bool)
    for side, k, axis, most in _hints(rods):
        if axis is not None:
            axes[side, k], given[side, k] = axis, True
        if most is not None:
            limits[side, k] = most
    if angle is not None:
        limits[:] = angle
    limits[0, _hinged(rods)] = np.inf
    return BallJoints(rods, axes, limits, given)


def _hinged(rods: Legs) -> np.ndarray:
    """Return which rods are sides of a triangle that turns about one axis on its cart: two that end in one point of the plate."""
    same = np.linalg.norm(rods.on_plate[:, None] - rods.on_plate[None], axis=2) < 1e-9
    stem = np.array([name.rpartition("_")[0] for name in rods.names])
    pair = (stem[:, None] == stem[None]) & (stem != "")[:, None]
    return (same & pair).sum(axis=1) > 1


def _in_carts(rods: Legs, q: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return vectors (N, n, 3) of the world in the frames of the links that carry the rods."""
    at = chains.compute_joint_frames(rods.numbers.joints, q.T)
    out = vectors.copy()
    for k, carrier in enumerate(rods.numbers.carried.carrier):
        if carrier >= 0:
            rotation = np.broadcast_to(np.moveaxis(at[carrier].rotation, 2, 0), (len(q), 3, 3))
            out[:, k] = np.einsum("nji,nj->ni", rotation, vectors[:, k])
    return out


def _hints(rods: Legs) -> list[tuple[int, int, np.ndarray | None, float | None]]:
    where, found = rods.robot.source, []
    for element in fromstring(rods.robot.urdf, forbid_dtd=True).findall(_TAG):
        name, side = element.get("rod", ""), element.get("side", "")
        if name not in rods.names:
            raise UnknownName("rod", name, rods.names, f"{where}: <ball_joint>")
        if side not in SIDES:
            raise InputError(
                "robot_structure", f"{where}: <ball_joint rod='{name}' side='{side}'>: side is cart or plate"
            )
        axis, most = _axis(element.get("axis"), where, name), _angle(element.get("angle"), where, name)
        found.append((SIDES.index(side), rods.names.index(name), axis, most))
    return found


def _axis(text: str | None, where: str, name: str) -> np.ndarray | None:
    if text is None:
        return None
    try:
        axis = np.array([float(word) for word in text.split()])
    except ValueError:
        axis = np.zeros(0)
    size = float(np.linalg.norm(axis))
    if axis.shape != (3,) or not np.isfinite(size) or size < 1e-9:
        raise InputError(
            "robot_structure", f"{where}: <ball_joint rod='{name}' axis='{text}'> must hold three numbers, not all zero"
        )
    return axis / size


def _angle(text: str | None, where: str, name: str) -> float | None:
    if text is None:
        return None
    try:
        angle = float(text)
    except ValueError:
        angle = np.nan
    if not 0 < angle <= np.pi:
        raise InputError(
            "robot_structure", f"{where}: <ball_joint rod='{name}' angle='{text}'> must be between 0 and pi rad"
        )
    return angle
