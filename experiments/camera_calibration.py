"""Camera vision (thesis 5.5) on a simulated L1: corners, one camera and two, lens model on and off, beside a laser tracker.

L1's dimensions are a few mm off the robot file. Its plate only translates, so its images alone do not tell a focal length; 12
images with the plate held by hand come along (`--hand 0` leaves them out). Cameras: 1024x768, f = 1000 px, 2.2 m before the
robot, lenses with k1 = -0.2; plate: 9x6 corners, squares of 50 mm, tilted by 25 degrees, flat and printed to scale. Corner
noise of 0.05 px is assumed, two to three times that of rendered photographs (`--photographs`, slower, uses those). The tracker
has 0.05 mm an axis.

Measured is the mean distance after the best rigid alignment of frames, as the thesis compares vision and tracker; and that of
the calibrated model from the true robot on poses used for nothing else.

    python experiments/camera_calibration.py --runs 5 --seed 1
    python experiments/camera_calibration.py --corners 15 --seed 1
    python experiments/camera_calibration.py --coverage 100 --seed 1

The plate of the thesis with five squares of 100 mm (as large as the chessboard), rendered and read from photographs: corners and
poses of known cameras next to the chessboard's, at rest and blurred by motion; shares found in clutter and dim light, behind a
bar and in rooms without it; and a moving L1, images and joints by two clocks, read from files as a user's are.

    python experiments/camera_calibration.py --squares 60 --seed 1
    python experiments/camera_calibration.py --found 30 --seed 1
    python experiments/camera_calibration.py --moving 60 --seed 1
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from camera_parts.photographs import Photography, draw_facing_rotation, render, render_clutter
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate import PoseSet
from tau_dyn.calibrate.model_selection import Options, fit_spec
from tau_dyn.calibrate.models import RodFamily, Spec
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.mechanism import Poses, build_rods, inverse_kinematics
from tau_dyn.robot import load_robot
from tau_dyn.vision import Cameras, ImageTimes, Pattern, Positions, measure_poses_from_images, parse_pattern, solve
from tau_dyn.vision.bundle import Views
from tau_dyn.vision.cameras import project
from tau_dyn.vision.detect import _in_order, find_corners
from tau_dyn.vision.images import Detection
from tau_dyn.vision.motion import JointLog
from tau_dyn.vision.quarter_turns import TURNS
from tau_dyn.vision.squares import find_squares

PATTERN = Pattern(9, 6, 0.05)
SIZE = np.array([1024, 768])
NUMBERS = np.array(
    [[1000, 1002, 505, 390, -0.20, 0.08, 8e-4, -6e-4, 0], [990, 991, 520, 377, -0.22, 0.09, -5e-4, 7e-4, 0.0]]
)
LOOK = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0.0]])  # camera axes in the robot's base: it looks along -x
BASE_LINE, DISTANCE = 0.8, 2.2  # [m]
OFF = 3e-3  # [m] dimensions from the robot file
TRACKER, CORNER = 0.05e-3, 0.05  # [m], [px]
REPEAT = 15e-6  # [m] repeatability of the robot


@dataclass(frozen=True)
class Rig:
    """Where cameras are: `rotation[c] X + position[c]` of a point in the first camera's frame."""

    rotation: np.ndarray
    position: np.ndarray


def rig() -> Rig:
    """Return two cameras whose axes meet before the robot."""
    turn = Rotation.from_rotvec([0.01, -np.arctan(BASE_LINE / DISTANCE), 0.02]).as_matrix()
    meet = np.array([0, 0, DISTANCE])
    return Rig(np.array([np.eye(3), turn]), np.array([np.zeros(3), meet - turn @ meet]))


def robot(rng: np.random.Generator, n: int):
    """Return L1's rods, its true geometry and parameters, and commanded positions (n, 3) spread over the workspace."""
    rods = build_rods(load_robot("gantry_tau"))
    geometry = RodGeometry(rods)
    theta = geometry.parameters.values + OFF * rng.standard_normal(len(geometry.parameters.names))
    for k, name in enumerate(geometry.parameters.names):
        if "direction" in name:
            theta[k] = geometry.parameters.values[k] + 1e-3 * rng.standard_normal()
    at = rods.home.position[0] + rng.uniform([-0.35, -0.4, -0.3], [0.35, 0.4, 0.3], (2 * n, 3))
    found = inverse_kinematics(rods, Poses(at, np.repeat(rods.rotation[None], len(at), axis=0)), limits=False)
    return rods, geometry, theta, found.q[found.ok][:n]


