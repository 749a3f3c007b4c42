"""Are the 95 % intervals of a calibration honest, is the predicted accuracy right, and how long does it take?

Robots whose dimensions are off by millimetres at random are calibrated from poses at random with Gaussian noise.
Counted over all seeds: how often the interval of each determined geometric parameter holds the truth; rms error at
unseen poses against the predicted one; processor time. Parameters that no pose can tell are nominal in the true robot
too, or there would be no truth to compare the others with.

    python experiments/calibration_coverage.py --runs 100 --seed 1
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from tau_dyn.calibrate import PoseSet, fit_geometry_to_poses
from tau_dyn.calibrate.models import RodFamily, Spec
from tau_dyn.calibrate.result import list_weak_parameters
from tau_dyn.calibrate.simulated import simulate_poses
from tau_dyn.mechanism import build_rods
from tau_dyn.robot import load_robot

CASES: tuple[tuple[str, dict[str, str], str, int, float], ...] = (
    ("gantry_tau", {}, "nonparallel", 60, 0.35),
    ("gantry_tau", {"prototype": "d1", "arms": "complete"}, "complete", 200, 0.35),
    ("gantry_tau_f1", {}, "complete", 60, 0.35),
    ("delta", {}, "complete", 80, 0.25),
)
NOISE = (10e-6, 20e-6)  # [m], [rad]
OFF = {"m": 1e-3, "rad": 1e-3, "1": 1e-3}


def study(name: str, arguments: dict[str, str], structure: str, n: int, reach: float, runs: int, seed: int) -> str:
    """Return one robot's line."""
    rods = build_rods(load_robot(name, **arguments))
    home, na = rods.robot.home, rods.na
    family = RodFamily(rods, PoseSet(np.tile(home, (2, 1)), np.zeros((2, 3))))
    geometry = family.build(Spec(structure))
    first = np.random.default_rng(seed)
    turned = geometry.orients

    def poses(theta: np.ndarray, rng: np.random.Generator, n: int) -> PoseSet:
        q = home + reach * (2 * rng.random((2 * n, na)) - 1)
        found = simulate_poses(geometry, theta, q, rng, noise=NOISE, turned=turned)
        return found.take(np.arange(min(n, found.n)))

    seen = fit_geometry_to_poses(geometry, poses(geometry.parameters.values, first, n))
    blind = [seen.identifiability.names[k] for k in seen.identifiability.dropped]
    scale = np.array([0.0 if p.name in blind else OFF[p.unit] for p in geometry.parameters])
    hits = total = 0
    ratio, seconds = [], []
    for run in range(runs):
        rng = np.random.default_rng([seed, run])
        theta = geometry.parameters.values + scale * rng.standard_normal(len(scale))
        measured = poses(theta, rng, n)
        begun = time.process_time()
        found = fit_geometry_to_poses(geometry, measured, fix=blind)
        seconds.append(time.process_time() - begun)
        loose = set(list_weak_parameters(found))
        for p, true in zip(found.parameters, theta, strict=False):
            interval = found.interval(p)
            if interval is not None and p.name not in loose:
                hits += interval[0] <= true <= interval[1]
                total += 1
        unseen = poses(theta, rng, 100)
        achieved = found.errors(unseen).position_size.rms
        predicted = np.sqrt(np.mean(found.model_error(unseen.q) ** 2) + 3 * found.noise[0] ** 2)
        ratio.append(achieved / predicted)
    return (
        f"{name} {structure}: {n} poses, {found.n_estimated} estimated, coverage {100 * hits / total:.1f} % of {total}, "
        f"achieved / predicted rms {np.mean(ratio):.3f} ({min(ratio):.2f} to {max(ratio):.2f}), "
        f"{np.median(seconds):.2f} s (most {max(seconds):.2f})"
    )


def main() -> None:
    """Print one line a robot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--case", type=int, nargs="*", default=range(len(CASES)))
    args = parser.parse_args()
    for k in args.case:
        name, arguments, structure, n, reach = CASES[k]
        print(study(name, arguments, structure, n, reach, args.runs, args.seed), flush=True)


if __name__ == "__main__":
    main()
