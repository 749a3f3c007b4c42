"""Forward and inverse kinematics of every robot: there and back over random poses, Jacobians, and speed.

Question: do FK(IK(x)) and IK(FK(q)) return what went in, in all configurations, and how many poses a second does one core do?
Inputs: the robots of `urdf/`. Outputs: a table on stdout, with `--out FILE.csv` also as CSV.
Run: python experiments/benchmarks/kinematics.py [--runs 10000] [--seed 0] [--only NAME] [--speed] [--cost] [--arms]
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import pandas as pd
from bench import machine

from tau_dyn.mechanism import (
    Poses,
    build_chains,
    find_all_solutions,
    forward_kinematics,
    get_rods,
    inverse_kinematics,
    jacobian,
    solve_all_configurations,
)
from tau_dyn.mechanism.chain_inverse import NewtonChain
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

ROBOTS = {
    "gantry_tau l1 simplified": ("gantry_tau", {}),
    "gantry_tau d1 simplified": ("gantry_tau", {"prototype": "d1"}),
    "gantry_tau l1 complete": ("gantry_tau", {"arms": "complete"}),
    "gantry_tau l2 complete": ("gantry_tau", {"arms": "complete", "prototype": "l2"}),
    "gantry_tau d1 complete": ("gantry_tau", {"arms": "complete", "prototype": "d1"}),
    "gantry_tau t1 complete": ("gantry_tau", {"arms": "complete", "prototype": "t1"}),
    "gantry_tau_5dof": ("gantry_tau_5dof", {}),
    "gantry_tau_f1": ("gantry_tau_f1", {}),
    "gantry_tau_t2": ("gantry_tau_t2", {}),
    "queensland 3 DOF": ("gantry_tau_queensland", {}),
    "queensland 5 DOF": ("gantry_tau_queensland", {"dof": 5}),
    "queensland telescopic": ("gantry_tau_queensland", {"telescopic": "true"}),
    "delta": ("delta", {}),
    "hexa_321": ("hexa_321", {}),
    "hexaglide": ("hexaglide", {}),
    "hexarot": ("hexarot", {}),
    "scara_tau": ("scara_tau", {}),
    "stewart": ("stewart", {}),
    "triglide": ("triglide", {}),
    "triglide complete": ("triglide", {"arms": "complete"}),
    "h4": ("h4", {}),
    "parallelogram": ("parallelogram", {}),
    "linear_axis": ("linear_axis", {}),
}
SLOW = 40  # poses of robots that only the tree solves
SEVERAL = 300  # poses for all configurations where chains have several actuators or the plate five freedoms


def positions(robot: Robot, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return positions (n, na) uniform over a fifth of the joint limits around home."""
    low = np.where(np.isfinite(robot.lower), robot.lower, robot.home - 1.0)
    high = np.where(np.isfinite(robot.upper), robot.upper, robot.home + 1.0)
    return robot.home + 0.2 * rng.uniform(low - robot.home, high - robot.home, (n, robot.na))


def there_and_back(name: str, robot: Robot, runs: int, seed: int) -> dict[str, object]:
    """Return the largest errors of one robot."""
    rng, rods = np.random.default_rng(seed), get_rods(robot)
    q = positions(robot, runs if rods is not None or not robot.loops else SLOW, rng)
    forward = forward_kinematics(robot, q)
    ok = forward.ok
    poses, q = forward.poses.take(ok), q[ok]
    inverse = inverse_kinematics(robot, poses, limits=False)
    again = forward_kinematics(robot, inverse.q[inverse.ok], start=None if rods is None else poses.take(inverse.ok))
    error = np.abs(again.poses.position - poses.position[inverse.ok])
    several = rods is None or rods.na in (4, 5) or any(isinstance(chain, NewtonChain) for chain in build_chains(rods))
    part = slice(0, (8 if robot.loops and rods is None else SEVERAL) if several else len(q))
    solutions = solve_all_configurations(robot, poses.take(part))
    found = np.isfinite(solutions[..., 0])
    away = np.nan_to_num(np.abs(solutions - q[part, None]).max(axis=2), nan=np.inf).min(axis=1)
    return {
        "robot": name,
        "rods": 0 if rods is None else rods.n,
        "poses": len(q),
        "fk ok %": 100 * ok.mean(),
        "ik ok %": 100 * inverse.ok.mean(),
        "FK(IK(x)) [m]": np.nanmax(error),
        "FK elsewhere": int((~again.ok).sum()),
        "IK(FK(q))": away.max(),
        "configurations": f"{found.sum(axis=1).min()} to {found.sum(axis=1).max()} of {len(found)}",
        "all close [m]": closing(rods, solutions, forward.plate.take(ok).take(part)),
        "J error": jacobian_error(robot, q[:50], rng),
    }


def closing(rods, solutions: np.ndarray, plate) -> float:
    """Return by how much the rods fail to close over all solutions [m]; on a surface, with the rotation that belongs to them."""
    if rods is None:
        return np.nan
    gaps = [np.abs(rods.gap(solutions[:, k], plate)).max(axis=1) for k in range(solutions.shape[1])]
    exact = np.array(gaps)[np.isfinite(np.array(gaps)) & (np.array(gaps) < 1e-6)]
    return float(exact.max(initial=0.0))


