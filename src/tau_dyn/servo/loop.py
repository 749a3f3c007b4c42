"""Servo loops along a known motion: every joint a scalar equation, all joints, parameter values and logs stepped at once.

    (I(t) + armature) v' + load(t) + G(t) (q - q_along) + friction = tau(law, command, q, v)

The effect of the rest of the robot on a joint (gravity, Coriolis and the other joints' accelerations) is a load, evaluated
along a motion close to the simulated one; the joint's own gravity is linearised about that motion. The exact simulation of the
coupled robot evaluates loads along the simulated motion itself, repeated window by window until convergence (waveform
relaxation). A step then holds all joints (projected Gauss-Seidel): a change of any speed or position pushes the others, by mass
matrix and gravity slopes.

One step of h by the trapezoidal rule, linearly implicit in the motor's damping d and the viscous one b, with torque and
load at the middle of the step and friction f that holds exactly (a box complementarity problem of one unknown):

    w = (I / h + (d - b) / 2) v + tau - load,   f = clip(w, -F, F),   v+ = (w - f) / (I / h + (d + b) / 2),
    q+ = q + h (v + v+) / 2.

If v would change its sign, the step is divided at rest, so that a small change of a parameter moves a stop by little.

With a spring between motor (w, its armature B, the friction) and link (v, I), the twist's own motion is solved exactly over the
step (`solve_spring`) and its centre of mass by the rule above; friction then sees the mobility of the pair. A play opens the
spring; without compliance its stops are springs that the step resolves, critically damped.

A command holds until the next; a delay moves it by fractions of a step, so that the response has a derivative with respect to
it.
Reference: Lelarasmee, Ruehli & Sangiovanni-Vincentelli 1982 (waveform relaxation); Moreau 1988 (dry friction); Jourdan, Alart &
Jean 1998 (Gauss-Seidel); Spong 1987.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.servo.compiled_loop import run_compiled
from tau_dyn.servo.records import move_to_stamps
from tau_dyn.servo.waves import LoadRows, Trials, Waves

FINE_STEP_S = 0.0026
"""Longest step [s] if the residual is too small for the longer one; it changes positions by less than 0.05 mrad."""
MIN_INERTIA = 1e-6
"""Smallest inertia of a joint in a step [kg m^2]; smaller ones result from bad trial values only."""

BEND = 0.02
"""Share of the supply below which a bent drive law is straight, so that its slope stays finite."""
SETTLED_SPEED = 1e-9
"""Change of speeds below which a step of coupled joints has converged [rad/s]: 1e-5 of an encoder's resolution."""
MAX_STEP_SWEEPS = 200
"""Sweeps over the joints of such a step (projected Gauss-Seidel), at most."""
CONTACT_TURN = 3.0
"""Phase of a stop's own oscillation in a step [rad], critically damped: it decays within two steps."""
TEETH_DAMPING = 0.2
"""Least damping of a spring behind a play, over the critical one: teeth that meet return at half of their speed. Without any, a
step finds no rest between the stops, and coupled joints do not converge."""


def simulate_loops(waves: Waves, trials: Trials) -> np.ndarray:
    """Return measured positions (M, na, C, S) [rad] of C trials in S logs, from their starts, at the stamps of M samples."""
    return _simulate(waves, trials, False)[0]


def simulate_motion(waves: Waves, trials: Trials) -> np.ndarray:
    """Return measured positions at the stamps, and the links' positions and speeds on the clock (3, N, na, C, S)."""
    return _simulate(waves, trials, True)


