"""Does `calibrate` with default options name a wrong convention of a pose file, and nothing that is not there?

    python experiments/pose_files.py [--what convention clean rows frames delay] [--sets 60] [--seed 0] [--robots NAME...]
                                     [--out DIR]

In: nothing; poses of a six-axis arm, a UR5, the L1 Gantry-Tau and a Delta, each with three dimensions off by 0.3 to 1 mm (mrad),
device and target anywhere, a tracker's noise of 20 um and 40 urad; 80 poses to fit and 60 held out with the same convention.
`convention`: one of `CONVENTIONS` is wrong in both files. `clean`: none is. `rows`: two or three campaigns with a device each,
one of them on a line or in a plane, in six orders of the rows. `frames`: the device moves by 0.2 mm before the held-out
poses or does not, after training on full, planar and one-joint motion. `delay`: the robot moves; in every other set its joints
were read 0.5 to 20 ms before or after the tool. Out: `pose_files_WHAT.csv`, a row a set, and the counts.
"""

from __future__ import annotations

import argparse
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation
from serial_calibration import own_arm

from tau_dyn.calibrate import Calibration, PoseSet, calibrate, fit_geometry_to_poses
from tau_dyn.calibrate.frames import DeviceFrames, Frame
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.models import RodFamily, Spec
from tau_dyn.calibrate.simulated import simulate_poses
from tau_dyn.calibrate.tree_geometry import build_tree_geometry
from tau_dyn.files import write_whole
from tau_dyn.mechanism import build_rods
from tau_dyn.robot import Robot, load_robot

NOISE = (20e-6, 40e-6)  # m, rad
N_TRAIN, N_HELD = 80, 60
N_OFF = 3
"""Dimensions that differ from the file."""


DIMENSIONS = ("rod_length", "joint_placement", "guideway_nonparallel", "pinion_scale")
"""Causes that are dimensions off the file, as in every set."""
MOVES = ("device_moved", "target_moved")


class StudiedRobot(NamedTuple):
    """A robot, its geometry, how far its joints move about home, and whether its tool turns."""

    robot: Robot
    geometry: Geometry
    reach: float
    turns: bool


def build_machine(name: str) -> StudiedRobot:
    """Return a robot of the study."""
    if name in ("six", "ur5"):
        robot = own_arm() if name == "six" else load_robot("ur5")
        return StudiedRobot(robot, build_tree_geometry(robot), 1.2, True)
    robot = load_robot("gantry_tau") if name == "l1" else load_robot("delta")
    rods = build_rods(robot)
    family = RodFamily(rods, PoseSet(np.tile(robot.home, (2, 1)), np.zeros((2, 3))))
    return StudiedRobot(robot, family.build(Spec("nonparallel" if name == "l1" else "complete")), 0.3, False)


ROBOTS = ("six", "ur5", "l1", "delta")


class Drawn(NamedTuple):
    """One machine's truth: parameters (p,), device and target, and a source of noise."""

    machine: StudiedRobot
    theta: np.ndarray
    frames: DeviceFrames
    rng: np.random.Generator

    def poses(self, q: np.ndarray, frames: DeviceFrames | None = None, campaign: np.ndarray | None = None) -> PoseSet:
        """Return measured poses at joint positions (N, na)."""
        return simulate_poses(self.machine.geometry, self.theta, q, self.rng, frames=frames or self.frames, noise=NOISE,
                              turned=self.machine.turns, campaign=campaign)  # fmt: skip

    def positions(self, n: int) -> np.ndarray:
        """Return joint positions (n, na) about home."""
        m = self.machine
        return m.robot.home + m.reach * self.rng.uniform(-1, 1, (n, m.robot.na))


def draw_frame(rng: np.random.Generator, reach: float) -> Frame:
    """Return a frame anywhere within so many metres."""
    return Frame(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-reach, reach, 3))


