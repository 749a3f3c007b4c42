"""Positions of a coupled robot from commands alone: servo loops whose loads are taken along the simulated motion itself.

Window by window, loads are taken along a motion, the loops are simulated, the loads are taken along the result, until nothing
moves (waveform relaxation). Where it ends does not depend on where it began: with the measured motion, where there is one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from tau_dyn.mechanism import Mechanism
from tau_dyn.servo.loop import FINE_STEP_S, simulate_motion
from tau_dyn.servo.records import (
    InertialSpace,
    LoadWaves,
    LoopRecord,
    build_waves,
    count_slow,
    fill_coupled_loads,
    fill_coupled_matrices,
    refine,
    refine_record,
)
from tau_dyn.servo.waves import JointCoupling, LoadRows, Trials
from tau_dyn.simulate import ServoLaw

WINDOW_S = 0.5
"""Length over which loads and motion settle together before the next window begins [s]: a few time constants of a servo's loop,
over which the mass matrix changes little."""
MAX_SWEEPS = 16
"""Sweeps of a window at most; three are usual."""
SETTLED_RAD = 1e-5
"""Largest change of positions at which a window has settled [rad]: a hundredth of a step of a hobby servo's encoder. The next
sweep would change a tenth of it."""

UNSETTLED_RAD = 1e-4
"""Change of positions after the last sweep from which a window is told as not settled [rad]: a tenth of an encoder's step."""


def predict_positions(
    space: InertialSpace,
    unknowns: np.ndarray,
    values: Mapping[str, np.ndarray],
    law: ServoLaw,
    records: Sequence[LoopRecord],
    step: float = FINE_STEP_S,
) -> list[np.ndarray]:
    """Return simulated positions (N, na) of each record, at its measured samples.

    Args:
        space: Inertial numbers.
        unknowns: Their unknowns (K,).
        values: Joint values and law entries (na,).
        law: Says what differs by log.
        records: Commands, starts and motions to begin with.
        step: Longest step of the loops [s].
    """
    return [x.q for x in simulate_coupled(space, unknowns, values, law, records, step)]


class SimulatedMotion(NamedTuple):
    """A log's motion, simulated, at its samples (N, na): positions of the measured side, the links' positions and speeds.

    Accelerations are means over the time from half a sample before to half a sample after. `unsettled` is the time [s] from
    which loads and motion kept changing each other, None where they settled.
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
    step: float,
) -> list[SimulatedMotion]:
    """Return the motion of each record, joints coupled; see `predict_positions`."""
    times = max(1, int(np.ceil(max(r.dt for r in records) / step - 1e-9)))
    fine = [refine_record(r, times) for r in records]
    every = count_slow(max(r.dt for r in fine))
    guesses = [[refine(x, times) for x in r.motion[:2]] for r in records]
    mechanism = space.build_mechanism(unknowns)
    relaxation = _Relaxation(mechanism, guesses, [r.dt for r in fine], every)
    window = every * max(1, round(WINDOW_S / (every * max(r.dt for r in fine))))
    empty = [_build_first_loads(mechanism, r) for r in fine]
    waves = replace(
        build_waves(fine, empty, law), step=step, held=True, coupling=JointCoupling(every, window, relaxation.settle)
    )
    trial = Trials({key: value[:, None] for key, value in values.items()}, np.zeros((0, 1)))
    out = simulate_motion(waves, trial)
    found = []
    for k, r in enumerate(fine):
        shown, q, v = (x[: len(r.t), :, 0, k] for x in out)
        around = max(1, times // 2)
        half = np.clip(np.arange(len(q)) + np.array([[-around], [around]]), 0, len(q) - 1)
        a = (v[half[1]] - v[half[0]]) / ((half[1] - half[0])[:, None] * r.dt)
        first = relaxation.unsettled.get(k)
        shown, q, v, a = (x[::times] for x in (shown, q, v, a))
        found.append(SimulatedMotion(shown, q, v, a, None if first is None else first * r.dt))
    return found


def _build_first_loads(mechanism: Mechanism, record: LoopRecord) -> LoadWaves:
    """Return no loads but that of the first sample, which twists a spring before the loops are stepped."""
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
        unsettled: Logs -> the first sample of the first window that did not settle; filled on the way.
    """

    mechanism: Mechanism
    guesses: Sequence[Sequence[np.ndarray]]
    dt: Sequence[float]
    every: int
    unsettled: dict[int, int] = field(default_factory=dict)

    def settle(self, rows: LoadRows, log: int, begin: int, stop: int, turn: int) -> int:
        """Take loads along a window's motion, at first along a guess that starts where the window does; 1 where they settled."""
        part = slice(begin, stop + 1)
        if begin >= len(self.guesses[log][0]) - 1:  # beyond the log's end, where the joints are of no interest
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
        if not turn:  # loads hold what the matrices of the first motion do not
            fill_coupled_matrices(self.mechanism, rows, log, part, self.every)
        fill_coupled_loads(self.mechanism, rows, log, part, self.every, self.dt[log])
        return 0
