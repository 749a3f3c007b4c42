"""Forty servos that learn, each of its own making: a motor and a load on a spring, Coulomb friction, a loop and a late command.

    m1 a1 = f - viscous v1 - friction + disturbance - k (x1 - x2) - c (v1 - v2)        m2 a2 = k (x1 - x2) + c (v1 - v2)
    f = kv e + ki int e,   e = kp (r(t - delay) - x1) + share r'(t - delay) - v1

All servos move at once: one array entry each. Nothing here is taken from the product's simulator.
"""

from dataclasses import dataclass

import numpy as np

DT = 0.004  # s, of references and encoders
STEP = 2e-4  # s, of the simulation
N = 750  # samples of a trial, 3 s
STROKE = 0.01  # m
START, TRAVEL, BACK = 0.4, 0.35, 1.25  # s; TRAVEL times the servo's own factor
DISTURBANCE_SHARE = 0.05  # RMS of the force that does not repeat, over the peak of the accelerating force
DISTURBANCE_HZ = 3.0  # its corner
FRICTION_LIMIT = 3.0  # largest Coulomb friction over the peak of the accelerating force


@dataclass(frozen=True, eq=False)
class Servos:
    """Parameters, each (n,)."""

    motor: np.ndarray  # kg
    load: np.ndarray  # kg
    spring_hz: np.ndarray  # of the load on its spring, the motor held
    damping: np.ndarray  # ratio of that mode
    viscous: np.ndarray  # N s/m
    friction: np.ndarray  # Coulomb friction over the peak of the accelerating force
    uneven: np.ndarray  # of the friction, forwards and backwards
    kp: np.ndarray  # 1/s
    speed_hz: np.ndarray  # bandwidth of the speed loop
    integral_s: np.ndarray  # time constant of its integrator
    share: np.ndarray  # of the reference's speed that goes ahead
    delay: np.ndarray  # s
    noise: np.ndarray  # m, of the encoder
    travel: np.ndarray  # s, of a move
    at_load: np.ndarray  # whether the encoder is on the load
    seed: int

    @property
    def n(self) -> int:
        """Number of servos."""
        return len(self.motor)

    def reference(self) -> np.ndarray:
        """Return motions (N, n) [m]: a stroke there and back, from rest to rest, quintic."""
        t = np.arange(N)[:, None] * DT
        return STROKE * (_rise((t - START) / self.travel) - _rise((t - BACK) / self.travel))

    def accelerating_force(self) -> np.ndarray:
        """Return the peak of the force that accelerates (n,) [N]; a quintic's peak is 5.7735 stroke / time^2."""
        return (self.motor + self.load) * 5.7735 * STROKE / self.travel**2

    def run(self, reference: np.ndarray, trial: int) -> np.ndarray:
        """Return encoder positions (N, n) [m] of one trial on references (N, n), from rest."""
        rng = np.random.default_rng([self.seed, trial, 77])
        push = self._disturbances(rng)
        late, speed = self._late(reference)
        kv = 2 * np.pi * self.speed_hz * (self.motor + self.load)
        ki, k = kv / self.integral_s, self.load * (2 * np.pi * self.spring_hz) ** 2
        c = 2 * self.damping * np.sqrt(k * self.load)
        slip = STEP * self.friction * self.accelerating_force() / self.motor
        x1, v1, x2, v2, integral = (np.zeros(self.n) for _ in range(5))
        seen = np.empty_like(reference)
        for i in range(len(reference)):
            seen[i] = np.where(self.at_load, x2, x1)
            wanted = self.kp * late[i] + self.share * speed[i]
            for _ in range(round(DT / STEP)):
                e = wanted - self.kp * x1 - v1
                integral = integral + ki * e * STEP
                spring = k * (x1 - x2) + c * (v1 - v2)
                free = v1 + STEP * (kv * e + integral - self.viscous * v1 + push[i] - spring) / self.motor
                bound = slip * np.where(v1 > 0, 1 + self.uneven, 1 - self.uneven)
                v1 = np.where(np.abs(free) > bound, free - np.sign(free) * bound, 0.0)
                v2 = v2 + STEP * spring / self.load
                x1, x2 = x1 + STEP * v1, x2 + STEP * v2
        return seen + self.noise * rng.standard_normal(seen.shape)

    def _late(self, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return references and their speeds (N, n), each servo's delay later; references are held over a sample."""
        whole = np.floor(self.delay / DT).astype(int)
        part = self.delay / DT - whole
        rows = np.arange(len(reference))[:, None] - whole
        take = lambda r: np.take_along_axis(reference, np.clip(r, 0, len(reference) - 1), axis=0)  # noqa: E731
        late = (1 - part) * take(rows) + part * take(rows - 1)
        return late, np.diff(late, axis=0, prepend=late[:1]) / DT

    def _disturbances(self, rng: np.random.Generator) -> np.ndarray:
        """Return forces (N, n) [N] that differ from trial to trial."""
        keep = np.exp(-2 * np.pi * DISTURBANCE_HZ * DT)
        out, x = np.empty((N, self.n)), rng.standard_normal(self.n)
        for i in range(N):
            x = keep * x + np.sqrt(1 - keep**2) * rng.standard_normal(self.n)
            out[i] = x
        return DISTURBANCE_SHARE * self.accelerating_force() * out


def _rise(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0, 1)
    return x**3 * (10 - 15 * x + 6 * x**2)


def draw_servos(n: int, seed: int) -> Servos:
    """Return servos with random parameters."""
    rng = np.random.default_rng(seed)

    def between(low: float, high: float) -> np.ndarray:
        return rng.uniform(low, high, n)

    total = between(8, 60)
    share = between(0.2, 0.6)
    return Servos(
        motor=(1 - share) * total, load=share * total, spring_hz=between(10, 40), damping=between(0.01, 0.05),
        viscous=between(20, 200), friction=between(0, FRICTION_LIMIT), uneven=between(-0.15, 0.15), kp=between(10, 30),
        speed_hz=between(8, 25), integral_s=between(0.03, 0.2), share=between(0, 0.9), delay=between(0.002, 0.032),
        noise=1e-6 * 10 ** between(-0.5, 0.7), travel=TRAVEL * between(0.7, 1.3), at_load=rng.random(n) < 0.5, seed=seed,
    )  # fmt: skip
