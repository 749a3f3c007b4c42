"""Positions of a coupled robot from commands alone: servo loops whose loads are taken along the simulated motion itself.

Loads are taken along a motion, the loops are simulated, the loads are taken along the result, until nothing moves (waveform
relaxation). Where it ends does not depend on where it began; it begins with the measured motion, where there is one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from tau_dyn.servo.loop import FINE_STEP_S, simulate_loops
from tau_dyn.servo.records import InertialSpace, LoadWaves, LoopRecord, build_waves, compute_load_waves, smooth_motion
from tau_dyn.servo.waves import Trials
from tau_dyn.simulate import ServoLaw

MAX_SWEEPS = 8
"""Sweeps of the relaxation at most; a position servo needs two or three."""
SETTLED_RAD = 2e-4
"""rms change of positions at which the relaxation ends [rad]: a tenth of a step of a hobby servo's encoder."""


def predict_positions(
    space: InertialSpace,
    unknowns: np.ndarray,
    values: Mapping[str, np.ndarray],
    law: ServoLaw,
    records: Sequence[LoopRecord],
    loads: Sequence[LoadWaves] | None = None,
    step: float = FINE_STEP_S,
) -> list[np.ndarray]:
    """Return simulated positions (N, na) of each record.

    Args:
        space: Inertial numbers.
        unknowns: Their unknowns (K,).
        values: Joint values and law entries (na,).
        law: Says what differs by log.
        records: Commands, starts and motions to begin with.
        loads: Loads along the records' measured motions, where they are known.
        step: Longest step of the loops [s], that of the fit.
    """
    trials = Trials({key: value[:, None] for key, value in values.items()}, unknowns[:, None])
    loads = loads or [compute_load_waves(space, *r.motion, r.dt) for r in records]
    found: list[np.ndarray] = []
    for sweep in range(MAX_SWEEPS):
        waves = replace(build_waves(space, records, loads, law), step=step)
        before, found = found, _cut(simulate_loops(waves, trials), records)
        if (
            before
            and max(float(np.sqrt(np.mean((a - b) ** 2))) for a, b in zip(found, before, strict=True)) < SETTLED_RAD
        ):
            break
        if sweep + 1 < MAX_SWEEPS:
            links = found  # loads are the links'; where motors are measured, both start with the same twist
            if waves.measured_on_motor and np.any(trials.values["joint_compliance"] + trials.values["backlash"]):
                links = _cut(simulate_loops(replace(waves, measured_on_motor=False), trials), records)
            motions = [smooth_motion(q, r.dt) for q, r in zip(links, records, strict=True)]
            loads = [compute_load_waves(space, *motion, r.dt) for motion, r in zip(motions, records, strict=True)]
    return found


def _cut(out: np.ndarray, records: Sequence[LoopRecord]) -> list[np.ndarray]:
    """Return the positions (N, na) of each record, of one trial."""
    return [out[: len(r.t), :, 0, k] for k, r in enumerate(records)]
