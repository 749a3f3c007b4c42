"""The calibration paper's complete Delta (Savoure et al. 2006, II): 51 parameters, the simplified model, compensation.

1. Which of the 51 errors of (20) poses can tell, by rank-revealing QR, with the base frame known (as in the paper) and
with the device's and the target's frames unknown.
2. Poses simulated with errors in all 51, fitted by the complete and by the simplified model (one rod an arm); held-out
error at the measured target and 200 mm below it.
3. The paper's linear compensation (27) to (33) against the exact one, as the errors grow; what a call costs.

    python experiments/delta_calibration.py --runs 10 --seed 11 [--parts told compared growth costs]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from tau_dyn.calibrate import Geometry, GeometryFit, PoseSet, build_compensation, fit_geometry_to_poses
from tau_dyn.calibrate.compensation import Compensation
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.calibrate.simulated import TRACKER, simulate_poses
from tau_dyn.calibrate.tree_geometry import TreeGeometry, build_tree_geometry
from tau_dyn.calibrate.unknowns import find_identifiable
from tau_dyn.mechanism import build_rods
from tau_dyn.robot import Robot, load_robot

FILE = Path(__file__).resolve().parents[1] / "urdf" / "delta.urdf.xacro"
RODS = tuple(f"rod{i}{j}" for i in (1, 2, 3) for j in "ab")
SETS = {
    "b_ij on the plate": tuple(f"plate_link.anchor_{rod}_{a}" for rod in RODS for a in "xyz"),
    "a_ij on the arms": tuple(f"{rod}_yaw.origin_{a}" for rod in RODS for a in "xyz"),
    "l_ij": tuple(f"{rod}.length" for rod in RODS),
    "beta_i": tuple(f"arm{i}.{what}" for i in (1, 2, 3) for what in ("offset", "ry", "rz")),
}
"""The paper's parameters (20) by the robot file's names."""

NAMES = tuple(name for names in SETS.values() for name in names)
REACH = 0.5  # [rad] from home
NOISE = (10e-6, 30e-6)  # m, rad
ARM = 0.235  # [m] turns errors of points into those of angles
PARTS = ("told", "compared", "growth", "costs")
SIZES = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 3e-3)  # [m]


def workspace(robot: Robot, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return actuated positions (n, 3) all over the workspace [rad]."""
    return robot.home + rng.uniform(-REACH, REACH, (n, robot.na))


def errors(geometry: TreeGeometry, size: float, rng: np.random.Generator) -> np.ndarray:
    """Return true parameters (51,) with errors of a standard deviation [m], angles as seen at the end of an arm."""
    scale = np.array([size if p.unit == "m" else size / ARM for p in geometry.parameters])
    return geometry.parameters.values + rng.normal(0, 1, len(scale)) * scale


def told(robot: Robot, geometry: TreeGeometry, rng: np.random.Generator) -> None:
    """Print the rank of the 51 and what depends on what."""
    q = workspace(robot, 100, rng)
    columns = geometry.tool_by_parameter(geometry.parameters.values, q) / np.repeat(NOISE, 3)[None, :, None]
    priority = np.zeros(len(NAMES), int)
    scales = np.array([1e-3 if p.unit == "m" else 1e-3 / ARM for p in geometry.parameters])
    for what, rows in (("position and orientation", slice(0, 6)), ("position alone", slice(0, 3))):
        found = find_identifiable(columns[:, rows].reshape(-1, len(NAMES)), NAMES, scales, priority)
        s = found.singular_values
        print(
            f"{what} measured in the base frame: {found.rank} of {len(NAMES)}; "
            f"smallest singular value {s[found.rank - 1]:.3g}, next {s[found.rank]:.1g}"
        )
        if what.startswith("position and"):
            for k, factors in zip(found.dropped, found.factors.T, strict=True):
                parts = [f"{f:+.4g} {NAMES[c]}" for f, c in zip(factors, found.kept, strict=True) if abs(f) > 1e-6]
                print(f"   {NAMES[k]} = {' '.join(parts) or 'no effect'}")


def below(poses: PoseSet, fitted: GeometryFit, depth: float) -> np.ndarray:
    """Return the error (N,) [m] of the point `depth` below the measured target, along the tool's z."""
    seen = fitted.seen(poses)
    rotation = seen.rotation if fitted.geometry.orients else seen.rotation @ fitted._target()
    down = np.array([0.0, 0.0, -depth])
    return np.linalg.norm(poses.position + poses.rotation @ down - seen.position - rotation @ down, axis=1)


