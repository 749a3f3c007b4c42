"""Poses chosen for a calibration against poses at random: predicted and achieved accuracy on L1, F1 and a serial arm.

L1: 21 dimensions, positions with 0.1 mm noise, 30 poses of about 1000 on a grid. F1: all dimensions, full poses with
    0.1 mm and 0.1 mrad, 200 of
1347 on the thesis' grid of 25 cm and 10 degrees (section 5.4; we find more within the limits assumed for F1, and take
as many at random). Serial arm: six axes, positions with 0.05 mm, 40 of 1000 spread over the joints. Robots are off by
1 mm and 1 mrad; accuracy is the root mean square error of the fitted model at 400 places of the workspace, noise not
counted. `random` draws other poses in every run.

    python experiments/calibration_poses.py --runs 40 --seed 3 [--robots l1 f1 serial]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate import Geometry, PoseSet, fit_geometry_to_poses
from tau_dyn.calibrate.poses import Safety, UniformDevice, compute_doubling_gain
from tau_dyn.calibrate.poses.automation import build_geometry
from tau_dyn.calibrate.poses.choice import choose_from, predict
from tau_dyn.calibrate.poses.criteria import NAMES, compute_observability_indices, leave_one_out
from tau_dyn.calibrate.poses.design import PoseDesign, build_design
from tau_dyn.calibrate.poses.devices import transform_to_device
from tau_dyn.calibrate.poses.monte_carlo import draw_robot, simulate_measurement
from tau_dyn.calibrate.poses.reachable import find_reachable
from tau_dyn.kinematics.workspace import build_machine, find_workspace
from tau_dyn.mechanism import Poses
from tau_dyn.robot import load_robot

OFF = 0.1  # of the scales: 1 mm, 1 mrad, 0.001
STEP, TILT = 0.25, np.deg2rad(10.0)  # the thesis' grid for F1
GRID = 1347


@dataclass(frozen=True, eq=False)
class Case:
    """A robot, its candidates, and how many are chosen."""

    name: str
    design: PoseDesign
    device: UniformDevice
    n: int
    criteria: tuple[str, ...]


def l1(seed: int) -> Case:
    """Return the L1 prototype with a guideway direction each."""
    robot = load_robot("gantry_tau")
    q = find_reachable(build_machine(robot), safety=Safety(0.05, 0.0, 0.0), seed=seed).q
    return _case("L1", build_geometry(robot), q, (1e-4,), 30, NAMES, seed)


def f1(seed: int) -> Case:
    """Return F1 on the thesis' grid."""
    robot = load_robot("gantry_tau_f1")
    space = find_workspace(robot, resolution=STEP)
    places = space.lattice.points(np.argwhere(space.inside))
    found = []
    for angles in np.array(np.meshgrid(*[(-TILT, 0.0, TILT)] * 3)).reshape(3, -1).T:
        turn = Rotation.from_rotvec(angles).as_matrix() @ space.rotation
        judged = space.judge.judge(Poses(places, np.broadcast_to(turn, (len(places), 3, 3))))
        found.append(judged.q[judged.code == 0])
    q = np.concatenate(found)
    print(f"F1: {len(q)} grid poses within the limits, {min(GRID, len(q))} taken as candidates (thesis {GRID})")
    q = q[np.sort(np.random.default_rng(seed).choice(len(q), min(GRID, len(q)), replace=False))]
    return _case(
        "F1", build_geometry(robot), q, (1e-4, 1e-4), 200, ("tool", "determinant", "amplification", "condition"), seed
    )


def serial(seed: int) -> Case:
    """Return a six-axis arm, positions measured."""
    from serial_calibration import own_arm

    robot = own_arm()
    q = robot.home + np.random.default_rng(seed).uniform(-1.6, 1.6, (1000, robot.na))
    return _case("serial arm", build_geometry(robot), q, (5e-5,), 40, NAMES, seed)


def _case(
    name: str, geometry: Geometry, q: np.ndarray, noise: tuple[float, ...], n: int, criteria: tuple[str, ...], seed: int
) -> Case:
    q = q[geometry.forward(geometry.parameters.values, q).ok]
    places = q[np.random.default_rng(seed).choice(len(q), min(400, len(q)), replace=False)]
    return Case(name, build_design(geometry, q, noise, workspace=places), UniformDevice(noise), n, criteria)


