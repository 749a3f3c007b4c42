"""How many ways to put a six-rod plate together: the F1 study of thesis 4.5, random hexapods, Dietmaier's, and shared points.

    python experiments/assembly_modes.py [f1|random|published|shared|regions ...] [--runs 240] [--seed 1] [--out DIR]

`f1` chooses 50 poses as the thesis does (grid of 25 cm and 10 degrees, largest condition numbers 5.9), finds all
assembly modes at each, and draws Figures 4.17 and 4.18: with Table 5.5's geometry, the same with quaternions of unit
length, and exact parallelograms. `random` solves hexapods of four kinds and prints how many are certified and how long
they take; `published` Dietmaier's hexapod with 40 real modes; `shared` counts for rods that share points of the plate;
`regions` which of the F1's modes can be reached. Without names, all. Needs matplotlib for the figure. About 5 minutes
of one core. The numbers stand in docs/results/kinematics.md.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.files import read_yaml
from tau_dyn.kinematics.assembly import (
    AssemblyModes,
    find_assembly_modes,
    find_reachable_modes,
    solve_configuration_states,
)
from tau_dyn.kinematics.assembly.robot_modes import select_real_poses
from tau_dyn.mechanism import Poses, Rods, build_rods, inverse_kinematics
from tau_dyn.robot import load_robot

ROOT = Path(__file__).resolve().parents[1]
DIETMAIER = (  # Dietmaier 1998, Advances in Robot Kinematics, p. 7: base points, plate points, lengths
    [[0, 0, 0], [1.107915, 0, 0], [0.549094, 0.756063, 0], [0.735077, -0.223935, 0.525991]]
    + [[0.514188, -0.526063, -0.368418], [0.590473, 0.094733, -0.205018]],
    [[0, 0, 0], [0.542805, 0, 0], [0.956919, -0.528915, 0], [0.665885, -0.353482, 1.402538]]
    + [[0.478359, 1.158742, 0.107672], [-0.137087, -0.235121, 0.353913]],
    [1, 0.645275, 1.086284, 1.503439, 1.281933, 0.771071],
)
GRID, TURN, N_POSES = 0.25, np.radians(10), 50  # m, rad


def main() -> None:
    """Run the studies that were asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("studies", nargs="*", default=[], help="f1, random, published, shared, regions; all without")
    parser.add_argument("--runs", type=int, default=240)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "assembly_modes")
    options = parser.parse_args()
    known = {
        "f1": lambda: f1(options.out),
        "random": lambda: random_hexapods(options.runs, options.seed),
        "published": published,
        "shared": lambda: shared_points(options.seed),
        "regions": lambda: regions(options.seed),
    }
    for name in options.studies or known:
        print(f"\n== {name}", flush=True)
        known[name]()


def f1(out: Path) -> None:
    """Repeat the study of 4.5 with three geometries."""
    calibrated = f1_rods()
    results = {}
    for name, rods in (
        ("Table 5.5", calibrated),
        ("unit quaternions", unit_quaternions(calibrated)),
        ("parallelograms", parallelograms(calibrated)),
    ):
        q, tool = chosen_poses(rods)
        modes = timed(name, [(rods.base_points(x)[0], rods.on_plate, rods.leg_lengths(x)[0]) for x in q])
        results[name] = modes
        print(
            f"  nominal pose found again to {max(nearest(m, p) for m, p in zip(modes, plates(rods, tool), strict=True)):.1e} m"
        )
        tell_groups(rods, q, modes)
    figure(out, results, parallelograms(calibrated))


def f1_rods() -> Rods:
    """Return the F1 as calibrated."""
    return build_rods(load_robot(ROOT / "urdf" / "gantry_tau_f1.urdf.xacro"))


def parallelograms(rods: Rods) -> Rods:
    """Return the F1 as designed: rods of arms 2 and 3 equal, and at home parallel."""
    A = rods.base_points(rods.robot.home)[0]
    names = {}
    for first, others in ((1, (2,)), (3, (4, 5))):
        for k in others:
            on_plate = rods.on_plate[first] + rods.home.rotation[0].T @ (A[k] - A[first])
            names |= {f"{rods.names[k]}.plate_{axis}": {"value": v} for axis, v in zip("xyz", on_plate, strict=True)}
            names |= {f"{rods.names[k]}.length": {"value": rods.lengths[first]}}
    return rods.with_geometry(rods.geometry.update(names))


