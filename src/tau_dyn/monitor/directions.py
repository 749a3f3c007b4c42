"""Possible changes of a robot and the forces that each adds: a few directions on which a user would act.

friction         of one joint: the model's Coulomb and viscous friction times 1 + size (without a friction model: N or N m)
payload          a body at the tool, or at the last link's joint: its mass [kg], moments [kg m] and inertia [kg m^2]
encoder_offset   of one joint: the forces of a position error [m or rad]
delay            of all forces [s]
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tau_dyn.diagnose import find_end_link
from tau_dyn.effects import Motion
from tau_dyn.model import Model
from tau_dyn.robot import INERTIAL, LinkInertia

_TYPICAL = {"friction": 0.3, "payload": 0.1, "encoder_offset": 0.02, "delay": 0.005}
"""Typical sizes: share of a joint's friction; of the robot's mass; [m or rad]; [s]. They regularise undetermined directions."""
_FRICTION_SHARE = 0.05  # of a joint's rms force: typical Coulomb friction if the model has no friction
_PAYLOAD_ARM_M = 0.1  # typical distance of a payload's centre from the tool [m]
_OFFSET_STEP = 1e-5  # of an encoder's offset, for a finite difference [m or rad]
_MIN_EFFECT = 1e-6  # force of a typical size, relative to all forces, below which it is not detectable
_LAWS = ("coulomb", "coulomb_pos", "coulomb_neg", "viscous", "viscous_pos", "viscous_neg")


CAUSES = {
    "friction": ("friction_change", 1.0),
    "payload": ("payload", 1.0),
    "payload_moment": ("payload", 1.0),
    "payload_inertia": ("payload", 1.0),
    "encoder_offset": ("joint_zero", -1.0),
    "delay": ("delay", 1.0),
}
"""Name of each kind of change in the catalogue of causes, and the sign of its amplitude there: `joint_zero` is added to logged
positions, `encoder_offset` to the positions at which the forces are."""

_PAYLOAD_PARTS = ("payload_moment", "payload_inertia")
"""Changes that are never reported alone: they belong to the body whose mass is."""


class Direction(NamedTuple):
    """A possible change: its kind, the joint (empty for all), the unit and a typical size."""

    what: str
    joint: str
    unit: str
    typical: float

    @property
    def cause(self) -> str:
        """Its name in the catalogue of causes."""
        return CAUSES[self.what][0]

    @property
    def words(self) -> str:
        """Its name for a person."""
        return f"{self.what.replace('_', ' ')}{f' of {self.joint}' if self.joint else ''}"


def compute_direction_columns(
    model: Model, motion: Motion, forces: np.ndarray, dt: float
) -> tuple[tuple[Direction, ...], np.ndarray]:
    """Return the possible changes, and the change of the forces by one unit of each (N, na, D), along a motion.

    Args:
        model: The model.
        motion: The motion, with the signals that the model's effects need.
        forces: The model's forces along it (N, na) [N or N m].
        dt: Time between samples [s].
    """
    rigid = model.mechanism.inverse_dynamics(motion.q, motion.v, motion.a)
    found = _list_friction(model, motion, forces)
    found += [*_list_payload(model, motion), *_list_offsets(model, motion, rigid)]
    found.append((Direction("delay", "", "s", _TYPICAL["delay"]), -np.gradient(forces, dt, axis=0)))
    return tuple(d for d, _ in found), np.stack([column for _, column in found], axis=2)


def list_felt(directions: Sequence[Direction], columns: np.ndarray, forces: np.ndarray) -> tuple[int, ...]:
    """Return the indices of the directions that affect the forces, from columns (N, na, D) and forces (N, na)."""
    least = _MIN_EFFECT * float(np.sqrt(np.mean(forces**2)))
    sizes = np.sqrt(np.mean(columns**2, axis=(0, 1))) * [d.typical for d in directions]
    return tuple(int(k) for k in np.flatnonzero(sizes > least))


def _list_friction(model: Model, motion: Motion, forces: np.ndarray) -> list[tuple[Direction, np.ndarray]]:
    found, parameters = [], model.effect_parameters
    friction = [e for e in model.effects if all(n.rpartition(".")[2] in (*_LAWS, "offset") for n in e.parameters.names)]
    values = parameters.with_values({n: 0.0 for n in parameters.names if n.rpartition(".")[2] not in _LAWS})
    force = np.zeros_like(forces)
    for effect in friction:
        force += effect.force(motion, values)
    for k, (joint, unit) in enumerate(zip(model.robot.actuated, model.robot.force_units, strict=True)):
        column = np.zeros_like(forces)
        column[:, k] = force[:, k]
        direction = Direction("friction", joint, "1", _TYPICAL["friction"])
        if not column.any():
            column[:, k] = motion.sign[:, k]
            size = _FRICTION_SHARE * float(np.sqrt(np.mean(forces[:, k] ** 2)))
            direction = Direction("friction", joint, unit, size or 1.0)
        found.append((direction, column))
    return found


def _list_payload(model: Model, motion: Motion) -> list[tuple[Direction, np.ndarray]]:
    """Return the forces of a body: of a point mass at the tool, of moments and inertia beyond it; an empty list for several ends.

    If centre and inertia of the link follow its mass, as for a plate that never turns, only the mass changes.
    """
    body = find_end_link(model.robot)
    if body is None or body.own[0] != 0:
        return []
    names = [model.robot.parameters.names.index(name) for name in body.names]
    columns = model.mechanism.regressor(motion.q, motion.v, motion.a)[:, :, names]
    masses = [link.map @ model.robot.parameters.select(link.names).values for link in model.robot.links]
    typical = _TYPICAL["payload"] * float(sum(max(pi[0], 0.0) for pi in masses)) or 1.0
    if len(body.own) < len(INERTIAL):
        return [(Direction("payload", "", "kg", typical), columns[:, :, 0])]
    moment = Direction("payload_moment", "", "kg m", _PAYLOAD_ARM_M * typical)
    inertia = Direction("payload_inertia", "", "kg m^2", _PAYLOAD_ARM_M**2 * typical)
    kinds = [Direction("payload", "", "kg", typical), *[moment] * 3, *[inertia] * 6]
    numbers = np.eye(len(INERTIAL))
    numbers[:, 0] = _describe_point(_find_tool(model, body))
    return list(zip(kinds, np.moveaxis(columns @ numbers, 2, 0), strict=True))


def list_named(directions: Sequence[Direction]) -> list[Direction]:
    """Return the directions that are reported: each change once."""
    return [d for d in directions if d.what not in _PAYLOAD_PARTS]


def group_payload(directions: Sequence[Direction]) -> tuple[int, ...]:
    """Return the indices of the directions of one body at the tool, its mass first; empty if no mass is monitored."""
    mass = [k for k, d in enumerate(directions) if d.what == "payload"]
    parts = [k for k, d in enumerate(directions) if d.what in _PAYLOAD_PARTS]
    return (*mass, *parts) if mass and parts else ()


def _find_tool(model: Model, body: LinkInertia) -> np.ndarray:
    """Return the tool's position in the frame of the link's joint (3,) [m]; the origin if the tool is on another link."""
    tool = model.robot.tool_frame
    if tool is None or int(model.robot.model.frames[tool].parentJoint) != body.joint_id:
        return np.zeros(3)
    return np.array(model.robot.model.frames[tool].placement.translation)


def _describe_point(place: np.ndarray) -> np.ndarray:
    """Return the ten inertial numbers (10,) of one kilogram at a place (3,) [m]."""
    inertia = place @ place * np.eye(3) - np.outer(place, place)
    return np.array([1.0, *place, *inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])


def _list_offsets(model: Model, motion: Motion, rigid: np.ndarray) -> list[tuple[Direction, np.ndarray]]:
    found = []
    for k, (joint, unit) in enumerate(zip(model.robot.actuated, model.robot.position_units, strict=True)):
        moved = motion.q.copy()
        moved[:, k] += _OFFSET_STEP
        there = model.mechanism.inverse_dynamics(moved, motion.v, motion.a)
        direction = Direction("encoder_offset", joint, unit, _TYPICAL["encoder_offset"])
        found.append((direction, (there - rigid) / _OFFSET_STEP))
    return found
