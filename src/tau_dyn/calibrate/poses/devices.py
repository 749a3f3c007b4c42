"""What a measuring device must be able to say: which poses it sees, how well, and what it would measure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.frames import DeviceFrames
from tau_dyn.mechanism import Poses

SEEN = ""


class MeasuringDevice(Protocol):
    """A measuring device that stands at a known place (about: a fit finds it anew)."""

    @property
    def name(self) -> str:
        """What it is called in messages."""
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
    def place(self) -> np.ndarray | None:
        """Where it looks from (3,) [m] in the robot's base frame, None where it sees through everything."""
        ...

    def reasons(self, tool: Poses) -> np.ndarray:
        """Return why it does not see the target at each tool pose (N,), '' where it does; obstacles apart."""
        ...

    def marks(self, tool: Poses) -> np.ndarray:
        """Return the points (N, k, 3) [m] that must be in sight."""
        ...

    def covariance(self, tool: Poses) -> np.ndarray:
        """Return the covariance (N, 3, 3) or (N, 6, 6) of position [m] and orientation [rad], in its own axes."""
        ...

    def measure(self, tool: Poses, rng: np.random.Generator) -> Poses:
        """Return what it would measure of the target at tool poses, in its own frame."""
        ...


@dataclass(frozen=True, eq=False)
class UniformDevice:
    """A device that sees every pose equally well.

    Attributes:
        noise: Standard deviations of positions [m] and, if it measures them, orientations [rad].
        frames: Device and target.
        name: For messages.
    """

    noise: tuple[float, ...] = (1e-4,)
    frames: DeviceFrames = field(default_factory=DeviceFrames)
    name: str = "device"

    @property
    def turned(self) -> bool:
        """Whether it measures orientations."""
        return len(self.noise) > 1

    @property
    def place(self) -> None:
        """It sees through everything."""
        return

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
