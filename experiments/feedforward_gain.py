"""What is each step of this toolkit worth in a controller: no feedforward, nominal, identified, diagnosed-and-extended model?

    python experiments/feedforward_gain.py [--seeds 3] [--seed 0] [--out DIR]

In: nothing. The plant is the demo's L1 (friction of Table 6.1, a pinion's ripple, friction that falls with speed), masses
up to 10 % off the file's, under a cascade of 8 and 40 Hz with speed feedforward, encoders of 5 um. Models are made from 60 s of
another motion and judged on one used for nothing else. Out: `feedforward_gain.csv`, a row a seed, motion and feedforward, and a
table of medians. Thesis: Figure 6.1 (the scheme).
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from tau_dyn.cli.demo import make_gantry
from tau_dyn.control import Feedforward
from tau_dyn.diagnose import diagnose
from tau_dyn.identify import identify
from tau_dyn.model import Model
from tau_dyn.robot import load_robot
from tau_dyn.simulate import CascadeController, CascadeLaw, Sensors, build_named_motion, simulate, simulate_drive

SENSORS = Sensors(encoder_noise=5e-6, force_noise=5.0, log_rate_hz=500.0)
WIDTH = 0.005  # [m/s] within which the feedforward's sign of friction is smoothed
MOTIONS = {"fourier": 20.0, "strokes": 20.0}  # what is tracked, for so long [s]


def models(truth: Model, seed: int) -> dict[str, Model | None]:
    """Return what each step gives."""
    robot = load_robot("gantry_tau", prototype="l1")
    motion = build_named_motion("fourier", truth, 60.0, seed)
    held = build_named_motion("fourier", truth, 40.0, seed + 100)
    logs = [simulate(truth, m, sensors=SENSORS, seed=seed + k, name=f"log{k}") for k, m in enumerate((motion, held))]
    fit = identify(robot, logs[0], holdout=logs[1], seed=seed)
    why = diagnose(robot, logs[0], holdout=logs[1], seed=seed)
    return {"none": None, "nominal": Model.of(robot), "identified": fit.model, "extended": why.extended_model}


def tracked(truth: Model, model: Model | None, motion: str, seed: int) -> float:
    """Return the rms distance of the tool from its reference [m]."""
    path = build_named_motion(motion, truth, MOTIONS[motion], seed)
    law = CascadeLaw.for_model(Model.of(load_robot("gantry_tau", prototype="l1")))
    given = None if model is None else Feedforward(model.steady(), width=WIDTH)
    start = truth.steady() if model is None else None
    controller = CascadeController(law, start=start, feedforward=given)
    run = simulate_drive(truth, path, controller, SENSORS, np.random.default_rng(seed))
    off = run.tool - truth.mechanism.tool_position(path.resampled(1000.0).q)
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def main(seeds: int, seed: int, out_dir: Path) -> None:
    out_dir.mkdir(parents=True, exist_ok=True)
    rows = []
    for one in range(seed, seed + seeds):
        truth = make_gantry(one).truth
        for name, model in models(truth, one).items():
            for motion in MOTIONS:
                rows.append(
                    {
                        "seed": one,
                        "feedforward": name,
                        "motion": motion,
                        "rms_m": tracked(truth, model, motion, one + 500),
                    }
                )
                print(rows[-1], flush=True)
    table = pd.DataFrame(rows)
    table.to_csv(out_dir / "feedforward_gain.csv", index=False)
    print(
        (
            1e6 * table.pivot_table(index="feedforward", columns="motion", values="rms_m", aggfunc="median", sort=False)
        ).round(1)
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    args = parser.parse_args()
    main(args.seeds, args.seed, args.out)
