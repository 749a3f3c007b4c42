"""How well do a complementary and a Kalman filter see the tool? Figure 7.1 of Dressler 2012 on a simulated flexible L1.

    python experiments/tool_observers.py [--seed 71] [--runs 5] [--figure docs/figures/tool_observers.svg]

The 10 mm square at 100 mm/s without learning. Observers are tuned on one trial and judged on others, against the true tool. The
Kalman filter stands on the stored model (6.13), identified in thesis_6_3.py, and is tuned without any tool position. About a
minute on one core. The answer stands in docs/results/control.md.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from ilc_parts.bench import AXES, DT, motion, plant
from ilc_parts.learning_plant import LearningPlant, Trial

from tau_dyn.control.observers import (
    ComplementaryToolObserver,
    KalmanToolObserver,
    check_whiteness,
    extend_model,
    tune_complementary,
    tune_kalman,
)
from tau_dyn.modes import load_state_space

MODEL = Path(__file__).parents[1] / "identification" / "models" / "l1_kinematics_to_tool.yaml"
THESIS_CUTOFF = (4.50, 2.63)  # Hz, (7.18)
FACTORS = 10.0 ** np.arange(-14, 1)

Estimate = Callable[[Trial], np.ndarray]


def signals(trial: Trial) -> tuple[np.ndarray, np.ndarray]:
    return trial.kinematic[:, AXES], trial.acceleration[:, AXES]


def errors(estimate: Estimate, trials: list[Trial]) -> np.ndarray:
    """Root mean square error (2,) [um] over all trials."""
    left = [estimate(t) - t.true_tool[:, AXES] for t in trials]
    return 1e6 * np.sqrt(np.mean(np.concatenate(left) ** 2, axis=0))


def thesis_kalman(trial: Trial) -> KalmanToolObserver:
    """(7.21), (7.22) as printed: R1 = r I with r "by inspection", here the best of a grid against the gauges."""
    model = load_state_space(MODEL).model
    eye = np.eye(len(extend_model(model).A))
    tried = [KalmanToolObserver(model, r * eye, 0.07**2, aligned=False, predict=True) for r in FACTORS]
    return min(tried, key=lambda k: float(np.mean((k.estimate(*signals(trial)) - trial.tool[:, AXES]) ** 2)))


def observers(robot: LearningPlant, trial: Trial) -> dict[str, tuple[Estimate, str]]:
    tuned = tune_kalman(load_state_space(MODEL).model, *signals(trial))
    ours, printed = tuned.observer, thesis_kalman(trial)
    low = ComplementaryToolObserver(THESIS_CUTOFF, DT)
    best, causal = (tune_complementary(*signals(trial), trial.tool[:, AXES], DT, causal=c) for c in (False, True))
    white = check_whiteness(ours.run(*signals(trial))[1], ours.innovation_covariance)
    print(f"Kalman: r {ours.process:.2g} m^2, accelerometer {np.sqrt(np.diag(ours.R2)).round(3)} m/s^2, standard errors "
          f"{(1e6 * ours.standard_error()).round(1)} um, innovations {white.ratio.round(2)} of what is expected, "
          f"correlated up to {white.correlation.round(2)}")  # fmt: skip
    found: dict[str, tuple[Estimate, str]] = {
        "forward kinematics": (lambda t: t.kinematic[:, AXES], ""),
        "complementary, (7.18)": (lambda t: low.estimate(*signals(t)), "4.50, 2.63 Hz"),
        "complementary, tuned": (lambda t: best.estimate(*signals(t)), "{:.2f}, {:.2f} Hz".format(*best.cutoff_hz)),
        "complementary, causal": (
            lambda t: causal.estimate(*signals(t)),
            "{:.2f}, {:.2f} Hz".format(*causal.cutoff_hz),
        ),
        "Kalman, (7.22) as printed": (lambda t: printed.estimate(*signals(t)), "r chosen by gauges"),
        "Kalman, not aligned": (lambda t: replace(ours, aligned=False).estimate(*signals(t)), "as below"),
        "Kalman": (lambda t: ours.estimate(*signals(t)), f"r = {ours.process:.2g} m^2"),
    }
    return found


def draw(path: Path, found: dict[str, tuple[Estimate, str]], trial: Trial) -> None:
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update({"svg.hashsalt": "tau_dyn", "svg.fonttype": "none"})
    import matplotlib.pyplot as plt

    shown = {"forward kinematics": "0.6", "complementary, (7.18)": "tab:blue", "Kalman": "tab:red"}
    figure, axes = plt.subplots(2, 1, figsize=(7, 4.2), sharex=True, sharey=True)
    part = slice(400, 1025, 2)
    t = np.arange(len(trial.q))[part] * DT
    for name, colour in shown.items():
        left = 1e6 * (trial.true_tool[:, AXES] - found[name][0](trial))
        for k, axis in enumerate(axes):
            axis.plot(t, left[part, k], color=colour, lw=0.9, label=name)
    for axis, name in zip(axes, "xy", strict=True):
        axis.set_ylabel(f"error in {name} [um]")
    axes[0].legend(fontsize=8, ncol=3, loc="upper right")
    axes[1].set_xlabel("time [s]")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})


def main(seed: int, runs: int, figure: Path | None) -> None:
    robot = plant(seed)
    path = motion(robot)
    trials = [robot.run(path.q, k) for k in range(runs + 1)]
    found = observers(robot, trials[0])
    first = errors(found["forward kinematics"][0], trials[1:])
    print("| estimate | setting | x [um] | y [um] | x | y |")
    print("|---|---|---|---|---|---|")
    for name, (estimate, setting) in found.items():
        e = errors(estimate, trials[1:])
        print(
            f"| {name} | {setting} | {e[0]:.1f} | {e[1]:.1f} | {100 * e[0] / first[0]:.1f} % | {100 * e[1] / first[1]:.1f} % |"
        )
    if figure:
        draw(figure, found, trials[1])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=71)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--figure", type=Path)
    main(**vars(parser.parse_args()))
