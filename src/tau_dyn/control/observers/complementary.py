"""A complementary filter: the tool from the actuators at low, from an accelerometer at high frequency (thesis 7.17).

    z = G z_c + (1 - G) z_a,     z_a the acceleration integrated twice

Integrating noise twice drifts without bound, and filtering the drift away afterwards loses digits. Neither is needed: with the
trapezoidal rule the integrators cancel against zeros of `1 - G` at zero frequency.

Zero phase: `G` is a second-order Butterworth low-pass H forwards and backwards. Then `1 - |H|^2` is the square of the Butterworth
high-pass P with the same cutoff, exactly so for filters from the bilinear transform, and one pass of P with both integrators
is `H / w^2` with `w = 2 / dt tan(pi f dt)`: the acceleration runs through `H / w^2` forwards and P backwards.

Causal: the complement of a second-order low-pass has one zero at zero frequency and lets drift pass. Here
`1 - G = s^3 / (s^3 + 2 w s^2 + 2 w^2 s + w^3)`: a constant error of the accelerometer has no effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy.signal import bilinear, butter, freqz, lfilter

from tau_dyn.control.iterative import Operator, build_signal_operator
from tau_dyn.exceptions import InputError


def require_signals(kinematic: np.ndarray, acceleration: np.ndarray, axes: int) -> np.ndarray:
    """Return positions (N, m) that belong to accelerations (N, m), both of so many axes.

    Raises:
        InputError: Their shapes differ or do not fit, or a number is not finite.
    """
    if kinematic.shape != acceleration.shape or kinematic.shape[1:] != (axes,) or len(kinematic) < 2:
        raise InputError(
            "wrong_shape",
            f"an observer of {axes} axes takes positions and accelerations (N, {axes}), "
            f"not {kinematic.shape} and {acceleration.shape}",
        )
    if not (np.isfinite(kinematic).all() and np.isfinite(acceleration).all()):
        raise InputError("bad_sample", "positions or accelerations hold a number that is not finite")
    return kinematic


@dataclass(frozen=True)
class ComplementaryToolObserver:
    """Tool positions from positions computed by forward kinematics and an accelerometer.

    Attributes:
        cutoff_hz: Cutoff of G, one per axis [Hz]; the thesis' (7.18) are 4.50 and 2.63.
        dt: Sampling step [s].
        causal: Use the past alone, as a controller must; otherwise the filter has zero phase and needs the whole trial.
    """

    cutoff_hz: tuple[float, ...]
    dt: float
    causal: bool = False

    def __post_init__(self) -> None:
        """Refuse cutoffs that no sampled filter has."""
        if not self.dt > 0:
            raise InputError("invalid_value", f"a sampling step must be positive, not {self.dt:g} s")
        for f in self.cutoff_hz:
            if not 0 < f < 0.5 / self.dt:
                raise InputError(
                    "invalid_value", f"a cutoff of {f:g} Hz does not fit to samples every {1000 * self.dt:g} ms"
                )

    @property
    def axes(self) -> int:
        """Number of tool directions."""
        return len(self.cutoff_hz)

    def estimate(self, kinematic: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """Return tool positions (N, m) [m].

        Args:
            kinematic: Tool positions computed from the actuators (N, m) [m]; the robot is at rest at the first sample.
            acceleration: Acceleration of the tool, without gravity (N, m) [m/s^2].
        """
        rest = require_signals(kinematic, acceleration, self.axes)[0]
        slow = [p.run(kinematic[:, k] - rest[k]) for k, (p, _) in enumerate(self.pairs())]
        fast = [p.run(acceleration[:, k]) for k, (_, p) in enumerate(self.pairs())]
        return rest + np.column_stack(slow) + np.column_stack(fast)

    def operators(self, n: int) -> tuple[Operator, Operator]:
        """Return the estimate's (m n, m n) from positions and from accelerations, channel after channel: F_y in (7.7)."""
        pairs = [(p.matrix(n), a.matrix(n)) for p, a in self.pairs()]
        slow, fast = (_channelwise([pair[k] for pair in pairs]) for k in (0, 1))
        return slow, fast

    def responses(self, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the same as responses (F, m, m) at frequencies (F,) [Hz]."""
        slow, fast = ([p[k].response(frequency, self.dt) for p in self.pairs()] for k in (0, 1))
        return _diagonal_responses(slow), _diagonal_responses(fast)

    def standard_error(self, kinematic_noise: float | np.ndarray, acceleration_noise: float | np.ndarray) -> np.ndarray:
        """Return the estimate's standard deviation (m,) [m] from white noise of both sensors [m], [m/s^2].

        It does not contain systematic errors (deflection below the cutoff, errors of the accelerometer above it).
        """
        f = (np.arange(4096) + 0.5) / 8192 / self.dt
        slow, fast = self.responses(f)
        power = [np.mean(np.abs(np.einsum("fii->fi", x)) ** 2, axis=0) for x in (slow, fast)]
        return np.sqrt(power[0] * kinematic_noise**2 + power[1] * acceleration_noise**2)

    def pairs(self) -> list[tuple[Passes, Passes]]:
        """Return for each axis the filter of the position and that of the acceleration."""
        return [(_causal if self.causal else _zero_phase)(f, self.dt) for f in self.cutoff_hz]


@dataclass(frozen=True, eq=False)
class Passes:
    """A filter forwards, then another backwards, both from rest.

    Attributes:
        forwards: Numerator and denominator.
        backwards: The same, None for a causal filter.
        held: After its end the signal keeps its last value; otherwise it is zero there.
    """

    forwards: tuple[np.ndarray, np.ndarray]
    backwards: tuple[np.ndarray, np.ndarray] | None
    held: bool

    def run(self, x: np.ndarray) -> np.ndarray:
        """Filter (N, ...) along time; the backward pass begins one length after the end, where the response has settled."""
        if self.backwards is None:
            return np.asarray(lfilter(*self.forwards, x, axis=0))
        tail = np.repeat(x[-1:] * float(self.held), len(x), axis=0)
        once = np.asarray(lfilter(*self.forwards, np.concatenate([x, tail]), axis=0))
        b, a = self.backwards
        settled = once[-1] * np.sum(b) / np.sum(a)
        back = np.asarray(lfilter(b, a, once[::-1] - once[-1], axis=0))[::-1] + settled
        return back[: len(x)]

    def matrix(self, n: int) -> np.ndarray:
        """Return (n, n)."""
        return self.run(np.eye(n))

    def response(self, frequency: np.ndarray, dt: float) -> np.ndarray:
        """Return the response (F,) at frequencies (F,) [Hz]."""
        w = 2 * np.pi * np.asarray(frequency, float) * dt
        once = np.asarray(cast(Any, freqz)(*self.forwards, worN=w)[1])
        return (
            once if self.backwards is None else once * np.conj(np.asarray(cast(Any, freqz)(*self.backwards, worN=w)[1]))
        )


def _zero_phase(cutoff: float, dt: float) -> tuple[Passes, Passes]:
    low, high = (_arrays(butter(2, cutoff, kind, fs=1 / dt)) for kind in ("lowpass", "highpass"))
    size = (2 / dt * np.tan(np.pi * cutoff * dt)) ** 2
    return Passes(low, low, True), Passes((low[0] / size, low[1]), high, False)


def _arrays(ba: object) -> tuple[np.ndarray, np.ndarray]:
    b, a = cast(tuple[np.ndarray, np.ndarray], ba)
    return b, a


def _causal(cutoff: float, dt: float) -> tuple[Passes, Passes]:
    w = 2 / dt * np.tan(np.pi * cutoff * dt)
    below = [1, 2 * w, 2 * w**2, w**3]
    position = _arrays(bilinear(below[1:], below, fs=1 / dt))
    acceleration = _arrays(bilinear([1, 0], below, fs=1 / dt))
    return Passes(position, None, True), Passes(acceleration, None, False)


def _channelwise(matrices: Sequence[np.ndarray]) -> Operator:
    n, m = len(matrices[0]), len(matrices)

    def each(x: np.ndarray, transposed: bool) -> np.ndarray:
        return np.column_stack([(M.T if transposed else M) @ x[:, k] for k, M in enumerate(matrices)])

    return build_signal_operator(lambda x: each(x, False), lambda x: each(x, True), n, m, m)


def _diagonal_responses(channels: Sequence[np.ndarray]) -> np.ndarray:
    out = np.zeros((len(channels[0]), len(channels), len(channels)), complex)
    for k, response in enumerate(channels):
        out[:, k, k] = response
    return out