def draw(machine: StudiedRobot, rng: np.random.Generator) -> Drawn:
    """Return a machine with dimensions off the file that poses determine."""
    geometry = machine.geometry
    tool = Frame(Rotation.from_rotvec(rng.normal(size=3)).as_matrix(), rng.uniform(-0.1, 0.1, 3))
    frames = DeviceFrames((draw_frame(rng, 3.0),), (tool,))
    theta = geometry.parameters.values.copy()
    plain = Drawn(machine, theta, frames, rng)
    seen = fit_geometry_to_poses(geometry, plain.poses(plain.positions(N_TRAIN))).identifiability
    kept = {seen.names[k] for k in seen.kept}
    places = [k for k, p in enumerate(geometry.parameters) if p.free and p.name in kept]
    for k in rng.choice(places, N_OFF, replace=False):
        theta[k] += rng.choice((-1, 1)) * rng.uniform(0.3e-3, 1e-3)
    return plain._replace(theta=theta)


def reverse(poses: PoseSet, k: int) -> PoseSet:
    return replace(poses, q=poses.q * np.where(np.arange(poses.q.shape[1]) == k, -1.0, 1.0))


def exchange(poses: PoseSet, k: int) -> PoseSet:
    order = np.arange(poses.q.shape[1])
    other = (k + 1) % len(order)
    order[[k, other]] = order[[other, k]]
    return replace(poses, q=poses.q[:, order])


def quarter_turn(poses: PoseSet, k: int) -> PoseSet:
    return replace(poses, q=poses.q + np.pi / 2 * (np.arange(poses.q.shape[1]) == k))


def in_degrees(poses: PoseSet, k: int) -> PoseSet:
    del k
    return replace(poses, q=np.degrees(poses.q))


def in_millimetres(poses: PoseSet, k: int) -> PoseSet:
    del k
    return replace(poses, position=1e3 * poses.position)


def roll_quaternion(poses: PoseSet, k: int) -> PoseSet:
    del k
    assert poses.rotation is not None
    turned = Rotation.from_quat(np.roll(Rotation.from_matrix(poses.rotation).as_quat(), 1, axis=1)).as_matrix()
    return replace(poses, rotation=turned)


def invert(poses: PoseSet, k: int) -> PoseSet:
    del k
    assert poses.rotation is not None
    back = np.swapaxes(poses.rotation, 1, 2)
    return replace(poses, rotation=back, position=-np.einsum("nij,nj->ni", back, poses.position))


def shift(poses: PoseSet, k: int) -> PoseSet:
    rows = 1 if k % 2 else -1
    index = np.arange(max(0, rows), min(poses.n, poses.n + rows))
    return replace(poses.take(index), q=poses.q[index - rows], approach=poses.approach[index - rows])


def exchange_axes(poses: PoseSet, k: int) -> PoseSet:
    """Exchange y and z of the device."""
    del k
    return replace(poses, position=poses.position[:, [0, 2, 1]])


class Convention(NamedTuple):
    """A wrong convention: how it is done to a file, the causes that name it, and whether it needs turning joints or poses."""

    apply: Callable[[PoseSet, int], PoseSet]
    causes: tuple[str, ...]
    needs: str = ""


CONVENTIONS = {
    "joint_sign": Convention(reverse, ("joint_sign",)),
    "columns_exchanged": Convention(exchange, ("columns_exchanged",)),
    "quarter_turn": Convention(quarter_turn, ("joint_zero",), "inner turning joint"),
    "degrees": Convention(in_degrees, ("joint_unit",), "turning joints"),
    "millimetres": Convention(in_millimetres, ("position_unit",)),
    "axes_exchanged": Convention(exchange_axes, ("columns_exchanged",)),
    "quaternion_order": Convention(roll_quaternion, ("quaternion_order",), "orientation"),
    "inverse_poses": Convention(invert, ("inverse_poses",), "orientation"),
    "row_shift": Convention(shift, ("row_shift",)),
}


