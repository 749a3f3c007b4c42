r"""What a tool touches: a compliant surface with friction, and a hole for a peg.

Both answer with the work's force and torque on the tool as a function of the tool's pose and twist. A contact is a spring
and a damper in series with nothing, `f = max(0, k d + c d')` along the normal: a work never pulls (Hunt & Crossley's
objection to c d' at the first touch concerns impact energy, not a force loop). Stiffness is that of work, tool and sensor in
series. Friction is Coulomb's behind a bristle: a spring along the surface that gives way at mu f (Dahl 1968).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from tau_dyn.exceptions import InputError

_RUB = 2e-3  # [m/s] over which a peg's friction turns its sign


class ContactWorkpiece(Protocol):
    """Something a tool touches."""

    def reset(self) -> None:
        """Forget what friction remembers; nothing where it has no memory."""
        return

    def wrench(self, position: np.ndarray, rotation: np.ndarray, twist: np.ndarray, dt: float) -> np.ndarray:
        """Return force and torque on the tool (6,), world axes at the tool point.

        Args:
            position: Tool point (3,) [m].
            rotation: Tool axes (3, 3).
            twist: Tool twist (6,), linear first [m/s, rad/s].
            dt: Time since the last call [s].
        """
        ...


@dataclass(eq=False)
class CompliantSurface:
    """A plane, or a plane with waves, that gives way.

    Attributes:
        point: A point on it (3,) [m].
        normal: Outward normal of the plane (3,).
        stiffness: [N/m].
        damping: [N s/m].
        friction: Coulomb coefficient; small for a rolling tool.
        bristle: Stiffness along the surface before it slides [N/m].
        wave: Height of its waves along `along` [m].
        wavelength: Their length [m].
        along: Direction of the waves (3,), in the plane.
    """

    point: np.ndarray
    normal: np.ndarray
    stiffness: float
    damping: float = 0.0
    friction: float = 0.0
    bristle: float = 2000.0
    wave: float = 0.0
    wavelength: float = 0.2
    along: np.ndarray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))

    def __post_init__(self) -> None:
        """Refuse what is no surface."""
        _physical(self, ("stiffness", "bristle", "wavelength"), ("damping", "friction"))
        self.normal = np.asarray(self.normal, float) / np.linalg.norm(self.normal)
        along = np.asarray(self.along, float)
        along = along - (along @ self.normal) * self.normal
        self.along = along / np.linalg.norm(along)
        self.reset()

    def reset(self) -> None:
        """Let the bristle go."""
        self._stretch = np.zeros(3)

    def shape(self, position: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the height of the tool over the surface along the true normal [m], and that normal (3,)."""
        offset = position - self.point
        phase = 2 * np.pi / self.wavelength * float(offset @ self.along)
        slope = self.wave * 2 * np.pi / self.wavelength * np.cos(phase)
        normal = (self.normal - slope * self.along) / np.hypot(1.0, slope)
        height = float(offset @ self.normal) - self.wave * np.sin(phase)
        return float(height / np.hypot(1.0, slope)), normal

    def wrench(self, position: np.ndarray, rotation: np.ndarray, twist: np.ndarray, dt: float) -> np.ndarray:
        """See `Work.wrench`; a point contact at the tool point has no torque."""
        height, normal = self.shape(position)
        press = -self.stiffness * height - self.damping * float(normal @ twist[:3])
        out = np.zeros(6)
        if height >= 0 or press <= 0:
            self.reset()
            return out
        out[:3] = press * normal + self._rub(press, normal, twist[:3], dt)
        return out

    def _rub(self, press: float, normal: np.ndarray, speed: np.ndarray, dt: float) -> np.ndarray:
        stretch = self._stretch + dt * speed
        stretch = stretch - (normal @ stretch) * normal
        size, most = np.linalg.norm(stretch), self.friction * press / self.bristle
        self._stretch = stretch * (most / size) if size > most else stretch
        return -self.bristle * self._stretch


