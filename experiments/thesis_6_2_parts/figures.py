"""Figures 6.2 to 6.7, and two of our own: which mass Table 6.2 asks for, and Table 6.3's residuals."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from tau_dyn.mechanism import GantryTauMechanism
from thesis_6_2_parts.friction import FrictionStudy
from thesis_6_2_parts.gravity import EXACT, GravityStudy
from thesis_6_2_parts.models import CircleStudy, ModelStudy
from thesis_6_2_parts.printed import CARTS, GRAVITY_MASS, NAMES, SYMBOLS, TABLE_6_1

INK, GREY, SOFT = "#1a1a1a", "#8a8a8a", "#d9d9d9"
COLOURS = dict(zip(SYMBOLS, ("#1a1a1a", "#0072b2", "#009e73", "#d55e00", "#cc79a7"), strict=True))
MARKERS = dict(zip(SYMBOLS, ("*", "s", "o", "D", "P"), strict=True))
plt.rcParams.update({
    "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.titlesize": 9, "axes.titlelocation": "left",
    "legend.frameon": False, "svg.hashsalt": "thesis_6_2", "figure.constrained_layout.use": True, "lines.linewidth": 1.0,
})  # fmt: skip


def save(figure: Figure, out_dir: Path, name: str) -> None:
    """Write a figure as PNG and SVG and close it."""
    figure.savefig(out_dir / f"{name}.png", dpi=150)
    figure.savefig(out_dir / f"{name}.svg", metadata={"Date": None})
    plt.close(figure)


def figure_6_2(gravity: GravityStudy) -> Figure:
    """Constant speed against force: cart 1 at the star, with gravity's share dotted."""
    figure, ax = plt.subplots(figsize=(4.6, 3.2))
    level = gravity.forces[0, 0]
    for sign, side in ((1, "pos"), (-1, "neg")):
        v = np.array([0, sign * 1.0])
        ax.plot(
            v, level + sign * TABLE_6_1[f"coulomb_{side}"][0] + TABLE_6_1[f"viscous_{side}"][0] * v, color=INK, lw=1.6
        )
        ax.annotate(
            "", (0, level + sign * TABLE_6_1[f"coulomb_{side}"][0]), (0, level), arrowprops={"arrowstyle": "->"}
        )
        text = f"$f_{{c1}}^{'+' if sign > 0 else '-'}$ = {TABLE_6_1[f'coulomb_{side}'][0]:.0f} N"
        ax.text(0.03 * sign, level + sign * 80, text, va="center", ha="left" if sign > 0 else "right")
    ax.axhline(level, color=GREY, ls=":")
    ax.text(1.0, level - 6, f"gravity {level:.0f} N", ha="right", va="top", color=GREY)
    ax.axvline(0, color=SOFT, lw=0.8, zorder=0)
    ax.set(
        xlabel="cart velocity [m/s]", ylabel="cart force [N]", title="6.2  Cart 1 at the star: friction about gravity"
    )
    return figure


def figure_6_3(mechanism: GantryTauMechanism, gravity: GravityStudy) -> Figure:
    """The y-z section with guideways and the fitted positions."""
    figure, ax = plt.subplots(figsize=(4.8, 4.8))
    rails = mechanism.origin[:, 1:]
    ax.plot(*rails.T, "s", ms=12, color=INK)
    for k, (y, z) in enumerate(rails):
        ax.annotate(f"guideway {k + 1}", (y, z), (0, -16 if z > 1 else 12), textcoords="offset points", ha="center")
    near = {"*": (8, 6), "square": (-9, -4), "circle": (8, 4), "diamond": (-10, 8), "+": (10, -3)}
    for s, (y, z), rms in zip(SYMBOLS, gravity.fitted, gravity.misfit, strict=True):
        ax.plot(y, z, MARKERS[s], ms=10, color=COLOURS[s], mfc=COLOURS[s] if rms < EXACT else "none", clip_on=False)
        note = "exact" if rms < EXACT else f"{rms:.0f} N off"
        ax.annotate(
            f"{NAMES[s]}, {note}", (y, z), near[s], textcoords="offset points", ha="left" if near[s][0] > 0 else "right"
        )
    ax.set(aspect="equal", xlim=(-1.75, 0.2), ylim=(-0.12, 1.56), xlabel="y [m]", ylabel="z [m]")
    ax.set_title(
        f"6.3  Positions fitted to Table 6.2 at {GRAVITY_MASS} kg\n(open symbols: no position in the frame fits)"
    )
    return figure


