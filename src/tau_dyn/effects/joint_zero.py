r"""An encoder whose zero differs from the robot file's by an angle or a length.

    q_log = q + joint_zero,     tau_log = rigid body(q_log - joint_zero, v, a) + friction(v)

The force is not linear in the zero, so it is linearised near a setting `about`, as in `timing.py`:

    tau = rigid body(q_log) + joint_zero (rigid body(q_log - about) - rigid body(q_log)) / about

is exact where both agree, and diagnosis fits them as one number. The rigid body's force at displaced positions is a signal: its
change at four shifts of each joint. Between them the law of a tree is interpolated exactly: its force is a trigonometric
polynomial of degree two in a hinge's position, and a polynomial of degree two in a slide's.

Two zeros are not identifiable from forces, and diagnosis lists their joints. No force depends on the position of a first joint
about a vertical axis. The zero of a joint whose links have free first moments and inertias is an exact alias of these: the last
joint's zero is one of its centre of mass. Reference: Khalil & Dombre 2002, 9.4; Hollerbach, Khalil & Gautier 2016, 6.2.
"""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType

import numpy as np

from tau_dyn.effects.effect import build_slide_and_hinge_ranges
from tau_dyn.effects.jointwise import DisplacementEffect, JointParameters
from tau_dyn.effects.motion import Motion, Scene

SHIFTED_FORCE = "shifted_force"
"""Signal (N, na, na, 4) [N or N m]: change of the rigid body's forces at positions that are smaller by each of the shifts, one
joint (third axis) at a time."""

SHIFTS = MappingProxyType({"N": 0.02 * np.array([-2, -1, 1, 2]), "N m": 0.25 * np.array([-2, -1, 1, 2])})
"""Force unit -> shifts of a joint [m or rad]: far from the period of a hinge, and small enough to keep a slide's loops closed."""

MIN_ABOUT = 1e-3
"""Smallest setting `about` that is tried [m or rad]; the law is linear to a thousandth up to it."""


def interpolate_shifts(shift: float, unit: str) -> np.ndarray:
    """Return weights (4,) with which the forces at `SHIFTS` give the force at one shift [m or rad], per unit of it."""
    nodes = SHIFTS[unit]
    if unit == "N":
        basis = np.stack([nodes ** (k + 1) for k in range(4)])
        wanted = np.array([shift**k for k in range(4)])
    else:
        basis = np.stack([np.sin(nodes), 1 - np.cos(nodes), np.sin(2 * nodes), 1 - np.cos(2 * nodes)])
        half = [np.sinc(k * shift / (2 * np.pi)) for k in (1, 2)]  # sin(k z / 2) / (k z / 2)
        one, two = shift / 2 * half[0] ** 2, 2 * shift * half[1] ** 2
        wanted = np.array([np.sinc(shift / np.pi), one, 2 * np.sinc(2 * shift / np.pi), two])
    return np.linalg.solve(basis, wanted)


def compute_shifted_forces(
    force: Callable[[np.ndarray], np.ndarray], q: np.ndarray, joint: int, unit: str
) -> np.ndarray:
    """Return the change (N, ..., 4) of a function of positions (N, na) at the four shifts of one joint."""
    here, found = force(q), []
    for shift in SHIFTS[unit]:
        moved = np.array(q)
        moved[:, joint] -= shift
        found.append(force(moved) - here)
    return np.stack(found, axis=-1)


class JointZero(JointParameters, DisplacementEffect):
    """A constant error of a joint's position."""

    name = "joint_zero"
    cause = True
    equation = "tau_log = tau(q_log - joint_zero), q_log = q + joint_zero"
    reference = "Khalil & Dombre 2002, 9.4; Hollerbach, Khalil & Gautier 2016, 6.2"
    reveals = "slow motion of all joints together with a weighed payload, its mass fixed by --fix; or a tool measured at poses"
    mistaken_for = ("gravity_direction", "link_mass", "payload", "drive_gain")
    # Remounted encoders are off by some mrad, belts jump by teeth of up to 0.2 rad; more is another convention of the angles
    plausible = tuple(build_slide_and_hinge_ranges("joint_zero", "Q", (-0.1, -0.6), (0.1, 0.6)))
    needs = (SHIFTED_FORCE,)
    quantities = (("joint_zero", "Q"),)
    sentence = "the encoder's zero is off: it reads {joint_zero} more than the joint's position in the robot file"
    defaults = {"about": MIN_ABOUT}
    setting_units = {"about": "Q"}
    matched = {"about": "joint_zero"}
    felt_by_all = True

    @property
    def measured(self) -> bool:
        """The encoder's reading is wrong, not the robot's position."""
        return True

    def displacement(self, motion: Motion) -> np.ndarray:
        """Return encoder minus load per unit parameter (N, na, p) [m or rad]."""
        out = np.zeros_like(motion.v, shape=(*motion.v.shape, len(self.joints)))
        for n, k in enumerate(self._indices(motion)):
            out[:, k, n] = 1.0
        return out

    def columns(self, motion: Motion) -> np.ndarray:
        """Return force per unit parameter (N, na, p)."""
        changed, about = motion.signal(SHIFTED_FORCE), self.settings["about"]
        weights = [interpolate_shifts(about, self.units[joint]) for joint in self.joints]
        return np.stack([changed[:, :, k] @ w for k, w in zip(self._indices(motion), weights, strict=True)], axis=2)

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return the zero that fits the whole baseline best and one on each side of it."""
        zero = scene.zeros.get(joints[0], 0.0)
        about = zero if abs(zero) > MIN_ABOUT else MIN_ABOUT
        return [{"about": share * about} for share in (0.75, 1.0, 1.25)]

    @classmethod
    def untestable(cls, scene: Scene) -> tuple[str, str] | None:
        """Return the reason why forces do not show it; if the tool is measured, the baseline refits every zero."""
        missing = cls.needs[0] not in scene.signals
        return ("the logs give no forces of a known robot", cls.reveals) if missing else None

    @classmethod
    def explain_absorbed(cls, joints: tuple[str, ...], is_felt: bool) -> str:
        """Return the reason why the baseline absorbs the zero of these joints: no force depends on it, or bodies replace it."""
        if not is_felt:
            return f"no force depends on the position of {joints[0]}"
        return f"the zero of {joints[0]} is an exact alias of the centre of mass and inertia of the bodies it moves"
