"""Positions of a coupled robot from commands alone: servo loops whose loads are evaluated along the simulated motion itself.

Window by window, loads are evaluated along a motion, the loops are simulated, and the loads are evaluated along the result,
until convergence (waveform relaxation). The result does not depend on the first motion, which is the measured one if available.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism import Mechanism
from tau_dyn.servo.loads import InertialSpace, LoadWaves, count_slow, fill_coupled_loads, fill_coupled_matrices
from tau_dyn.servo.loop import FINE_STEP_S, simulate_motion
from tau_dyn.servo.records import LoopRecord, build_waves, move_to_stamps, refine, refine_record
from tau_dyn.servo.waves import JointCoupling, LoadRows, Trials
from tau_dyn.simulate import ServoLaw

WINDOW_S = 0.5
"""Length of a window over which loads and motion converge together [s]: a few time constants of a servo's loop, over which the
mass matrix changes little."""
MAX_SWEEPS = 16
"""Largest number of sweeps of a window; three are usual."""
SETTLED_RAD = 1e-5
"""Largest change of positions at which a window has converged [rad]: a hundredth of a step of a hobby servo's encoder. The next
sweep would change a tenth of it."""

UNSETTLED_RAD = 1e-4
"""Change of positions after the last sweep from which a window is reported as not converged [rad]: a tenth of an encoder's
step."""


class SimulatedMotion(NamedTuple):
    """A log's motion, simulated, at its samples (N, na): positions of the measured side, the links' positions and speeds.

    Positions of the measured side are at the log's stamps, the others on its clock. Accelerations are means over the time from
    half a sample before to half a sample after. `unsettled` is the time [s] from which loads and motion did not converge, or
    None.
    """

    q: np.ndarray
    link: np.ndarray
    v: np.ndarray
    a: np.ndarray
    unsettled: float | None = None


def simulate_coupled(
    space: InertialSpace,
    unknowns: np.ndarray,
    values: Mapping[str, np.ndarray],
    law: ServoLaw,
    records: Sequence[LoopRecord],
    step: float = FINE_STEP_S,
) -> list[SimulatedMotion]:
    """Return the motion of each record at its measured samples, joints coupled.

    Args:
        space: Inertial numbers.
        unknowns: Their unknowns (K,).
        values: Joint values and law entries (na,).
        law: The law, for the entries that differ between logs.
        records: Commands, starts and initial motions.
        step: Longest step of the loops [s].
    """
    fine = FineRecords.of(records, step)
    relaxation = _Relaxation(space.build_mechanism(unknowns), fine.guesses, fine.dt, fine.every)
    out = fine.simulate(relaxation, values, law)
    found = []
    for k, r in enumerate(fine.records):
        shown, q, v = (x[: len(r.t), :, 0, k] for x in out)
        around = max(1, fine.times // 2)
        half = np.clip(np.arange(len(q)) + np.array([[-around], [around]]), 0, len(q) - 1)
        a = (v[half[1]] - v[half[0]]) / ((half[1] - half[0])[:, None] * r.dt)
        first = relaxation.unsettled.get(k)
        shown = _pick_stamps(shown, records[k], fine.times)
        q, v, a = (x[:: fine.times] for x in (q, v, a))
        found.append(SimulatedMotion(shown, q, v, a, None if first is None else first * r.dt))
    return found


def _pick_stamps(q: np.ndarray, record: LoopRecord, times: int) -> np.ndarray:
    """Return positions (N, na) at a record's stamps from positions at `times` samples for each of its own."""
    if record.apart is None:
        return q[::times]
    at = np.clip(times * (np.arange(len(record.t)) + record.apart), 0, len(q) - 1)
    near = np.rint(at).astype(int)
    apart = np.zeros(len(q))
    apart[near] = at - near
    return move_to_stamps(q, apart[:, None])[near]


def differentiate_coupled(
    space: InertialSpace,
    trials: Trials,
    law: ServoLaw,
    records: Sequence[LoopRecord],
    step: float,
) -> list[np.ndarray]:
    """Return the changes of positions (N, na, C) of each record from the first trial to each one, joints coupled.

    Loads, mass matrix and slopes of gravity are those along the first trial's motion, so that joints respond to each other's
    changes of acceleration and position; the effect of another joint's change of speed on a load is neglected.
    """
    fine = FineRecords.of(records, step)
    first = {key: value[:, 0] for key, value in trials.values.items()}
    relaxation = _Relaxation(space.build_mechanism(trials.inertial[:, 0]), fine.guesses, fine.dt, fine.every)
    out = fine.simulate(relaxation, first, law)
    along = [[x[: len(r.t), :, 0, k] for x in out[1:]] for k, r in enumerate(fine.records)]
    held: dict[bytes, _HeldLoads] = {}
    shown = []
    for c in range(trials.inertial.shape[1]):
        key = trials.inertial[:, c].tobytes()
        if key not in held:
            mechanism = space.build_mechanism(trials.inertial[:, c])
            held[key] = _HeldLoads(_Relaxation(mechanism, along, fine.dt, fine.every))
        values = {name: value[:, c] for name, value in trials.values.items()}
        shown.append(np.array(fine.simulate(held[key], values, law)[0, :: fine.times, :, 0]))
    return [
        np.stack([x[: len(r.t), :, k] - shown[0][: len(r.t), :, k] for x in shown], axis=2)
        for k, r in enumerate(records)
    ]


