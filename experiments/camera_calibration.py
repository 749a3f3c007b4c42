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
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate import PoseSet
from tau_dyn.calibrate.model_selection import Options, fit_spec
from tau_dyn.calibrate.models import RodFamily, Spec
from tau_dyn.calibrate.rod_geometry import RodGeometry
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.mechanism import Poses, build_rods, inverse_kinematics
from tau_dyn.robot import load_robot
from tau_dyn.vision import Pattern, solve
from tau_dyn.vision.bundle import Views
from tau_dyn.vision.cameras import project
from tau_dyn.vision.detect import _in_order, find_corners
from tau_dyn.vision.pattern import Photography, draw_facing_rotation, render, render_clutter

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
    args = parser.parse_args()
    try:
        if args.corners:
            corner_table(args.corners, args.seed)
        elif args.coverage:
            coverage(args.coverage, args.seed)
        else:
            table(args)
    except CannotAnswer as fault:
        print(f"cannot answer: {fault}")


if __name__ == "__main__":
    main()