def draw_convention(machine: StudiedRobot, rng: np.random.Generator) -> tuple[str, int]:
    """Return a convention that applies to a robot, and a joint; zero and sign of an arm's outer joints are those of frames."""
    robot = machine.robot
    names = [
        name
        for name, convention in CONVENTIONS.items()
        if machine.turns or convention.needs not in ("orientation", "inner turning joint")
        if convention.needs != "turning joints" or "revolute" in robot.joint_kinds
    ]
    return str(rng.choice(names)), int(rng.integers(1, robot.na - 1) if machine.turns else rng.integers(robot.na))


def list_confirmed(found: Calibration) -> list[str]:
    """Return the confirmed findings as `cause@joints`."""
    return [f"{f.cause}@{'+'.join(f.joints)}" for f in found.findings if f.status == "confirmed"]


def measure_ratio(found: Calibration) -> float:
    """Return the held-out rms position error over the measurement noise."""
    return float(found.errors(found.chosen).position_size.rms / (np.sqrt(3) * NOISE[0]))


def count_intervals(found: Calibration, drawn: Drawn) -> tuple[int, int]:
    """Return how many 95 % intervals of the machine's own parameters hold the truth, and how many there are."""
    truth = dict(zip(drawn.machine.geometry.parameters.names, drawn.theta, strict=True))
    inside = total = 0
    for p in found.fit.parameters:
        interval = found.fit.interval(p)
        if interval is not None and p.name in truth:
            inside += interval[0] <= truth[p.name] <= interval[1]
            total += 1
    return inside, total


def study_convention(name: str, number: int, seed: int, clean: bool) -> list[dict[str, object]]:
    """Return the row of one file, with a wrong convention or without."""
    machine = build_machine(name)
    rng = np.random.default_rng([seed, number, ROBOTS.index(name), int(clean)])
    drawn = draw(machine, rng)
    train, held = drawn.poses(drawn.positions(N_TRAIN)), drawn.poses(drawn.positions(N_HELD))
    wrong, joint = ("", 0) if clean else draw_convention(machine, rng)
    if wrong:
        train, held = (CONVENTIONS[wrong].apply(x, joint) for x in (train, held))
    found = calibrate(machine.robot, train, held)
    confirmed = list_confirmed(found)
    causes = CONVENTIONS[wrong].causes if wrong else ()
    named = [x for x in confirmed if x.split("@")[0] in causes]
    others = [x for x in confirmed if x not in named and x.split("@")[0] not in DIMENSIONS]
    if wrong in ("joint_sign", "columns_exchanged", "quarter_turn"):
        named = [x for x in named if machine.robot.actuated[joint] in x.split("@")[1].split("+")]
    inside, total = count_intervals(found, drawn)
    scale = 1e3 if wrong == "millimetres" and not named else 1.0
    return [
        {
            "robot": name, "number": number, "convention": wrong, "joint": machine.robot.actuated[joint] if wrong else "",
            "named": bool(named), "others": "; ".join(others),
            "error_over_noise": measure_ratio(found) / scale, "inside": inside, "total": total, "model": found.chosen.name,
        }
    ]  # fmt: skip


