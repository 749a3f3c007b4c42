"""Are dimensions found as exactly as they can be from distances, pins, planes, balls, cameras on the tool?

    python experiments/measurements.py [--what distance hole plane sphere trackers hand_eye wire_and_tracker encoders
                                       encoders_and_tracker] [--sets 20] [--seed 0] [--out DIR]

In: nothing; a six-axis arm and a UR5, or the L1 Gantry-Tau where its three axes can do it, each with three dimensions off by
0.3 to 1 mm (mrad), devices and fixtures anywhere, the target anywhere on the tool. Encoders of passive joints, with zeros that
nobody knows: a planar five-bar and a Delta. Joint positions that touch a fixture come from Newton's method on the true robot.
Out: `measurements.csv`, a row a set; for each kind the error of the determined parameters over the Cramer-Rao bound at the true
noise (of predictions, where there are encoders), the coverage of 95 % intervals, and other causes that were confirmed.
"""

from __future__ import annotations

import argparse
import time
import traceback
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
from changed_loads import write_fivebar
from pose_files import DIMENSIONS, N_OFF, ROBOTS, StudiedRobot, build_machine, draw_frame
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate import Calibration, GeometryFit, PoseSet, calibrate, fit_geometry_to_poses
from tau_dyn.calibrate.fit_problem import FitState, Problem, WeightedProblem
from tau_dyn.calibrate.frames import DeviceFrames, Frame
from tau_dyn.calibrate.measured import ENCODERS, KINDS, PassiveEncoders, find_directions, predict_measured
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.files import write_whole
from tau_dyn.robot import load_robot

STUDIES = {
    # kind of each device, its noise [m], poses of each, robots
    "distance": (("distance",) * 3, (2e-5,) * 3, 60, ("six", "l1")),
    "hole": (("hole",) * 4, (3e-5,) * 4, 30, ("six", "ur5")),
    "plane": (("plane",) * 3, (2e-5,) * 3, 60, ("six", "ur5")),
    "sphere": (("sphere",) * 4, (2e-5,) * 4, 50, ("six", "ur5")),
    "trackers": (("pose",) * 2, (2e-5, 6e-5), 60, ("six", "l1")),
    "hand_eye": (("hand_eye",), (1e-4,), 80, ("six", "ur5")),
    "wire_and_tracker": (("pose", "distance"), (2e-5, 5e-5), 60, ("ur5", "l1")),
    "encoders": ((), (), 60, ("fivebar", "delta_tree")),
    "encoders_and_tracker": (("pose",), (2e-5,), 60, ("fivebar", "delta_tree")),
}
PASSIVE = {
    "fivebar": ("elbow1", "elbow2"),
    "delta_tree": tuple(f"rod{k}a_{turn}" for k in (1, 2, 3) for turn in ("yaw", "pitch")),
}
"""Joints with encoders: on a Delta both turns of a rod of each arm."""
ARC_NOISE_M = 1e-5  # of the arc at the tool's distance
SHOWN_PLACES = {"fivebar": np.array([1.0, 0.0, 1.0]), "delta_tree": np.zeros(3)}
"""Along which axes of the tool frame the target may be anywhere: the others show too little, and the fit keeps them at zero."""
ZERO_RAD = 0.3  # up to which zeros of encoders are off
HAND_EYE_RAD = 5e-4  # noise of a camera on the tool
OFFSETS_M = {"distance": 0.35, "sphere": 0.0127}
NEWTON_STEPS = 30
CLOSED_M = 1e-10


def draw_devices(machine: StudiedRobot, kinds: tuple[str, ...], rng: np.random.Generator) -> DeviceFrames:
    """Return devices around the robot, fixtures where it can touch them, and a target on the tool."""
    geometry = machine.geometry
    shown = SHOWN_PLACES[get_name(machine)] if set(kinds) & set(ENCODERS) else np.ones(3)
    tool = Frame(draw_frame(rng, 1.0).rotation, shown * rng.uniform(-0.1, 0.1, 3))
    device = []
    for kind in kinds:
        turn = draw_frame(rng, 1.0).rotation if kind in ("pose", "plane", "hand_eye") else np.eye(3)
        if kind in ENCODERS:
            device.append(Frame(np.eye(3), np.zeros(3)))
            continue
        if kind in ("pose", "distance", "hand_eye"):
            device.append(Frame(turn, turn @ rng.uniform(-2.0, 2.0, 3)))
            continue
        q = machine.robot.home + 0.5 * machine.reach * rng.uniform(-1, 1, (1, machine.robot.na))
        at = DeviceFrames((Frame(turn, np.zeros(3)),), (tool,)).measured(
            geometry.forward(geometry.parameters.values, q).poses, np.zeros(1, int)
        )
        shift = OFFSETS_M["sphere"] * np.array([0.0, 0.0, 1.0]) if kind == "sphere" else np.zeros(3)
        device.append(Frame(turn, shift - at.position[0]))
    lengths = tuple(
        rng.uniform(-ZERO_RAD, ZERO_RAD) if kind in ENCODERS else OFFSETS_M.get(kind, 0.0) for kind in kinds
    )
    return DeviceFrames(tuple(device), (tool,), kinds, lengths)