def unit_quaternions(rods: Rods) -> Rods:
    """Return the F1 with the joint plates' frames of unit size: Table 5.5's quaternions have other norms, and shrink them."""
    arms = read_yaml(ROOT / "urdf" / "prototypes" / "f1.yaml")
    second, third = (float(np.sum(np.square(arms[arm]["quaternion"]))) for arm in ("arm2", "arm3"))
    tilted = third * float(np.sum(np.square(arms["arm3"]["second_quaternion"])))
    shrunk = {"q6.origin": third} | {f"{rod}.base": second for rod in ("rod2a", "rod2b")}
    shrunk |= {f"{rod}.base": tilted for rod in ("rod3a", "rod3b", "rod3c")}
    names = {f"{point}_{axis}": by for point, by in shrunk.items() for axis in "xyz"}
    values = {p.name: {"value": p.value / names[p.name]} for p in rods.geometry if p.name in names}
    return rods.with_geometry(rods.geometry.update(values))


def chosen_poses(rods: Rods) -> tuple[np.ndarray, Poses]:
    """Return actuated positions and tool poses of the grid poses with the largest condition numbers (5.9)."""
    home = rods.tool_poses(rods.home)
    steps = [home.position[0] + GRID * np.array(k) for k in product(range(-4, 5), range(-4, 5), range(-1, 2))]
    turns = [Rotation.from_euler("xyz", TURN * np.array(k)).as_matrix() for k in product(range(-2, 3), repeat=3)]
    grid = Poses(
        np.repeat(steps, len(turns), axis=0), np.tile([home.rotation[0] @ turn for turn in turns], (len(steps), 1, 1))
    )
    inverse = inverse_kinematics(rods, grid)
    q, poses = inverse.q[inverse.ok], grid.take(inverse.ok)
    J = rods.closure_by_geometry(q, rods.plate_poses(poses))
    J = J / np.linalg.norm(J, axis=(0, 1))
    values, basis = np.linalg.eigh(np.einsum("nki,nkj->ij", J, J))
    J = J @ basis[:, values > 1e-12 * values[-1]]  # combinations of parameters that can be told apart
    total = np.einsum("nki,nkj->ij", J, J)
    conditions = [np.linalg.cond(total - own) for own in np.einsum("nki,nkj->nij", J, J)]
    best = np.sort(np.argsort(conditions)[::-1][:N_POSES])
    print(f"  {len(q)} grid poses can be reached, {J.shape[2]} parameters; {N_POSES} of them chosen")
    return q[best], poses.take(best)


def plates(rods: Rods, tool: Poses) -> list[Poses]:
    """Return the plate's poses one by one."""
    plate = rods.plate_poses(tool)
    return [plate.take(slice(k, k + 1)) for k in range(plate.n_samples)]


def nearest(modes: AssemblyModes, pose: Poses) -> float:
    """Return how far the nearest mode is [m, rotation matrices' entries counted as metres]."""
    apart = np.abs(modes.position - pose.position).max(axis=1) + np.abs(modes.rotation - pose.rotation).max(axis=(1, 2))
    return float(apart.min())


def tell_groups(rods: Rods, q: np.ndarray, modes: list[AssemblyModes]) -> None:
    """Print how poses with eight real modes split into groups, and the signs of their determinants."""
    signs, splits = Counter(), Counter()
    for x, m in zip(q, modes, strict=True):
        poses = select_real_poses(m)
        state = solve_configuration_states(rods, np.repeat(x[None], m.n_real, axis=0), poses).assembly
        signs[int((state > 0).sum()), int((state < 0).sum())] += 1
        if m.n_real == 8:
            splits[tuple(sorted(len(g) for g in two_groups(poses.position)))] += 1
    print(f"  real modes with determinant above, below zero: {dict(sorted(signs.items()))}")
    print(f"  poses with eight real modes, split in two groups by position: {dict(sorted(splits.items()))}")


def two_groups(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices on either side of the widest gap in one direction, that of the largest spread."""
    centred = points - points.mean(axis=0)
    along = centred @ np.linalg.svd(centred)[2][0]
    order = np.argsort(along)
    cut = int(np.argmax(np.diff(along[order]))) + 1
    return order[:cut], order[cut:]


def random_hexapods(runs: int, seed: int) -> None:
    """Solve hexapods of four kinds, all with one real pose by construction."""
    for kind in ("points in a ball", "plate a tenth of the base", "flat base and plate", "three clusters"):
        rng = np.random.default_rng([seed, len(kind)])
        timed(kind, [drawn(kind, rng) for _ in range(runs // 4)])


def drawn(kind: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw points, and lengths that fit a random pose."""
    A, B = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
    if kind == "plate a tenth of the base":
        B *= 0.1
    elif kind == "flat base and plate":
        A[:, 2] = B[:, 2] = 0
    elif kind == "three clusters":  # as a Gantry-Tau: 1, 2 and 3 rods
        cluster = [0, 1, 1, 2, 2, 2]
        A, B = 2 * rng.normal(size=(3, 3))[cluster] + 0.1 * A, 0.15 * B
    rotation, position = Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3)
    return A, B, np.linalg.norm(position + B @ rotation.T - A, axis=1)


