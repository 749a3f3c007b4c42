"""The robot in motion: actuated coordinates, a fixed step, friction with exact sticking.

Velocities `w` are at half steps, positions at full steps (leapfrog). With the velocity extrapolated to the sample,
`v_k = w_{k-1/2} + dt/2 a_{k-1}`,

    M(q_k) a_k = tau_k - h(q_k, v_k) - f_k,   w_{k+1/2} = w_{k-1/2} + dt a_k,   q_{k+1} = q_k + dt w_{k+1/2}.

So `tau_k` acts from half a step before its sample to half a step after it: a log of (q_k, tau_k) has no delay, and central
differences of its positions satisfy the equation of motion to second order. `h` sees the extrapolated velocity, which errs
by `dt/2 (a_k - a_{k-1})`; friction, which is more sensitive, is evaluated again at the resulting velocity. Passive joints are
closed by the mechanism at every position, so loops cannot drift.

Friction obeys the sign of `w_{k+1/2}` and holds a joint exactly still; the one sample in which a joint reverses or stops mixes
both directions. With `u` the velocity after the step, `f` the friction force, `A = dt M^-1` and `free` the velocity
without friction,

    u = free - A f,   f_i = upper_i where u_i > 0,   f_i = lower_i where u_i < 0,   lower_i <= f_i <= upper_i where u_i = 0.

This box complementarity problem has one solution if A is symmetric and positive definite. Usually the last direction of motion
is the solution; else projected Gauss-Seidel finds the sticking joints, and a linear solve makes their velocities exactly zero.
Reference: Hairer, Lubich & Wanner 2003 (leapfrog); Moreau 1988; Stewart & Trinkle 1996; Jourdan, Alart & Jean 1998.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError, LoopClosureError
from tau_dyn.model import Model
from tau_dyn.simulate.compiled_plant import CompiledPlant, PlantMotion
from tau_dyn.simulate.controllers import CascadeController, Controller
from tau_dyn.simulate.forces import EffectSurroundings, SampledForces
from tau_dyn.simulate.plant_run import PlantRun, Progress
from tau_dyn.simulate.sensors import EncoderReadings
from tau_dyn.simulate.trajectory import Trajectory

_SWEEPS = 500  # Gauss-Seidel sweeps over the contacts at most; tens are usual
_TOLERANCE = 1e-11  # of the largest friction force


class Slip(NamedTuple):
    """Velocities after the step (na,), friction forces (na,) [N or N m], and which joints rest (na,)."""

    u: np.ndarray
    force: np.ndarray
    stuck: np.ndarray


def solve_slip(A: np.ndarray, free: np.ndarray, lower: np.ndarray, upper: np.ndarray, guess: np.ndarray) -> Slip:
    """Solve the step; `lower <= upper` (na,), and `guess` (na,) is a friction force near the solution."""
    u = free - A @ guess
    wrong = ((u > 0) & (guess != upper)) | ((u < 0) & (guess != lower)) | ((u == 0) & (lower < upper))
    if not wrong.any():
        return Slip(u, guess, np.zeros(len(u), dtype=bool))
    force = np.array(_gauss_seidel(A.tolist(), free.tolist(), lower.tolist(), upper.tolist(), guess.tolist()))
    stuck = (force > lower) & (force < upper)
    if stuck.any():
        sliding = ~stuck
        rest = free[stuck] - A[np.ix_(stuck, sliding)] @ force[sliding]
        force[stuck] = np.linalg.solve(A[np.ix_(stuck, stuck)], rest)
    u = free - A @ force
    u[stuck] = 0.0
    return Slip(u, force, stuck)


def _gauss_seidel(
    A: list[list[float]], free: list[float], lower: list[float], upper: list[float], force: list[float]
) -> list[float]:
    """Return the forces after projected Gauss-Seidel sweeps; floats in lists are faster than arrays of three numbers."""
    joints = range(len(free))
    enough = _TOLERANCE * max(max(map(abs, lower)), max(map(abs, upper)), 1e-12)
    for _ in range(_SWEEPS):
        largest = 0.0
        for i in joints:
            row = A[i]
            u = free[i] - sum(row[j] * force[j] for j in joints)
            new = min(max(force[i] + u / row[i], lower[i]), upper[i])
            largest = max(largest, abs(new - force[i]))
            force[i] = new
        if largest <= enough:
            break
    return force


class Plant:
    """One robot with its effects, stepped in time."""

    def __init__(
        self, model: Model, q0: np.ndarray, v0: np.ndarray, dt: float, surroundings: EffectSurroundings | None = None
    ) -> None:
        """Start at positions and velocities (na,) with a step of `dt` [s], by default in a room that warms up."""
        self.mechanism, self.forces, self.dt = model.mechanism, SampledForces(model, surroundings), dt
        self.q, self.w = np.array(q0, float), np.array(v0, float)
        self._a, self._friction = np.zeros(len(self.q)), np.zeros(len(self.q))
        self._started = False
        self._check_inertia(model)

    def step(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Apply forces (na,) around the current sample; return its velocity, acceleration and stuck joints, then advance."""
        if not self._started:  # w still is the velocity at the sample: go back by half a step
            self._started = True
            u, _ = self._after(tau)
            self._a = (u - self.w) / self.dt
            self.w = self.w - 0.5 * self.dt * self._a
        u, stuck = self._after(tau)
        v, self._a = 0.5 * (self.w + u), (u - self.w) / self.dt
        self.w, self.q = u, self.q + self.dt * u
        self.forces.memory.advance(self.dt * u, self.dt)
        return v, self._a, stuck

    def _check_inertia(self, model: Model) -> None:
        """Refuse a robot whose joints would accelerate without any force."""
        M, _ = self.mechanism.mass_and_bias(self.q, np.zeros(len(self.q)))
        added = self.forces.mass(self.q, np.zeros(len(self.q)))
        if np.linalg.eigvalsh(M if added is None else M + added)[0] <= 1e-12 * np.trace(M):
            raise InputError(
                "robot_structure",
                f"{model.robot.source}: the mass matrix is singular, so the robot cannot be simulated; give every joint a "
                "mass or a drive inertia (parameters <link>.mass, <joint>.armature)",
            )

    def _after(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the velocity half a step after the sample, and the stuck joints."""
        v = self.w + 0.5 * self.dt * self._a
        M, h = self.mechanism.mass_and_bias(self.q, v)
        if not self.forces.any:
            return self.w + self.dt * np.linalg.solve(M, tau - h), np.zeros(len(v), dtype=bool)
        added = self.forces.mass(self.q, v)
        A = self.dt * np.linalg.inv(M if added is None else M + added)
        free = self.w + A @ (tau - h)
        u = self._slip(A, free, v, self._a).u
        slip = self._slip(A, free, 0.5 * (self.w + u), (u - self.w) / self.dt)
        self._friction = slip.force
        return slip.u, slip.stuck

    def _slip(self, A: np.ndarray, free: np.ndarray, v: np.ndarray, a: np.ndarray) -> Slip:
        """Solve the step with friction as it is at velocities and accelerations (na,)."""
        lower, upper = self.forces.bounds(self.q, v, a)
        held = np.minimum(np.maximum(self._friction, lower), upper)
        return solve_slip(A, free, lower, upper, np.where(self.w > 0, upper, np.where(self.w < 0, lower, held)))


def run_plant(
    model: Model,
    reference: Trajectory,
    controller: Controller,
    *,
    encoder: EncoderReadings | None = None,
    progress: Progress | None = None,
) -> PlantRun:
    """Let a controller drive the robot along a reference, from rest at the reference's start.

    A cascade runs as compiled code if that is possible and saves time (`compiled_plant.py`).

    Args:
        model: The plant.
        reference: Motion sampled evenly at the control rate.
        controller: Computes the forces around each sample from its measured positions.
        encoder: Gives the readings of positions (na,) in sample k; by default the true positions.
        progress: Called with the share that is done.

    Raises:
        InputError: The feedback is unstable.
        LoopClosureError: The robot was driven to a position at which its loops cannot be closed.
    """
    dt = reference.duration / (reference.n_samples - 1)
    plant = Plant(model, reference.q[0], np.zeros(model.robot.na), dt)
    controller.reset(reference)
    moved = _run_compiled(model, reference, controller, encoder, progress)
    if moved is not None:
        read = None if encoder is None else moved.read
        return PlantRun(model, np.array(reference.t), *moved[:5], reference, read, compute_tool=moved.compute_tool)
    record = _Recorder(model, reference.n_samples)
    read = np.empty_like(reference.q)
    for k in range(reference.n_samples):
        read[k] = plant.q if encoder is None else encoder(k, plant.q)
        tau = controller.force(k, reference.t[k], reference.q[k], reference.v[k], reference.a[k], read[k])
        try:
            record.step(k, plant, tau)
        except LoopClosureError as fault:
            raise _ran_away(reference, k) if _is_far(plant, reference, k) else fault from None
        if k % max(1, reference.n_samples // 100) == 0:
            if not _is_near(plant.q, reference):
                raise _ran_away(reference, k)
            if progress is not None:
                progress(k / reference.n_samples)
    return record.run(np.array(reference.t), reference, None if encoder is None else read)


def _run_compiled(
    model: Model,
    reference: Trajectory,
    controller: Controller,
    encoder: EncoderReadings | None,
    progress: Progress | None,
) -> PlantMotion | None:
    """Return the run of a cascade as compiled code; None if this is not possible or the run fails."""
    if type(controller) is not CascadeController:
        return None
    compiled = CompiledPlant.find(model, reference.n_samples, encoders=encoder is not None)

    def watch(k: int, q: np.ndarray) -> bool:
        if progress is not None:
            progress(k / reference.n_samples)
        return _is_near(q, reference)

    start = reference.q[0], np.zeros(model.robot.na)
    return None if compiled is None else follow_cascade(compiled, controller, reference, start, encoder, watch=watch)


def follow_cascade(
    compiled: CompiledPlant,
    controller: CascadeController,
    reference: Trajectory,
    start: tuple[np.ndarray, np.ndarray],
    encoder: EncoderReadings | None = None,
    **options: Any,
) -> PlantMotion | None:
    """Return the run of a controller that is ready, from positions and velocities (na,); see `CompiledPlant.follow`."""
    try:
        servo = controller.describe(reference, compiled.compute_inertia)
    except LoopClosureError:
        return None
    if encoder is not None:
        servo = replace(servo, noise=encoder.noise, resolution=encoder.resolution)
    return compiled.follow(*start, servo, **options)


def free_motion(
    model: Model, q0: np.ndarray, v0: np.ndarray, duration: float, dt: float = 1e-3, tau: np.ndarray | None = None
) -> PlantRun:
    """Let the robot move from a state (na,), (na,) for a time [s], under a constant force (na,) or without force."""
    n = round(duration / dt) + 1
    plant = Plant(model, q0, v0, dt)
    force = np.zeros(model.robot.na) if tau is None else np.asarray(tau, float)
    compiled = CompiledPlant.find(model, n)
    moved = compiled and compiled.apply_forces(q0, v0, dt, np.tile(force, (n, 1)))
    if moved:
        return PlantRun(model, np.arange(n) * dt, *moved[:5])
    record = _Recorder(model, n)
    for k in range(n):
        record.step(k, plant, force)
    return record.run(np.arange(n) * dt, None, None)


class _Recorder:
    """Records the plant's motion and forces, sample by sample."""

    def __init__(self, model: Model, n: int) -> None:
        self.model = model
        self.q, self.v, self.a, self.tau = np.empty((4, n, model.robot.na))
        self.stuck = np.zeros((n, model.robot.na), dtype=bool)

    def step(self, k: int, plant: Plant, tau: np.ndarray) -> None:
        self.q[k], self.tau[k] = plant.q, tau
        self.v[k], self.a[k], self.stuck[k] = plant.step(tau)

    def run(self, t: np.ndarray, reference: Trajectory | None, read: np.ndarray | None) -> PlantRun:
        return PlantRun(self.model, t, self.q, self.v, self.a, self.tau, self.stuck, reference, read)


def _is_near(q: np.ndarray, reference: Trajectory) -> bool:
    """Return whether positions (na,) are finite and near the range of the reference."""
    return bool(np.all(np.abs(q) < 100 * (1 + float(np.max(np.abs(reference.q))))))


def _is_far(plant: Plant, reference: Trajectory, k: int) -> bool:
    """Tell whether the robot is farther from its reference than the motion is wide, and so no longer follows it."""
    return bool(np.any(np.abs(plant.q - reference.q[k]) > np.ptp(reference.q, axis=0)))


def _ran_away(reference: Trajectory, k: int) -> InputError:
    return InputError(
        "unstable",
        f"{reference.name}: the simulated robot ran away before t = {reference.t[k]:.4g} s; the controller's gains are "
        f"too high for this robot and control rate ({(reference.n_samples - 1) / reference.duration:.4g} Hz), or its forces "
        "too small",
    )
