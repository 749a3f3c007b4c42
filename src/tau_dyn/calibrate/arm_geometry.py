r"""An arm whose joints follow laws beside their encoders: `q_real = q + sum of e`, the deflection by gravity last.

The file's masses are known to `BODY_STDERR` only, so `tau = sum_k (1 + m_k) tau_k` over the bodies k that yielding joints carry,
and the base is level within the prior of all angles, as the device's frame takes its tilt `t` up: gravity is `g + t x g`. The
shares `m_k` and `t` are unknowns with these priors; what poses do not tell of them widens intervals of compliances and of poses.

Torques are those of the nominal arm at the joints' positions before they yield. Calibrated placements would make the direction of
a link's centre of mass a parameter: an offset and the next joint's place turn a link in its own frame without moving the tool.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tau_dyn.calibrate.geometry import KNOWN_BEFOREHAND, GeometryDefaults, Predicted
from tau_dyn.calibrate.laws import JointLaw, MovedJoints, move_joints
from tau_dyn.calibrate.loads import GravityLaw, GravityMoments, compute_gravity_moments
from tau_dyn.calibrate.tree_geometry import TreeGeometry
from tau_dyn.mechanism import Poses
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot.robot import BODY_STDERR

_TILTS = ("base.tilt_x", "base.tilt_y", "base.tilt_z")
"""Rotation vector by which gravity is turned in the base frame [rad]; the one along gravity does nothing and is left out."""
_LEVEL = 1e-6
"""Share of gravity across an axis that is rounding."""


class _PlacedArm(NamedTuple):
    own: np.ndarray  # the tree's parameters
    yielding: tuple[tuple[GravityLaw, np.ndarray], ...]  # laws of gravity and their values
    moved: MovedJoints  # by the encoders' laws
    real: np.ndarray  # joints' positions (N, na)
    moments: GravityMoments | None
    gravity: np.ndarray
    weights: np.ndarray  # of the bodies
    torques: np.ndarray  # of all masses and of 1 kg at the tool (N, na, 2)


@dataclass(frozen=True, eq=False)
class ArmGeometry(GeometryDefaults):
    """A tree whose joints follow laws beside their encoders; see `geometry.Geometry` for what each method returns.

    Attributes:
        tree: The tree.
        laws: What its joints do besides.
    """

    tree: TreeGeometry
    laws: tuple[JointLaw | GravityLaw, ...]

    @property
    def parameters(self) -> Parameters:
        """The tree's parameters, then the laws', then by what share masses are off that matter to them, and the base's tilt."""
        return self._parameters

    @cached_property
    def _parameters(self) -> Parameters:
        masses = [
            Parameter(f"{body}.mass_error", 0.0, "1", prior_stderr=BODY_STDERR, origin="law") for body in self._bodies
        ]
        tilts = [Parameter(_TILTS[axis], 0.0, "rad", origin="law") for axis in self._tilts]
        return Parameters([*self.tree.parameters, *(p for law in self.laws for p in law.parameters), *masses, *tilts])

    @cached_property
    def _bodies(self) -> tuple[str, ...]:
        """Joints whose bodies load a joint that yields, each once."""
        return tuple(dict.fromkeys(b for law in self._gravity_laws for b in law.bodies))

    @cached_property
    def _gravity_laws(self) -> tuple[GravityLaw, ...]:
        return tuple(law for law in self.laws if isinstance(law, GravityLaw))

    @property
    def _gravity(self) -> np.ndarray:
        return np.asarray(self.tree.shape.robot.model.gravity.linear)

    @cached_property
    def _tilts(self) -> tuple[int, ...]:
        """Axes about which a tilt of the base turns gravity, where a joint yields to it."""
        across = np.linalg.norm(np.cross(np.eye(3), self._gravity), axis=1)
        return (
            tuple(np.flatnonzero(across > _LEVEL * np.linalg.norm(self._gravity)).tolist())
            if self._gravity_laws
            else ()
        )

    @property
    def actuated(self) -> tuple[str, ...]:
        """Actuated joints."""
        return self.tree.actuated

    @property
    def position_units(self) -> tuple[str, ...]:
        """Units of `q`."""
        return self.tree.position_units

    @property
    def orients(self) -> bool:
        """Whether the tool can turn."""
        return self.tree.orients

    @property
    def priority(self) -> np.ndarray:
        """The tree's, and one more for the laws: what a dimension does as well stays with the dimension (p,)."""
        own, loads = self.tree.priority, len(self._bodies) + len(self._tilts)
        laws = np.full(len(self.parameters) - len(own) - loads, int(own.max(initial=0)) + 1)
        return np.concatenate([own, laws, np.full(loads, KNOWN_BEFOREHAND)])

    def forward(self, theta: np.ndarray, q: np.ndarray, start: Poses | None = None) -> Predicted:
        """Return tool poses."""
        at = self._place(theta, q)
        return self.tree.forward(at.own, at.real, start)

    def tool_by_parameter(self, theta: np.ndarray, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per parameter (N, 6, p)."""
        at = self._place(theta, q)
        slopes, columns = self.tree.tool_by_joint(at.own, at.real), [self.tree.tool_by_parameter(at.own, at.real)]
        through, encoders = slopes @ self._by_position(at), iter(at.moved.columns)
        for law in self.laws:
            if isinstance(law, GravityLaw):
                columns.append(slopes[:, :, [law.actuator]] * law.select(at.torques)[:, None])
            else:
                actuator, own = next(encoders)
                columns.append(through[:, :, [actuator]] * own[:, None])
        return np.concatenate([*columns, slopes @ self._by_load(at)], axis=2)

    def tool_by_joint(self, theta: np.ndarray, q: np.ndarray, poses: Poses | None = None) -> np.ndarray:
        """Return the tool's twist per actuated joint's encoder (N, 6, na)."""
        at = self._place(theta, q)
        return self.tree.tool_by_joint(at.own, at.real) @ self._by_position(at) @ at.moved.by_encoder

    def _place(self, theta: np.ndarray, q: np.ndarray) -> _PlacedArm:
        """Return where the joints really are when their encoders say `q` (N, na)."""
        ends = np.cumsum([len(self.tree.parameters), *(len(law.parameters) for law in self.laws)])
        own, *values, off = np.split(np.asarray(theta, float), ends)
        pairs = [(law, v) for law, v in zip(self.laws, values, strict=True) if not isinstance(law, GravityLaw)]
        moved = move_joints([law for law, _ in pairs], [v for _, v in pairs], q)
        yielding = [(law, v) for law, v in zip(self.laws, values, strict=True) if isinstance(law, GravityLaw)]
        if not yielding:
            return _PlacedArm(own, (), moved, moved.real, None, np.zeros(3), np.zeros((0, 2)), np.zeros((*q.shape, 2)))
        tilt = np.zeros(3)
        tilt[list(self._tilts)] = off[len(self._bodies) :]
        moments, gravity = compute_gravity_moments(self.tree, moved.real), self._gravity + np.cross(tilt, self._gravity)
        weights = moments.weights(dict(zip(self._bodies, off[: len(self._bodies)].tolist(), strict=True)))
        torques, real = moments.torques(gravity, weights), moved.real.copy()
        for law, v in yielding:
            real[:, law.actuator] += law.select(torques) @ v
        return _PlacedArm(own, tuple(yielding), moved, real, moments, gravity, weights, torques)

    def _by_position(self, at: _PlacedArm) -> np.ndarray:
        """Return the derivative of the joints' positions by those before they yield (N, na, na)."""
        out = np.tile(np.eye(at.real.shape[1]), (len(at.real), 1, 1))
        if at.moments is not None:
            slopes = at.moments.slopes(at.gravity, at.weights)
            for law, v in at.yielding:
                out[:, law.actuator] += np.einsum("npa,p->na", law.select(slopes), v)
        return out

    def _by_load(self, at: _PlacedArm) -> np.ndarray:
        """Return the derivative of the joints' positions by what is off in loads (N, na, o): masses, then the tilt."""
        many = len(self._bodies)
        out = np.zeros((*at.real.shape, many + len(self._tilts)))
        if at.moments is None:
            return out
        own = at.moments.torques(at.gravity)[:, :, [at.moments.bodies.index(body) for body in self._bodies]]
        tilted = [at.moments.torques(np.cross(np.eye(3)[axis], self._gravity), at.weights) for axis in self._tilts]
        for law, v in at.yielding:
            if law.sizes[0] > 0:
                out[:, law.actuator, :many] += v[0] * own[:, law.actuator]
            for k, torques in enumerate(tilted):
                out[:, law.actuator, many + k] += law.select(torques) @ v
        return out