def study_rows(name: str, number: int, seed: int) -> list[dict[str, object]]:
    """Return the row of one file with campaigns, calibrated in six orders of its rows."""
    machine = build_machine(name)
    rng = np.random.default_rng([seed, number, ROBOTS.index(name), 2])
    drawn = draw(machine, rng)
    n_campaigns = int(rng.integers(2, 4))
    devices = tuple(draw_frame(rng, 3.0) for _ in range(n_campaigns))
    frames = DeviceFrames(devices, drawn.frames.tool * n_campaigns)
    q = drawn.positions(40 * n_campaigns)
    campaign = np.repeat(np.arange(n_campaigns), 40)
    poor = int(rng.integers(n_campaigns))
    thin = np.flatnonzero(campaign == poor)
    moving = rng.choice(machine.robot.na, int(rng.integers(1, 3)), replace=False)  # one joint: a line; two: a surface
    still = np.setdiff1d(np.arange(machine.robot.na), moving)
    q[np.ix_(thin, still)] = machine.robot.home[still]
    poses = drawn.poses(q, frames, campaign)
    held = drawn.poses(drawn.positions(N_HELD), replace(frames, device=devices[:1], tool=frames.tool[:1]))
    turned = np.roll(np.arange(n_campaigns), 1)
    orders = [np.arange(poses.n), np.arange(poses.n)[::-1], *(rng.permutation(poses.n) for _ in range(2))]
    orders += [np.argsort(x, kind="stable") for x in (-poses.campaign, turned[poses.campaign])]
    errors, answers = [], set()
    for order in orders:
        found = calibrate(machine.robot, poses.take(order), held)
        errors.append(float(found.errors(found.chosen).position_size.rms))
        answers.add((found.chosen.name, *sorted(list_confirmed(found))))
    spread = max(errors) / min(errors) - 1
    return [
        {
            "robot": name, "number": number, "campaigns": n_campaigns, "poor": poor, "moving": len(moving), "spread": spread,
            "answers": len(answers), "error_over_noise": max(errors) / (np.sqrt(3) * NOISE[0]),
            "listed": " | ".join(map(str, answers)),
        }
    ]  # fmt: skip


def study_frames(name: str, number: int, seed: int) -> list[dict[str, object]]:
    """Return the rows of one machine whose device moves or not, after three kinds of training motion."""
    machine, rows = build_machine(name), []
    for motion in ("full", "planar", "one joint"):
        for moved in (False, True):
            rng = np.random.default_rng([seed, number, ROBOTS.index(name), 3])
            drawn = draw(machine, rng)
            q = drawn.positions(N_TRAIN)
            free = {"full": machine.robot.na, "planar": 2, "one joint": 1}[motion]
            q[:, free:] = machine.robot.home[free:]
            train = drawn.poses(q)
            device = drawn.frames.device[0]
            direction = rng.normal(size=3)
            shifted = Frame(device.rotation, device.translation + 0.2e-3 * direction / np.linalg.norm(direction))
            frames = replace(drawn.frames, device=(shifted if moved else device,))
            found = calibrate(machine.robot, train, drawn.poses(drawn.positions(N_HELD), frames))
            confirmed = list_confirmed(found)
            moves = [x for x in confirmed if x.split("@")[0] in MOVES]
            rows.append(
                {
                    "robot": name, "number": number, "motion": motion, "moved": moved, "reported": "; ".join(moves),
                    "silent": any("cannot be compared" in w for w in found.warnings), "confirmed": "; ".join(confirmed),
                }
            )  # fmt: skip
    return rows


def study_delay(name: str, number: int, seed: int) -> list[dict[str, object]]:
    """Return the row of one file of a moving robot, its joints read in time or not."""
    machine = build_machine(name)
    rng = np.random.default_rng([seed, number, ROBOTS.index(name), 4])
    drawn = draw(machine, rng)
    delay = (
        float(rng.choice((-1, 1)) * 10 ** rng.uniform(np.log10(5e-4), np.log10(2e-2)))
        if number // len(ROBOTS) % 2
        else 0.0
    )

    rate, phase = 2 * np.pi * rng.uniform(0.05, 0.3, machine.robot.na), rng.uniform(0, 2 * np.pi, machine.robot.na)

    def move(n: int) -> PoseSet:
        t = rng.uniform(0, 200, (n, 1))
        q, v, a, j = (machine.reach * rate**k * np.sin(rate * (t - delay) + phase + k * np.pi / 2) for k in range(4))
        measured = drawn.poses(machine.robot.home + machine.reach * np.sin(rate * t + phase))
        return replace(measured, q=machine.robot.home + q, speed=v, acceleration=a, jerk=j, approach=np.sign(v))

    found = calibrate(machine.robot, move(N_TRAIN), move(N_HELD))
    confirmed = list_confirmed(found)
    others = [x for x in confirmed if x.split("@")[0] not in (*DIMENSIONS, "joint_delay")]
    stated = next((p for f in found.findings if f.cause == "joint_delay" for p in f.parameters), None)
    interval = None if stated is None else found.fit.interval(stated)
    return [
        {
            "robot": name, "number": number, "delay": delay, "named": "joint_delay@" in confirmed, "others": "; ".join(others),
            "estimate": np.nan if stated is None else stated.value,
            "holds": interval is not None and interval[0] <= delay <= interval[1],
            "error_over_noise": measure_ratio(found), "model": found.chosen.name,
        }
    ]  # fmt: skip


