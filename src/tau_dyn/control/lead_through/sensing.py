"""Evaluation of the sensors: the force at the tool, the contact state, the surface's normal and the contact's stiffness.

`ForceSensor` converts a reading to the force at the tool point, in world axes, without the weight of the parts on the sensor.

`ContactState` is the contact state c of Dressler 2012, (8.3) and Figure 8.2, with hysteresis. The thesis does not print how c is
found. Here contact begins above one threshold and ends below a lower one after a short wait, so that noise cannot toggle it. It
also ends at once if the hand pulls the tool away with more than the release force (text of 8.4); then it does not begin again
before the tool is clear.

`NormalEstimator` finds the surface's normal from the tool's force: by (8.10) of Dressler 2012, or by a smoother estimate.

(8.10) takes `f / |f|` of the last sample, or the nominal normal if the angle between both exceeds the correction range. Noise of
standard deviation s tilts it by about `s / |f|`, Coulomb friction by `atan(mu)`; both let a share `sin(tilt)` of the hand's
velocity pass the projection (8.8) into the direction of the force loop. So a wider correction range makes an oscillation larger:
the noise then drives a loop with little damping.

The smoother estimate filters f first and removes friction (the component along the velocity *command*; the thesis had only noisy
measured velocities for that, while the command is exact). Beyond the range it stays at the edge instead of jumping back.

`StiffnessWatch` estimates the contact's stiffness. A stated stiffness may be wrong: the thesis' gain, right for cardboard, met a
metal plate. Between samples the force changes by `k` times the motion along the normal, which is known from the joints.
Regression over a few samples,

    k = sum dx df / sum dx^2,   used if sum df^2 is above noise and dx explains at least half of it,

gives k at the first touch. Since only the product of gain and stiffness counts (`stability.py`), the gain is lowered to a share
of the limit if the contact is stiffer than stated, and returns slowly if it is not.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tau_dyn.exceptions import InputError

GRAVITY = np.array([0.0, 0.0, -9.81])
"""Gravity in the world [m/s^2]."""


@dataclass(frozen=True, eq=False)
class ForceSensor:
    """Mounting of a six-axis sensor and the mass on it; by default it reads at the tool point in the tool's axes.

    Attributes:
        position: The sensor's origin in the tool's frame (3,) [m].
        rotation: Its axes in the tool's frame (3, 3).
        mass: Mass carried by the sensor [kg].
        centre: Centre of that mass in the sensor's frame (3,) [m].
        offset: Reading without any load (6,) [N, N m].
        largest_force: Force of one axis at which the sensor saturates [N].
    """

    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    mass: float = 0.0
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    offset: np.ndarray = field(default_factory=lambda: np.zeros(6))
    largest_force: float = np.inf

    def __post_init__(self) -> None:
        """Refuse invalid values."""
        shapes = {"position": (3,), "rotation": (3, 3), "centre": (3,), "offset": (6,)}
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), float)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError("wrong_shape", f"a force sensor's {name} must be {shape} finite numbers")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if np.abs(self.rotation.T @ self.rotation - np.eye(3)).max() > 1e-6 or np.linalg.det(self.rotation) < 0:
            raise InputError("mismatch", "a force sensor's rotation must be a rotation matrix")
        if not (np.isfinite(self.mass) and self.mass >= 0):
            raise InputError(
                "invalid_value", f"the mass on a force sensor must not be below zero, but it is {self.mass}"
            )
        if not self.largest_force > 0:
            raise InputError(
                "invalid_value", f"a force sensor's largest force must be above zero, but it is {self.largest_force}"
            )

    def to_numbers(self) -> np.ndarray:
        """Return position, axes by rows, weight in the world, centre and offset (24,)."""
        weight = self.mass * GRAVITY
        return np.concatenate([self.position, self.rotation.ravel(), weight, self.centre, self.offset])

    def at_tool(self, reading: np.ndarray, tool_rotation: np.ndarray) -> np.ndarray:
        """Return the wrench (6,) at the tool point in world axes, without the weight.

        Args:
            reading: Force and torque on the mass at the sensor (6,) [N, N m], in the sensor's axes at its origin.
            tool_rotation: The tool's axes in the world (3, 3).
        """
        turn = tool_rotation @ self.rotation
        force, torque = turn @ (reading[:3] - self.offset[:3]), turn @ (reading[3:] - self.offset[3:])
        weight = self.mass * GRAVITY
        force, torque = force - weight, torque - _cross(turn @ self.centre, weight)
        return np.concatenate([force, torque + _cross(tool_rotation @ self.position, force)])

    def reading(self, wrench: np.ndarray, tool_rotation: np.ndarray) -> np.ndarray:
        """Return the sensor's reading (6,) for a wrench (6,) at the tool point in world axes: the inverse of `at_tool`."""
        turn = tool_rotation @ self.rotation
        weight = self.mass * GRAVITY
        torque = wrench[3:] - _cross(tool_rotation @ self.position, wrench[:3]) + _cross(turn @ self.centre, weight)
        return np.concatenate([turn.T @ (wrench[:3] + weight), turn.T @ torque]) + self.offset


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