def plates_on(robot_at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pattern's rotation (3, 3) and positions (n, 3) in the first camera's frame, of a plate that only translates."""
    middle = robot_at.mean(axis=0)
    return draw_facing_rotation(np.radians(25), 0.8, 0.1), (robot_at - middle) @ LOOK.T + [0, 0, DISTANCE]


def by_hand(rng: np.random.Generator, n: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return plates held by hand, tilted by 20 to 45 degrees, within the first image."""
    out = []
    while len(out) < n:
        r = draw_facing_rotation(rng.uniform(0.35, 0.8), rng.uniform(0, 2 * np.pi), rng.uniform(-0.5, 0.5))
        t = rng.uniform([-0.7, -0.5, 1.2], [0.7, 0.5, 2.2])
        pixels = project(PATTERN.points @ r.T + t, NUMBERS[0])
        if np.all((pixels > 30) & (pixels < SIZE - 31)):
            out.append((r, t))
    return out


def look(
    plates: list[tuple[np.ndarray, np.ndarray]], cameras: Rig, rng: np.random.Generator, photographs: bool
) -> Views:
    """Return what the cameras see of plates, where they see them whole."""
    corners, camera, plate = [], [], []
    rooms = [render_clutter(tuple(SIZE), rng) for _ in range(2)] if photographs else []
    for k, (r, t) in enumerate(plates):
        for c in range(2):
            rc, tc = cameras.rotation[c] @ r, cameras.rotation[c] @ t + cameras.position[c]
            seen = project(PATTERN.points @ rc.T + tc, NUMBERS[c])
            if not np.all((seen > 20) & (seen < SIZE - 21)):
                continue
            if photographs:
                found = find_corners(
                    render(PATTERN, rc, tc, NUMBERS[c], tuple(SIZE), rng, background=rooms[c]), PATTERN
                ).corners
                if found is None:
                    continue
                seen = found
            else:
                seen = seen + CORNER * rng.standard_normal(seen.shape)
            corners.append(seen), camera.append(c), plate.append(k)
    return Views(np.array(corners), np.array(camera), np.array(plate))


def aligned(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return distances (n,) after the best rigid motion."""
    a, b = found - found.mean(0), truth - truth.mean(0)
    turn = Rotation.align_vectors(b, a)[0]
    return np.linalg.norm(turn.apply(a) - b, axis=1)


def measure(views: Views, n: int, cameras: int, lens: str) -> tuple[np.ndarray, np.ndarray]:
    """Return which of the first n plates were measured, and where (m, 3)."""
    if cameras == 1:
        views = Views(*(a[views.camera == 0] for a in views))
    kept = np.unique(views.plate)
    numbered = Views(views.corners, views.camera, np.searchsorted(kept, views.plate))
    solved = solve(numbered, PATTERN, np.tile(SIZE, (cameras, 1)), lens=lens)
    kept = kept[np.unique(numbered.plate[solved.used])]
    return kept[kept < n], solved.bundle.plates.position[kept < n]


def study(seed: int, n: int, hand: int, photographs: bool) -> list[tuple[str, float, float, float, int]]:
    """Return for each way of measuring: mean and largest measuring error, mean error of the calibrated model [m], and poses."""
    rng = np.random.default_rng(seed)
    rods, geometry, theta, q = robot(rng, n + 100)
    truth = geometry.forward(theta, q).poses.position
    at, unseen = truth[:n] + REPEAT * rng.standard_normal((n, 3)), slice(n, None)
    turn, where = plates_on(at)
    views = look([(turn, t) for t in where] + by_hand(rng, hand), rig(), rng, photographs)
    rows = []
    ways = [
        (f"{'stereo' if c == 2 else 'one camera'}, lens {lens}", c, lens)
        for c in (2, 1)
        for lens in ("none", "radial", "brown")
    ]
    for name, c, lens in [*ways, ("laser tracker", 0, "")]:
        if c:
            index, found = measure(views, n, c, lens)
        else:
            index, found = np.arange(n), at + TRACKER * rng.standard_normal(at.shape)
        off = aligned(found, truth[index])
        fitted = fit_spec(
            RodFamily(rods, PoseSet(q[index], found)), Spec("nonparallel"), PoseSet(q[index], found), Options()
        )
        model = fitted.geometry.forward(fitted.theta, q[unseen]).poses.position
        rows.append((name, off.mean(), off.max(), aligned(model, truth[unseen]).mean(), len(index)))
    return rows


def table(args: argparse.Namespace) -> None:
    """Print the comparison."""
    runs = [study(seed, args.poses, args.hand, args.photographs) for seed in range(args.seed, args.seed + args.runs)]
    print(f"{'':<28}{'measured: mean':>16}{'largest':>10}{'model, held out':>18}   [mm], means over {args.runs} runs")
    for rows in zip(*runs, strict=True):
        values = 1e3 * np.mean([[r[1], r[2], r[3]] for r in rows], axis=0)
        print(f"{rows[0][0]:<28}{values[0]:>16.3f}{values[1]:>10.3f}{values[2]:>18.3f}   {rows[0][4]} poses")


def opencv_corners(image: np.ndarray) -> dict[str, np.ndarray]:
    """Print how far corners are from the truth: our method, OpenCV's with every flag for accuracy, refined by `cornerSubPix`."""
    import cv2

    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    ok, found = cv2.findChessboardCornersSB(image, (PATTERN.columns, PATTERN.rows), flags=flags)
    if not ok:
        return {}
    enough = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
    finer = cv2.cornerSubPix(image, found.reshape(-1, 1, 2).astype(np.float32), (5, 5), (-1, -1), enough)
    return {
        "SB": _in_order(image, found.reshape(-1, 2), PATTERN),
        "SubPix": _in_order(image, finer.reshape(-1, 2), PATTERN),
    }


def corner_table(n: int, seed: int) -> None:
    """Print how well corners are found in photographs, beside OpenCV's own."""
    print(f"{'photographs':<26}{'SB':>8}{'+ SubPix':>10}{'ours':>8}{'largest':>9}{'found':>8}   rms [px]")
    kinds = {
        "usual": Photography(),
        "blur 1.5 px": Photography(blur=1.5),
        "noise 6 of 255": Photography(noise=6.0),
        "light down to a fifth": Photography(gradient=0.8),
        "exposure 0.35": Photography(exposure=0.35),
    }
    small = np.array([640, 480])
    numbers = np.array([640, 642, 322, 238, -0.20, 0.08, 8e-4, -6e-4, 0.0])
    for name, photography in kinds.items():
        rng = np.random.default_rng(seed)
        room, off = render_clutter(tuple(small), rng), {"SB": [], "SubPix": [], "ours": []}
        for _ in range(n):
            r = draw_facing_rotation(rng.uniform(0, 0.7), rng.uniform(0, 6.28), rng.uniform(-3.1, 3.1))
            t = rng.uniform([-0.2, -0.15, 1.0], [0.2, 0.15, 1.6])
            image = render(PATTERN, r, t, numbers, tuple(small), rng, background=room, photography=photography)
            found = find_corners(image, PATTERN).corners
            theirs = opencv_corners(image)
            for kind, corners in (theirs | {"ours": found}).items() if found is not None else ():
                off[kind].append(corners - project(PATTERN.points @ r.T + t, numbers))
        rms = {kind: np.sqrt(np.mean(np.square(e))) for kind, e in off.items()}
        largest, counted = np.abs(off["ours"]).max(), len(off["ours"])
        print(f"{name:<26}{rms['SB']:>8.3f}{rms['SubPix']:>10.3f}{rms['ours']:>8.3f}{largest:>9.3f}{counted:>5}/{n}")


def coverage(runs: int, seed: int) -> None:
    """Print how often 95 % intervals hold the truth, and how long an adjustment takes."""
    for c in (1, 2):
        inside, spent = [], 0.0
        for s in range(seed, seed + runs):
            rng = np.random.default_rng(s)
            plates = by_hand(rng, 12)
            views = look(plates, rig(), rng, False)
            views = Views(*(a[views.camera < c] for a in views))
            begun = time.process_time()
            bundle = solve(views, PATTERN, np.tile(SIZE, (c, 1))).bundle
            spent += time.process_time() - begun
            off = bundle.plates.position - np.array([t for _, t in plates])
            turn = Rotation.from_matrix(bundle.plates.rotation @ np.array([r.T for r, _ in plates])).as_rotvec()
            stderr = np.sqrt(np.diagonal(bundle.covariance, axis1=1, axis2=2))
            inside.append(np.abs(np.hstack([off, turn])) < 1.96 * stderr)
        share = np.mean(inside, axis=(0, 1))
        print(
            f"{c} camera(s), {runs} runs: position {share[:3].mean():.3f}, orientation {share[3:].mean():.3f}; "
            f"{spent / runs:.2f} s of CPU a run"
        )


FIVE = parse_pattern("five-squares", 0.1)
FINE = 8
"""Square root of the rays of a pixel: with fewer, the renderer is worse than the corners read from it."""


def read_corners(image: np.ndarray, pattern: Pattern) -> Detection:
    """Return what is found of a pattern in an image."""
    return find_corners(image, pattern) if pattern.kind == "chessboard" else find_squares(image, pattern)


def turn_alike(pattern: Pattern, found: np.ndarray, rotation: np.ndarray, truth: np.ndarray):
    """Return the true corners (n, 2) and rotation in the quarter turn that was found."""
    if pattern.turns == 1:
        return truth, rotation
    index = np.arange(pattern.n).reshape(pattern.rows, pattern.columns)
    turned = [truth[np.rot90(index, k).ravel()] for k in range(4)]
    k = int(np.argmin([np.abs(found - t).max() for t in turned]))
    return turned[k], rotation @ TURNS[k]


def squares_table(n: int, seed: int) -> None:
    """Print corners and poses of both patterns before a known camera."""
    print(
        f"{'':<30}{'corners':>9}{'position':>10}{'orientation':>13}{'95 % hold':>11}{'read':>9}   [px], [mm], [mrad] rms"
    )
    for pattern in (FIVE, PATTERN):
        for blurred in (0.0, 4.0):
            rng = np.random.default_rng(seed)
            room, seen = render_clutter(tuple(SIZE), rng), []
            for r, t in by_hand(rng, n):
                angle = rng.uniform(0, 2 * np.pi)
                shift = blurred * t[2] / NUMBERS[0, 0] * np.array([np.cos(angle), np.sin(angle), 0])
                motion = np.concatenate([shift, np.zeros(3)]) if blurred else None
                photography = Photography(fine=FINE)
                image = render(
                    pattern, r, t, NUMBERS[0], tuple(SIZE), rng, background=room, photography=photography, motion=motion
                )
                found = read_corners(image, pattern)
                if found.corners is not None and found.stderr is not None and np.isfinite(found.stderr).all():
                    truth, turned = turn_alike(pattern, found.corners, r, project(pattern.points @ r.T + t, NUMBERS[0]))
                    seen.append((found.corners, found.stderr, truth, turned, t))
            corners, stderr, truth, rotation, position = (np.array(a) for a in zip(*seen, strict=True))
            views = Views(corners, np.zeros(len(seen), int), np.arange(len(seen)), stderr / np.median(stderr))
            known = Cameras(NUMBERS[:1], np.eye(3)[None], np.zeros((1, 3)), SIZE[None], "brown", np.zeros((9, 9)))
            solved = solve(views, pattern, SIZE[None], known=known)
            bundle, used = solved.bundle, solved.used
            off = bundle.plates.position - position[used]
            turn = Rotation.from_matrix(bundle.plates.rotation @ np.swapaxes(rotation[used], 1, 2)).as_rotvec()
            sizes = np.sqrt(np.diagonal(bundle.covariance, axis1=1, axis2=2))
            held = np.mean(np.abs(np.hstack([off, turn])) < 1.96 * sizes)
            rms = [np.sqrt(np.mean(np.square(e))) for e in (corners - truth, off, turn)]
            name = f"{pattern.name}, {f'moved by {blurred:.0f} px' if blurred else 'at rest'}"
            print(
                f"{name:<30}{rms[0]:>9.3f}{1e3 * rms[1]:>10.3f}{1e3 * rms[2]:>13.3f}{100 * held:>9.1f} %{len(used):>5}/{n}",
                flush=True,
            )


def found_table(n: int, seed: int) -> None:
    """Print in how many photographs five squares are found, and how many poses are wrong."""
    print(f"{'photographs of 640x480':<34}{'found':>10}{'wrong':>8}")
    small = (640, 480)
    numbers = np.array([640, 642, 322, 238, -0.20, 0.08, 8e-4, -6e-4, 0.0])
    kinds = {
        **{f"exposure {e:g}": Photography(exposure=e) for e in (1.0, 0.35, 0.15, 0.1, 0.05)},
        "noise 10 of 255": Photography(noise=10.0),
        "blur 2 px": Photography(blur=2.0),
        "light down to a fifth": Photography(gradient=0.8),
        "a bar of 2 to 12 px before it": Photography(),
        "clutter alone, 60 to 600 things": Photography(),
        "a chessboard instead": Photography(),
    }
    for name, photography in kinds.items():
        found = wrong = 0
        for k in range(n):
            rng = np.random.default_rng([seed, k])
            room = render_clutter(small, rng, things=int(rng.uniform(60, 600)) if "alone" in name else 60)
            r = draw_facing_rotation(rng.uniform(0, 0.7), rng.uniform(0, 6.28), rng.uniform(-3.1, 3.1))
            t = rng.uniform([-0.2, -0.15, 1.4], [0.2, 0.15, 2.5])
            shown = Pattern(6, 5, 0.08) if "chessboard" in name else FIVE
            where = t if "alone" not in name else np.array([0, 0, -1.0])
            image = render(shown, r, where, numbers, small, rng, background=room, photography=photography)
            truth = project(FIVE.points @ r.T + t, numbers)
            if "bar" in name:
                middle, angle = truth.mean(axis=0) + rng.uniform(-20, 20, 2), rng.uniform(0, np.pi)
                v, u = np.mgrid[0 : small[1], 0 : small[0]]
                across = (u - middle[0]) * np.cos(angle) + (v - middle[1]) * np.sin(angle)
                image[np.abs(across) < rng.uniform(1, 6)] = rng.choice([10, 60, 120, 240])
            corners = find_squares(image, FIVE).corners
            if corners is not None:
                found += 1
                own = turn_alike(FIVE, corners, r, truth)[0]
                wrong += bool(np.abs(corners - own).max() > 2.0) or "chessboard" in name or "alone" in name
        print(f"{name:<34}{found:>6}/{n}{wrong:>8}", flush=True)


def move(n: int, speed: float, seed: int):
    """Return L1's joints over time, and of n images: time, plate in the first camera and its velocity; rms speed [m/s]."""
    rng = np.random.default_rng(seed)
    rods, geometry, theta, _ = robot(rng, 1)
    t, path = np.arange(0, n / 5 + 2, 1 / 250), 0.0
    for _ in range(3):
        rate, phase = rng.uniform(0.6, 1.4, 3), rng.uniform(0, 2 * np.pi, 3)
        path = path + rng.uniform(0.5, 1, 3) * np.sin(2 * np.pi * rate * t[:, None] + phase)
    path = path / np.abs(path).max(axis=0) * [0.3, 0.3, 0.25]
    t = t * np.sqrt(np.mean(np.sum(np.gradient(path, t, axis=0) ** 2, axis=1))) / speed
    at = rods.home.position[0] + path
    q = inverse_kinematics(rods, Poses(at, np.repeat(rods.rotation[None], len(at), axis=0)), limits=False).q
    curve, moments = CubicSpline(t, q), np.sort(rng.uniform(t[0] + 0.2, t[-1] - 0.2, n))

    def place(when: np.ndarray) -> np.ndarray:
        return (geometry.forward(theta, curve(when)).poses.position - rods.home.position[0]) @ LOOK.T + [0, 0, DISTANCE]

    return geometry.actuated, curve, t, moments, place(moments), (place(moments + 1e-3) - place(moments - 1e-3)) / 2e-3


def moving_table(n: int, seed: int) -> None:
    """Print what two cameras measure of a moving L1, read from files: images, their times, and a log by another clock."""
    print(f"{'':<26}{'poses':>8}{'position':>10}{'95 % hold':>11}{'offset off':>12}{'stderr':>8}   [mm] rms, [ms]")
    turn = draw_facing_rotation(np.radians(25), 0.8, 0.1)
    cameras = rig()
    known = Cameras(NUMBERS, cameras.rotation, cameras.position, np.tile(SIZE, (2, 1)), "brown", np.zeros((24, 24)))
    for speed, exposure in ((0.1, 0.002), (0.3, 0.005), (0.6, 0.005), (0.6, 0.02)):
        joints, curve, t, moments, truth, velocity = move(n, speed, seed)
        rng = np.random.default_rng([seed, 1])
        offset, step = rng.uniform(50, 60), 1 / 250
        with TemporaryDirectory() as folder:
            for c, side in enumerate(("left", "right")):
                (Path(folder) / side).mkdir()
                room = render_clutter(tuple(SIZE), rng)
                for k, (at, v) in enumerate(zip(truth, velocity, strict=True)):
                    rc, tc = cameras.rotation[c] @ turn, cameras.rotation[c] @ at + cameras.position[c]
                    motion = np.concatenate([exposure * cameras.rotation[c] @ v, np.zeros(3)])
                    image = render(
                        FIVE,
                        rc,
                        tc,
                        NUMBERS[c],
                        tuple(SIZE),
                        rng,
                        background=room,
                        photography=Photography(fine=FINE),
                        motion=motion,
                    )
                    write_image(Path(folder) / side / f"{k:03d}.png", image)
            log = np.arange(t[0] + rng.uniform(0, step), t[-1] - step, step)
            table = measure_poses_from_images(
                Path(folder) / "left",
                FIVE,
                second=Path(folder) / "right",
                cameras=known,
                times=ImageTimes(moments + offset, None, "times"),
                positions=Positions(tuple(joints), curve(log), None, "log", JointLog(log, curve(log), "log")),
            )
        assert table.clock is not None
        index = [int(Path(name).stem) for name in table.names]  # "right/012.png" where the left image shows no plate
        off = table.position - truth[index]
        held = np.mean(np.abs(off) < 1.96 * table.stderr[:, :3])
        print(
            f"{speed:g} m/s, {1e3 * exposure:.0f} ms exposure{'':<4}{table.n:>5}/{n}{1e3 * np.sqrt(np.mean(off**2)):>10.3f}"
            f"{100 * held:>9.1f} %{1e3 * (table.clock.value + offset):>12.3f}{1e3 * table.clock.stderr:>8.3f}",
            flush=True,
        )


def write_image(path: Path, image: np.ndarray) -> None:
    """Write an image file."""
    import cv2

    cv2.imwrite(str(path), image)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--poses", type=int, default=50, help="robot poses to measure")
    parser.add_argument("--hand", type=int, default=12, help="images with the plate held by hand")
    parser.add_argument(
        "--photographs", action="store_true", help="render and read photographs instead of adding noise to corners"
    )
    parser.add_argument("--corners", type=int, metavar="N", help="only: corners in N photographs of each kind")
    parser.add_argument("--coverage", type=int, metavar="N", help="only: intervals over N runs")
    parser.add_argument("--squares", type=int, metavar="N", help="only: five squares and chessboard, N poses of each")
    parser.add_argument("--found", type=int, metavar="N", help="only: five squares in N photographs of each kind")
    parser.add_argument("--moving", type=int, metavar="N", help="only: a moving L1, N images by each camera")
    args = parser.parse_args()
    try:
        if args.squares:
            squares_table(args.squares, args.seed)
        elif args.found:
            found_table(args.found, args.seed)
        elif args.moving:
            moving_table(args.moving, args.seed)
        elif args.corners:
            corner_table(args.corners, args.seed)
        elif args.coverage:
            coverage(args.coverage, args.seed)
        else:
            table(args)
    except CannotAnswer as fault:
        print(f"cannot answer: {fault}")


if __name__ == "__main__":
    main()
