"""Interface of a measuring device (visible poses, covariance, simulated measurements), and a laser tracker.

A reflector is seen from within a cone about its axis: about 30 degrees for a corner cube, 75 for a cat's eye, 45 in pitch and yaw
for a target with a measurable orientation (Leica Geosystems 2009). The tracker's noise grows with the distance.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.frames import DeviceFrames, Frame
from tau_dyn.mechanism import Move, NewtonRules, Poses, iterate_newton

SEEN = ""
_STEPS = 40  # of Newton's method; touches need about eight
_MAX_STEP = 0.3  # [m or rad] of a joint; longer ones leave the neighbourhood


class MeasuringDevice(Protocol):
    """A measuring device at an approximately known place, which a fit estimates."""

    @property
    def name(self) -> str:
        """Name in messages."""
        ...

    @property
    def frames(self) -> DeviceFrames:
        """Device and target as far as they are known."""
        ...

    @property
    def turned(self) -> bool:
        """Whether it measures orientations."""
        ...

    @property
    def kind(self) -> str:
        """Kind of measurement, a name of `KINDS`."""
        ...

    def find_places(self, tool: Poses) -> np.ndarray | None:
        """Return its viewpoint (N, 3) [m] in the robot's base frame, None if it sees through everything."""
        ...

    def reasons(self, tool: Poses) -> np.ndarray:
        """Return why it does not see the target at each tool pose (N,), '' if it does; obstacles are not considered."""
        ...

    def marks(self, tool: Poses) -> np.ndarray:
        """Return the points (N, k, 3) [m] that must be in sight."""
        ...

    def covariance(self, tool: Poses) -> np.ndarray:
        """Return the covariance (N, 3, 3) or (N, 6, 6) of position [m] and orientation [rad], in its own axes."""
        ...

    def measure(self, tool: Poses, rng: np.random.Generator) -> Poses:
        """Return simulated measurements of the target at tool poses, in its own frame."""
        ...


@dataclass(frozen=True, eq=False)
class UniformDevice:
    """A device that sees every pose equally well.

    Attributes:
        noise: Standard deviations of positions [m] and, if it measures them, orientations [rad].
        frames: Device and target.
        name: Name in messages.
    """

    noise: tuple[float, ...] = (1e-4,)
    frames: DeviceFrames = field(default_factory=DeviceFrames)
    name: str = "device"

    @property
    def turned(self) -> bool:
        """Whether it measures orientations."""
        return len(self.noise) > 1

    @property
    def kind(self) -> str:
        """Kind of measurement: poses."""
        return "pose"

    def find_places(self, tool: Poses) -> None:
        """Return None: it sees through everything."""

    def reasons(self, tool: Poses) -> np.ndarray:
        """Return '' for every pose."""
        return np.full(len(tool.position), SEEN, dtype=object)

    def marks(self, tool: Poses) -> np.ndarray:
        """Return the target (N, 1, 3)."""
        return transform_to_base(self.frames, tool).position[:, None]

    def covariance(self, tool: Poses) -> np.ndarray:
        """Return one covariance for all (N, m, m)."""
        return np.repeat(np.diag(np.repeat(np.square(self.noise), 3))[None], len(tool.position), axis=0)

    def measure(self, tool: Poses, rng: np.random.Generator) -> Poses:
        """Return the target's pose with noise."""
        return add_noise(transform_to_device(self.frames, tool), self.covariance(tool), rng)


def transform_to_device(frames: DeviceFrames, tool: Poses) -> Poses:
    """Return the target in the device's frame at tool poses in the robot's base frame."""
    return frames.measured(tool, np.zeros(len(tool.position), int))


def transform_to_base(frames: DeviceFrames, tool: Poses) -> Poses:
    """Return the target in the robot's base frame."""
    back = frames.device[0].inverse
    at = transform_to_device(frames, tool)
    return Poses(at.position @ back.rotation.T + back.translation, back.rotation @ at.rotation)


def add_noise(poses: Poses, covariance: np.ndarray, rng: np.random.Generator) -> Poses:
    """Return poses with Gaussian noise; orientations stay where only positions are measured."""
    root = np.linalg.cholesky(covariance)
    error = np.einsum("nij,nj->ni", root, rng.standard_normal(root.shape[:2]))
    if error.shape[1] == 3:
        return Poses(poses.position + error, poses.rotation)
    return Poses(poses.position + error[:, :3], Rotation.from_rotvec(error[:, 3:]).as_matrix() @ poses.rotation)