def figure_6_4(study: FrictionStudy) -> Figure:
    """Forces at 15 speeds both ways, the model identified at the star, gravity differences taken out."""
    figure, axes = plt.subplots(1, 3, figsize=(10, 3.4), sharex=True)
    table = study.table_6_1.set_index("parameter")["ours"]
    star = study.forces[study.forces["position"] == "*"]
    for j, ax in zip(CARTS, axes, strict=True):
        for s in SYMBOLS:
            here = study.forces[study.forces["position"] == s]
            ax.plot(here["speed_m_per_s"], here[f"{j}_compensated_N"], MARKERS[s], ms=7 if s == "*" else 5, mfc="none",
                    color=COLOURS[s], label=NAMES[s])  # fmt: skip
        middle = _gravity_level(star, table, j)
        for sign, side in ((1, "pos"), (-1, "neg")):
            v = np.array([0, sign * 1.0])
            ax.plot(
                v, middle + sign * table[f"{j}.coulomb_{side}"] + table[f"{j}.viscous_{side}"] * v, color=INK, zorder=0
            )
        ax.axhline(middle, color=GREY, ls=":")
        ax.set(title=f"actuator {j[-1]}", xlabel="cart velocity [m/s]")
    axes[0].set_ylabel("cart force [N]")
    axes[0].legend(loc="upper left", fontsize=8)
    figure.suptitle("6.4  Lines: model of the star; symbols: measured, less the difference in gravity; dotted: gravity", x=0.01,
                    ha="left", fontsize=9)  # fmt: skip
    return figure


def figure_6_5(circle: CircleStudy) -> Figure:
    """Measured force and model 2 over the fast and the slow motion that it was identified on."""
    figure, axes = plt.subplots(3, 1, figsize=(9, 5.4), sharex=True)
    run = circle.identified.estimate.regression.runs[0]
    modelled = run.W_all @ circle.identified.estimate.theta
    for k, ax in enumerate(axes):
        ax.plot(run.t, run.y_all[:, k], color=INK, lw=0.8, label="measured")
        ax.plot(run.t, modelled[:, k], color="#e69f00", lw=1.0, alpha=0.9, label="model 2")
        rms = circle.identified.train.rms[k]
        ax.set_ylabel(f"force {k + 1} [N]")
        ax.set_title(
            f"residual {rms:.1f} N rms, reversals left out" + ("   (fast until 40 s, then slow)" if k == 0 else "")
        )
    axes[0].legend(loc="lower right", ncols=2, fontsize=8, bbox_to_anchor=(1, 1))
    axes[-1].set_xlabel("time [s]")
    figure.suptitle("6.5  Estimation data and model 2", x=0.01, ha="left", fontsize=9)
    return figure


def figure_6_6(circle: CircleStudy) -> Figure:
    """The 1 cm circle: measured force and model 2, whose speed sign flickers with encoder noise."""
    figure, axes = plt.subplots(3, 1, figsize=(9, 5.4), sharex=True)
    t = circle.log.t - circle.log.t[0]
    for k, ax in enumerate(axes):
        ax.plot(t, circle.modelled[:, k], color="#e69f00", lw=0.7, label="model 2")
        ax.plot(t, circle.measured[:, k], color=INK, lw=0.5, label="measured")
        flips = f"{circle.flips[k]} sign changes of the noisy speed, {circle.reversals[k]} real"
        ax.set_title(f"misfit {circle.misfit[k]:.1f} N rms; {flips}")
        ax.set_ylabel(f"force {k + 1} [N]")
    axes[0].legend(loc="lower right", ncols=2, fontsize=8, bbox_to_anchor=(1, 1))
    axes[-1].set_xlabel("time [s]")
    title = "6.6  1 cm circle in 12 s: friction is 15 % larger near standstill than model 2 knows"
    figure.suptitle(title, x=0.01, ha="left", fontsize=9)
    return figure


def figure_6_7(circle: CircleStudy) -> Figure:
    """Cart speeds on the circle."""
    figure, ax = plt.subplots(figsize=(9, 2.4))
    for k, style in enumerate(("-", "--", ":")):
        ax.plot(
            circle.log.t - circle.log.t[0], 1e3 * circle.speed[:, k], style, color=INK, lw=1.3, label=f"cart {k + 1}"
        )
    ax.axhline(0, color=SOFT, lw=0.8, zorder=0)
    ax.legend(ncols=3, loc="upper right", fontsize=8)
    ax.set(xlabel="time [s]", ylabel="velocity [mm/s]", title="6.7  Cart velocities on the circle", ylim=(-5, 6))
    return figure


