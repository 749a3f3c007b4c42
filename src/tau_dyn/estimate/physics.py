"""What makes inertial parameters physical: each link's pseudo-inertia is positive semidefinite.

    J = [[ 1/2 tr(I) 1 - I,  m c ], [ (m c)',  m ]]  >=  0

with `I` about the joint frame's origin. It holds if and only if some distribution of positive mass has these ten numbers.
Reference: Wensing, Kim & Slotine 2018, Linear matrix inequalities for physically consistent inertial parameter
identification.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_IXX, _IXY, _IYY, _IXZ, _IYZ, _IZZ = range(4, 10)


@dataclass(frozen=True, eq=False)
class InertialBody:
    """One body: which parameters make its ten inertial numbers `pi = map @ parameters`.

    Attributes:
        name: Link name.
        parameters: Names of its parameters (k,).
        map: (10, k).
    """

    name: str
    parameters: tuple[str, ...]
    map: np.ndarray


@dataclass(frozen=True, eq=False)
class PhysicalConstraints:
    """The bodies whose inertial numbers must be those of something that exists.

    Attributes:
        bodies: The bodies.
        rotors: Fixed drive inertias that no data tell from the bodies'. A rotor turns about its joint alone, faster than the
            body that carries it, so its inertia in a body may be more than any mass distribution has.
    """

    bodies: tuple[InertialBody, ...]
    rotors: tuple[str, ...] = ()


def pseudo_inertia(pi: np.ndarray) -> np.ndarray:
    """Return the pseudo-inertia (4, 4) of ten inertial numbers (10,), Pinocchio's order, about the joint origin."""
    return np.tensordot(np.asarray(pi, float), PSEUDO_INERTIA_BASIS, axes=1)


def _basis() -> np.ndarray:
    basis = np.zeros((10, 4, 4))
    basis[0, 3, 3] = 1.0
    for k in range(3):
        basis[1 + k, k, 3] = basis[1 + k, 3, k] = 1.0
    for k, index in enumerate((_IXX, _IYY, _IZZ)):
        basis[index, :3, :3] = np.eye(3) / 2
        basis[index, k, k] -= 1.0
    for (i, j), index in (((0, 1), _IXY), ((0, 2), _IXZ), ((1, 2), _IYZ)):
        basis[index, i, j] = basis[index, j, i] = -1.0
    return basis


PSEUDO_INERTIA_BASIS = _basis()
"""`d J / d pi` (10, 4, 4): the pseudo-inertia is linear in the ten numbers."""
