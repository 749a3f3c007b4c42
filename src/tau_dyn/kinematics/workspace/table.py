"""The judged points of a workspace as a table: place, positions, whether it belongs, why not, and the maps where it does."""

from __future__ import annotations

import numpy as np
import pandas as pd

from tau_dyn.kinematics.workspace.lattice import INSIDE
from tau_dyn.kinematics.workspace.study import Study


def build_points_table(found: Study) -> pd.DataFrame:
    """Return one row a judged point, columns as a log's: `x_tool`.., `q_<joint>`, then `inside`, `reason` and the maps."""
    space = found.workspace
    index = np.rint((space.places - space.lattice.low) / space.lattice.step).astype(int)
    _, first = np.unique(index, axis=0, return_index=True)
    places, q, codes = space.places[first], space.q[first], space.place_codes[first]
    columns: dict[str, np.ndarray] = {f"{axis}_tool": places[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"q_{name}": q[:, k] for k, name in enumerate(space.machine.robot.actuated)}
    inside = codes == INSIDE
    columns["inside"] = inside.astype(int)
    words = {int(code): space.reasons.words(int(code)) for code in np.unique(codes)}
    columns["reason"] = np.array([words[int(code)] for code in codes], dtype=object)
    for name, value in found.quality.values(found.maps, q[inside], space.poses(places[inside])).items():
        columns[name] = np.full(len(codes), np.nan)
        columns[name][inside] = value
    return pd.DataFrame(columns)
