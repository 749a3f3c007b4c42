"""A planar arm of hobby servos by equations of its own: closed-form Lagrange, dry friction by impulses, play by contact.

With absolute angles `phi = L q` of a chain in a vertical plane (Spong, Hutchinson & Vidyasagar 2006, section 7.3)

    M_ij = A_ij cos(phi_i - phi_j),    h_i = sum_j A_ij sin(phi_i - phi_j) dphi_j^2 - g B_i cos(phi_i)

`A_ii = I_i + m_i c_i^2 + l_i^2 sum_{k>i} m_k`, `A_ij = l_i (m_j c_j + l_j sum_{k>j} m_k)` for `i < j`, and
`B_i = m_i c_i + l_i sum_{k>i} m_k`. Rotors add to the diagonal in `q`. Dry friction is an impulse of at most `F dt` that stops
the joint or opposes it (Moreau 1988), found by Gauss-Seidel. A play divides rotor and link, which touch through a stiff spring.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

GRAVITY = 9.81
STEP_S = 2.5e-4
CONTACT_N_M, CONTACT_N_M_S = 1500.0, 0.6
"""Stiffness and damping of gear teeth in contact [N m/rad, N m s/rad]: a load bends them by less than the encoder's step."""
SETTLED = 1e-9
"""Change of an impulse, as a share of the largest one, from which no sweep follows."""
SWEEPS = 8


@dataclass(frozen=True)
class Servo:
    """A servo's law, as `docs/reference` states it; one number for all joints [SI]."""

    gain: float = 2.65
    torque: float = 2.9
    back_emf: float = 0.17
    command_delay: float = 0.0
    torque_delay: float = 0.0
    dead_band: float = 0.0
    supply_sag: float = 0.0
    exponent: float = 1.0
    load_friction: float = 0.0
    stiction: float = 0.0
    stiction_speed: float = 0.05
    acceleration: float = 0.0
    play: float = 0.0


@dataclass(frozen=True)
class Arm:
    """The arm as it is (n,) [SI]."""

    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    rotor: np.ndarray
    coulomb: np.ndarray
    viscous: np.ndarray
    length: float = 0.12
    servo: Servo = field(default_factory=Servo)

    def coefficients(self) -> tuple[np.ndarray, np.ndarray]:
        """Return `A` (n, n) and `B` (n,)."""
        n, reach = len(self.mass), self.length
        beyond = np.array([self.mass[i + 1 :].sum() for i in range(n)])
        B = self.mass * self.centre + reach * beyond
        A = np.diag(self.inertia + self.mass * self.centre**2 + reach**2 * beyond)
        for i in range(n):
            for j in range(i + 1, n):
                A[i, j] = A[j, i] = reach * B[j]
        return A, B


