r"""Elimination of ground forces from the equations of a floating base: contacts are loop closures that change with time.

    M a + h = tau + J' f,   tau = 0 for the base,   J' stacked over the contacts of this sample

`J` (k, n) is the velocity of the contact points, and of flat feet their angular velocity, per velocity of the n coordinates. With
the coordinates split into dependent and independent ones, as for closed loops (`mechanism/loops.py`),

    v = G v_i,   G = [1; -J_d^+ J_i],   J G = 0,   G' (M a + h) = G' tau,

so contact forces of any size cancel. The forces only have to act at the contact points: feet may slip and yield. The dependent
coordinates are chosen once for every set of contacts, the legs' joints before the base, by QR with column pivoting; so rows are
smooth while a set of contacts lasts. A quadruped on all feet keeps its six base equations, which contain the torques of all
legs; a leg in the air adds the equations of its joints. Reference: Mistry, Buchli & Schaal 2010; Khalil & Dombre 2002, ch. 7.

A spherical foot touches the ground below its centre, on a level ground. A foot counts as in contact in case of doubt, and
always if the log has no flag: the equations stay exact, but the leg's own are lost. A contact that counts as air would be an
error.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.linalg import lapack

from tau_dyn.exceptions import InputError
from tau_dyn.log import Log
from tau_dyn.robot import FLAT, Robot

_WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
MAX_FLAG = 1.5
"""Largest value of a column that holds flags 0 and 1; above, it holds forces [N]."""
MIN_WEIGHT_SHARE = 0.01
"""Share of the robot's weight from which a force counts as contact."""
BASE_SCALE = 1e-3
"""Weight of the base's columns in the choice of dependent coordinates: joints come first."""
MAX_CONDITION = 1e3
"""Conditioning of `J_d`, its columns in m per rad or m, above which a sample is left out: a leg is stretched out."""
_RANK = 1e-6  # singular value relative to the largest, of a set of contacts that hold the same motion twice


class ContactElimination(NamedTuple):
    """Elimination of contact forces.

    Attributes:
        G: Velocity of all coordinates per velocity of independent ones (N, n, n); zero columns of dependent ones.
        free: Which coordinates are independent (N, n); their rows of `G' (M a + h) = G' tau` hold.
    """

    G: np.ndarray
    free: np.ndarray

    def project(self, rows: np.ndarray) -> np.ndarray:
        """Return `G'` times forces (N, n) or columns (N, n, p).

        Samples of columns are last in memory, and products with zero are skipped: most columns act on few coordinates.
        """
        if rows.ndim == 2:
            return np.einsum("nij,ni->nj", self.G, rows)
        columns = np.ascontiguousarray(rows.transpose(1, 2, 0))
        found = np.zeros_like(columns)
        share = np.ascontiguousarray(self.G.transpose(1, 2, 0))
        for own, weights in zip(columns, share, strict=True):
            kept = np.flatnonzero(own.any(axis=1))
            used = own[kept]
            for j in np.flatnonzero(weights.any(axis=1)):
                found[j, kept] += weights[j] * used
        return found.transpose(2, 0, 1)


def find_contacts(robot: Robot, log: Log) -> np.ndarray:
    """Return which contacts may touch the ground (N, k), from columns `contact_FRAME`: flags 0 and 1, or forces [N].

    A foot without a column counts as touching all the time.

    Raises:
        InputError: A column holds something that is no number.
    """
    weight = 9.81 * sum(link.nominal[0] for link in robot.links)
    found = np.ones((log.n_samples, len(robot.contacts)), bool)
    for k, contact in enumerate(robot.contacts):
        x = log.channels.get(f"contact_{contact.frame}")
        if x is None:
            continue
        if not np.isfinite(x).all():
            raise InputError("bad_sample", f"{log.name}: a sample of contact_{contact.frame} is no finite number")
        forces = np.abs(x).max(initial=0.0) > MAX_FLAG
        found[:, k] = np.abs(x) > MIN_WEIGHT_SHARE * weight if forces else x > 0
    return found


def find_usual_flight(contacts: Iterable[tuple[np.ndarray, float]]) -> float:
    """Return how long a foot is usually in the air [s], from logs' contacts (N, k) and steps [s]; zero if no foot ever is.

    It is the median over the time in the air, so that short bounces do not count for much.
    """
    lasting = []
    for touching, dt in contacts:
        for flies in ~touching.T:
            edges = np.flatnonzero(np.diff(np.concatenate([[0], flies.astype(int), [0]])))
            lasting += [np.full(stop - start, (stop - start) * dt) for start, stop in edges.reshape(-1, 2)]
    return float(np.median(np.concatenate(lasting))) if lasting else 0.0


