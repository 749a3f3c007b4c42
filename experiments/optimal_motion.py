"""Minimum time against effort, free and along a line: Table 3.1 and Figures 3.9 and 3.10 of Dressler 2012, on L1's model.

    python experiments/optimal_motion.py [--runs 20] [--seed 0] [--figures docs/figures]

The simplified Gantry-Tau with L1's masses, 300 N a cart, rest to rest over 0.97 m, cart 3 travelling furthest as in the thesis.
Weights are the thesis', converted by the ratio of the drives' limits (its motors' limit follows from its table, see `weight`).
Printed: the table; motions planned with the friction of Table 6.1 within 800 N less what `compute_feedback_margin` keeps for
the feedback,
run on a simulated plant whose masses and friction are off by up to 5 %; a serial arm and robots with loops; how the solver
fares between random ends. The answer stands in docs/results/control.md.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import pandas as pd

from tau_dyn.cli.demo import TABLE_6_1
from tau_dyn.control import Feedforward
from tau_dyn.control.motion import (
    MotionLimits,
    MotionPlan,
    compute_feedback_margin,
    estimate_feedback_noise,
    plan_motion,
)
from tau_dyn.effects import build_friction_model
from tau_dyn.exceptions import TauDynError
from tau_dyn.model import Model
from tau_dyn.robot import load_robot
from tau_dyn.simulate import CascadeController, CascadeLaw, Sensors, simulate_drive

START, END = np.array([1.3, -0.75, 0.65]), np.array([2.2, -0.45, 0.85])  # [m]
FORCE = 300.0  # [N] a cart
DRIVE = 800.0  # [N] a cart where friction counts
NOISES = (1e-6, 5e-6)  # [m] of the encoders
OFF = 0.05  # by which the plant's masses and friction differ from the model's at most
UNKNOWN = 0.1  # share of the forces that this may come to: 1.05 / 0.95, as masses and their coupling are off both ways
THESIS = {"w = 0": (0.9074, 103.8448, 199), "w = 0.001": (0.9191, 77.0024, 53), "w = 0.01": (0.9968, 50.1301, 26),
          "line": (0.97612, 57.32659, 70)}  # fmt: skip
CASES = {"w = 0": (0.0, None), "w = 0.001": (0.001, None), "w = 0.01": (0.01, None), "line": (0.0, "line")}
MOTOR = np.sqrt(103.8448 / (3 * 0.9074))
"""Torque [N m] that three motors at their limits all the time would have: Table 3.1's energy over its time, w = 0."""
IRB140 = Path(__file__).parent / "lead_through_parts" / "irb140.urdf"
NEAR_HOME = np.array([1.625, -0.65, 0.71]), np.array([2.0, -0.5, 0.83])  # [m] tool of the Gantry-Tau
PICK = np.array([-0.05, -0.025, -0.765]), np.array([0.05, 0.025, -0.815])  # [m] tool of the delta robot
BOX = np.array([0.6, 0.35, 0.25])  # [m] to either side of home, for random ends
FREE_SPEED = 10.0  # [m/s] for the carts: the thesis limits forces alone


def weight(w: float) -> float:
    """Return a weight of the thesis [s per (N m)^2 s] as one of squared cart forces, the drives' limits alike."""
    return w * (MOTOR / FORCE) ** 2


def l1_with_friction() -> Model:
    robot = load_robot("gantry_tau", prototype="l1")
    model = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    names = ("coulomb_neg", "coulomb_pos", "viscous_neg", "viscous_pos")
    return model.with_values(
        {
            f"{j}.{n}": x
            for j, row in zip(robot.actuated, TABLE_6_1, strict=True)
            for n, x in zip(names, row, strict=True)
        }
    )


def planned(model: Model, limits: MotionLimits) -> dict[str, MotionPlan]:
    return {
        name: plan_motion(model, START, END, limits=limits, energy_weight=weight(w), path=path)
        for name, (w, path) in CASES.items()
    }