@dataclass(eq=False)
class Hole(ContactWorkpiece):
    """A round hole with a chamfer in a block, for a round peg along the tool's z axis that ends `peg` past the tool point.

    Three places may touch: the tip on the block's face or chamfer, the tip on the wall, and the peg's side at the mouth. With
    the tool point at the peg's root each of them turns it, `tau = r x f`; that is how it feels the hole's direction. With
    the tool point at the tip only the mouth would, and a tip pressed against one wall would stay there.

    Attributes:
        mouth: Centre of the hole in the block's face (3,) [m].
        axis: Outward axis of the hole (3,).
        peg: From the tool point to the tip [m].
        clearance: Diameter of hole less diameter of peg [m].
        depth: Of the hole [m].
        chamfer: Its width, at 45 degrees [m].
        stiffness: Along the hole [N/m].
        side_stiffness: Across it; that of a slender peg is its bending [N/m].
        damping: [N s/m], for both.
        friction: Coulomb coefficient.
    """

    mouth: np.ndarray
    axis: np.ndarray
    peg: float = 0.095
    clearance: float = 0.001
    depth: float = 0.03
    chamfer: float = 0.001
    stiffness: float = 20e3
    side_stiffness: float = 1000.0
    damping: float = 5.0
    friction: float = 0.2

    def __post_init__(self) -> None:
        """Refuse what is no hole."""
        _physical(
            self, ("clearance", "depth", "stiffness", "side_stiffness"), ("peg", "damping", "friction", "chamfer")
        )
        self.axis = np.asarray(self.axis, float) / np.linalg.norm(self.axis)

    def inserted(self, position: np.ndarray, rotation: np.ndarray) -> float:
        """Return how deep the tip is in the hole [m]; zero beside it."""
        offset = position + self.peg * rotation[:, 2] - self.mouth
        deep = -float(self.axis @ offset)
        across = np.linalg.norm(offset + deep * self.axis)
        return max(0.0, deep) if across < self.clearance / 2 + self.chamfer + 0.01 else 0.0

    def tilt(self, rotation: np.ndarray) -> float:
        """Return the angle between peg and hole [rad]."""
        return float(np.arccos(np.clip(-rotation[:, 2] @ self.axis, -1, 1)))

    def wrench(self, position: np.ndarray, rotation: np.ndarray, twist: np.ndarray, dt: float) -> np.ndarray:
        """See `Work.wrench`."""
        reach = self.peg * rotation[:, 2]
        offset = position + reach - self.mouth
        deep = -float(self.axis @ offset)
        if deep <= 0:
            return np.zeros(6)
        force = self._at_tip(offset, deep, twist[:3] + compute_cross_product(twist[3:], reach))
        out = np.concatenate([force, compute_cross_product(reach, force)])
        back = -rotation[:, 2]  # from the tip up the peg
        rise = deep - self.chamfer
        if rise > 0 and back @ self.axis > 0.1:
            arm = back * rise / (back @ self.axis)
            force = self._at_wall(offset + arm, twist[:3] + compute_cross_product(twist[3:], reach + arm))
            out += np.concatenate([force, compute_cross_product(reach + arm, force)])
        return out

    def _at_tip(self, offset: np.ndarray, deep: float, speed: np.ndarray) -> np.ndarray:
        """Return the force on the tip: of wall, chamfer or face, whichever it has entered least, and of the bottom."""
        across = offset + deep * self.axis
        radius, room = float(np.linalg.norm(across)), self.clearance / 2
        out = np.zeros(3)
        if deep > self.depth:
            out += self._push(deep - self.depth, self.axis, self.stiffness, speed)
        if radius <= room:
            return out
        inward = -across / radius
        slope = (deep - (room + self.chamfer - radius)) / np.sqrt(2)
        faces = [(deep, self.axis, self.stiffness), (radius - room, inward, self.side_stiffness)]
        faces.append((slope, (inward + self.axis) / np.sqrt(2), self.stiffness))
        into, normal, stiffness = min(faces, key=lambda face: face[0])
        return out + self._push(into, normal, stiffness, speed) if into > 0 else out

    def _at_wall(self, offset: np.ndarray, speed: np.ndarray) -> np.ndarray:
        across = offset - (self.axis @ offset) * self.axis
        radius, room = float(np.linalg.norm(across)), self.clearance / 2
        if radius <= room:
            return np.zeros(3)
        return self._push(radius - room, -across / radius, self.side_stiffness, speed)

    def _push(self, into: float, normal: np.ndarray, stiffness: float, speed: np.ndarray) -> np.ndarray:
        press = max(0.0, stiffness * into - self.damping * float(normal @ speed))
        along = speed - (normal @ speed) * normal
        size = float(np.linalg.norm(along))
        rub = self.friction * press * np.tanh(size / _RUB) * along / size if size > 0 else np.zeros(3)
        return press * normal - rub


def compute_cross_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a x b of two vectors (3,), which is faster than NumPy's for just two."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _physical(work: object, positive: tuple[str, ...], not_negative: tuple[str, ...]) -> None:
    for name in (*positive, *not_negative):
        value = float(getattr(work, name))
        if not np.isfinite(value) or value < 0 or (name in positive and value == 0):
            raise InputError(
                "invalid_value",
                f"{name} of a contact must be a finite number {'above' if name in positive else 'not below'} zero, not {value:g}",
            )
