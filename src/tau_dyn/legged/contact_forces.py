"""Forces of the ground that were measured: they enter the equations as measurements, so their feet need no elimination.

    M a + h = tau + J' f,   f of a foot in columns force_FOOT_x, force_FOOT_y, force_FOOT_z [N]

`f` acts on the foot at its contact point, in axes of the world, z up: a robot at rest adds up to its weight along z. The right
side takes the place of the measured forces, those of the base included, and the foot counts as in the air. Feet without these
columns are eliminated as always (`contacts.py`). Then the total mass follows from the force sensors, and torques and forces
determine the legs' bodies by all equations.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.legged.contacts import compute_contact_jacobian
from tau_dyn.log import Log
from tau_dyn.robot import FLAT, ContactFrame, Robot

MIN_UPRIGHT_SHARE = 0.5
"""Least mean force along z over its size and over the nominal weight; in other axes, or with another sign, it is less."""


def name_contact_forces(contact: ContactFrame) -> tuple[str, str, str]:
    """Return the columns of a foot's force."""
    x, y, z = (f"force_{contact.frame}_{axis}" for axis in "xyz")
    return x, y, z


def is_contact_force_measured(contact: ContactFrame, log: Log) -> bool:
    """Return whether a log has a foot's force."""
    return all(name in log.channels for name in name_contact_forces(contact))


def add_contact_forces(robot: Robot, log: Log) -> Log:
    """Return a log in which measured forces of feet are added to those of the coordinates, and these feet are in the air.

    Args:
        robot: The robot, with a floating base.
        log: A log with positions and forces of all coordinates.

    Raises:
        InputError: A foot has some of its three columns, a sample that is no number, or is flat; or forces do not carry the
            robot.
    """
    forces = np.zeros((log.n_samples, len(robot.contacts), 3))
    measured = np.zeros(len(robot.contacts), bool)
    for k, contact in enumerate(robot.contacts):
        names = name_contact_forces(contact)
        there = [name for name in names if name in log.channels]
        if not there:
            continue
        if len(there) < 3:
            missing = next(name for name in names if name not in there)
            raise InputError("missing_column", f"{log.name} has {there[0]} and no {missing}")
        if contact.kind == FLAT:
            raise InputError(
                "unsupported",
                f"{log.name}: {there[0]} is of a flat foot, whose moment is not read; leave its force out, or name it as a point",
            )
        forces[:, k] = np.column_stack([log.channels[name] for name in names])
        measured[k] = True
    if not measured.any():
        return log
    if not np.isfinite(forces).all():
        raise InputError("bad_sample", f"{log.name}: a force of a foot is no finite number")
    if measured.all():
        _require_upright(robot, log, forces)
    return _with_forces(robot, log, forces, measured)


def _with_forces(robot: Robot, log: Log, forces: np.ndarray, measured: np.ndarray) -> Log:
    """Return a log with the forces (N, k, 3) of the measured feet (k,) added to those of the coordinates."""
    joints = robot.actuated
    sizes = [6 if contact.kind == FLAT else 3 for contact in robot.contacts]
    points = (np.concatenate([[0], np.cumsum(sizes)[:-1]])[:, None] + np.arange(3)).ravel()
    jacobian = compute_contact_jacobian(robot, log.joint("q", joints))[:, points]
    total = log.joint("tau", joints) + np.einsum("nri,nr->ni", jacobian, forces.reshape(len(forces), -1))
    flags = {
        f"contact_{contact.frame}": np.zeros(log.n_samples)
        for contact, known in zip(robot.contacts, measured, strict=True)
        if known
    }
    return replace(log, channels={**log.channels, **flags, **{f"tau_{j}": total[:, k] for k, j in enumerate(joints)}})


def _require_upright(robot: Robot, log: Log, forces: np.ndarray) -> None:
    """Refuse forces that do not carry the robot.

    Raises:
        InputError: Their mean does not point up, or is less than half of the weight.
    """
    mean = forces.sum(axis=1).mean(axis=0)
    weight = 9.81 * sum(float(link.nominal[0]) for link in robot.links)
    if not mean[2] > MIN_UPRIGHT_SHARE * max(float(np.linalg.norm(mean)), weight):
        listed = ", ".join(f"{x:.3g}" for x in mean)
        raise InputError(
            "mismatch",
            f"{log.name}: forces of the feet add up to ({listed}) N on average, and the robot weighs {weight:.3g} N; columns "
            "force_FOOT_x, _y, _z are forces on the foot in N, in axes of the world, z up",
        )