def move_joints(
    q: np.ndarray,
    find_gap: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    closed: float,
    small: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the joint positions (N, na) nearest to those given at which a gap is closed, and whether it is (N,).

    Args:
        q: Start positions (N, na).
        find_gap: Function of joint positions (k, na) and their indices (k,) that returns the gap (k, m), nan where there is no
            pose, and the derivative (k, m, na) of the quantity that closes it.
        closed: Largest part of a gap that is closed.
        small: Ratio of singular values below which a direction is left alone.
    """
    q = q.copy()

    def advance(index: np.ndarray) -> tuple[np.ndarray, np.ndarray, Move]:
        gap, slope = find_gap(q[index], index)
        step = (np.linalg.pinv(np.nan_to_num(slope), rcond=small) @ np.nan_to_num(gap)[:, :, None])[:, :, 0]
        size = np.where(np.isfinite(gap).all(axis=1), np.abs(step).max(axis=1), np.inf)

        def move(share: np.ndarray) -> None:
            q[index] += share[:, None] * step

        return np.abs(np.nan_to_num(gap, nan=np.inf)).max(axis=1), size, move

    rules = NewtonRules(_STEPS, _STEPS, _MAX_STEP, closed, still=np.inf, done=np.inf)
    return q, iterate_newton(np.ones(len(q), bool), advance, rules)


class StandingDevice(ABC):
    """Base class of stationary devices that see a target on the tool.

    Attributes:
        pose: The device in the robot's base frame.
        on_tool: The target in the tool frame.
    """

    pose: Frame
    on_tool: Frame

    @property
    def kind(self) -> str:
        """Kind of measurement: poses."""
        return "pose"

    @property
    def frames(self) -> DeviceFrames:
        """The base in the device's frame, the target on the tool."""
        return DeviceFrames((self.pose.inverse,), (self.on_tool,))

    def find_places(self, tool: Poses) -> np.ndarray:
        """Return its viewpoint (N, 3) [m]."""
        return np.repeat(self.pose.translation[None], len(tool.position), axis=0)

    def see(self, tool: Poses) -> Poses:
        """Return the target in the device's frame."""
        return transform_to_device(self.frames, tool)

    def reasons(self, tool: Poses) -> np.ndarray:
        """Return why it does not see the target (N,), the first rule that is broken, '' if it sees it."""
        out = np.full(len(tool.position), SEEN, dtype=object)
        for words, broken in self._rules(self.see(tool)):
            out[broken & (out == SEEN)] = words
        return out

    @abstractmethod
    def _rules(self, at: Poses) -> Sequence[tuple[str, np.ndarray]]:
        """Return the rules that target poses in the device's frame may break, in words, and which poses break them (N,)."""


@dataclass(frozen=True, eq=False)
class Tracker(StandingDevice):
    """A stationary laser tracker.

    Attributes:
        pose: The tracker in the robot's base frame, z upwards.
        on_tool: The reflector in the tool frame, z out of it.
        along: Standard deviation of the measured distance [m].
        across: Standard deviation of both angles [rad].
        turn: Standard deviation of orientations [rad], None if the target's orientation is not measured.
        distance: Nearest and farthest distance [m].
        incidence: Half angle of the reflector's cone [rad].
        elevation: Lowest and highest elevation of the beam [rad].
        name: Name in messages.
    """

    pose: Frame
    on_tool: Frame
    along: float = 10e-6
    across: float = 5e-6
    turn: float | None = None
    distance: tuple[float, float] = (0.5, 30.0)
    incidence: float = float(np.deg2rad(30.0))
    elevation: tuple[float, float] = (float(-np.pi / 4), float(np.pi / 4))
    name: str = "tracker"

    @property
    def turned(self) -> bool:
        """Whether the target's orientation is measured."""
        return self.turn is not None

    def _rules(self, at: Poses) -> Sequence[tuple[str, np.ndarray]]:
        away = np.maximum(np.linalg.norm(at.position, axis=1), 1e-9)
        cosine = -np.einsum("ni,ni->n", at.rotation[:, :, 2], at.position) / away
        height = np.arcsin(np.clip(at.position[:, 2] / away, -1, 1))
        return (
            (f"nearer than {self.distance[0]:g} m", away < self.distance[0]),
            (f"farther than {self.distance[1]:g} m", away > self.distance[1]),
            ("reflector turned away", cosine <= 0),
            (f"reflector hit at more than {np.rad2deg(self.incidence):.0f} degrees", cosine < np.cos(self.incidence)),
            ("below the tracker's elevation", height < self.elevation[0]),
            ("above the tracker's elevation", height > self.elevation[1]),
        )

    def marks(self, tool: Poses) -> np.ndarray:
        """Return the reflector (N, 1, 3) [m] in the robot's base frame."""
        return transform_to_base(self.frames, tool).position[:, None]

    def covariance(self, tool: Poses) -> np.ndarray:
        """Return the covariance of its measurements (N, 3, 3) or (N, 6, 6)."""
        at = transform_to_device(self.frames, tool).position
        away = np.linalg.norm(at, axis=1)
        beam = at / np.maximum(away, 1e-9)[:, None]
        outer = beam[:, :, None] * beam[:, None]
        place = self.along**2 * outer + (self.across * away)[:, None, None] ** 2 * (np.eye(3) - outer)
        if self.turn is None:
            return place
        full = np.zeros((len(at), 6, 6))
        full[:, :3, :3], full[:, 3:, 3:] = place, self.turn**2 * np.eye(3)
        return full

    def measure(self, tool: Poses, rng: np.random.Generator) -> Poses:
        """Return the reflector's pose with noise."""
        return add_noise(transform_to_device(self.frames, tool), self.covariance(tool), rng)