def compute_contact_jacobian(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return the contacts' velocity per velocity of the coordinates (N, rows, n), in world axes at positions (N, n).

    Three rows a contact: its point's velocity; a flat one has three more, its angular velocity.
    """
    model, data = robot.model, robot.model.createData()
    share, offset = robot.coupling
    frames = [model.getFrameId(contact.frame, pin.FrameType.BODY) for contact in robot.contacts]
    turning = np.array([model.joints[k].nq == 2 for k in range(1, model.njoints)])
    index = [(item.idx_q, item.idx_v) for item in list(model.joints)[1:]]
    rows = []
    tree = np.empty(model.nq)
    for x in q @ share.T + offset:
        for (at, v), turns in zip(index, turning, strict=True):
            if turns:
                tree[at : at + 2] = np.cos(x[v]), np.sin(x[v])
            else:
                tree[at] = x[v]
        pin.computeJointJacobians(model, data, tree)
        pin.updateFramePlacements(model, data)
        parts = []
        for frame, contact in zip(frames, robot.contacts, strict=True):
            both = pin.getFrameJacobian(model, data, frame, _WORLD)
            lever = data.oMf[frame].rotation @ contact.centre - [0.0, 0.0, contact.radius]
            parts.append(both[:3] - pin.skew(lever) @ both[3:])
            if contact.kind == FLAT:
                parts.append(both[3:])
        rows.append(np.concatenate(parts) @ share if parts else np.zeros((0, robot.na)))
    return np.array(rows)


def eliminate_contacts(robot: Robot, q: np.ndarray, touching: np.ndarray) -> ContactElimination:
    """Return the motions that contacts leave free at positions (N, n), with contacts (N, k) that touch.

    Samples at which a leg is stretched out, or whose contacts hold each other, have no free coordinate.
    """
    jacobian = compute_contact_jacobian(robot, q)
    sizes = [6 if contact.kind == FLAT else 3 for contact in robot.contacts]
    of = np.repeat(np.arange(len(sizes)), sizes)
    n = robot.na
    G, free = np.zeros((n, n, len(q))).transpose(2, 0, 1), np.zeros((len(q), n), bool)  # samples last in memory
    sets, which = np.unique(touching, axis=0, return_inverse=True)
    for number, contacts in enumerate(sets):
        samples = np.flatnonzero(which.ravel() == number)
        J = jacobian[np.ix_(samples, np.flatnonzero(contacts[of]))]
        dependent = _choose_dependent(robot, J)
        kept = np.setdiff1d(np.arange(n), dependent)
        motion = np.zeros((len(samples), n, n))
        motion[:, kept, kept] = 1.0
        sound = np.ones(len(samples), bool)
        if dependent.size:
            s = np.linalg.svd(J[:, :, dependent], compute_uv=False)
            sound = s[:, 0] <= MAX_CONDITION * s[:, -1]
            motion[np.ix_(np.flatnonzero(sound), dependent, kept)] = (
                -np.linalg.pinv(J[sound][:, :, dependent]) @ J[sound][:, :, kept]
            )
        motion[~sound] = 0.0
        G[samples] = motion
        free[np.ix_(samples, kept)] = sound[:, None]
    return ContactElimination(G, free)


def _choose_dependent(robot: Robot, J: np.ndarray) -> np.ndarray:
    """Return the coordinates that follow from the others, for Jacobians (N, rows, n) of one set of contacts.

    Up to 20 samples are tried; the choice with the best conditioned equations is returned.
    """
    if not J.shape[1]:
        return np.zeros(0, int)
    scale = np.ones(robot.na)
    scale[: len(robot.base_coordinates)] = BASE_SCALE
    best, found = np.inf, np.zeros(0, int)
    for k in np.unique(np.linspace(0, len(J) - 1, 20).astype(int)):
        rank = int(np.linalg.matrix_rank(J[k], tol=_RANK * np.linalg.norm(J[k], 2)))
        _, order, *_ = lapack.dgeqp3(J[k] * scale)  # counts columns from 1
        chosen = np.sort(order[:rank] - 1)
        s = np.linalg.svd(J[k][:, chosen], compute_uv=False)
        worst = s[0] / max(s[-1], 1e-300)
        if worst < best:
            best, found = worst, chosen
    return found
