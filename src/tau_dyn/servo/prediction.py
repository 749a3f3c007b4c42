"""Positions of a coupled robot from commands alone: servo loops whose loads are taken along the simulated motion itself.

Loads are taken along a motion, the loops are simulated, the loads are taken along the result, until nothing moves (waveform
relaxation). Where it ends does not depend on where it began; it begins with the measured motion, where there is one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from tau_dyn.servo.loop import FINE_STEP_S, simulate_loops, simulate_motion
from tau_dyn.servo.records import (
    InertialSpace,
    LoopRecord,
    build_waves,
    compute_held_loads,
    compute_load_waves,
    refine_record,
    smooth_motion,
)
from tau_dyn.servo.waves import Trials
from tau_dyn.simulate import ServoLaw

MAX_SWEEPS = 16
"""Sweeps of the relaxation at most; a position servo needs five, springs in front of coupled links more."""
SETTLED_RAD = (2e-5, 2e-4)
"""rms change of positions at which the relaxation ends, with fine and with long steps [rad]: a hundredth and a tenth of a step
of a hobby servo's encoder."""


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

    Accelerations are means over the time from half a sample before to half a sample after.
    """

    q: np.ndarray
    link: np.ndarray
    v: np.ndarray
    a: np.ndarray


def simulate_coupled(
    space: InertialSpace,
    unknowns: np.ndarray,
    values: Mapping[str, np.ndarray],
    law: ServoLaw,
    records: Sequence[LoopRecord],
    step: float,
) -> list[SimulatedMotion]:
    """Return the motion of each record, joints coupled; see `predict_positions`.

    Where the relaxation diverges, as of springs that swing in play, loads hold only what is slower than a servo's loop.
    """
    every = max(1, int(np.ceil(max(r.dt for r in records) / step - 1e-9)))
    fine = [refine_record(r, every) for r in records]
    space = replace(space, nominal=space.at(unknowns), directions=space.directions[:, :0])
    trial = Trials({key: value[:, None] for key, value in values.items()}, np.zeros((0, 1)))
    motions = [[np.repeat(x, every, axis=0)[: len(f.t)] for x in r.motion] for r, f in zip(records, fine, strict=True)]
    first = loads = [compute_load_waves(space, q, v, a, f.dt) for (q, v, a), f in zip(motions, fine, strict=True)]
    links: list[np.ndarray] = []
    change, smooth = np.inf, False
    for _ in range(MAX_SWEEPS):
        waves = replace(build_waves(space, fine, loads, law), step=step)
        both = simulate_motion(replace(waves, measured_on_motor=False), trial)  # loads are the links'
        before, links, speeds = links, *([x[: len(r.t), :, 0, k] for k, r in enumerate(fine)] for x in both)
        last, change = change, _compare(links, before) if before else np.inf
        if change < SETTLED_RAD[step > FINE_STEP_S]:
            break
        if not smooth and change > last:
            links, loads, smooth = [], first, True
        elif smooth:
            loads = [compute_load_waves(space, *smooth_motion(q, r.dt), r.dt) for q, r in zip(links, fine, strict=True)]
        else:
            loads = [compute_held_loads(space, *x, r.dt) for *x, r in zip(links, speeds, fine, strict=True)]
    out = simulate_loops(waves, trial) if waves.measured_on_motor else both[0]
    found = []
    for k, (r, q, v) in enumerate(zip(fine, links, speeds, strict=True)):
        around = max(1, every // 2)
        half = np.clip(np.arange(len(q)) + np.array([[-around], [around]]), 0, len(q) - 1)
        a = (v[half[1]] - v[half[0]]) / ((half[1] - half[0])[:, None] * r.dt)
        found.append(SimulatedMotion(*(x[::every] for x in (out[: len(r.t), :, 0, k], q, v, a))))
    return found


def _compare(found: Sequence[np.ndarray], before: Sequence[np.ndarray]) -> float:
    return max(float(np.sqrt(np.mean((a - b) ** 2))) for a, b in zip(found, before, strict=True))