def reach_fixture(
    machine: StudiedRobot,
    theta: np.ndarray,
    frames: DeviceFrames,
    k: int,
    n: int,
    noise: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Return joint positions (n, na) at which the target touches a fixture, off by noise [m], at attitudes by chance."""
    kind, found = frames.kinds[k], np.zeros((0, machine.robot.na))
    while len(found) < n:
        q = machine.robot.home + machine.reach * rng.uniform(-1, 1, (4 * n, machine.robot.na))
        which, start = np.full(len(q), k), q.copy()
        off = noise * rng.standard_normal((len(q), 3))
        for _ in range(NEWTON_STEPS):
            base = machine.geometry.forward(theta, q)
            seen = frames.measured(base.poses, which).position
            twist = frames.carried(base.poses, machine.geometry.tool_by_joint(theta, q, base.poses), which)[:, :3]
            if KINDS[kind].numbers == 3:
                gap, slope = seen - off, twist
            else:
                u = find_directions((kind,), np.zeros(len(q), int), seen)
                gap = (np.sum(u * seen, axis=1) - frames.lengths[k] - off[:, 0])[:, None]
                slope = np.einsum("ni,nij->nj", u, twist)[:, None]
            step = (np.linalg.pinv(np.nan_to_num(slope), rcond=1e-3) @ np.nan_to_num(gap)[:, :, None])[:, :, 0]
            q = q - step * np.minimum(1.0, 0.3 / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12))
        near = np.all(np.abs(q - start) < 1.5 * machine.reach, axis=1)
        good = base.ok & near & (np.abs(gap).max(axis=1) < CLOSED_M)
        found = np.vstack([found, q[good]])
    return found[:n]


def measure(
    machine: StudiedRobot,
    theta: np.ndarray,
    frames: DeviceFrames,
    noise: tuple[float, ...],
    n: int,
    rng: np.random.Generator,
) -> PoseSet:
    """Return what all devices measure of a robot with parameters `theta`, the rows in an order by chance."""
    q, position, device = [], [], []
    for k, (kind, sigma) in enumerate(zip(frames.kinds, noise, strict=True)):
        if kind in ("pose", "distance", "hand_eye", *ENCODERS):
            own = machine.robot.home + machine.reach * rng.uniform(-1, 1, (n, machine.robot.na))
        else:
            own = reach_fixture(machine, theta, frames, k, n, sigma, rng)
        rows = describe_devices(machine, frames, own, np.full(n, k))
        seen = frames.measured(predict_measured(machine.geometry, theta, rows, own).poses, np.full(n, k)).position
        value = np.zeros((n, 3))
        if kind == "pose":
            value = seen + sigma * rng.standard_normal((n, 3))
        elif kind == "distance":
            value[:, 0] = np.linalg.norm(seen, axis=1) + frames.lengths[k] + sigma * rng.standard_normal(n)
        elif kind in ENCODERS:
            value[:, 0] = seen[:, 0] + frames.lengths[k] * rows.length_factors + sigma * rng.standard_normal(n)
        q.append(own)
        position.append(value)
        device.append(np.full(n, k))
    if frames.kinds == ("hand_eye",):  # the file as a camera on the tool writes it, without a word on that
        board = frames.measured(machine.geometry.forward(theta, q[0]).poses, np.zeros(n, int))
        seen = PoseSet(q[0], board.position, board.rotation).as_seen_from_tool()
        turn = Rotation.from_rotvec(HAND_EYE_RAD * rng.standard_normal((n, 3))).as_matrix()
        return PoseSet(q[0], seen.position + noise[0] * rng.standard_normal((n, 3)), turn @ seen.rotation)
    order = rng.permutation(n * len(noise))
    rows = describe_devices(machine, frames, np.vstack(q)[order], np.concatenate(device)[order])
    return replace(rows, position=np.vstack(position)[order])


def describe_devices(machine: StudiedRobot, frames: DeviceFrames, q: np.ndarray, device: np.ndarray) -> PoseSet:
    """Return rows at joint positions (N, na) by their devices' numbers (N,), without measured values."""
    joints = iter(PASSIVE.get(get_name(machine), ()))
    names = tuple(next(joints) if kind in ENCODERS else f"{kind} {k + 1}" for k, kind in enumerate(frames.kinds))
    used = [name for name, kind in zip(names, frames.kinds, strict=True) if kind in ENCODERS]
    radius = PassiveEncoders.of(machine.robot, used).arc_radius if used else 1.0
    return PoseSet(
        q,
        np.zeros((len(q), 3)),
        device=device,
        devices=names,
        kinds=frames.kinds,
        arc_radius=radius,
        source="measurements",
    )


def get_name(machine: StudiedRobot) -> str:
    """Return the study's name of a robot with encoders."""
    return "delta_tree" if machine.robot.na > 2 else "fivebar"


def build_studied_robot(name: str) -> StudiedRobot:
    """Return a robot of the study; those with encoders as trees with loops."""
    if name not in PASSIVE:
        return build_machine(name)
    with TemporaryDirectory() as folder:
        robot = write_fivebar(Path(folder)) if name == "fivebar" else load_robot("delta")
    return StudiedRobot(robot, build_tree_geometry(robot), 0.4 if name == "fivebar" else 0.3, False)


def compute_bound(fitted: GeometryFit, theta: np.ndarray, frames: DeviceFrames, noise: tuple[float, ...]) -> np.ndarray:
    """Return the covariance of the kept unknowns at the truth and the true noise, with the fit's prior (Cramer-Rao)."""
    poses = replace(fitted.poses, device_errors=tuple(np.array(noise) / noise[0]))
    turned = fitted.poses.rotation is not None
    problem = Problem(fitted.geometry, poses, fitted.unknowns, "forward", turned)
    start = problem.place(theta, frames, fitted.state.slack, None)
    state = FitState(theta, frames, start.base, start.ok, fitted.state.slack)
    weighted = WeightedProblem.of(problem, "none", (noise[0], HAND_EYE_RAD)[: 1 + turned])
    return weighted.compute_covariance(state, fitted.identifiability.kept)[2]


def compare_with_truth(
    fitted: GeometryFit, truth: dict[str, float], frames: DeviceFrames, noise: tuple[float, ...]
) -> dict[str, object]:
    """Return the error of the kept dimensions against the bound, and how many intervals hold the truth.

    A dimension that the fit left at its nominal value is made up for by those that it kept.
    """
    found, names = fitted.identifiability, fitted.geometry.parameters.names
    nominal = {p.name: p.value for p in fitted.geometry.parameters}
    off = np.array(
        [truth[found.names[k]] - nominal[found.names[k]] if found.names[k] in truth else 0.0 for k in found.dropped]
    )
    made_up = found.factors @ off
    bound = compute_bound(fitted, np.array([truth[name] for name in names]), frames, noise)
    estimate = {p.name: p for p in fitted.parameters}
    own, error, inside = [], [], 0
    for k, more in zip(found.kept, made_up, strict=True):
        name = found.names[k]
        if name in truth:
            interval = fitted.interval(estimate[name])
            assert interval is not None
            inside += interval[0] <= truth[name] + more <= interval[1]
            own.append(k)
            error.append(estimate[name].value - truth[name] - more)
    square, rank = np.array(error) @ np.linalg.solve(bound[np.ix_(own, own)], error), len(own)
    if fitted.poses.of_encoders.any():
        square, rank = (
            measure_predictions(fitted, np.array([truth[name] for name in names]), frames, noise),
            len(found.kept),
        )
    weights = " ".join(f"{x:.2f}" for x in fitted.poses.device_errors)
    return {"square": float(square), "rank": rank, "total": len(own), "inside": inside, "weights": weights}


def measure_predictions(
    fitted: GeometryFit, theta: np.ndarray, frames: DeviceFrames, noise: tuple[float, ...]
) -> float:
    """Return the squared error of what is predicted at the fitted rows, in units of the noise; its bound is the rank.

    Loops leave directions that hardly show and are curved, along which parameters do not follow their derivatives.
    """
    poses = fitted.poses
    seen = []
    for values, own in ((fitted.theta, fitted.frames), (theta, frames)):
        base = predict_measured(fitted.geometry, values, poses, poses.q).poses
        position = own.measured(base, poses.setup).position
        position[:, 0] += np.where(poses.of_encoders, own.lengths_of(poses.setup) * poses.length_factors, 0.0)
        seen.append(position)
    return float(np.sum(((seen[0] - seen[1]) / np.array(noise)[poses.device, None]) ** 2))


def study(what: str, name: str, number: int, seed: int) -> dict[str, object]:
    """Return the row of one set."""
    kinds, noise, n, _ = STUDIES[what]
    n_encoders = len(PASSIVE.get(name, ()))
    kinds, noise = (*kinds, *("angle",) * n_encoders), (*noise, *(ARC_NOISE_M,) * n_encoders)
    place = ROBOTS.index(name) if name in ROBOTS else len(ROBOTS) + list(PASSIVE).index(name)
    machine, rng = build_studied_robot(name), np.random.default_rng([seed, number, place, sum(map(ord, what))])
    geometry, frames = machine.geometry, draw_devices(machine, kinds, rng)
    theta = geometry.parameters.values.copy()
    plain = fit_geometry_to_poses(
        geometry, measure(machine, theta, frames, noise, n, rng), frames=frames
    ).identifiability
    kept = {plain.names[k] for k in plain.kept}
    places = [k for k, p in enumerate(geometry.parameters) if p.free and p.name in kept]
    for k in rng.choice(places, N_OFF, replace=False):
        theta[k] += rng.choice((-1, 1)) * rng.uniform(0.3e-3, 1e-3)
    train, held = (measure(machine, theta, frames, noise, n, rng) for _ in range(2))
    model = "complete" if name in PASSIVE else "auto" if machine.turns else "nonparallel"
    found: Calibration = calibrate(machine.robot, train, held, model)
    fitted = found.fit
    row: dict[str, object] = {"what": what, "robot": name, "number": number, "model": found.chosen.name}
    row |= {"square": 0.0, "rank": 0, "total": 0, "inside": 0, "weights": ""}
    if set(fitted.geometry.parameters.names) == set(geometry.parameters.names):
        row |= compare_with_truth(fitted, dict(zip(geometry.parameters.names, theta, strict=True)), frames, noise)
    held_mm = 1e3 * found.errors(found.chosen).position_size.rms
    confirmed = [
        f.cause for f in found.findings if f.status == "confirmed" and f.cause not in (*DIMENSIONS, "inverse_poses")
    ]
    return row | {"held_mm": held_mm, "others": "; ".join(confirmed), "warnings": " | ".join(found.warnings)}


def summarise(what: str, table: pd.DataFrame) -> str:
    """Return the counts of one kind in a line."""
    whole = table[table.fault == ""]
    ratio = np.sqrt(whole.square.sum() / max(whole["rank"].sum(), 1))
    cover = 100 * whole.inside.sum() / max(whole.total.sum(), 1)
    return (
        f"{what}: {len(table)} sets, error over bound {ratio:.3f}, coverage {cover:.1f} %, "
        f"{int((whole.others != '').sum())} with another cause confirmed, {len(table) - len(whole)} without an answer"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", nargs="+", choices=sorted(STUDIES), default=list(STUDIES), metavar="KIND")
    parser.add_argument("--sets", type=int, default=20, help="sets of each kind, half of them of each robot")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, object]] = []
    for what in args.what:
        for number in range(args.sets):
            name, begun = STUDIES[what][3][number % 2], time.monotonic()
            try:
                row = study(what, name, number, args.seed) | {"fault": ""}
            except Exception as fault:
                traceback.print_exc()
                row = {"what": what, "robot": name, "number": number, "fault": f"{type(fault).__name__}: {fault}"[:300]}
            rows.append(row | {"seconds": round(time.monotonic() - begun, 1)})
            print(rows[-1], flush=True)
            write_whole(args.out / "measurements.csv", pd.DataFrame(rows).to_csv(index=False))
    table = pd.DataFrame(rows)
    for what in args.what:
        print(summarise(what, table[table.what == what]))


if __name__ == "__main__":
    main()
