r"""Iterative learning control: repeat a motion and update a correction of its reference from the last error (thesis chapter 7).

Convergence is checked before any motion (thesis 7.15 to 7.17, Figures 7.14 and 7.17). With `H = Q (I - L (F_u + F_y T_uy))`
over a whole trial, corrections converge if and only if the spectral radius of H is below 1, (7.15). They come closer to their
limit in every single iteration if the largest singular value of H is below 1, (7.16). For a long trial the equivalent
condition at each frequency is `|1 - L (F_u + F_y T_uy)| < 1 / |Q|` [Norrlof & Gunnarsson 2002]. A frequency that violates it
grows from trial to trial. A law that is stable but not monotone may cause large errors before it converges: it is refused
unless requested.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
from scipy.sparse.linalg import svds

from tau_dyn.control.iterative.laws import UpdateLaw
from tau_dyn.control.iterative.learned_outputs import Reference, TrialMeasurement
from tau_dyn.control.iterative.lifted_system import Operator, make_operator
from tau_dyn.exceptions import InputError


@dataclass(frozen=True, eq=False)
class FrequencyCondition:
    """Convergence condition at each frequency; responses over frequencies (F,).

    Attributes:
        frequency: Frequencies [Hz].
        left: `|1 - L (F_u + F_y T_uy)|` of each channel alone (F, m).
        bound: `1 / |Q|` of each channel (F, m).
        growth: Largest singular value of the whole `Q (I - L ..)`, coupling included (F,).
    """

    frequency: np.ndarray
    left: np.ndarray
    bound: np.ndarray
    growth: np.ndarray

    @property
    def worst(self) -> tuple[float, float]:
        """Frequency [Hz] and size of the largest growth."""
        k = int(np.argmax(self.growth))
        return float(self.frequency[k]), float(self.growth[k])

    @property
    def fails(self) -> tuple[float, float] | None:
        """Lowest and highest frequency [Hz] where an error grows; None if no error grows."""
        bad = self.frequency[self.growth >= 1]
        return (float(bad[0]), float(bad[-1])) if len(bad) else None


@dataclass(frozen=True, eq=False)
class Convergence:
    """Convergence of a law, computed before the first trial.

    Attributes:
        singular: Largest singular value of H, (7.16); one per channel if the channels are decoupled, else one.
        radius: Spectral radius of H, (7.15), or an upper bound of it that is already below 1.
        picture: The frequency condition; None if the law varies along the trial.
    """

    singular: tuple[float, ...]
    radius: float
    picture: FrequencyCondition | None

    @property
    def monotone(self) -> bool:
        """Whether every iteration brings the correction closer to its limit."""
        return max(self.singular) < 1

    @property
    def stable(self) -> bool:
        """Whether corrections converge at all."""
        return self.radius < 1


def analyse_convergence(law: UpdateLaw, motion: Reference, frequency: np.ndarray | None = None) -> Convergence:
    """Return (7.15), (7.16) and the frequency condition of a law on a motion.

    Raises:
        InputError: Law and motion have different sampling steps.
    """
    if abs(law.side.dt - motion.dt) > 1e-9 * motion.dt:
        raise InputError(
            "mismatch",
            f"the law is made for steps of {1000 * law.side.dt:g} ms, the motion has {1000 * motion.dt:g} ms",
        )
    if law.bound is not None:
        return Convergence((law.bound,), law.bound, compute_frequency_condition(law, frequency))
    H, m = build_iteration_operator(law, motion), law.side.reference(motion).shape[1]
    blocks = [H] if law.side.coupled else [_block(H, k, motion.n) for k in range(m)]
    singular = tuple(compute_largest_singular_value(b) for b in blocks)
    radius = max(singular) if max(singular) < 1 else max(_radius(b, motion.weights() > 0) for b in blocks)
    return Convergence(singular, radius, compute_frequency_condition(law, frequency))


def build_iteration_operator(law: UpdateLaw, motion: Reference) -> Operator:
    """Return H (m N, m N) for corrections that are zero where their weight is zero."""
    Q, QL = law.operators(motion)
    T = law.side.operator(motion.n)
    on = np.tile(motion.weights() > 0, T.shape[1] // motion.n).astype(float)
    kept = make_operator(T.shape, lambda x: on * np.ravel(x), lambda x: on * np.ravel(x))
    return (Q - QL @ T) @ kept


def compute_frequency_condition(law: UpdateLaw, frequency: np.ndarray | None = None) -> FrequencyCondition | None:
    """Return the frequency condition, by default from 0.1 Hz to half the sampling rate."""
    dt = law.side.dt
    f = (
        np.concatenate([np.linspace(0.1, 40, 800), np.linspace(40.2, 0.499 / dt, 300)])
        if frequency is None
        else frequency
    )
    f = f[f < 0.5 / dt]
    pair = law.responses(f)
    if pair is None:
        return None
    Q, L = pair
    left = np.eye(Q.shape[-1]) - L @ law.side.response(f)
    alone = np.abs(np.einsum("fii->fi", left))
    with np.errstate(divide="ignore"):
        bound = 1 / np.abs(np.einsum("fii->fi", Q))
    whole = Q @ left
    growth = np.linalg.svd(whole, compute_uv=False)[:, 0] if law.side.coupled else (alone / bound).max(axis=1)
    return FrequencyCondition(f, left=alone, bound=bound, growth=growth)


def require_convergence(found: Convergence, *, monotone: bool = True) -> None:
    """Refuse a law that would not converge.

    Raises:
        InputError: It is unstable or, with `monotone`, not monotone; the message names the frequency where it fails.
    """
    if found.stable and (found.monotone or not monotone):
        return
    what = "learning would not converge" if not found.stable else "learning would converge, but not monotonically"
    size = (
        f"spectral radius {found.radius:.3f}"
        if not found.stable
        else f"largest singular value {max(found.singular):.3f}"
    )
    where = ""
    if found.picture is not None and found.picture.fails:
        f, growth = found.picture.worst
        low, high = found.picture.fails
        where = f"; an error at {f:.1f} Hz grows {growth:.2f} times in an iteration (above 1 from {low:.1f} to {high:.1f} Hz)"
    raise InputError(
        "unstable",
        f"{what}: {size}{where}. Let Q forget there (lower cutoff, or a dip), or take a smaller gain or a better shift in L",
    )


def compute_largest_singular_value(H: Operator) -> float:
    """Return the largest singular value of an operator."""
    start = np.random.default_rng(0).standard_normal(H.shape[0])
    return float(cast(Any, svds)(H, k=1, return_singular_vectors=False, v0=start, tol=1e-4)[0])


def _block(H: Operator, k: int, n: int) -> Operator:
    """Return the part of one channel that moves itself alone."""

    def alone(product: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
        def through(x: np.ndarray) -> np.ndarray:
            whole = np.zeros(H.shape[1])
            whole[k * n : (k + 1) * n] = np.ravel(x)
            return product(whole)[k * n : (k + 1) * n]

        return through

    return make_operator((n, n), alone(H.matvec), alone(H.rmatvec))


def _radius(H: Operator, on: np.ndarray) -> float:
    """Return the spectral radius; only samples with a weight `on` (N,) can have eigenvalues that are not zero."""
    places = np.flatnonzero(np.tile(on, H.shape[0] // len(on)))
    columns = np.zeros((H.shape[0], len(places)))
    columns[places, np.arange(len(places))] = 1.0
    return float(np.abs(np.linalg.eigvals((H @ columns)[places])).max())


@dataclass(frozen=True, eq=False)
class LearningHistory:
    """Errors and corrections of all trials; the first has no correction.

    Attributes:
        motion: The repeated motion.
        convergence: Convergence computed before the first trial.
        corrections: Correction of each trial (k + 1, N, m).
        errors: Errors of the learned output, r minus its estimate (k + 1, N, m).
        motor_errors: Actuator references minus measured positions (k + 1, N, na), thesis (7.23).
        tool_errors: The tool's reference minus its measured position (k + 1, N, 3) [m], thesis (7.24).
    """

    motion: Reference
    convergence: Convergence
    corrections: np.ndarray
    errors: np.ndarray
    motor_errors: np.ndarray
    tool_errors: np.ndarray

    def relative(self, which: str = "errors") -> np.ndarray:
        """Return (7.25), each trial's error in percent of the first one's (k + 1, m), where learning acts fully.

        Args:
            which: 'errors', 'motor_errors' or 'tool_errors'.
        """
        size = np.linalg.norm(getattr(self, which)[:, self.motion.full], axis=1)
        return 100 * size / np.where(size[0] > 0, size[0], 1.0)

    def rms(self, which: str = "errors") -> np.ndarray:
        """Return root mean squares (k + 1, m) where learning acts fully."""
        return np.sqrt(np.mean(getattr(self, which)[:, self.motion.full] ** 2, axis=1))


class TrialPlant(Protocol):
    """A robot with its controller, or a simulation of both."""

    @property
    def dt(self) -> float:
        """Step of references and sensors [s]."""
        ...

    def run(self, reference: np.ndarray, trial: int) -> TrialMeasurement:
        """Move along actuator references (N, na), from rest, and return the sensor signals."""
        ...


def learn(
    plant: TrialPlant,
    motion: Reference,
    law: UpdateLaw,
    iterations: int = 10,
    *,
    monotone: bool = True,
    limit: float | None = None,
    first_trial: int = 0,
) -> LearningHistory:
    """Learn a motion.

    Args:
        plant: The robot, or its simulation.
        motion: The motion to repeat.
        law: The learning law.
        iterations: Number of trials with a correction; one trial without a correction comes first.
        monotone: Refuse a law that converges, but not in every single iteration, (7.16).
        limit: Largest correction that may be sent [m or rad]; by default the size of the motion.
        first_trial: Number of the first trial; another number selects other disturbances.

    Raises:
        InputError: The law would not converge, sampling steps differ, or a correction is larger than the limit.
    """
    if abs(plant.dt - motion.dt) > 1e-9 * motion.dt:
        raise InputError(
            "mismatch",
            f"the robot takes references every {1000 * plant.dt:g} ms, the motion has one every {1000 * motion.dt:g} ms",
        )
    if iterations < 1:
        raise InputError("invalid_value", "learning takes at least one iteration")
    before = analyse_convergence(law, motion)
    require_convergence(before, monotone=monotone)
    wanted = law.side.reference(motion)
    allowed = float(np.ptp(wanted, axis=0).max()) if limit is None else limit
    u = np.zeros_like(wanted)
    kept: list[tuple[np.ndarray, ...]] = []
    for k in range(iterations + 1):
        _require_small(u, allowed, k)
        trial = plant.run(law.side.commands(motion, u), first_trial + k)
        error = wanted - law.side.estimate(trial)
        kept.append((u, error, motion.q - trial.q, motion.tool - trial.tool))
        u = law.update(motion, u, error)
    return LearningHistory(motion, before, *(np.array(part) for part in zip(*kept, strict=True)))


def _require_small(u: np.ndarray, allowed: float, k: int) -> None:
    size = float(np.abs(u).max(initial=0.0))
    if not size <= allowed:
        raise InputError(
            "invalid_value",
            f"iteration {k} asks for a correction of {size:.3g}, more than the {allowed:.3g} allowed; the robot does not follow "
            "its model, or the limit is too low",
        )