def figure_mass(gravity: GravityStudy) -> Figure:
    """Misfit of Table 6.2 against the mass, and the masses that each row allows."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2))
    profile = gravity.profile
    left.plot(profile["mass_kg"], profile["rms_N"], color=INK, lw=1.5)
    for mass, text, shift in (
        (9.13, "9.13 kg (motion)", (6, 0)),
        (11.5, "11.5 kg", (6, 0)),
        (GRAVITY_MASS, "22.38 kg", (4, 30)),
    ):
        left.plot(mass, gravity.rms_at(mass), "o", color="#d55e00")
        label = f"{text}: {gravity.rms_at(mass):.0f} N"
        line = {"arrowstyle": "-", "color": GREY} if shift[1] else None
        left.annotate(
            label, (mass, gravity.rms_at(mass)), shift, textcoords="offset points", va="bottom", arrowprops=line
        )
    left.set(
        xlabel="mass felt by gravity [kg]",
        ylabel="rms misfit of Table 6.2 [N]",
        ylim=(0, None),
        title="all rows at once",
    )
    for k, (s, (low, high)) in enumerate(zip(SYMBOLS, gravity.intervals, strict=True)):
        right.plot([low, high], [k, k], color=COLOURS[s], lw=5, solid_capstyle="butt")
        right.text(high + 0.4, k, f"{low:.1f} to {high:.1f} kg", va="center")
    right.axvline(GRAVITY_MASS, color=GREY, ls=":")
    right.text(GRAVITY_MASS - 0.2, -0.75, "22.38", ha="right", color=GREY)
    right.set(
        yticks=range(5),
        yticklabels=list(NAMES.values()),
        xlim=(8, 45),
        ylim=(4.6, -1),
        xlabel="mass felt by gravity [kg]",
    )
    right.set_title(f"each row alone: masses that fit within {EXACT} N")
    return figure


def figure_models(study: ModelStudy) -> Figure:
    """Residuals of the four models against the thesis', each over model 2's."""
    figure, axes = plt.subplots(1, 3, figsize=(9, 2.8), sharey=True)
    for j, ax in zip(CARTS, axes, strict=True):
        rows = study.table[study.table["cart"] == j]
        ax.plot(rows["model"], rows["e_ratio_thesis"], "s", color=INK, label="thesis")
        ax.plot(rows["model"], rows["e_ratio_floor"], "o", color="#d55e00", mfc="none", label="ours, 50 N floor")
        ax.set(xticks=[1, 2, 3, 4], xlabel="model", title=f"actuator {j[-1]}", yscale="log", yticks=[1, 2, 3, 5])
        ax.set_yticklabels(["1", "2", "3", "5"])
        ax.minorticks_off()
    axes[0].set_ylabel("$e_i$ over model 2's")
    axes[0].legend(loc="upper left", fontsize=8)
    return figure


def draw_all(
    out_dir: Path,
    mechanism: GantryTauMechanism,
    gravity: GravityStudy,
    friction: FrictionStudy,
    models: ModelStudy,
    circle: CircleStudy,
) -> None:
    """Draw and write all figures."""
    save(figure_6_2(gravity), out_dir, "figure_6_2")
    save(figure_6_3(mechanism, gravity), out_dir, "figure_6_3")
    save(figure_6_4(friction), out_dir, "figure_6_4")
    save(figure_6_5(circle), out_dir, "figure_6_5")
    save(figure_6_6(circle), out_dir, "figure_6_6")
    save(figure_6_7(circle), out_dir, "figure_6_7")
    save(figure_mass(gravity), out_dir, "figure_two_masses")
    save(figure_models(models), out_dir, "figure_table_6_3")


def _gravity_level(star: pd.DataFrame, table: pd.Series, j: str) -> float:
    """Return gravity's share at the star: what the model leaves of the mean force."""
    v, force = star["speed_m_per_s"].to_numpy(), star[f"{j}_N"].to_numpy()
    side = np.where(v > 0, "pos", "neg")
    friction = [
        np.sign(x) * table[f"{j}.coulomb_{s}"] + table[f"{j}.viscous_{s}"] * x for x, s in zip(v, side, strict=True)
    ]
    return float(np.mean(force - friction))