def achieved(case: Case, draw, runs: int, seed: int) -> np.ndarray:  # noqa: ANN001
    """Return the error [m] of calibrated robots at other places (runs,); `draw(rng)` gives the poses of each run."""
    design, geometry, out = case.design, case.design.geometry, []
    scales = OFF * design.unknowns.scales[: len(geometry.parameters)]
    for rng in np.random.default_rng(seed).spawn(runs):
        q = design.q[draw(rng)]
        theta = draw_robot(geometry, np.vstack([q, design.workspace]), scales, rng)
        fitted = fit_geometry_to_poses(geometry, simulate_measurement(case.device, geometry, theta, q, rng))
        places = transform_to_device(case.device.frames, geometry.forward(theta, design.workspace).poses)
        out.append(fitted.errors(PoseSet(design.workspace, places.position)).position_size.rms)
    return np.array(out)


def table(case: Case, runs: int, seed: int) -> None:
    """Print every criterion's choice."""
    design = case.design
    print(
        f"{case.name}: {design.n} candidates, {design.found.rank} of {len(design.found.names)} "
        f"unknowns can be told, {case.n} poses"
    )
    for name in case.criteria:
        start = time.process_time()
        index = choose_from(design, case.n, criterion=name, seed=seed).index
        _row(case, name, index, runs, seed, time.process_time() - start)
    start = time.process_time()
    index = leave_one_out(design.whitened(), case.n)
    _row(case, "thesis (5.9)", index, runs, seed, time.process_time() - start)

    def anyhow(rng: np.random.Generator) -> np.ndarray:
        return rng.choice(design.n, case.n, replace=False)

    draws = [predict(design, anyhow(rng)).rms for rng in np.random.default_rng(seed).spawn(runs)]
    made = achieved(case, anyhow, runs, seed)
    _print("random", float(np.sqrt(np.mean(np.square(draws)))), made, "")


def _row(case: Case, name: str, index: np.ndarray, runs: int, seed: int, cost: float) -> None:
    made = achieved(case, lambda rng: index, runs, seed)
    part = case.design.whitened()[index].reshape(-1, case.design.slopes.shape[2])
    found = compute_observability_indices(part.T @ part)
    more = f"  worst {1e6 * predict(case.design, index).worst:6.1f}  cond {found['condition_number']:8.0f}  "
    _print(
        name,
        predict(case.design, index).rms,
        made,
        more + f"index {found['noise_amplification_index']:.2e}  {cost:.1f} s",
    )


def _print(name: str, predicted: float, made: np.ndarray, more: str) -> None:
    reached = float(np.sqrt(np.mean(made**2)))
    spread = float(np.std(made**2) / np.sqrt(len(made)) / (2 * reached))
    print(
        f"  {name:<14} predicted {1e6 * predicted:6.1f} um  achieved {1e6 * reached:6.1f} +- {1e6 * spread:4.1f} um  "
        f"ratio {reached / predicted:4.2f}{more}"
    )


def enough(case: Case, runs: int, seed: int) -> None:
    """Print accuracy against the number of poses."""
    print(f"{case.name}: how many poses")
    for n in (10, 15, 20, 30, 50, 80):
        choice = choose_from(case.design, n, seed=seed)
        made = achieved(case, lambda rng, index=choice.index: index, runs, seed)
        _print(
            f"{n} poses",
            choice.predicted.rms,
            made,
            f"  twice as many: {100 * compute_doubling_gain(choice.predicted):.1f} % of the held-out error",
        )
    auto = choose_from(case.design, seed=seed)
    print(
        f"  auto takes {auto.n} poses: {1e6 * auto.predicted.rms:.1f} um, held out "
        f"{1e6 * auto.predicted.held_out:.1f} um"
    )


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--robots", nargs="+", default=["l1", "serial", "f1"], choices=["l1", "serial", "f1"])
    given = parser.parse_args()
    for name in given.robots:
        case = {"l1": l1, "f1": f1, "serial": serial}[name](given.seed)
        runs = max(2, given.runs // 5) if name == "f1" else given.runs
        table(case, runs, given.seed)
        if name == "l1":
            enough(replace(case), runs, given.seed)


if __name__ == "__main__":
    main()