def timed(name: str, hexapods: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> list[AssemblyModes]:
    """Solve all and print one line of counts, residuals and times."""
    modes, seconds = [], []
    for hexapod in hexapods:
        begin = time.process_time()
        modes.append(find_assembly_modes(*hexapod))
        seconds.append(time.process_time() - begin)
    relative = max((m.residual / (1 + np.abs(m.position).max(axis=1))).max(initial=0) for m in modes)
    print(f"{name}: {len(modes)} hexapods, {sum(m.certified for m in modes)} certified")
    print(f"  modes found: {dict(sorted(Counter(len(m.real) for m in modes).items()))}")
    print(f"  real ones: {dict(sorted(Counter(m.n_real for m in modes).items()))}")
    print(
        f"  largest residual {max(m.residual.max(initial=0) for m in modes):.1e} m, {relative:.1e} relative to the pose"
    )
    print(f"  CPU time: median {np.median(seconds):.2f} s, most {max(seconds):.2f} s", flush=True)
    for why in sorted({m.why for m in modes if not m.certified}):
        print(f"  not certified: {why}")
    return modes


def published() -> None:
    """Solve Dietmaier's hexapod, and its mirror images under exchange of base and plate."""
    base, plate, lengths = (np.array(x, float) for x in DIETMAIER)
    timed("Dietmaier 1998", [(base, plate, lengths)])
    timed("the same, base and plate exchanged", [(plate, base, lengths)])


def shared_points(seed: int) -> None:
    """Count modes where rods share points of the plate."""
    rng = np.random.default_rng(seed)
    for pattern in ((0, 0, 1, 2, 3, 4), (0, 0, 1, 1, 2, 3), (0, 0, 1, 1, 2, 2), (0, 0, 0, 1, 2, 3), (0, 0, 0, 1, 1, 2)):
        hexapods = []
        for _ in range(5):
            A, B, _ = drawn("points in a ball", rng)
            rotation, position = Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3)
            B = B[list(pattern)]
            hexapods.append((A, B, np.linalg.norm(position + B @ rotation.T - A, axis=1)))
        timed("-".join(str(n) for n in sorted(Counter(pattern).values(), reverse=True)), hexapods)


def regions(seed: int) -> None:
    """Say which of the F1's modes at home can be reached without a singularity, with its limits and without."""
    rods = f1_rods()
    q = rods.robot.home
    poses = select_real_poses(find_assembly_modes(rods.base_points(q)[0], rods.on_plate, rods.leg_lengths(q)[0]))
    home = int(np.argmin(np.linalg.norm(poses.position - rods.home.position, axis=1)))
    for limits in (True, False):
        print(f"limits {'kept' if limits else 'left out'}")
        for k, reach in enumerate(find_reachable_modes(rods, q, poses, home, limits=limits, n_samples=40, seed=seed)):
            print(
                f"  {np.round(poses.position[k], 3)} m: {reach.verdict} ({len(reach.q)} samples); {reach.why}",
                flush=True,
            )


def figure(out: Path, results: dict[str, list[AssemblyModes]], rods: Rods) -> None:
    """Draw Figure 4.17 (all geometries) and 4.18 (one pose with eight modes of the parallelograms)."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figures, axes = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
    for k, (name, modes) in enumerate(results.items()):
        for axis, counts, bins in (
            (axes[0], [2 * len(m.real) for m in modes], range(50, 83, 2)),
            (axes[1], [2 * m.n_real for m in modes], range(0, 22, 4)),
        ):
            number = Counter(counts)
            axis.bar(np.array(bins) + (k - 1) * 0.9, [number[b] for b in bins], width=0.9, label=name)
    axes[0].set(xlabel="solutions, both signs of the quaternion", ylabel="poses of 50")
    axes[1].set(xlabel="real solutions, both signs")
    axes[0].legend(fontsize=8)
    mode = next((m for m in results["parallelograms"] if m.n_real == 8), results["parallelograms"][0])
    poses = select_real_poses(mode)
    for k in range(poses.n_samples):
        corners = poses.position[k] + rods.on_plate[[0, 1, 3, 5, 4, 2, 0]] @ poses.rotation[k].T
        axes[2].plot(corners[:, 1], corners[:, 2], lw=1)
    axes[2].set(xlabel="y [m]", ylabel="z [m]", title="plates of eight modes", aspect="equal")
    out.mkdir(parents=True, exist_ok=True)
    figures.savefig(out / "assembly_modes.svg")
    print(f"  {out / 'assembly_modes.svg'}")


if __name__ == "__main__":
    main()
