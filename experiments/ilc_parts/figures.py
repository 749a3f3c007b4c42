"""Figures 7.10, 7.14, 7.16, 7.17 of the thesis, from the simulated robot."""

from pathlib import Path

import numpy as np
from ilc_parts.bench import AXES

from tau_dyn.control.iterative import LearningHistory, UpdateLaw, compute_frequency_condition

COLOURS = {"1": "0.5", "2A": "tab:blue", "2B": "tab:red", "3": "tab:green", "3, norm-optimal": "tab:purple"}


def draw(folder: Path, learnt: dict[str, list[LearningHistory]], known: dict[str, UpdateLaw]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update({"svg.hashsalt": "tau_dyn", "svg.fonttype": "none"})
    import matplotlib.pyplot as plt

    folder.mkdir(parents=True, exist_ok=True)
    figure, axes = plt.subplots(1, 2, figsize=(7.5, 3), sharey=True)
    for name, runs in learnt.items():
        relative = np.mean([r.relative("tool_errors") for r in runs], axis=0)
        for k, axis in zip(AXES, axes, strict=True):
            axis.plot(relative[:, k], "o-", ms=3, lw=1, color=COLOURS[name], label=f"case {name}")
    for name, axis in zip("xy", axes, strict=True):
        axis.set(xlabel="trial", title=f"tool error in {name}", ylim=(0, 105))
    axes[0].set_ylabel("% of the first")
    axes[1].legend(fontsize=8)
    _keep(figure, folder / "ilc_errors.svg")

    figure, axes = plt.subplots(1, 3, figsize=(9, 3), sharey=True)
    for name, axis in zip(("2A", "2B", "3"), axes, strict=True):
        seen = compute_frequency_condition(known[name], np.geomspace(0.5, 60, 300))
        if seen is None:
            continue
        axis.loglog(seen.frequency, seen.bound[:, 0], "k", lw=1.2, label="1 / |Q|")
        for k, style in enumerate(("-", "--")):
            axis.loglog(
                seen.frequency, seen.left[:, k], style, color=COLOURS[name], lw=0.9, label=f"|1 - L T|, {'xy'[k]}"
            )
        axis.set(xlim=(0.5, 60), ylim=(0.05, 200), xlabel="frequency [Hz]", title=f"case {name}")
        axis.legend(fontsize=7)
    _keep(figure, folder / "ilc_frequency.svg")

    figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), sharey=True, sharex=True)
    for name, axis in zip(("1", "2B", "3"), axes, strict=True):
        done = learnt[name][0]
        part = done.motion.full
        reference = 1e3 * (done.motion.tool - done.motion.tool[0])
        for k, colour in ((0, "0.7"), (-1, COLOURS[name])):
            tool = reference - 1e3 * done.tool_errors[k]
            axis.plot(tool[part, 0][::2], tool[part, 1][::2], color=colour, lw=0.8)
        axis.plot(reference[part, 0][::4], reference[part, 1][::4], "k", lw=1)
        axis.set(title=f"case {name}", xlabel="x [mm]", aspect="equal")
    axes[0].set_ylabel("y [mm]")
    _keep(figure, folder / "ilc_paths.svg")


def _keep(figure, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})