STUDIES: dict[str, Callable[[str, int, int], list[dict[str, object]]]] = {
    "convention": lambda name, number, seed: study_convention(name, number, seed, False),
    "clean": lambda name, number, seed: study_convention(name, number, seed, True),
    "rows": study_rows,
    "frames": study_frames,
    "delay": study_delay,
}


def summarise(what: str, table: pd.DataFrame) -> str:
    """Return the counts of a study in a line."""
    failed = int((table.fault != "").sum())
    whole = table[table.fault == ""]
    if what in ("convention", "clean"):
        named = f"{int(whole.named.sum())} of {len(table)} named, " if what == "convention" else ""
        others = int((whole.others != "").sum())
        cover = 100 * whole.inside.sum() / max(whole.total.sum(), 1)
        return (
            f"{what}: {named}{others} of {len(table)} with another cause confirmed, error over noise median "
            f"{whole.error_over_noise.median():.3f}, most {whole.error_over_noise.max():.3f}, coverage {cover:.1f} %, "
            f"{failed} failed"
        )
    if what == "rows":
        return f"rows: {int((whole.spread < 1e-6).sum())} of {len(table)} equal to 1e-6 in six orders, {failed} failed"
    if what == "delay":
        late, named = whole.delay != 0, whole.named.astype(bool)
        return (
            f"delay: {int((late & named).sum())} of {int(late.sum())} named, {int((~late & named).sum())} of "
            f"{int((~late).sum())} false, {int((whole.others != '').sum())} with another cause confirmed, "
            f"intervals of the time hold {100 * whole[late & named].holds.mean():.1f} %, "
            f"error over noise at most {whole.error_over_noise.max():.3f}, "
            f"{failed} failed"
        )
    false = whole[~whole.moved.astype(bool) & (whole.reported != "")]
    right = whole[whole.moved.astype(bool) & ((whole.reported != "") | whole.silent.astype(bool))]
    return (
        f"frames: {len(right)} of {int(whole.moved.sum())} named or not comparable, {len(false)} false, {failed} failed"
    )


def main(kinds: list[str], sets: int, seed: int, robots: list[str], out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    for what in kinds:
        rows: list[dict[str, object]] = []
        for number in range(sets):
            name = robots[number % len(robots)]
            start = time.perf_counter()
            try:
                new = STUDIES[what](name, number, seed)
            except Exception as fault:  # a study goes on after a set that fails
                traceback.print_exc()
                new = [{"robot": name, "number": number, "fault": f"{type(fault).__name__}: {fault}"[:200]}]
            for row in new:
                rows.append({"fault": ""} | row | {"seconds": round(time.perf_counter() - start, 1)})
                print(what, *rows[-1].values(), flush=True)
            write_whole(out / f"pose_files_{what}.csv", pd.DataFrame(rows).to_csv(index=False))
        print(summarise(what, pd.DataFrame(rows).fillna({"fault": "", "others": "", "reported": ""})), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument("--sets", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument("--out", type=Path, default=Path("out"))
    args = parser.parse_args()
    main(args.what, args.sets, args.seed, args.robots, args.out)