def _simulate(waves: Waves, trials: Trials, motion: bool) -> np.ndarray:
    often = max(1, int(np.ceil(waves.dt.max() / waves.step - 1e-9)))
    longest = len(waves.command) * waves.dt.max()
    waves = replace(waves, by_log=_cut_delays(waves.by_log, longest))
    trials = replace(trials, values=_cut_delays(trials.values, longest))
    found = run_compiled(
        waves, trials, often, (MIN_INERTIA, BEND, CONTACT_TURN, TEETH_DAMPING, SETTLED_SPEED), MAX_STEP_SWEEPS, motion
    )
    if found is not None:
        return found
    found = _simulate_in_numpy(waves, trials, often)
    if waves.apart is not None:
        found[0] = move_to_stamps(found[0], waves.apart[:, None, None])
    return found if waves.shown is None else np.take_along_axis(found, waves.shown[None, :, None, None], axis=1)


def _cut_delays(values: Mapping[str, np.ndarray], longest: float) -> dict[str, np.ndarray]:
    """Return values with delays limited to the length of the logs [s]: the effect is the same with fewer steps in memory."""
    late = {key: np.nan_to_num(values[key], nan=longest) for key in ("command_delay", "torque_delay") if key in values}
    return {**values, **{key: np.clip(x, -longest, longest) for key, x in late.items()}}


