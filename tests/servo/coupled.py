"""Planar arms with position servos, all joints at once: an independent simulator, against which the loops are checked.

    (M(q) + diag(armature)) (v+ - v) / h = torque - load(q, v) - viscous (v + v+) / 2 - f,   |f| <= F

M and load are written down for a chain of links in a vertical plane; f holds exactly, found joint by joint in turn until
nothing changes (projected Gauss-Seidel). Many arms are stepped side by side.
Reference: Moreau 1988; Jean 1999 (nonsmooth contact dynamics).
"""

from dataclasses import dataclass

import numpy as np

GRAVITY = 9.81
STEP_S = 5e-4
"""Step [s]: a fortieth of a sample of the logs."""
SWEEPS = 100
"""Sweeps of the friction problem, at most; three joints settle to 1e-9 in eight."""
SETTLED_SPEED = 1e-8  # rad/s


@dataclass(frozen=True, eq=False)
class PlanarArms:
    """S arms of n links of one length, turning about +y, x forward and z up.

    Attributes:
        length: From joint to joint [m].
        mass: (n, S) [kg].
        centre: Centre of mass along the link (n, S) [m].
        inertia: About the centre (n, S) [kg m^2].
        armature: (n, S) [kg m^2].
        coulomb: (n, S) [N m].
        viscous: (n, S) [N m s/rad].
        load_friction: (n, S).
        stiction: (n, S) [N m].
        stiction_speed: [rad/s].
        position_gain: (n, S).
        force_per_unit: [N m].
        back_emf: [s/rad].
        command_delay: (n, S) [s].
    """

    length: float
    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    armature: np.ndarray
    coulomb: np.ndarray
    viscous: np.ndarray
    load_friction: np.ndarray
    stiction: np.ndarray
    stiction_speed: float
    position_gain: np.ndarray
    force_per_unit: float
    back_emf: float
    command_delay: np.ndarray

    def compute_dynamics(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return M (n, n, S), and gravity, Coriolis and centrifugal torque (n, S) at q, v (n, S)."""
        n, count = q.shape
        turn, rate = np.cumsum(q, axis=0), np.cumsum(v, axis=0)
        along = np.stack([np.cos(turn), -np.sin(turn)])  # of each link, in x and z
        across = np.stack([-np.sin(turn), -np.cos(turn)])  # its derivative by the angle
        M, load = np.zeros((n, n, count)), np.zeros((n, count))
        for k in range(n):
            levers = [self.length] * k + [self.centre[k]]
            J = np.zeros((n, 2, count))
            bias = np.zeros((2, count))
            for i, lever in enumerate(levers):
                J[: i + 1] += across[:, i] * lever
                bias -= along[:, i] * lever * rate[i] ** 2
            turning = np.zeros((n, 1))
            turning[: k + 1] = 1.0
            M += self.mass[k] * np.einsum("ids,jds->ijs", J, J) + (turning * turning.T)[:, :, None] * self.inertia[k]
            bias[1] += GRAVITY
            load += self.mass[k] * np.einsum("ids,ds->is", J, bias)
        return M, load

    def simulate(self, command: np.ndarray, dt: float) -> np.ndarray:
        """Return positions (N, n, S) at samples of dt [s] from rest at the first command; commands (N, n, S) hold."""
        often = round(dt / STEP_S)
        h = dt / often
        q, v = command[0].copy(), np.zeros(command.shape[1:])
        out = np.empty_like(command)
        late = self.command_delay / h
        whole = np.floor(late).astype(int)
        part = late - whole
        rows = np.ogrid[: q.shape[0], : q.shape[1]]
        for k in range(len(command)):
            out[k] = q
            for i in range(often):
                first = k * often + i - whole
                one, before = (command[np.maximum(x, 0) // often, rows[0], rows[1]] for x in (first, first - 1))
                middle = q + 0.5 * h * v
                u = np.clip(self.position_gain * (one + part * (before - one) - middle), -1.0, 1.0)
                torque = self.force_per_unit * (u - self.back_emf * v)
                most = self.coulomb + self.load_friction * np.abs(torque)
                most = most + self.stiction * np.exp(-np.abs(v) / self.stiction_speed)
                M, load = self.compute_dynamics(middle, v)
                for j in range(len(q)):
                    M[j, j] += self.armature[j]
                damping = 0.5 * (self.viscous + self.force_per_unit * self.back_emf)
                wanted = np.einsum("ijs,js->is", M, v) / h + torque - load + (damping - self.viscous) * v
                after = _step(M / h, wanted, damping, most, v)
                q, v = q + 0.5 * h * (v + after), after
        return out


def _step(A: np.ndarray, wanted: np.ndarray, damping: np.ndarray, most: np.ndarray, v: np.ndarray) -> np.ndarray:
    v = v.copy()
    for _ in range(SWEEPS):
        before = v.copy()
        for j in range(len(v)):
            rest = wanted[j] - np.einsum("is,is->s", A[j], v) + A[j, j] * v[j]
            v[j] = (rest - np.clip(rest, -most[j], most[j])) / (A[j, j] + damping[j])
        if np.abs(v - before).max() < SETTLED_SPEED:
            break
    return v
