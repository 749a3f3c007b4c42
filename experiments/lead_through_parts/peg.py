"""A peg and a hole that does not point at it."""

from __future__ import annotations

import numpy as np
import pandas as pd

from lead_through_parts.scene import BuildLaw, insert
from tau_dyn.control.lead_through import LeadThrough

CASES = {
    "match (1 N/mm), 4 deg": (1e3, 4.0, {}),
    "stiffer (5 N/mm), 4 deg": (5e3, 4.0, {}),
    "stiffer (5 N/mm), 6 deg": (5e3, 6.0, {}),
    "clearance 0.4 mm, 4 deg": (1e3, 4.0, {"clearance": 0.0004}),
    "match, 4 deg, handle alone": (1e3, 4.0, {"tool_force": False}),
}


def study(runs: int, seed: int, law: BuildLaw = LeadThrough) -> tuple[pd.DataFrame, tuple]:
    """Return a table over runs (the worst of them) and the first insertion: run, depth, tilt."""
    rows, first = [], None
    for name, (stiffness, tilt, options) in CASES.items():
        made = [insert(stiffness, tilt, seed + k, law=law, **options) for k in range(runs)]
        first = first or made[0]
        rows.append(
            {
                "case": name,
                "inserted": f"{sum(deep[-1] > 0.029 for _, deep, _ in made)} of {runs}",
                "least depth [mm]": 1e3 * min(deep[-1] for _, deep, _ in made),
                "peak force [N]": max(run.tool_force.max() for run, _, _ in made),
                "peak torque [N m]": max(np.linalg.norm(run.tool_wrench[:, 3:], axis=1).max() for run, _, _ in made),
                "tilt at the end [deg]": np.degrees(np.mean([off[-1] for _, _, off in made])),
            }
        )
    assert first is not None
    return pd.DataFrame(rows), first