class FineRecords(NamedTuple):
    """Records with samples between the measured ones, for steps of coupled joints.

    Attributes:
        records: The records.
        guesses: Motions near theirs, positions and speeds (N, na).
        times: Number of samples per measured one.
        every: Samples between matrices.
        step: Longest step [s].
    """

    records: Sequence[LoopRecord]
    guesses: Sequence[Sequence[np.ndarray]]
    times: int
    every: int
    step: float

    @classmethod
    def of(cls, records: Sequence[LoopRecord], step: float) -> FineRecords:
        """Return records as fine as a step requires."""
        times = max(1, int(np.ceil(max(r.dt for r in records) / step - 1e-9)))
        fine = [refine_record(r, times) for r in records]
        guesses = [[refine(x, times) for x in r.motion[:2]] for r in records]
        return cls(fine, guesses, times, count_slow(max(r.dt for r in fine)), step)

    @property
    def dt(self) -> list[float]:
        """Time between samples of each record [s]."""
        return [r.dt for r in self.records]

    def simulate(self, loads: _Relaxation | _HeldLoads, values: Mapping[str, np.ndarray], law: ServoLaw) -> np.ndarray:
        """Return measured positions, and the links' positions and speeds (3, N, na, 1, S)."""
        window = self.every * max(1, round(WINDOW_S / (self.every * max(self.dt))))
        empty = [_build_first_loads(loads.mechanism, r) for r in self.records]
        coupling = JointCoupling(self.every, window, loads.settle)
        waves = replace(build_waves(self.records, empty, law), step=self.step, held=True, coupling=coupling)
        return simulate_motion(waves, Trials({key: value[:, None] for key, value in values.items()}, np.zeros((0, 1))))


def _build_first_loads(mechanism: Mechanism, record: LoopRecord) -> LoadWaves:
    """Return empty loads except at the first sample, whose load twists a spring before the loops are stepped."""
    zero = np.zeros((*record.q.shape, 1))
    load, start = zero.copy(), record.q[:1] if record.start is None else np.atleast_2d(record.start)
    load[0, :, 0] = mechanism.inverse_dynamics(start, np.zeros_like(start), np.zeros_like(start))[0]
    return LoadWaves(load, zero, zero[..., 0], record.q)


@dataclass(frozen=True, eq=False)
class _Relaxation:
    """Loads of logs along the motion that is simulated with them, window by window.

    Attributes:
        mechanism: The robot's dynamics, without drive inertias.
        guesses: A motion near that of each log, positions and speeds (N, na).
        dt: Time between samples of each log [s].
        every: Samples between matrices.
        unsettled: Logs -> the first sample of the first window that did not converge; filled during the simulation.
    """

    mechanism: Mechanism
    guesses: Sequence[Sequence[np.ndarray]]
    dt: Sequence[float]
    every: int
    unsettled: dict[int, int] = field(default_factory=dict)

    def settle(self, rows: LoadRows, log: int, begin: int, stop: int, turn: int) -> int:
        """Evaluate loads along a window's motion, first along a guess from the window's start; return 1 if they converged."""
        part = slice(begin, stop + 1)
        if begin >= len(self.guesses[log][0]) - 1:  # beyond the log's end
            first = begin // self.every
            rows.inertia[part, :, log], rows.mass[log, first:] = rows.inertia[begin - 1, :, log], rows.mass[log, first]
            return 1
        if turn:
            change = float(np.abs(rows.motion[0, part, :, log] - rows.along[part, :, log]).max())
            if change > UNSETTLED_RAD and turn >= MAX_SWEEPS:
                self.unsettled.setdefault(log, begin)
            if not change > SETTLED_RAD or turn >= MAX_SWEEPS:
                return 1
        else:
            for x, guess in zip(rows.motion, self.guesses[log], strict=True):
                near = guess[np.minimum(np.arange(begin, stop + 1), len(guess) - 1)]
                x[part, :, log] = near + (x[begin, :, log] - near[0])
        if not np.isfinite(rows.motion[:, part, :, log]).all():
            self.unsettled.setdefault(log, begin)
            return 1  # trial values that no step can follow
        if not turn:  # loads contain the terms that the matrices of the first motion lack
            fill_coupled_matrices(self.mechanism, rows, log, part, self.every)
        fill_coupled_loads(self.mechanism, rows, log, part, self.every, self.dt[log])
        return 0


@dataclass(frozen=True, eq=False)
class _HeldLoads:
    """Loads along one motion, evaluated once and used for others near it.

    Attributes:
        relaxation: Evaluates them.
        kept: Log and start of a window -> whether it is beyond the log's end, and its rows.
    """

    relaxation: _Relaxation
    kept: dict[tuple[int, int], tuple[int, list[np.ndarray]]] = field(default_factory=dict)

    @property
    def mechanism(self) -> Mechanism:
        """The robot's dynamics."""
        return self.relaxation.mechanism

    def settle(self, rows: LoadRows, log: int, begin: int, stop: int, turn: int) -> int:
        """Write a window's loads; return 1 after its step."""
        if turn:
            return 1
        part, every = slice(begin, stop + 1), self.relaxation.every
        slow = slice(begin // every, -(-stop // every) + 1)
        views = [x[part, :, log] for x in (rows.along, rows.load, rows.inertia, rows.stiffness)]
        views += [rows.mass[log, slow], rows.slope[log, slow]]
        if (log, begin) not in self.kept:
            self.kept[log, begin] = self.relaxation.settle(rows, log, begin, stop, 0), [x.copy() for x in views]
        done, kept = self.kept[log, begin]
        for x, row in zip(views, kept, strict=True):
            x[:] = row
        return done
