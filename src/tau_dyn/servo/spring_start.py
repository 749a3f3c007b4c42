"""Where the fit of a spring begins: a rigid fit first, then springs at resonances an octave apart, the best at each joint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tau_dyn.servo.cause_search import free_causes, list_starts
from tau_dyn.servo.data import BASELINE, LoopData, fit_precisely, keep_kinds
from tau_dyn.servo.fit import fit_loop

CAUSE = "joint_compliance"
_ITERATIONS = 8  # of each start
_FEW = 0.1  # of the usual start values of friction that a spring's fit did not have


def start_springs(data: LoopData, progress: Callable[[str], None]) -> LoopData:
    """Return the data with unknowns at start values near a spring, where the law asks for one; else as they are."""
    if CAUSE not in data.law.estimated:
        return data
    progress("springs from several starts")
    zero = np.zeros(len(data.law.joints))
    stiff = replace(data, law=data.law.with_values(joint_compliance=zero, joint_damping=zero))
    u = keep_kinds(stiff, BASELINE)
    u = replace(u, values={**u.values, CAUSE: zero, "joint_damping": zero})
    base = fit_precisely(stiff.build_problem(u), progress)
    places = [(CAUSE, j) for j in range(len(zero))]
    file = {key: np.array(data.law.values[key]) for key in (CAUSE, "joint_damping")}
    starts = [*list_starts(stiff, u, base, CAUSE), *([file] if np.all(file[CAUSE] > 0) else [])]
    sigmas = [
        fit_loop(
            stiff.build_problem(free_causes(stiff, u, base, places, {CAUSE: start})), max_iterations=_ITERATIONS,
        ).sigma
        for start in starts
    ]  # fmt: skip
    best = np.argmin(sigmas, axis=0)
    start = {key: np.array([starts[k][key][j] for j, k in enumerate(best)]) for key in file}
    wide = free_causes(stiff, u, base, places, {CAUSE: start})
    found = wide.with_values(fit_precisely(stiff.build_problem(wide), progress).x)
    values = {key: np.array(x) for key, x in data.unknowns.values.items()}
    values |= {key: found[key] for key in (*BASELINE, *file) if key in values}
    values["command_delay"] = np.array(data.law.values["command_delay"])  # the rigid screen's stands for the spring
    for kind in ("load_friction", "stiction"):
        values[kind] = np.where(data.law.values[kind] > 0, values[kind], _FEW * values[kind])
    return replace(data, unknowns=replace(data.unknowns, values=values))