def jacobian_error(robot: Robot, q: np.ndarray, rng: np.random.Generator) -> float:
    """Return the Jacobian's largest relative departure from central differences of position."""
    v, h = rng.standard_normal(q.shape), 1e-6
    up, down = (forward_kinematics(robot, q + s * h * v).poses.position for s in (1, -1))
    J = jacobian(robot, q)
    return float(np.nanmax(np.abs(np.einsum("nij,nj->ni", J, v)[:, :3] - (up - down) / (2 * h))) / np.nanmax(np.abs(J)))


def speed(robot: Robot, n: int) -> float:
    """Return poses a second of forward kinematics along a trajectory, on user CPU time, best of five."""
    t = np.linspace(0, 20, n)[:, None]
    q = robot.home + 0.4 * np.sin(t * (1 + 0.3 * np.arange(robot.na)) + np.arange(robot.na))
    best = 0.0
    for _ in range(5):
        before = time.process_time()
        found = forward_kinematics(robot, q)
        best = max(best, n / (time.process_time() - before))
        assert found.ok.all()
    return best


def cost(robot: Robot, n: int, seed: int) -> tuple[int, float, float]:
    """Return how many of n poses around home are reached, and the CPU time [ms] a pose of those and of the others."""
    rods, rng = get_rods(robot), np.random.default_rng(seed)
    home = forward_kinematics(robot, robot.home[None]).poses
    wide = 1.0 if rods is None else float(np.mean(rods.lengths))
    poses = Poses(home.position + wide * rng.uniform(-1, 1, (n, 3)), np.repeat(home.rotation, n, axis=0))
    ok = inverse_kinematics(robot, poses, limits=False).ok
    times = []
    for some in (ok, ~ok):
        before = time.process_time()
        inverse_kinematics(robot, poses.take(some), limits=False)
        times.append(1e3 * (time.process_time() - before) / max(1, int(some.sum())))
    return int(ok.sum()), times[0], times[1]


def draw_arm(rng: np.random.Generator) -> Robot:
    """Return an arm of six joints with axes anywhere in cubes of 1 m."""
    rows = ['<robot name="arm"><link name="l0"/>']
    for k in range(1, 8):
        xyz, rpy = (" ".join(map(repr, x.tolist())) for x in (rng.uniform(-0.5, 0.5, 3), rng.uniform(-3, 3, 3)))
        ends = f'<parent link="l{k - 1}"/><child link="l{k}"/><origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/>'
        rows.append(f'<link name="l{k}"/><joint name="j{k}" type="{"continuous" if k < 7 else "fixed"}">{ends}</joint>')
    return load_robot_from_urdf("".join(rows) + "</robot>", "arm", tool="l7")


def solve_arms(runs: int, seed: int) -> None:
    """Print how often all solutions hold the true one, how often their number is proved, and what a pose costs."""
    rng = np.random.default_rng(seed)
    for name in ("ur5", "ur10", "random"):
        fixed = None if name == "random" else load_robot(name)
        true, proved, counts, spent = 0, 0, [], 0.0
        for _ in range(runs):
            robot = fixed or draw_arm(rng)
            q = rng.uniform(-np.pi, np.pi, (1, 6))
            poses = forward_kinematics(robot, q).poses
            before = time.process_time()
            found = find_all_solutions(robot, poses)
            spent += time.process_time() - before
            away = np.abs((found.q[0] - q + np.pi) % (2 * np.pi) - np.pi).max(axis=1)
            true, proved = true + bool(np.nanmin(away) < 1e-6), proved + bool(found.proved[0])
            counts.append(int(np.isfinite(away).sum()))
        print(
            f"{name}: {runs} poses, {true} hold the true one, {proved} proved, {min(counts)} to {max(counts)} solutions, "
            f"{1e3 * spent / runs:.0f} ms a pose",
            flush=True,
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--speed", action="store_true", help="only the speed")
    parser.add_argument("--cost", action="store_true", help="only what inverse kinematics costs in and out of reach")
    parser.add_argument("--arms", action="store_true", help="only all solutions of six turning joints")
    parser.add_argument("--out")
    args = parser.parse_args()
    print(machine())
    if args.arms:
        solve_arms(args.runs, args.seed)
        return
    if args.cost:
        for name, (file, arguments) in ROBOTS.items():
            if args.only in name:
                robot = load_robot(file, **arguments)
                reached, inside, outside = cost(robot, args.runs if get_rods(robot) else 100, args.seed)
                print(f"{name}: {reached} reached, {inside:.3f} ms; the others {outside:.3f} ms a pose", flush=True)
        return
    if not args.only:
        for arms, n in (("simplified", 2_000_000), ("complete", 400_000)):
            print(f"forward kinematics, {arms}: {speed(load_robot('gantry_tau', arms=arms), n):.3g} poses/s")
    if args.speed:
        return
    rows = []
    for name, (file, arguments) in ROBOTS.items():
        if args.only in name:
            before = time.process_time()
            row = there_and_back(name, load_robot(file, **arguments), args.runs, args.seed)
            rows.append(row | {"cpu [s]": time.process_time() - before})
            print(
                ", ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in rows[-1].items()),
                flush=True,
            )
    if args.out:
        pd.DataFrame(rows).to_csv(args.out, index=False)


if __name__ == "__main__":
    main()