def compared(geometry: TreeGeometry, robot: Robot, runs: int, rng: np.random.Generator) -> None:
    """Print what the complete and the simplified model leave on held-out poses."""
    simple = build_tree_geometry(load_robot(FILE, arms="simplified"))
    rows: dict[str, list[list[float]]] = {"complete": [], "simplified": [], "nominal": []}
    cost = []
    for _ in range(runs):
        truth = errors(geometry, 5e-4, rng)
        poses = simulate_poses(geometry, truth, workspace(robot, 260, rng), rng, noise=NOISE)
        train, held = poses.take(np.arange(60)), poses.take(np.arange(60, poses.n))
        for name, model, fix in (("complete", geometry, ()), ("simplified", simple, ()), ("nominal", geometry, NAMES)):
            start = time.process_time()
            found = fit_geometry_to_poses(model, train, fix=fix)
            cost.append(time.process_time() - start) if name == "complete" else None
            rows[name].append([float(np.sqrt(np.mean(below(held, found, h) ** 2))) for h in (0.0, 0.2)])
        rank = found.identifiability.rank
    print(
        "\nheld-out rms of 200 poses [um], 60 poses fitted, errors 0.5 mm, noise 10 um and 30 urad; "
        f"median and worst of {runs} runs"
    )
    for name, values in rows.items():
        x = 1e6 * np.array(values)
        print(
            f"   {name:11} target: {np.median(x[:, 0]):8.1f} {x[:, 0].max():8.1f}"
            f"   200 mm below: {np.median(x[:, 1]):8.1f} {x[:, 1].max():8.1f}"
        )
    print(
        f"   noise alone {1e6 * NOISE[0] * np.sqrt(3):.1f} um at the target; complete fit {np.median(cost):.2f} s of one core; "
        f"frames alone {rank} unknowns"
    )


def growth(geometry: TreeGeometry, robot: Robot, runs: int, rng: np.random.Generator) -> None:
    """Print the linear compensation's error as the geometric errors grow."""
    q = workspace(robot, 100, rng)
    print(f"\nTCP error over 100 poses [um], median of {runs} machines: before | linear: rms, largest | exact: largest")
    passes: dict[str, list[float]] = {"rms": [], "largest": []}
    found = np.zeros((len(SIZES), runs, 4))
    for run in range(runs):
        pattern = errors(geometry, 1.0, rng) - geometry.parameters.values
        for k, size in enumerate(SIZES):
            correct = build_compensation(robot, geometry, geometry.parameters.values + size * pattern, limits=False)
            left = {m: correct.with_method(m)(q) for m in ("linear", "exact")}
            before = np.linalg.norm(correct.remaining(q, q)[:, :3], axis=1)
            linear, exact = (
                np.linalg.norm(correct.remaining(q, left[m].q)[:, :3], axis=1) for m in ("linear", "exact")
            )
            found[k, run] = [
                np.sqrt(np.nanmean(before**2)),
                np.sqrt(np.nanmean(linear**2)),
                np.nanmax(linear),
                np.nanmax(exact),
            ]
        for name, column in (("rms", 1), ("largest", 2)):
            passes[name].append(float(np.exp(np.interp(np.log(1e-5), np.log(found[:, run, column]), np.log(SIZES)))))
    for k, size in enumerate(SIZES):
        b, r, m, e = 1e6 * np.median(found[k], axis=0)
        print(f"   {1e3 * size:4.1f} mm: {b:8.0f} | {r:8.2f} {m:8.2f} | {e:.1e}")
    for name, values in passes.items():
        low, high = 1e3 * np.quantile(values, [0.05, 0.95])
        print(
            f"   {name} passes 10 um at errors of {1e3 * np.median(values):.2f} mm "
            f"(90 % of machines between {low:.2f} and {high:.2f})"
        )


def costs(geometry: TreeGeometry, robot: Robot, rng: np.random.Generator) -> None:
    """Print what a call costs: poses one by one along a path of 5 mrad steps, and in batches all over the workspace."""
    print("\nprocess time a pose [us]: one by one along a path, in batches of 500")
    path = robot.home + np.linspace(0.0, 0.3, 60)[:, None]
    rods = RodGeometry(build_rods(robot))
    models: dict[str, Geometry] = {"tree": geometry, "rods": rods}
    for name, model in models.items():
        theta = model.parameters.values + 5e-4 * rng.standard_normal(len(model.parameters))
        for method in ("linear", "exact"):
            correct = build_compensation(robot, model, theta, method=method, limits=False)
            one = timed(correct, [q[None] for q in path])
            many = timed(correct, [workspace(robot, 500, rng) for _ in range(3)])
            print(f"   {name} {method:6}: {1e6 * one:8.0f} {1e6 * many:8.0f}")


def timed(correct: Compensation, batches: list[np.ndarray]) -> float:
    """Return the process time a pose [s], the first batch left out."""
    correct(batches[0])
    start = time.process_time()
    for q in batches[1:]:
        correct(q)
    return (time.process_time() - start) / sum(len(q) for q in batches[1:])


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    given = parser.parse_args()
    robot = load_robot(FILE)
    geometry = build_tree_geometry(robot).only(NAMES)
    streams = np.random.default_rng(given.seed).spawn(4)
    print(f"{len(NAMES)} parameters; frames of device and target: {TRACKER.device[0].translation} m away")
    if "told" in given.parts:
        told(robot, geometry, streams[0])
    if "compared" in given.parts:
        compared(geometry, robot, given.runs, streams[1])
    if "growth" in given.parts:
        growth(geometry, robot, given.runs, streams[2])
    if "costs" in given.parts:
        costs(geometry, robot, streams[3])


if __name__ == "__main__":
    main()
