"""The power curve: how often an effect of strength lambda is found, beside the Neyman-Pearson limit."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd

from hidden_effects_parts.summary import interval, limit

mpl.use("Agg")
import matplotlib.pyplot as plt

EDGES = np.array([15, 22, 30, 42, 60, 85, 120, 200, 350, 600])


def power_curve(table: pd.DataFrame, path: Path) -> None:
    """Draw it for single known and unknown effects."""
    figure, axis = plt.subplots(figsize=(6.4, 3.8))
    grid = np.geomspace(10, 700, 200)
    for dof, style in ((1, "-"), (4, ":")):
        name = f"Neyman-Pearson limit, {dof} degree{'s' if dof > 1 else ''} of freedom"
        axis.semilogx(grid, 100 * limit(grid, table, dof), style, color="0.5", label=name)
    for what, colour, shift in (("single", "#1b6ca8", 0.97), ("unknown", "#c8553d", 1.03)):
        rows = table[(table["what"] == what) & ~table["form"].isin(("Payload", "LinkMass"))]
        if not len(rows):
            continue
        strength, seen = rows["lambda"].astype(float).to_numpy(), rows["detected"].astype(bool).to_numpy()
        place = np.digitize(strength, EDGES) - 1
        for k in np.unique(place):
            inside = place == k
            n, hits = int(inside.sum()), int(seen[inside].sum())
            low, high = interval(hits, n)
            x, y = shift * np.exp(np.mean(np.log(strength[inside]))), 100 * hits / n
            axis.errorbar(x, y, [[y - 100 * low], [100 * high - y]], fmt="o", ms=4, color=colour, lw=1)
        axis.plot([], [], "o", color=colour, label=f"{what} effects, 95 % intervals")
    axis.set(xlabel="strength lambda on the training part", ylabel="found [%]", ylim=(0, 102))
    axis.set_xticks([15, 30, 60, 120, 240, 480], ["15", "30", "60", "120", "240", "480"])
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.legend(loc="lower right", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    plt.close(figure)