def table_3_1(plans: dict[str, MotionPlan]) -> pd.DataFrame:
    unit = (MOTOR / FORCE) ** 2
    line = plans["line"]
    rows = []
    for name, plan in plans.items():
        T, E, iterations = THESIS[name]
        rows.append(
            {
                "case": name, "T [s]": plan.duration, "energy [kN^2 s]": plan.energy / 1e6,
                "energy, scaled [(N m)^2 s]": plan.energy * unit, "iterations": plan.iterations,
                "T / T of line": plan.duration / line.duration, "energy / line's": plan.energy / line.energy,
                "thesis T / T": T / THESIS["line"][0], "thesis energy / energy": E / THESIS["line"][1],
                "thesis iterations": iterations,
                "at limit [%]": " ".join(f"{100 * row['at_force_limit']:.0f}" for row in plan.peaks()),
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def on_the_plant(model: Model, noise: float, seed: int) -> pd.DataFrame:
    """Run plans on a robot that is not quite the model, under its cascade with the model's feedforward."""
    rng = np.random.default_rng(seed)
    names = [p.name for p in model.parameters if p.value]
    truth = model.with_values({n: model.parameters[n].value * (1 + rng.uniform(-OFF, OFF)) for n in names})
    rows = []
    sensors = Sensors(encoder_noise=noise)
    law = CascadeLaw.for_model(model)  # limited by the file's 2000 N: an excess of the plan's limit would be seen
    bare, home = MotionLimits.of(model, force=DRIVE), model.robot.home[None]
    margin = compute_feedback_margin(bare, law, home, noise, unknown=UNKNOWN)
    print(
        f"encoders of {1e6 * noise:g} um: {np.round(estimate_feedback_noise(law, home, noise), 1)} N rms, margin {margin:.3f}"
    )
    plans = planned(model, MotionLimits.of(model, force=DRIVE, margin=margin))
    for name, plan in plans.items():
        controller = CascadeController(law, feedforward=Feedforward(model, width=0.01))
        run = simulate_drive(truth, plan.trajectory(), controller, sensors, np.random.default_rng(seed))
        off = np.linalg.norm(run.tool - plan.tool[: len(run.tool)], axis=1)
        rows.append(
            {
                "case": name, "T [s]": plan.duration, "planned peak [N]": np.abs(plan.tau).max(),
                "peak on the plant [N]": np.abs(run.tau).max(), "of the limit [%]": 100 * np.abs(run.tau).max() / DRIVE,
                "tool off, rms [mm]": 1e3 * np.sqrt(np.mean(off**2)), "most [mm]": 1e3 * off.max(),
                "at the end [mm]": 1e3 * off[-1],
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def other_robots() -> pd.DataFrame:
    """Plan for a serial arm, for a Gantry-Tau with all its loops and its simplified twin, and for a delta robot."""
    irb = MotionLimits.of(load_robot(IRB140), force=[300.0, 300, 150, 50, 50, 30])
    carts = MotionLimits.of(load_robot("gantry_tau"), force=FORCE)
    delta = MotionLimits.of(load_robot("delta"), force=20.0)
    cases = [
        ("irb140", load_robot(IRB140), np.zeros(6), np.array([0.8, 0.3, -0.2, 0.2, 0.3, 0.1]), irb, "free", 40),
        ("gantry_tau simplified", load_robot("gantry_tau"), *NEAR_HOME, carts, "free", 20),
        ("gantry_tau complete", load_robot("gantry_tau", arms="complete"), *NEAR_HOME, carts, "free", 20),
        ("delta", load_robot("delta"), *PICK, delta, "line", 15),
        ("delta", load_robot("delta"), *PICK, delta, "free", 15),
    ]
    rows = []
    for name, robot, start, end, limits, path, nodes in cases:
        row, began = {"robot": name, "path": path, "intervals": nodes}, time.process_time()
        try:
            plan = plan_motion(
                robot,
                start,
                end,
                limits=limits,
                nodes=nodes,
                joints=len(start) == 6,
                path=None if path == "free" else path,
            )
            row |= {
                "T [s]": round(plan.duration, 5),
                "iterations": plan.iterations,
                "excess [%]": round(100 * plan.excess, 2),
            }
        except TauDynError as fault:
            row["refused"] = str(fault)
        rows.append(row | {"CPU [s]": round(time.process_time() - began, 1)})
    return pd.DataFrame(rows)


def between_random_ends(model: Model, runs: int, seed: int) -> pd.DataFrame:
    rng, rows = np.random.default_rng(seed), []
    home = model.mechanism.tool_position(model.robot.home[None])[0]
    limits = MotionLimits.of(model, force=FORCE, speed=FREE_SPEED)
    for k in range(runs):
        start, end = home + rng.uniform(-1, 1, (2, 3)) * BOX
        row = {"pair": k, "distance [m]": float(np.linalg.norm(end - start))}
        for name, path in (("free", None), ("line", "line")):
            try:
                plan = plan_motion(model, start, end, limits=limits, path=path, nodes=60)
            except TauDynError as fault:
                row |= {f"{name}": f"{type(fault).__name__}: {fault}"}
                continue
            row |= {f"{name}": "solved", f"{name} T": plan.duration, f"{name} energy": plan.energy,
                    f"{name} iterations": plan.iterations, f"{name} excess": plan.excess}  # fmt: skip
        rows.append(row)
        print(row, flush=True)
    return pd.DataFrame(rows)


def told(found: pd.DataFrame) -> None:
    solved = found[(found["free"] == "solved") & (found["line"] == "solved")]
    for name in ("free", "line"):
        n = int((found[name] == "solved").sum())
        its, worst = found[f"{name} iterations"].dropna(), found[f"{name} excess"].max()
        print(f"{name}: {n} of {len(found)} solved, iterations median {its.median():.0f}, most {its.max():.0f}; largest "
              f"excess of a limit between the nodes {100 * worst:.2f} %")  # fmt: skip
    saved = 100 * (1 - solved["free T"] / solved["line T"])
    ratio = solved["free energy"] / solved["line energy"]
    print(f"free saves {saved.median():.1f} % of the line's time (from {saved.min():.1f} to {saved.max():.1f} %) at "
          f"{ratio.median():.2f} times its energy (from {ratio.min():.2f} to {ratio.max():.2f})")  # fmt: skip


def draw(plans: dict[str, MotionPlan], folder: Path) -> None:
    """Draw Figure 3.9's counterpart (tool paths) beside Figure 3.10's (forces against limits)."""
    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"svg.hashsalt": "tau_dyn", "font.size": 8})
    figure, axes = plt.subplot_mosaic(
        [["xy", "cart1"], ["xy", "cart2"], ["xz", "cart3"]], figsize=(9, 6), layout="constrained"
    )
    grey = {"w = 0": "0.0", "w = 0.001": "0.35", "w = 0.01": "0.6", "line": "tab:orange"}
    for name, plan in plans.items():
        for key, j in (("xy", 1), ("xz", 2)):
            axes[key].plot(plan.tool[:, 0], plan.tool[:, j], color=grey[name], label=name)
            axes[key].set(xlabel="x [m]", ylabel=f"{'xyz'[j]} [m]", aspect="equal")
        for k, joint in enumerate(plan.joints):
            axes[joint].plot(plan.t, plan.tau[:, k], color=grey[name])
            axes[joint].set(ylabel=f"{joint} [N]")
    for joint in next(iter(plans.values())).joints:
        for edge in (-FORCE, FORCE):
            axes[joint].axhline(edge, color="tab:red", linestyle="--", linewidth=0.8)
    axes["xy"].legend(frameon=False)
    axes["cart3"].set_xlabel("time [s]")
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "optimal_motion.svg", metadata={"Date": None})


def main(runs: int, seed: int, figures: Path | None) -> None:
    rigid, rubbing = Model.of(load_robot("gantry_tau", prototype="l1")), l1_with_friction()
    plans = planned(rigid, MotionLimits.of(rigid, force=FORCE, speed=FREE_SPEED))
    print(table_3_1(plans).round(4).to_string(index=False), flush=True)
    print("\non a plant that is off by up to 5 %:", flush=True)
    for noise in NOISES:
        print(on_the_plant(rubbing, noise, seed).round(3).to_string(index=False), flush=True)
    print()
    print(other_robots().to_string(index=False), flush=True)
    if runs:
        print()
        told(between_random_ends(rigid, runs, seed))
    if figures is not None:
        draw(plans, figures)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20, help="pairs of random ends")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--figures", type=Path, metavar="DIR", help="draw optimal_motion.svg here")
    args = parser.parse_args()
    main(args.runs, args.seed, args.figures)
