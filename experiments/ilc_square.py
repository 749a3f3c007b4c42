"""Iterative learning on the 10 mm square: chapter 7 of Dressler 2012 on a simulated flexible L1.

    python experiments/ilc_square.py [--seed 72] [--runs 2] [--iterations 10] [--figures docs/figures]
    python experiments/ilc_square.py --rates 5        # case 1 on carts with friction: predicted and measured rates alone

Cases 1 (actuator positions), 2A (complementary filter), 2B (Kalman filter), 3 (tool measured) and a norm-optimal law. All models
are identified on the simulated robot first; stability is judged before anything moves. Printed beside the thesis: singular values
(7.28) and of cases 2 and 3, the motor-side error, Table 7.2. The answer stands in docs/results/control.md. About three
minutes on one core.
"""

import argparse
from pathlib import Path

import numpy as np
from ilc_parts import figures
from ilc_parts.bench import AXES, DT, models, motion, plant, printed_actuators
from ilc_parts.laws import laws, motor_law
from ilc_parts.rates import print_rates

from tau_dyn.control.iterative import (
    LearningHistory,
    LearningLaw,
    MotorSide,
    TimeShift,
    ToolSide,
    analyse_convergence,
    design_low_pass,
    learn,
    stack_controlled_actuators as controlled,
)
from tau_dyn.exceptions import InputError

THESIS_SINGULAR = {"1": "0.90, 0.91, 0.93", "2A": "0.86", "2B": "0.93", "3": "0.95"}
TABLE_7_2 = {"1": (13.3, 36.1), "2A": (12.6, 23.9), "2B": (13.3, 25.2), "3": (10.3, 24.9)}


def study(seed: int, runs: int, iterations: int) -> tuple[dict[str, list[LearningHistory]], dict]:
    robot, found = plant(seed), models(seed)
    fits = {name: fit.round(1).tolist() for name, fit in found.fit.items()}
    print(f"identified, held-out fit of x, y [%]: {fits}")
    path = motion(robot)
    known = laws(robot, found, robot.run(path.q, 5_000))
    learnt: dict[str, list[LearningHistory]] = {}
    for name, law in known.items():
        learnt[name] = [learn(robot, path, law, iterations, first_trial=100 * run) for run in range(runs)]
    return learnt, known


def table(learnt: dict[str, list[LearningHistory]]) -> None:
    print(
        "\n| case | largest singular value | thesis | x, mean of trials 5 to 10 | y | thesis x | y | RMS after, x, y [um] |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name, runs in learnt.items():
        late = np.mean([r.relative("tool_errors")[5:, AXES].mean(axis=0) for r in runs], axis=0)
        rms = 1e6 * np.mean([r.rms("tool_errors")[-1, AXES] for r in runs], axis=0)
        sigma = ", ".join(f"{s:.3f}" for s in runs[0].convergence.singular)
        x, y = (f"{v} %" for v in TABLE_7_2[name]) if name in TABLE_7_2 else ("", "")
        print(f"| {name} | {sigma} | {THESIS_SINGULAR.get(name, '')} | {late[0]:.1f} % | {late[1]:.1f} % | {x} | {y} | "
              f"{rms[0]:.0f}, {rms[1]:.0f} |")  # fmt: skip
    motor = np.mean([r.relative("motor_errors") for r in learnt["1"]], axis=0)
    for k in (1, 2, 5, len(motor) - 1):
        print(f"case 1, motor side, trial {k}: {motor[k].round(2)} % of the first error")
    first = learnt["1"][0]
    print(f"errors before learning: motor {1e6 * first.rms('motor_errors')[0].round(6)} um, tool "
          f"{1e6 * first.rms('tool_errors')[0, AXES].round(6)} um")  # fmt: skip


def repeatability(seed: int) -> None:
    """Figure 7.6: how far trials with the same references differ."""
    robot = plant(seed)
    path = motion(robot)
    trials = [robot.run(path.q, 7_000 + k) for k in range(5)]
    for what, signal in (("actuators", lambda t: t.q), ("tool", lambda t: t.tool[:, AXES])):
        apart = np.concatenate([signal(t) - signal(trials[0]) for t in trials[1:]])
        print(f"not repeatable, {what}: RMS {(1e6 * np.sqrt(np.mean(apart**2, axis=0) / 2)).round(1)} um")


def slow(seed: int) -> None:
    """Figure 7.5 (a): 10 mm/s."""
    robot = plant(seed)
    path = motion(robot, speed=0.01)
    done = learn(robot, path, motor_law(), 5)
    print(f"at 10 mm/s: tool error {1e6 * done.rms('tool_errors')[0, AXES].round(6)} um, after case 1 "
          f"{1e6 * done.rms('tool_errors')[-1, AXES].round(6)} um")  # fmt: skip


def as_printed(seed: int, iterations: int) -> None:
    """Drives that are (6.11) and no more: how far does the same law come?"""
    robot = plant(seed, velocity_share=0.0)
    done = learn(robot, motion(robot), motor_law(), iterations, limit=0.03)
    print(
        f"drives without velocity reference: motor side {done.relative('motor_errors')[-1].round(1)} % after {iterations}"
    )


def refused(seed: int) -> None:
    """Choices that must not reach the robot, and what is said."""
    robot, found = plant(seed), models(seed)
    path = motion(robot)
    tool = ToolSide(found.reference_to_tool, robot.actuators)
    tries = {
        "case 1, no shift, 60 Hz": LearningLaw(
            MotorSide(controlled(printed_actuators(), DT)), (design_low_pass(60, DT),) * 3, TimeShift(0.9, 0, DT)
        ),
        "case 3, low-pass at 10 Hz": LearningLaw(tool, (design_low_pass(10, DT),) * 2, TimeShift(0.9, 5, DT)),
    }
    for name, law in tries.items():
        seen = analyse_convergence(law, path)
        assert seen.picture is not None
        try:
            learn(robot, path, law, 1)
        except InputError as why:
            print(f"refused: {name}: {why}")


def main(seed: int, runs: int, iterations: int, out: Path | None, rates: int) -> None:
    if rates:
        return print_rates(rates)
    learnt, known = study(seed, runs, iterations)
    table(learnt)
    repeatability(seed)
    slow(seed)
    as_printed(seed, iterations)
    refused(seed)
    if out:
        figures.draw(out, learnt, known)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=72)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--rates", type=int, default=0, metavar="SEEDS")
    parser.add_argument("--figures", type=Path, dest="out")
    main(**vars(parser.parse_args()))
