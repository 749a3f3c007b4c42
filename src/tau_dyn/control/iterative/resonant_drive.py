"""A drive with resonances as `modes` identifies it, and the learning filter that inverts a response.

The inverse that leaves the smallest mean square `|1 - L G|^2 + |L|^2 s^2` of an error, if the response G has the standard error
s, is

    L = gain conj(G) / (|G|^2 + s^2)

For a gain up to 1 that mean square is below 1 at every frequency, so no resonance has to be left out of the learning; where G is
known poorly, L is small [Bristow, Tharayil, Alleyne 2006, IEEE Control Systems 26; de Roover & Bosgra 2000, Int. J. Control 73].
L acts on a whole trial, before and after each sample, since a trial is known to its end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.linalg import toeplitz

from tau_dyn.exceptions import InputError
from tau_dyn.modes import StateSpace, load_state_space, simulate_states

FREQUENCY_TOLERANCE = 0.02
"""Relative error of a model's frequencies that is allowed for, as in `observe`."""
_SLOW_HZ = 0.05  # where the phase of a model gives its time constant


class DriveModel(Protocol):
    """A model of one drive, from command to position."""

    @property
    def gain(self) -> float:
        """Static gain."""
        ...

    @property
    def time_constant(self) -> float:
        """Time constant [s]."""
        ...

    @property
    def delay(self) -> float:
        """Dead time [s]."""
        ...

    def simulate(self, reference: np.ndarray, dt: float) -> np.ndarray:
        """Return positions (N,) to a reference (N,), at rest at its first value."""
        ...

    def response(self, frequency: np.ndarray, dt: float) -> np.ndarray:
        """Return the response (F,) at frequencies (F,) [Hz]."""
        ...

    def unsure(self, frequency: np.ndarray, dt: float) -> np.ndarray:
        """Return the relative error (F,) of the response that the model's own tolerance leaves."""
        ...


@dataclass(frozen=True, eq=False)
class ResonantDrive:
    """One drive as a state-space model.

    Attributes:
        model: From one command to one position, stable.
    """

    model: StateSpace

    @property
    def gain(self) -> float:
        """Static gain."""
        return float(self.model.frequency_response(np.zeros(1))[0, 0, 0].real)

    @property
    def delay(self) -> float:
        """Dead time [s]."""
        return self.model.delay * self.model.dt

    @property
    def time_constant(self) -> float:
        """Lag of a slow motion beyond the delay [s], at least a sample."""
        slow = self.model.frequency_response(np.array([_SLOW_HZ]))[0, 0, 0] / self.gain
        return max(float(-np.angle(slow)) / (2 * np.pi * _SLOW_HZ) - self.delay, self.model.dt)

    def simulate(self, reference: np.ndarray, dt: float) -> np.ndarray:
        """Return positions (N,) to a reference (N,), at rest at its first value."""
        del dt  # the model's own
        rise = np.asarray(reference, float) - reference[0]
        late = min(self.model.delay, len(rise))
        u = np.concatenate([np.zeros(late), rise[: len(rise) - late]])[:, None]
        states = simulate_states(self.model.A, u @ self.model.B.T, np.zeros(self.model.order))
        return self.gain * reference[0] + (states @ self.model.C.T + u @ self.model.D.T)[:, 0]

    def response(self, frequency: np.ndarray, dt: float) -> np.ndarray:
        """Return the response (F,) at frequencies (F,) [Hz]."""
        del dt
        return self.model.frequency_response(frequency)[:, 0, 0]

    def unsure(self, frequency: np.ndarray, dt: float) -> np.ndarray:
        """Return the relative change (F,) of the response if all frequencies of the model are off by the tolerance."""
        f = np.asarray(frequency, float)
        ends = [
            self.response(np.minimum(f * (1 + k), 0.5 / dt), dt) for k in (-FREQUENCY_TOLERANCE, FREQUENCY_TOLERANCE)
        ]
        return np.abs(ends[1] - ends[0]) / (2 * np.maximum(np.abs(self.response(f, dt)), 1e-300))


def read_resonant_drives(path: str | Path, names: Sequence[str], dt: float) -> tuple[ResonantDrive, ...]:
    """Return the drives of a model that `modes --out` wrote, one an input, in the order of its columns.

    Args:
        path: The file. Only the response from input k to output k is used.
        names: Drives or axes to learn; as many as the model has inputs and outputs.
        dt: Sampling step of the trials [s].

    Raises:
        InputError: Another number of inputs or outputs, another step, or a model that is unstable or has no static gain.
    """
    found = load_state_space(path)
    whole, n = found.model, len(names)
    if (len(found.inputs), len(found.outputs)) != (n, n):
        raise InputError(
            "mismatch",
            f"{path}: it has the inputs {', '.join(found.inputs)} and the outputs {', '.join(found.outputs)}; learning "
            f"{', '.join(names)} takes {n} of each, commands and positions in this order",
        )
    if abs(whole.dt / dt - 1) > 1e-3:
        raise InputError(
            "mismatch", f"{path}: it is made for steps of {1e3 * whole.dt:g} ms, the trials have {1e3 * dt:g} ms"
        )
    if not whole.spectral_radius() < 1:
        raise InputError(
            "unstable", f"{path}: the model is unstable; identify one in closed loop, from command to position"
        )
    one = [
        replace(whole, B=whole.B[:, [k]], C=whole.C[[k]], D=whole.D[[k]][:, [k]], K=whole.K[:, [k]], noise=None)
        for k in range(n)
    ]
    drives = tuple(ResonantDrive(m) for m in one)
    weak = next((k for k, d in enumerate(drives) if not 0.1 < d.gain < 10), None)
    if weak is not None:
        raise InputError(
            "mismatch",
            f"{path}: {found.outputs[weak]} follows {found.inputs[weak]} with a static gain of {drives[weak].gain:.3g}; a "
            "command and its position have one near 1",
        )
    return drives


@dataclass(frozen=True, eq=False)
class ResponseInverse:
    """L that inverts a response known at evenly spaced frequencies; a learning filter like `TimeShift`.

    Attributes:
        values: L at the frequencies of a transform of `length` samples (length // 2 + 1,), zero first.
        length: Samples of the transform, at least twice those of a trial.
        dt: Sampling step [s].
    """

    values: np.ndarray
    length: int
    dt: float

    def apply(self, e: np.ndarray) -> np.ndarray:
        """Return errors (N, ...) through L."""
        return self._pass(e, self.values)

    def transposed(self, e: np.ndarray) -> np.ndarray:
        """Return signals (N, ...) through the transposed matrix."""
        return self._pass(e, self.values.conj())

    def matrix(self, n: int) -> np.ndarray:
        """Return (n, n)."""
        pulse = np.fft.irfft(self.values, self.length)
        return toeplitz(pulse[:n], np.concatenate([pulse[:1], pulse[:-n:-1]]))

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Return the response (F,) at frequencies (F,) [Hz], without the effects of both ends."""
        known, f = np.fft.rfftfreq(self.length, self.dt), np.asarray(frequency, float)
        return np.interp(f, known, self.values.real) + 1j * np.interp(f, known, self.values.imag)

    def _pass(self, e: np.ndarray, values: np.ndarray) -> np.ndarray:
        spectrum = np.fft.rfft(e, self.length, axis=0)
        return np.fft.irfft(values.reshape(-1, *(1,) * (e.ndim - 1)) * spectrum, self.length, axis=0)[: len(e)]