def _simulate_in_numpy(waves: Waves, trials: Trials, often: int) -> np.ndarray:
    """Return the result of the compiled code, with all joints, trials and logs stepped at once."""
    n, na, s = waves.command.shape
    coupling, shape = waves.coupling, (na, trials.inertial.shape[1], s)
    out = np.empty((3, n, *shape))
    if coupling is None:
        loops = _Loops(waves, trials, often, out)
        loops.run(0, n - 1)
        return out
    along, load, inertia, stiffness = (np.array(x) for x in (waves.along, waves.load, waves.inertia, waves.stiffness))
    mass, slope = np.zeros((2, s, -(-n // coupling.every) + 1, na, na))
    rows = LoadRows(along, load, inertia, stiffness, mass, slope, out[1:, :, :, 0])
    waves = replace(waves, along=rows.along, load=rows.load, inertia=rows.inertia, stiffness=rows.stiffness)
    loops = _Loops(waves, trials, often, out, rows)
    for begin in range(0, n - 1, coupling.window):
        stop, turn, kept = min(begin + coupling.window, n - 1), 0, loops.copy_state()
        while any([not coupling.settle(rows, log, begin, stop, turn) for log in range(s)]) or not turn:
            loops.take_state(kept)
            loops.run(begin, stop)
            turn += 1
    return out


_OPTIONAL = ("dead_band", "supply_sag", "load_friction", "carried_friction", "stiction")
"""Entries that take no computing time unless a trial has them."""


class _Sample(NamedTuple):
    """Quantities that hold from one sample to the next: arrays that broadcast to (na, C, S)."""

    mass_h: np.ndarray
    supply: np.ndarray
    full: np.ndarray
    now: np.ndarray
    slope: np.ndarray | float
    stiffness: np.ndarray
    along: np.ndarray
    turn: np.ndarray


class _Loops:
    """Servo loops and their state."""

    def __init__(self, waves: Waves, trials: Trials, often: int, out: np.ndarray, rows: LoadRows | None = None) -> None:
        """Start at the first sample; the simulated states are written to `out` (3, N, na, C, S)."""
        self._waves, self._often, self._out, self._rows = waves, often, out, rows
        shape, p = out.shape[2:], {key: value[:, :, None] for key, value in trials.values.items()}
        self._p = p = p | {key: value[:, None, :] for key, value in waves.by_log.items()}
        self._h = h = (waves.dt / often)[None, None, :]
        self._has = {key: bool(np.any(p[key])) for key in _OPTIONAL}
        self._bends, self._one_way = bool(np.any(p["drive_exponent"] != 1.0)), bool(np.any(p["braking"] != 1.0))
        self._load, self._inertia = (
            _combine(first, by, trials)
            for first, by in ((waves.load, waves.load_by), (waves.inertia, waves.inertia_by))
        )
        goal, delayed = _Goal(waves, p, often, h, shape), _Delay(p["torque_delay"] / h, shape)
        q, v = (np.broadcast_to(x[:, None, :], shape).copy() for x in (waves.start, waves.speed))
        springs = np.any(p["joint_compliance"]) or np.any(p["backlash"])
        self._joint = _Twist(p, h, self._load[0] + p["offset"]) if springs else None
        m, w = q, v
        if self._joint is not None:
            m, q = (q, q - self._joint.start) if waves.measured_on_motor else (q + self._joint.start, q)
            w = v.copy()
        self._state = [m, w, q, v, v, np.zeros(shape), np.zeros(shape), goal, delayed]
        self._show(0)

    def copy_state(self) -> list[Any]:
        """Return a copy of the state, which later steps do not change."""
        return [copy(x) for x in self._state]

    def take_state(self, state: list[Any]) -> None:
        """Go back to a state."""
        self._state = [copy(x) for x in state]

    def _show(self, k: int) -> None:
        m, _, q, v = self._state[:4]
        self._out[:, k] = m if self._waves.measured_on_motor else q, q, v

    def _follow_law(
        self, goal: np.ndarray, seen: np.ndarray, speed: np.ndarray, integral: np.ndarray, before: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray, np.ndarray]:
        """Return the law's output, its slope by the speed (None without an immediate effect), the integral and the last speed."""
        p, h, told = self._p, self._h, self._waves.told
        half, e, u = 0.5 * h, goal, goal
        if told not in ("position", "speed"):
            return u, None, integral, before
        gain = p["integral_gain"]
        if told == "position":
            e = goal - (seen + half * speed)
            if self._has["dead_band"]:
                e = np.sign(e) * np.maximum(np.abs(e) - p["dead_band"], 0.0)
            u = p["position_gain"] * e - p["derivative_gain"] * speed
        inner, slow = p["speed_gain"] > 0, None
        if np.any(inner):  # a speed loop, alone or inside the position loop
            lag = np.clip(u, -p["speed_limit"], p["speed_limit"]) - speed
            e, u = np.where(inner, lag, e), np.where(inner, p["speed_gain"] * lag, u)
            slow, gain = np.where(inner, p["speed_gain"], 0.0), np.where(inner, p["speed_integral_gain"], gain)
        if np.any(gain):  # to the middle of the step; a speed's error over the last one is known by now
            integral = integral - np.where(inner, half * gain * (speed - before), 0.0)
            before = speed
            u = u + np.clip(integral + half * gain * e, -p["limit"], p["limit"])
            integral = np.clip(integral + gain * h * e, -p["limit"], p["limit"])
        return u, slow, integral, before

    def run(self, begin: int, stop: int) -> None:
        """Step from one sample to another."""
        for k in range(begin, stop):
            sample = self._read_sample(k)
            for i in range(self._often):
                self._step_once(k, i, sample)
            self._show(k + 1)

    def _read_sample(self, k: int) -> _Sample:
        """Return the quantities that hold from one sample to the next."""
        waves, p, load = self._waves, self._p, self._load
        if self._joint is not None:
            self._joint.set_inertia(self._inertia[k], self._compute_loaded_inertias(k))
        along = waves.along[k : k + 2, :, None, :]
        return _Sample(
            np.maximum(self._inertia[k] + p["armature"], MIN_INERTIA) / self._h,
            waves.supply[k],
            p["force_per_unit"] * waves.enabled[k],
            load[k] + p["offset"],
            0.0 if waves.held else (load[k + 1] - load[k]) / self._often,
            waves.stiffness[k][:, None, :],
            along[0],
            (along[1] - along[0]) / self._often,
        )

    def _interpolate_matrices(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the mass matrix and the slopes of gravity (na, na, S) at a sample, for coupled joints."""
        assert self._rows is not None and self._waves.coupling is not None
        row, part = divmod(k, self._waves.coupling.every)
        part = part / self._waves.coupling.every
        M, slopes = (
            np.moveaxis(x[:, row] + part * (x[:, row + 1] - x[:, row]), 0, -1)
            for x in (self._rows.mass, self._rows.slope)
        )
        return M, slopes

    def _compute_loaded_inertias(self, k: int) -> np.ndarray:
        """Return the links' inertias (na, C, S) [kg m^2] at a sample while the other joints give way.

        It is the inverse of the diagonal of the inverse mass matrix, with the drives of rigid joints on their links.
        """
        if self._rows is None or self._waves.coupling is None or self._joint is None:
            return self._inertia[k]
        M = np.moveaxis(self._interpolate_matrices(k)[0], -1, 0)
        rigid = np.where(self._joint.there, 0.0, self._p["armature"])[:, 0, :].T
        inverse = np.linalg.inv(M + rigid[:, :, None] * np.eye(M.shape[1]))
        return (1.0 / np.diagonal(inverse, axis1=1, axis2=2)).T[:, None, :]

    def _step_once(self, k: int, i: int, sample: _Sample) -> None:
        """Compute step `i` of sample `k`: the law, the motor's torque, loads and friction, the motion."""
        waves, p, h, has = self._waves, self._p, self._h, self._has
        m, w, q, v, before, integral, gained, goal, delayed = self._state
        half = 0.5 * h
        seen, speed = (m, w) if waves.encoder_on_motor else (q, v)
        u, slow, integral, before = self._follow_law(goal.at(k * self._often + i), seen, speed, integral, before)
        loses = p["back_emf"]  # loss of the motor's torque per unit of its speed
        if slow is not None:
            loses = loses + np.where((np.abs(u) < p["limit"]) & (p["torque_delay"] == 0), sample.supply * slow, 0.0)
        u = np.minimum(np.maximum(u, -p["limit"]), p["limit"])
        if has["supply_sag"]:
            u = u * (1.0 - p["supply_sag"] * np.abs(u))
        u = delayed.pass_on(u)
        x = u * sample.supply - p["back_emf"] * w
        push, lever = sample.full * x, sample.full * loses
        if self._bends:
            power = p["drive_exponent"]
            grown = sample.full * np.maximum(np.abs(x), BEND) ** (power - 1.0)
            push, lever = grown * x, grown * np.where(np.abs(x) > BEND, power, 1.0) * loses
        if self._one_way:
            share = np.where(x * u < 0, p["braking"], 1.0)
            push, lever = push * share, lever * share
        apart = q + half * v - sample.along - (i + 0.5) * sample.turn
        rest = sample.now + (i + 0.5) * sample.slope + sample.stiffness * apart
        damping, friction = 0.5 * (lever + p["viscous"]), p["coulomb"]
        if has["load_friction"]:
            friction = friction + p["load_friction"] * np.abs(push)
        if has["carried_friction"]:
            friction = friction + p["carried_friction"] * np.abs(rest)
        if has["stiction"]:
            friction = friction + p["stiction"] * np.exp(-np.abs(w) / p["stiction_speed"])
        push = push + (damping - p["viscous"]) * w
        step = partial(_step, p, self._joint, (m, w, q, v), (push, damping, friction), sample.mass_h, half)
        if self._rows is None or waves.coupling is None:
            m, w, q, after = step(rest)
        else:
            M, slopes = self._interpolate_matrices(k)
            others = slopes * (1 - np.eye(len(M)))[:, :, None]
            rest = rest + np.einsum("jis,ics->jcs", others, apart)
            m, w, q, after = _step_together(step, rest, M / h[0], v, gained)
            gained = after - v
        self._state = [m, w, q, after, before, integral, gained, goal, delayed]


def _step(p, joint, state, forces, mass_h, half, rest) -> tuple[np.ndarray, ...]:  # noqa: ANN001
    """Return the state (m, w, q, v) after a step under loads."""
    push, damping, friction = forces
    m, w, q, v = state
    rigid_q, rigid_v = _step_rigid(p, (q, v), (push, rest, damping, friction), mass_h, half)
    if joint is None:
        return rigid_q, rigid_v, rigid_q, rigid_v
    w_after, v_after = joint.step(state, push, rest, damping, friction)
    m, q = (np.where(joint.there, x, rigid_q) for x in (m + half * (w + w_after), q + half * (v + v_after)))
    w, v = (np.where(joint.there, x, rigid_v) for x in (w_after, v_after))
    return m, w, q, v


def _step_together(
    step: Callable[[np.ndarray], Sequence[np.ndarray]],
    rest: np.ndarray,
    M: np.ndarray,
    v: np.ndarray,
    first: np.ndarray,
) -> list[np.ndarray]:
    """Return the state after a step of all joints by projected Gauss-Seidel: each load grows as the others' speeds change."""
    found, change = [np.empty(rest.shape) for _ in range(4)], first.copy()
    for _ in range(MAX_STEP_SWEEPS):
        most = 0.0
        for j in range(len(rest)):
            load = rest.copy()
            load[j] += np.einsum("is,ics->cs", M[j], change) - M[j, j] * change[j]
            for x, after in zip(found, step(load), strict=True):
                x[j] = np.broadcast_to(after, rest.shape)[j]
            most = max(most, float(np.abs(found[3][j] - v[j] - change[j]).max()))
            change[j] = found[3][j] - v[j]
        if not most > SETTLED_SPEED:
            break
    return found


def _step_rigid(p, state, forces, mass_h, half) -> tuple[np.ndarray, np.ndarray]:  # noqa: ANN001
    """Return positions and speeds (na, C, S) after a step of joints without a spring, divided where they come to rest."""
    (q, v), (push, rest, damping, friction) = state, forces
    wanted = mass_h * v + push - rest  # what friction acts on
    slid = (wanted - np.sign(v) * friction) / (mass_h + damping)
    rests = slid * v <= 0  # at once, or after a part of the step
    moving = np.divide(v, v - slid, out=np.zeros(np.shape(slid)), where=rests & (v != 0))
    friction = friction + np.where(v != 0, p["stiction"] * (1 - np.exp(-np.abs(v) / p["stiction_speed"])), 0)
    pushed = wanted - (mass_h - damping) * v
    free = (1 - moving) * (pushed - np.minimum(np.maximum(pushed, -friction), friction))
    after = np.where(rests, free / (mass_h + (1 - moving) * damping), slid)
    return q + half * np.where(rests, moving * v + (1 - moving) * after, v + after), after


class _Twist:
    """A spring and a play between motor and link; without both, motor and link are rigidly connected."""

    def __init__(self, p: Mapping[str, np.ndarray], h: np.ndarray, load: np.ndarray) -> None:
        self._p, self._h, self._gap = p, h, 0.5 * p["backlash"]
        self._springy = p["joint_compliance"] > 0
        self.there = self._springy | (p["backlash"] > 0)
        self.start = p["joint_compliance"] * load + np.sign(load) * self._gap

    def set_inertia(self, link: np.ndarray, loaded: np.ndarray) -> None:
        """Store the link's inertia over a sample, alone and while the other joints give way (na, C, S) [kg m^2]."""
        p, h = self._p, self._h
        motor, link = np.maximum(p["armature"], MIN_INERTIA), np.maximum(link, MIN_INERTIA)
        self._total, self._share = motor + link, link / (motor + link)
        self._mu = motor * self._share
        contact = self._mu * (CONTACT_TURN / h) ** 2
        self._stiffness = np.where(self._springy, 1.0 / np.where(self._springy, p["joint_compliance"], 1.0), contact)
        gives = np.where(self._springy, np.clip(loaded, MIN_INERTIA, link), link)
        mine = motor * gives / (motor + gives)
        more = (self._mu - mine) / h  # the coupling itself takes this off the twist's inertia over the step
        critical = 2.0 * np.sqrt(self._stiffness * mine)
        least = np.where(self._gap > 0, TEETH_DAMPING * critical, 0.0)
        damping = np.where(self._springy, np.maximum(p["joint_damping"], least), critical)
        a, S = solve_spring(self._stiffness, damping, mine, h)
        self._a, self._S = (a * S + more) / (S + more), S + more

    def step(self, state, push, rest, damping, friction):  # noqa: ANN001, ANN201
        """Return the speeds of motor and link after a step."""
        m, w, q, v = state
        h, share = self._h, self._share
        twist, rate = m - q, w - v
        open_ = np.abs(twist) < self._gap
        pull = np.where(open_, 0.0, self._stiffness * (twist - np.where(twist > 0, self._gap, -self._gap)))
        a, S = np.where(open_, 1.0, self._a), np.where(open_, self._mu / h, self._S)
        base = a * rate + ((1.0 - share) * rest - pull) / S
        common = w - share * rate - h / self._total * rest
        inverse = 1.0 / (h / self._total + share**2 / S)
        free = (common + share * base) * inverse
        wanted = free + push
        left = wanted - np.minimum(np.maximum(wanted, -friction), friction)
        after = left / (inverse + damping)
        return after, after - base - share * (left - damping * after - free) / S


def solve_spring(
    stiffness: np.ndarray, damping: np.ndarray, mu: np.ndarray, h: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a and S of a step `S rate+ = a S rate - stiffness twist + force`, `twist+ = twist + h (rate + rate+) / 2`.

    Its two eigenvalues are those of `mu twist'' + damping twist' + stiffness twist = 0` over h, exactly, and a constant force
    twists by force / stiffness. If the step turns by more than one radian, damping is added, so that oscillations that the step
    cannot resolve decay.
    """
    square, sigma = stiffness / mu * h**2, 0.5 * damping / mu * h
    late = sigma + np.maximum(0.0, np.sqrt(square) - 1.0)
    turn = square - sigma**2
    size = np.sqrt(np.abs(turn))
    slow = np.where(turn > 0, 0.0, size)
    trace = np.where(
        turn > 0, 2 * np.exp(-late) * np.cos(np.minimum(size, np.pi)), np.exp(slow - late) + np.exp(-slow - late)
    )
    determinant = np.exp(-2 * late)
    return 0.5 * (trace + determinant - 1.0), stiffness * h / (determinant - trace + 1.0)


class _Delay:
    """The law's output (na, C, S), delayed by fractions of steps."""

    def __init__(self, late: np.ndarray, shape: tuple[int, ...]) -> None:
        self._late = np.broadcast_to(late, shape)
        self._whole = np.floor(self._late).astype(int)
        self._past: list[np.ndarray] = []

    def pass_on(self, u: np.ndarray) -> np.ndarray:
        """Store the law's present output, and return the motor's delayed one."""
        if not np.any(self._late):
            return u
        keep = int(self._whole.max()) + 2
        self._past = [u, *self._past[: keep - 1]] if self._past else [u] * keep
        newer, older = np.empty(self._late.shape), np.empty(self._late.shape)
        for steps in np.unique(self._whole):
            for out, past in zip((newer, older), self._past[steps : steps + 2], strict=True):
                np.copyto(out, past, where=self._whole == steps)
        return newer + (self._late - self._whole) * (older - newer)


def _combine(first: np.ndarray, by: np.ndarray, trials: Trials) -> np.ndarray:
    """Return a signal (N, na, C, S) at the trials' inertial values."""
    if not by.shape[2] or not np.any(trials.inertial):
        return first[:, :, None, :]
    if np.all(trials.inertial == trials.inertial[:, :1]):
        return (first + np.einsum("njks,k->njs", by, trials.inertial[:, 0]))[:, :, None, :]
    return first[:, :, None, :] + np.einsum("njks,kc->njcs", by, trials.inertial)


class _Goal:
    """The goal position over the steps: commands are delayed, rounded, and passed through the profile generator."""

    def __init__(
        self, waves: Waves, p: Mapping[str, np.ndarray], often: int, h: np.ndarray, shape: tuple[int, ...]
    ) -> None:
        step = p["command_step"]
        command = waves.command[:, :, None, :]
        if np.any(step):
            command = np.where(step > 0, step * np.round(command / np.where(step > 0, step, 1.0)), command)
        self._command, self._often, self._h = (
            np.broadcast_to(command, (len(command), shape[0], command.shape[2], shape[2])),
            often,
            h,
        )
        late = np.broadcast_to(p["command_delay"] / h, shape)
        self._last = len(command) - 1
        self._whole = np.floor(late).astype(int)
        self._part = late - self._whole
        self._limit, self._speed = p["acceleration_limit"], p["speed_limit"]
        bounded = bool(np.any(np.isfinite(self._limit)) or np.any(np.isfinite(self._speed)))
        self._has_profile = bounded and waves.told == "position"
        self._finer = max(1, -(-waves.profile_steps // often))
        self._passes: np.ndarray | None = None
        if self._has_profile and np.any(p["steps_pass"]):
            self._passes = (waves.steps[:, :, None, :] & (p["steps_pass"] > 0)) & np.ones(shape, bool)
        self._x, self._w = np.broadcast_to(self._command[0], shape).copy(), np.zeros(shape)
        grid = np.ogrid[: shape[0], : shape[1], : shape[2]]
        self._rows = [grid[0], grid[1] if command.shape[2] > 1 else np.zeros_like(grid[1]), grid[2]]
        self._single = len(np.unique(self._whole)) == 1

    def at(self, step: int) -> np.ndarray:
        """Return the mean goal (na, C, S) over a step."""
        if self._single:
            first = step - int(self._whole.flat[0])
            one, before = (self._command[min(max(i, 0) // self._often, self._last)] for i in (first, first - 1))
        else:
            first = step - self._whole
            j, c, s = self._rows
            one, before = (self._command[np.clip(i // self._often, 0, self._last), j, c, s] for i in (first, first - 1))
        target = one + self._part * (before - one)
        if not self._has_profile:
            return target
        passes = None
        if self._passes is not None:
            j, c, s = np.ogrid[: target.shape[0], : target.shape[1], : target.shape[2]]
            now, then = (self._passes[np.clip(i // self._often, 0, self._last), j, c, s] for i in (first, first - 1))
            passes = now | (then & (one == before))  # a fractional delay ends a step late
        return self._follow(one, before, passes)

    def _follow(self, one: np.ndarray, before: np.ndarray, passes: np.ndarray | None) -> np.ndarray:
        """Return the mean of a profile over a step; its speed can always be braked to rest at the target. Steps may pass it."""
        h, total = self._h / self._finer, np.zeros(self._x.shape)
        x, w, bounded = self._x, self._w, np.isfinite(self._limit)
        limit = np.where(bounded, self._limit, 0.0)
        half = 0.5 * limit * h  # change of speed in half a step
        for n in range(self._finer):
            target = one + np.clip(self._part * self._finer - n, 0.0, 1.0) * (before - one)
            distance = target - x
            apart, way = np.abs(distance), np.sign(distance)
            room = np.maximum(apart - 0.5 * h * way * w, 0.0)  # remaining distance after the step if it ends at rest
            wanted = np.minimum(np.where(bounded, np.sqrt(half**2 + 2.0 * limit * room) - half, apart / h), self._speed)
            after = np.where(
                bounded, w + np.minimum(np.maximum(way * wanted - w, -2.0 * half), 2.0 * half), way * wanted
            )
            step = h * np.where(bounded, 0.5 * (w + after), after)
            there = bounded & (apart <= 2.0 * half * h) & (np.abs(w) <= 4.0 * half)
            total += np.where(there, target, x + 0.5 * step)
            x, w = np.where(there, target, x + step), np.where(there, 0.0, after)
        goal = total / self._finer
        if passes is not None:
            x, w, goal = (
                np.where(passes, free, held)
                for free, held in ((one, x), (0.0, w), (one + self._part * (before - one), goal))
            )
        self._x, self._w = x, w
        return goal