class ContactState:
    """Follows the contact, sample by sample."""

    def __init__(self, begin: float, end: float, release: float, wait: int) -> None:
        """Keep thresholds.

        Args:
            begin: Load at which contact begins, as a share of the caller's scale.
            end: Load below which it ends.
            release: The hand's pull along the normal that ends it at once [N].
            wait: Samples below `end` before it ends.
        """
        self._begin, self._end, self._release, self._wait = begin, end, release, wait
        self._quiet, self._released = 0, False
        self.touching = False

    def update(self, load: float, pull: float) -> bool:
        """Return whether the tool touches, from the load on the tool and the hand's pull along the normal [N]."""
        self._quiet = self._quiet + 1 if load < self._end else 0
        self._released = self._released and self._quiet < self._wait
        if self.touching:
            self._released = pull > self._release
            self.touching = not self._released and self._quiet < self._wait
        else:
            self.touching = load > self._begin and not self._released
        return self.touching


SLOW_M_S = 2e-3  # [m/s] below which the command gives friction no direction
WEAK_N = 1e-9  # [N]


class NormalEstimator:
    """Estimates the unit normal, from the work towards the tool."""

    def __init__(self, nominal: np.ndarray, reach: float, smoothing: float, calm: bool, least_force: float) -> None:
        """Start at the nominal normal.

        Args:
            nominal: Nominal unit normal (3,).
            reach: Correction range [rad].
            smoothing: Share of a new sample in the smoothed force, up to 1.
            calm: Whether friction is taken out and the range's edge held; else (8.10) as printed.
            least_force: Force below which a calm estimate keeps the last normal [N].
        """
        self.nominal, self.normal = nominal, nominal
        self._reach, self._smoothing, self._calm, self._least = reach, smoothing, calm, least_force
        self._force, self._along = np.zeros(3), np.zeros(3)

    def update(self, force: np.ndarray, command: np.ndarray) -> np.ndarray:
        """Return the normal (3,) from the work's force on the tool (3,) [N] and the last linear command (3,) [m/s]."""
        if not self._calm:
            self.normal = self._printed(force)
            return self.normal
        self._force = self._force + self._smoothing * (force - self._force)
        self._along = self._along + self._smoothing * (command - self._along)
        if np.linalg.norm(self._force) >= self._least:
            self.normal = self._within(self._without_friction())
        return self.normal

    def reset(self) -> None:
        """Forget the force; the next contact starts from the nominal normal."""
        self.normal = self.nominal
        self._force, self._along = np.zeros(3), np.zeros(3)

    def _printed(self, force: np.ndarray) -> np.ndarray:
        size = np.linalg.norm(force)
        if size < WEAK_N:
            return self.nominal
        estimate = force / size
        return estimate if self.nominal @ estimate > np.cos(self._reach) else self.nominal

    def _without_friction(self) -> np.ndarray:
        speed = np.linalg.norm(self._along)
        along = self._along / speed if speed > SLOW_M_S else np.zeros(3)
        return self._force - (along @ self._force) * along

    def _within(self, force: np.ndarray) -> np.ndarray:
        """Return the direction of a force; outside the range it is turned back to the edge."""
        across = force - (self.nominal @ force) * self.nominal
        tilt = np.arctan2(np.linalg.norm(across), self.nominal @ force)
        if tilt < 1e-9:
            return self.nominal
        tilt_kept = min(tilt, self._reach)
        return np.cos(tilt_kept) * self.nominal + np.sin(tilt_kept) * across / np.linalg.norm(across)


STIFFNESS_SAMPLES = 6  # memory of the regression
COHERENT = 0.5  # least squared coherence of force and motion for an estimate of the stiffness
_BACK = 5.0  # [s] in which the estimate falls back


class StiffnessWatch:
    """Follows the stiffness along the normal."""

    def __init__(self, least_force: float, sample_time: float) -> None:
        """Start without an estimate.

        Args:
            least_force: Changes of force (root of the sum of squares) below which only noise is present [N].
            sample_time: Time between samples [s].
        """
        self._least, self.fade = least_force, float(np.exp(-sample_time / _BACK))
        self._sums, self._last = np.zeros(3), None
        self.stiffness = 0.0

    def reset(self) -> None:
        """Leave the contact; the stiffness stays known."""
        self._sums, self._last = np.zeros(3), None

    def update(self, force: float, place: float) -> float:
        """Return the stiffness [N/m], 0 while unknown, from the force along the normal [N] and the position into the work [m]."""
        self.stiffness *= self.fade
        if self._last is not None:
            df, dx = force - self._last[0], place - self._last[1]
            self._sums = (1 - 1 / STIFFNESS_SAMPLES) * self._sums + [df * df, df * dx, dx * dx]
            ff, fx, xx = map(float, self._sums)
            if ff > self._least**2 and fx > 0 and fx * fx > COHERENT * ff * xx:
                self.stiffness = max(self.stiffness, fx / xx)
        self._last = (force, place)
        return self.stiffness
