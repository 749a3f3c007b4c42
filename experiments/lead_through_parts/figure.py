"""The study's figure: Figures 8.4, 8.5 and 8.7 again, from the simulation."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from lead_through_parts.contact import ContactRun


def draw(path: Path, runs: dict[str, ContactRun], peg: tuple) -> None:
    """Write the figure: surface tracking, plate, cure and peg."""
    figure, axes = plt.subplots(2, 2, figsize=(9, 5.2), layout="constrained")
    _forces(axes[0, 0], runs, ("cardboard, handle alone", "cardboard, two sensors"), (0.5, 7.0), 5)
    _forces(axes[0, 1], runs, ("plate, 10 deg", "plate, 5 deg", "plate, 0 deg"), (4.25, 4.75), 1, step=5.0)
    _forces(axes[1, 0], runs, ("plate, 10 deg", "cure: calm normal and watch"), (4.25, 4.75), 1)
    run, deep, tilt = peg
    axes[1, 1].plot(run.t[::10], run.tool_force[::10], label="force [N]", lw=0.8)
    axes[1, 1].plot(run.t[::10], 100 * deep[::10], label="depth [cm]", lw=1.2)
    axes[1, 1].plot(run.t[::10], np.degrees(tilt[::10]), label="misalignment [deg]", lw=1.2)
    axes[1, 1].set_title("peg in hole", fontsize=9)
    for axis in axes.flat:
        axis.set_xlabel("time [s]", fontsize=8)
        axis.tick_params(labelsize=8)
        axis.legend(fontsize=7, loc="upper right")
        axis.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn = BytesIO()
    figure.savefig(drawn, dpi=85)
    plt.close(figure)
    Image.open(drawn).convert("RGB").quantize(128).save(path, optimize=True)


def _forces(axis, runs: dict[str, ContactRun], names: tuple[str, ...], span: tuple[float, float], every: int, step=0.0):
    for k, name in enumerate(names):
        run = runs[name].between(*span)
        shift = step * (len(names) - 1 - k)
        label = name + (f" (+{shift:g} N)" if shift else "")
        axis.plot(run.t[::every], run.tool_wrench[::every, 2] + shift, lw=0.8, label=label)
    axis.set_ylabel("tool force, normal [N]", fontsize=8)
