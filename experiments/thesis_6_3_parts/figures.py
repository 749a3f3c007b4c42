"""Figures 6.9 to 6.13 on the flexible robot."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from tau_dyn.modes.modal import list_zeros
from thesis_6_3_parts.black_box import BlackBox, held, true_response
from thesis_6_3_parts.drives import DriveStudy
from thesis_6_3_parts.pushes import PushStudy
from thesis_6_3_parts.robots import CARTS, with_wrist, without_wrist
from thesis_6_3_parts.wristless import WristlessStudy

INK, GREY, SOFT, RED, BLUE = "#1a1a1a", "#8a8a8a", "#d9d9d9", "#d55e00", "#0072b2"
plt.rcParams.update({
    "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.titlesize": 9, "axes.titlelocation": "left",
    "legend.frameon": False, "svg.hashsalt": "thesis_6_3", "figure.constrained_layout.use": True, "lines.linewidth": 1.0,
})  # fmt: skip


def draw_all(out_dir: Path, drives: DriveStudy, table: PushStudy, models: list[BlackBox], bare: WristlessStudy) -> None:
    figures = {
        "figure_6_9": figure_6_9(drives),
        "table_6_4": table_6_4(table),
        "figure_6_10": figure_6_10(models),
        "figure_6_11": figure_6_11(bare),
        "figure_6_12": figure_6_12(bare),
        "figure_6_13": figure_6_13(bare),
    }
    for name, figure in figures.items():
        figure.savefig(out_dir / f"{name}.png", dpi=150)
        figure.savefig(out_dir / f"{name}.svg", metadata={"Date": None})
        plt.close(figure)


def figure_6_9(drives: DriveStudy) -> Figure:
    """Carts on the step back that the models were not fitted on."""
    figure, axes = plt.subplots(1, 3, figsize=(8, 2.6), sharey=True)
    log, q = drives.held_out, with_wrist().q
    for k, (ax, cart) in enumerate(zip(axes, CARTS, strict=True)):
        t = log.t - log.t[0]
        ax.plot(t, 1e3 * (log.channels[f"q_ref_{cart}"] - q[k]), color=SOFT, label="reference")
        ax.plot(t, 1e3 * (log.channels[f"q_{cart}"] - q[k]), color=BLUE, lw=2, label="measured")
        ax.plot(t, 1e3 * drives.modelled[:, k], color=RED, ls="--", label="model")
        ax.set(xlabel="time [s]", xlim=(0, 1.2), title=f"{cart}, fit {drives.fit_percent[k]:.2f} %")
    axes[0].set_ylabel("position [mm]")
    axes[0].legend()
    return figure


def table_6_4(table: PushStudy) -> Figure:
    """Decays after pushes along x and along y."""
    figure, axes = plt.subplots(2, 2, figsize=(8, 4), sharex=True)
    for row, force in zip(axes, "xy", strict=True):
        log = table.logs[force]
        for ax, output in zip(row, "xy", strict=True):
            y = log.channels[f"{output}_tool"]
            ax.plot(log.t, 1e3 * (y - y[-500:].mean()), color=BLUE)
            whole, early, late = (np.median(part[force, output]) for part in (table.whole, table.early, table.late))
            ax.set(
                xlim=(0, 3),
                title=f"pushed along {force}: {output}, {whole:.1f} Hz (first {early:.1f}, later {late:.1f})",
            )
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    for ax in axes[:, 0]:
        ax.set_ylabel("displacement [mm]")
    return figure


def figure_6_10(models: list[BlackBox]) -> Figure:
    """(6.12) solid, (6.13) dashed, the flexible model itself in grey."""
    figure, axes = plt.subplots(2, 2, figsize=(8, 4.6), sharex=True)
    f = np.geomspace(0.3, 60, 3000)
    found = {m.name: m.model.frequency_response(f) for m in models if m.experiment == "plane"}
    truth = {side: true_response(side, f) * held(f)[:, None, None] for side in "rc"}
    for i, row in enumerate(axes):
        for j, ax in enumerate(row):
            for side in "rc":
                ax.loglog(f, np.abs(truth[side][:, i, j]), color=SOFT, lw=3)
            ax.loglog(f, np.abs(found["(6.12)"][:, i, j]), color=INK, label="(6.12), from the reference, order 7")
            ax.loglog(f, np.abs(found["(6.13)"][:, i, j]), color=INK, ls="--", label="(6.13), from the carts, order 10")
            ax.set(title=f"{'xy'[j]} to {'xy'[i]}", ylim=(1e-4, 60))
    for ax in axes[-1]:
        ax.set_xlabel("frequency [Hz]")
    for ax in axes[:, 0]:
        ax.set_ylabel("gain")
    axes[0, 0].legend(loc="lower left", fontsize=8)
    return figure


def figure_6_11(bare: WristlessStudy) -> Figure:
    """The 12th-order model from the pushes, and the flexible model itself in grey."""
    figure, axes = plt.subplots(1, 3, figsize=(8, 2.8), sharey=True)
    f = np.geomspace(3, 200, 3000)
    forces, tool = ([f"{s}{a}_tool" for a in "xyz"] for s in ("f", ""))
    truth = without_wrist().state_space().select(forces, tool).frequency_response(f) * held(f, 0.001)[:, None, None]
    model = bare.full.refined.model.frequency_response(f)
    for k, (ax, axis) in enumerate(zip(axes, "xyz", strict=True)):
        ax.loglog(f, 1e6 * np.abs(truth[:, k, k]), color=SOFT, lw=3, label="flexible model")
        ax.loglog(f, 1e6 * np.abs(model[:, k, k]), color=RED, label="12th order, identified")
        ax.set(xlabel="frequency [Hz]", title=f"push along {axis} to {axis}")
    axes[0].set_ylabel("receptance [µm/N]")
    axes[0].legend(fontsize=8)
    return figure


def figure_6_12(bare: WristlessStudy) -> Figure:
    """Poles and transmission zeros of the 12th-order model in the s plane."""
    figure, ax = plt.subplots(figsize=(4.2, 4.2))
    model = bare.full.refined.model
    poles, zeros = np.log(model.poles().astype(complex)) / model.dt, list_zeros(model)
    true = [2 * np.pi * m.frequency_hz * complex(-m.damping_ratio, np.sqrt(1 - m.damping_ratio**2))
            for m in without_wrist().modes() if m.frequency_hz < 75]  # fmt: skip
    ax.plot(np.real(true), np.imag(true) / (2 * np.pi), "o", color=SOFT, ms=9, label="flexible model")
    ax.plot(poles.real[poles.imag > 0], poles.imag[poles.imag > 0] / (2 * np.pi), "x", color=RED, label="poles")
    ax.plot(zeros.real, zeros.imag / (2 * np.pi), "o", mfc="none", color=BLUE, ms=5, label="zeros")
    ax.set(xlim=(-30, 5), ylim=(0, 75), xlabel="real part [1/s]", ylabel="imaginary part / 2π [Hz]")
    ax.axvline(0, color=SOFT, lw=0.8, zorder=0)
    ax.legend()
    return figure


def figure_6_13(bare: WristlessStudy) -> Figure:
    """Pushes that the model was not fitted on: measured blue, model red."""
    figure, axes = plt.subplots(3, 1, figsize=(8, 4.6), sharex=True)
    for k, (ax, axis) in enumerate(zip(axes, "xyz", strict=True)):
        record, simulated = bare.full.held_out[k], bare.full.simulated[k]
        t = np.arange(len(simulated)) * record.dt
        ax.plot(t, 1e3 * record.y[:, k], color=BLUE, lw=1.5)
        ax.plot(t, 1e3 * simulated[:, k], color=RED, lw=0.8)
        ax.set(xlim=(0, 1.2), ylabel=f"{axis} [mm]", title=f"pushed along {axis}")
    axes[-1].set_xlabel("time [s]")
    return figure
