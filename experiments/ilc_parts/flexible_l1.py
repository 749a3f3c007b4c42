"""The L1 with elastic rods and friction, nonlinear: three carts that a cascade drives, and a plate on three rods as springs.

    f_i = k (|p - c_i| - L_i) + c d|p - c_i|/dt                       along rod i, from cart c_i = A_i + q_i e_x to the plate p
    m_i q_i'' = u_i - friction_i + push_i + f_i n_ix                  n_i the rod's direction, u_i the cascade's force
    M p'' = M g - sum f_i n_i

Masses and geometry are the nominal ones of the L1, friction and controller are assumed. Several robots move at once, one for
each learning case. Nothing here is taken from the product's simulator.
"""

from dataclasses import dataclass

import numpy as np

DT, STEP = 0.004, 2e-4  # s, of references and sensors, and of the simulation
ORIGINS = np.array([[0.04, 0, 1.44], [0.25, -1.31, 1.46], [0, 0, 0]])  # m
LENGTHS = np.array([2.05, 1.82, 1.81])  # m
CARTS = np.array([13.58, 13.64, 38.23])  # kg
PLATE = 9.13 + 2.4  # kg, with half of the rods
SOFTEST_HZ = 11.5  # of the plate with the carts held, in y and z as in the thesis
DAMPING = 0.03  # ratio of that mode
COULOMB, UNEVEN, VISCOUS = np.array([150.0, 120.0, 180.0]), 0.15, np.array([150.0, 130.0, 200.0])  # N, N s/m
KP, SPEED_HZ = 2 * np.pi * 8, 40.0  # 1/s, Hz; the cascade of the L1 in `tau-dyn demo`
INTEGRAL_S, SHARE, DELAY = 0.05, 0.5, 0.010  # s, of the reference's speed, s
ENCODER, GAUGE, ACCELEROMETER = 1e-6, 2e-6, 0.05  # m, m, m/s^2; standard deviations
PUSH, PUSH_HZ = 2.0, 3.0  # N on a cart, different in every trial
GRAVITY = np.array([0, 0, -9.81])


@dataclass(frozen=True, eq=False)
class Run:
    """A trial of several robots, (N, robots, 3) each.

    Attributes:
        q: Encoders [m].
        tool: Length gauges [m].
        acceleration: Of the plate, without gravity [m/s^2].
        true_tool: Plate [m].
    """

    q: np.ndarray
    tool: np.ndarray
    acceleration: np.ndarray
    true_tool: np.ndarray


class FlexibleL1:
    """Robots of one make, from rest at a tool position."""

    def __init__(self, carts: np.ndarray, plate: np.ndarray, seed: int) -> None:
        """Find springs and the sagged rest at cart positions (3,) and the rigid plate there (3,) [m]."""
        self._carts, self._seed = carts, seed
        n = (plate - self._ends(carts)) / LENGTHS[:, None]
        softest = np.linalg.eigvalsh(n.T @ n)[0]
        w = 2 * np.pi * SOFTEST_HZ
        self._k, self._c = PLATE * w**2 / softest, 2 * DAMPING * PLATE * w / softest
        self._tension = np.linalg.solve(n.T, PLATE * GRAVITY)  # of the rods at rest
        self._plate, self._free = plate, LENGTHS - self._tension / self._k  # so that the loaded rods are L long
        self._still = self._tension * n[:, 0]

    @staticmethod
    def _ends(q: np.ndarray) -> np.ndarray:
        return ORIGINS + q[..., None] * np.array([1.0, 0, 0])

    def run(self, reference: np.ndarray, trial: int) -> Run:
        """Return a trial on cart references (N, robots, 3) [m]."""
        N, robots = reference.shape[:2]
        rng = np.random.default_rng([self._seed, trial])
        push = _wander(rng, N, robots)
        late, speed = _delay(reference)
        kv = 2 * np.pi * SPEED_HZ * (CARTS + PLATE / 3)
        ki, often = kv / INTEGRAL_S, round(DT / STEP)
        q, v = np.tile(self._carts, (robots, 1)), np.zeros((robots, 3))
        p, w = np.tile(self._plate, (robots, 1)), np.zeros((robots, 3))
        integral = np.tile(-self._still, (robots, 1))
        seen, tool, before = (np.empty((N, robots, 3)) for _ in range(3))
        for i in range(N):
            seen[i], tool[i] = q, p
            wanted = KP * late[i] + SHARE * speed[i]
            for step in range(often):
                if step == often // 2:
                    before[i] = w
                e = wanted - KP * q - v
                integral = integral + STEP * ki * e
                rod = p[:, None, :] - self._ends(q)
                size = np.sqrt(np.einsum("rij,rij->ri", rod, rod))
                n = rod / size[..., None]
                stretch = np.einsum("rij,rj->ri", n, w) - n[..., 0] * v
                force = self._k * (size - self._free) + self._c * stretch
                free = v + STEP * (kv * e + integral - VISCOUS * v + push[i] + force * n[..., 0]) / CARTS
                slip = STEP * COULOMB * np.where(free > 0, 1 + UNEVEN, 1 - UNEVEN) / CARTS
                v = np.where(np.abs(free) > slip, free - np.sign(free) * slip, 0.0)
                w = w + STEP * (GRAVITY - np.einsum("ri,rij->rj", force, n) / PLATE)
                q, p = q + STEP * v, p + STEP * w
        felt = np.diff(before, axis=0, prepend=before[:1]) / DT
        noise = (s * rng.standard_normal(seen.shape) for s in (ENCODER, GAUGE, ACCELEROMETER))
        return Run(*(x + e for x, e in zip((seen, tool, felt), noise, strict=True)), tool)


def _delay(reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return references and their speeds (N, robots, 3) a command's delay later."""
    whole, part = int(DELAY / DT), DELAY / DT % 1
    rows = np.arange(len(reference)) - whole
    first, second = (reference[np.clip(rows - k, 0, None)] for k in (0, 1))
    late = (1 - part) * first + part * second
    return late, np.diff(late, axis=0, prepend=late[:1]) / DT


def _wander(rng: np.random.Generator, N: int, robots: int) -> np.ndarray:
    """Return forces (N, robots, 3) [N] of first order that differ from trial to trial."""
    keep = np.exp(-2 * np.pi * PUSH_HZ * DT)
    out, x = np.empty((N, robots, 3)), np.zeros((robots, 3))
    for i in range(N):
        x = keep * x + np.sqrt(1 - keep**2) * rng.standard_normal((robots, 3))
        out[i] = x
    return PUSH * out