def move(arm: Arm, stamps: np.ndarray, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions of link and rotor (N, n) at the stamps (N,), with commands (N, n) that act from their stamps on."""
    s, n = arm.servo, len(arm.mass)
    A, B = arm.coefficients()
    L = np.tril(np.ones((n, n)))
    steps = int(np.ceil(stamps[-1] / STEP_S)) + 1
    apart = s.play > 0
    q, v, before = commands[0].copy(), np.zeros(n), np.zeros(n)
    theta, w = q.copy(), np.zeros(n)
    goal, goal_speed = commands[0].copy(), np.zeros(n)
    late = max(1, round(s.torque_delay / STEP_S))
    pipeline = np.zeros((late, n))
    links, rotors = np.zeros_like(commands), np.zeros_like(commands)
    row, begins = (
        0,
        (np.arange(steps + 1) - 0.5) * STEP_S - s.command_delay,
    )  # leapfrog: a force acts about its position
    sent = np.maximum(np.searchsorted(stamps, begins + 1e-12, side="right") - 1, 0)
    for k in range(steps):
        while row < len(stamps) and stamps[row] <= k * STEP_S + STEP_S / 2:
            after = stamps[row] - k * STEP_S
            links[row], rotors[row] = q + after * v, theta + after * w
            row += 1
        motor, speed = (theta, w) if apart else (q, v)
        share = (begins[k + 1] - stamps[sent[k + 1]]) / STEP_S if sent[k + 1] != sent[k] else 0.0
        old, new = commands[sent[k]], commands[sent[k + 1]]
        if s.acceleration or not share:
            goal, goal_speed = _follow(goal, goal_speed, old + share * (new - old), s.acceleration)
            u = _follow_law(s, goal - motor)
        else:  # the mean of the outputs about a new command
            goal, u = new, (1 - share) * _follow_law(s, old - motor) + share * _follow_law(s, new - motor)
        if s.torque_delay > 0:
            u, pipeline[k % late] = pipeline[k % late].copy(), u
        tau = _drive(s, u, 1.5 * speed - 0.5 * before)  # speeds are half a step older than positions
        before = speed.copy()
        phi, spin = L @ q, L @ v
        between = phi[:, None] - phi[None, :]
        M = L.T @ (A * np.cos(between)) @ L
        h = L.T @ ((A * np.sin(between)) @ spin**2 - GRAVITY * B * np.cos(phi))
        dry = (
            arm.coulomb + s.load_friction * np.abs(tau) + s.stiction * np.exp(-np.abs(speed) / s.stiction_speed)
        ) * STEP_S
        if not apart:
            G = np.linalg.inv(M + np.diag(arm.rotor + STEP_S * arm.viscous))
            v = _stop(v + STEP_S * G @ (tau - arm.viscous * v - h), G, dry)
            q = q + STEP_S * v
            continue
        gap = theta - q
        over = np.sign(gap) * np.maximum(np.abs(gap) - s.play / 2, 0.0)
        contact = np.where(over != 0, CONTACT_N_M * over + CONTACT_N_M_S * (w - v), 0.0)
        contact = np.where(contact * over > 0, contact, 0.0)  # teeth push, they do not pull
        v = v + STEP_S * np.linalg.solve(M, contact - h)
        w = _stop(w + STEP_S * (tau - contact - arm.viscous * w) / arm.rotor, np.diag(1 / arm.rotor), dry)
        q, theta = q + STEP_S * v, theta + STEP_S * w
    return links, rotors if apart else links


def _follow(
    goal: np.ndarray, speed: np.ndarray, wanted: np.ndarray, acceleration: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return goal and its speed one step on, at most so fast that it can stop at the command."""
    if not acceleration:
        return wanted, np.zeros_like(speed)
    left = wanted - goal
    best = np.sign(left) * np.sqrt(2 * acceleration * np.abs(left))
    speed = speed + np.clip(best - speed, -acceleration * STEP_S, acceleration * STEP_S)
    arrives = np.abs(left) <= np.abs(speed) * STEP_S
    return np.where(arrives, wanted, goal + speed * STEP_S), np.where(arrives, 0.0, speed)


def _follow_law(s: Servo, error: np.ndarray) -> np.ndarray:
    error = np.sign(error) * np.maximum(np.abs(error) - s.dead_band, 0.0)
    u = np.clip(s.gain * error, -1.0, 1.0)
    return u * (1 - s.supply_sag * np.abs(u))


def _drive(s: Servo, u: np.ndarray, speed: np.ndarray) -> np.ndarray:
    x = u - s.back_emf * speed
    return s.torque * np.sign(x) * np.abs(x) ** s.exponent


def _stop(v: np.ndarray, G: np.ndarray, dry: np.ndarray) -> np.ndarray:
    """Return speeds (n,) after impulses of dry friction of at most `dry` (n,), with the inverse mass `G` (n, n)."""
    speeds, columns, limits = v.tolist(), G.T.tolist(), dry.tolist()
    p = [0.0] * len(speeds)
    for _ in range(SWEEPS):
        settled = True
        for j, (column, limit) in enumerate(zip(columns, limits, strict=True)):
            new = min(max(p[j] - speeds[j] / column[j], -limit), limit)
            change, p[j] = new - p[j], new
            settled = settled and abs(change) < SETTLED * limit
            speeds = [x + g * change for x, g in zip(speeds, column, strict=True)]
        if settled:
            break
    return np.array(speeds)
