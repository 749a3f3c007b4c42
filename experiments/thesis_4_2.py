"""Do the checks of section 4.2 of Dressler 2012 find what is wrong with guideways and orientation, and nothing else?

    python experiments/thesis_4_2.py [OUT_DIR] [--seed 42] [--runs 200]

In: nothing. The thesis prints no raw measurements, so they are simulated: carts measured every 50 mm by a tracker of 10 um, with
errors chosen to give Table 4.1's sizes, a rack of 31.4 mm teeth, and 40 um of backlash seen by a length gauge; the plate's
orientation from the D1's calibrated six-rod dimensions (Table 5.9), nothing added but the tracker's noise. Out, in OUT_DIR
(default out/thesis_4_2): the kind of Figures 4.3, 4.4, 4.5 and 4.7 as PNG and SVG, the simulated measurements as CSV for
`tau-dyn accuracy gantry_tau --set prototype=d1 --measured ...`, `summary.csv` with found beside put in and the thesis', and
`trials.csv`: how often each check fires on RUNS draws with and without its error. Needs matplotlib. About 1 minute on one
core.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from tau_dyn.kinematics.assumptions import check_orientation, check_parallelism, fit_guideway, load_shift
from tau_dyn.mechanism import Poses, build_rods, convert_to_quaternions, forward_kinematics, inverse_kinematics
from tau_dyn.robot import load_robot

TRACKER = 10e-6  # m, a coordinate
TOOTH = 0.0314  # m, assumed pitch of rack and pinion
TABLE_4_1 = {"D1": (32, 77, 54), "L1": (163, 76, 116)}  # um, mean |e|
CHOSEN = {  # along (teeth), across (bow) in um, so that mean |e| is about Table 4.1's
    "D1": ((17, 80), (91, 110), (30, 145)),
    "L1": ((60, 520), (30, 230), (45, 345)),
}
BACKLASH = 40e-6
DIRECTIONS = ((0.99779, -0.06634, -0.00530), (0.99752, -0.06598, -0.00544), (0.99769, -0.06603, -0.00509))  # Table 5.8


def main(out_dir: Path, seed: int, runs: int) -> None:
    rng = np.random.default_rng(seed)
    out_dir.mkdir(parents=True, exist_ok=True)
    rows, lines = [], {}
    for robot in CHOSEN:
        lines[robot] = [carts(rng, robot, k) for k in range(3)]
        rows += [guideway_row(robot, k, line) for k, line in enumerate(lines[robot])]
        for p in check_parallelism(lines[robot]):
            name, put = (
                f"{robot}: angle {p.joints[0]}, {p.joints[1]} [mrad]",
                angle(*(int(j[-1]) - 1 for j in p.joints)),
            )
            rows.append({"what": name, "found": 1e3 * p.angle, "stderr": 1e3 * p.stderr, "put in": 1e3 * put})
    shift = load_shift(lines["L1"][0], *moved(rng, lines["L1"][0]))
    rows.append(
        {"what": "L1: another load moves cart 1 by [um]", "found": 1e6 * shift["size"], "put in": 60, "thesis": 100}
    )
    one_way, both_ways = gauge(rng, False), gauge(rng, True)
    rows.append({"what": "L2: backlash [um]", "found": 1e6 * both_ways.backlash.size, "stderr": 1e6 * both_ways.backlash.stderr,
                 "put in": 1e6 * BACKLASH, "thesis": 40})  # fmt: skip
    rows.append(
        {"what": "L2: cycle, gauge every 2 mm [mm]", "found": 1e3 * one_way.cycle.period, "put in": 1e3 * TOOTH}
    )
    table, rods_only, tilted = orientation(rng, out_dir)
    rows += table
    summary = pd.DataFrame(rows)
    summary.to_csv(out_dir / "summary.csv", index=False, float_format="%.5g")
    tried = trials(seed, runs)
    tried.to_csv(out_dir / "trials.csv", index=False, float_format="%.4g")
    draw(out_dir, lines, shift, one_way, both_ways, rods_only)
    for line in lines["D1"]:
        write(out_dir / f"{line.joint}.csv", {f"q_{line.joint}": line.q}, line.points)
    print(summary.to_string(index=False, float_format="{:.4g}".format, na_rep=""))
    print("\n".join([line.sentence for line in lines["D1"]] + [rods_only.sentence, tilted.sentence]))
    print(tried.to_string(index=False, float_format="{:.3g}".format))


def carts(rng: np.random.Generator, robot: str, k: int):
    """Return the line through one cart's simulated tracker points, every 50 mm, one direction of travel."""
    q = np.arange(-0.9, 0.91, 0.05)
    along, across = (1e-6 * x for x in CHOSEN[robot][k])
    d = np.array(DIRECTIONS[k]) / np.linalg.norm(DIRECTIONS[k])
    teeth = along * np.sin(2 * np.pi * q / TOOTH + rng.uniform(0, 6))
    bow = across * ((q / 0.9) ** 2 + 0.25 * np.sin(2 * np.pi * q / rng.uniform(0.7, 1.4)))
    side = np.cross(d, (0.0, 0.0, 1.0))
    points = (
        np.outer(q + teeth, d) + np.outer(bow, side / np.linalg.norm(side)) + TRACKER * rng.standard_normal((len(q), 3))
    )
    return fit_guideway(f"cart{k + 1}", q, points)


def guideway_row(robot: str, k: int, line) -> dict:
    sizes = 1e6 * line.sizes
    return {"what": f"{robot}: cart{k + 1} mean |e| [um], its std", "found": sizes.mean(), "stderr": sizes.std(ddof=1),
            "thesis": TABLE_4_1[robot][k]}  # fmt: skip


def angle(i: int, j: int) -> float:
    a, b = (np.array(DIRECTIONS[k]) / np.linalg.norm(DIRECTIONS[k]) for k in (i, j))
    return float(np.linalg.norm(np.cross(a, b)))


def moved(rng: np.random.Generator, line) -> tuple[np.ndarray, np.ndarray]:
    """Return the same cart measured with the end-effector elsewhere: 60 um lower, noise new."""
    q = line.q[::2]
    noise = TRACKER * rng.standard_normal((len(q), 3))
    return q, line.points[::2] + np.array([0.0, 0.0, -60e-6]) + noise


def gauge(rng: np.random.Generator, both: bool):
    """Return the L2's cart against a length gauge every 2 mm (1 um), teeth and a resolver cycle, with or without reversal."""
    there = np.arange(0.0, 0.5, 0.002)
    q = np.concatenate([there, there[::-1]]) if both else there
    way = np.sign(np.diff(q, prepend=q[0] - 1))
    e = 15e-6 * np.sin(2 * np.pi * q / TOOTH) + 6e-6 * np.sin(2 * np.pi * q / 0.0157) - BACKLASH / 2 * way * both
    points = np.outer(q + e, (1.0, 0.0, 0.0)) + 1e-6 * rng.standard_normal((len(q), 3))
    return fit_guideway("cart1", q, points)


def orientation(rng: np.random.Generator, out_dir: Path):
    """Return rows, and the checks of a grid of poses of the calibrated D1: as it is, and with carts that turn."""
    robot = load_robot("gantry_tau", prototype="d1", arms="complete")
    rods = build_rods(robot)
    q, poses = grid(rods)
    noise = Rotation.from_rotvec(np.radians(0.003) * rng.standard_normal((len(q), 3))).as_matrix()
    seen = Poses(poses.position + TRACKER * rng.standard_normal(poses.position.shape), noise @ poses.rotation)
    found = check_orientation(q, seen)
    tilt = Rotation.from_rotvec(np.outer(np.sin(3 * poses.position[:, 0]), (0.0, 2e-3, 1e-3))).as_matrix()
    turned = check_orientation(q, Poses(seen.position, tilt @ seen.rotation))
    write(
        out_dir / "orientation.csv",
        {f"q_{j}": q[:, k] for k, j in enumerate(robot.actuated)},
        seen.position,
        convert_to_quaternions(seen),
    )
    ranges = np.degrees(np.ptp(found.euler, axis=0))
    rows = [{"what": f"D1: range of Euler angle {name} [deg]", "found": r, "thesis": t}
            for name, r, t in zip(("alpha", "beta", "gamma"), ranges, (0.1, 0.5, np.nan), strict=True)]  # fmt: skip
    rows += [{"what": "D1: poses", "found": len(q), "thesis": 176},
             {"what": "D1: share of orientation error by place across (rods)", "found": found.across.share},
             {"what": "D1: share along the guideways (carts)", "found": found.along.share},
             {"what": "carts made to turn 2 mrad: share along", "found": turned.along.share}]  # fmt: skip
    return rows, found, turned


def grid(rods) -> tuple[np.ndarray, Poses]:
    """Return six layers of places across the guideways, every second one walked backwards (Figure 4.6)."""
    home = forward_kinematics(rods, rods.robot.home[None]).poses
    y, z = np.meshgrid(np.linspace(-0.5, 0.5, 6), np.linspace(-0.45, 0.45, 5), indexing="ij")
    across = np.column_stack([y.ravel(), z.ravel()])
    lean = np.array([1.0, -0.066, -0.0053])
    layers = [
        home.position[0] + 0.15 * (k - 2.5) * lean + np.column_stack([0 * across[:, 0], across]) for k in range(6)
    ]
    at = np.concatenate([layer if k % 2 == 0 else layer[::-1] for k, layer in enumerate(layers)])
    solved = inverse_kinematics(rods, Poses(at, np.broadcast_to(home.rotation, (len(at), 3, 3))), limits=False)
    q = solved.q[solved.ok]
    found = forward_kinematics(rods, q)
    return q[found.ok], found.poses.take(found.ok)


def trials(seed: int, runs: int) -> pd.DataFrame:
    """Return how often each check fires (p < 0.01) with nothing wrong and with 20 um (0.05 mrad) of what it looks for."""
    fired: dict[str, list[float]] = {}
    for run in range(runs):
        rng = np.random.default_rng([seed, run])
        for wrong in (False, True):
            q = np.concatenate([np.arange(0, 1.8, 0.05), np.arange(1.8, 0, -0.05)])
            size = 20e-6 * wrong
            way = np.sign(np.diff(q, prepend=-1))
            one = straight(
                rng, q, size * (q - 0.9) ** 2 / 0.81, size / 2 * np.sin(2 * np.pi * q / 0.23) - size / 2 * way, 0.0
            )
            other = straight(rng, q, 0 * q, 0 * q, 5e-5 * wrong)
            for name, seen in (("bow 20 um", one.bow.sure), ("cycle +-10 um", one.cycle.p_value < 0.01),
                               ("backlash 20 um", one.backlash.sure), ("angle 0.05 mrad", check_parallelism([one,
                               other])[0].sure)):  # fmt: skip
                fired.setdefault(f"{name}|{wrong}", []).append(seen)
    names = dict.fromkeys(key.split("|")[0] for key in fired)
    return pd.DataFrame([{"check": n, "fires without": np.mean(fired[f"{n}|False"]), "fires with": np.mean(fired[f"{n}|True"])}
                         for n in names])  # fmt: skip


def straight(rng: np.random.Generator, q: np.ndarray, across: np.ndarray, along: np.ndarray, tilt: float):
    points = np.column_stack([q + along, across + tilt * q, 0 * q]) + TRACKER * rng.standard_normal((len(q), 3))
    return fit_guideway("cart1" if not tilt else "cart2", q, points)


def write(path: Path, q: dict, points: np.ndarray, turned: np.ndarray | None = None) -> None:
    columns = q | {f"{a}_tool": points[:, k] for k, a in enumerate("xyz")}
    if turned is not None:
        columns |= {f"q{a}_tool": turned[:, k] for k, a in enumerate("xyzw")}
    pd.DataFrame(columns).to_csv(path, index=False, float_format="%.9f")


def draw(out_dir: Path, lines: dict, shift: dict, one_way, both_ways, turned) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(2, 1, figsize=(8, 5), constrained_layout=True)
    for ax, line, name in zip(axes, (one_way, both_ways), ("one direction", "both directions"), strict=True):
        ax.plot(line.q, 1e6 * line.along, "k.", ms=2)
        ax.set(ylabel="error [um]", title=f"Figure 4.3's kind: length gauge, {name}")
    axes[1].set_xlabel("q [m]")
    _save(fig, out_dir / "figure_4_3")
    fig, axes = plt.subplots(2, 1, figsize=(8, 5), constrained_layout=True)
    for line, style in zip(lines["D1"], ("-", "--", "-."), strict=True):
        axes[0].plot(line.q, 1e6 * line.along, f"k{style}", label=line.joint)
        axes[1].plot(line.q, 1e6 * np.linalg.norm(line.across, axis=1), f"k{style}")
    axes[0].set(ylabel="along [um]", title="Figure 4.4's kind: D1, residuals along and across the actuator axis")
    axes[1].set(ylabel="across [um]", xlabel="q [m]")
    axes[0].legend()
    _save(fig, out_dir / "figure_4_4")
    fig, ax = plt.subplots(figsize=(8, 3.6), constrained_layout=True)
    line = lines["L1"][0]
    for k, name in enumerate("xyz"):
        ax.plot(line.q, 1e6 * line.residuals[:, k], label=name)
    ax.plot(line.q, 1e6 * line.sizes, label="norm")
    ax.axhline(1e6 * shift["shift"][2], color="C2", ls=":", label="z, other load (mean)")
    ax.set(ylabel="residual [um]", xlabel="q [m]", title="Figure 4.5's kind: L1, cart 1")
    ax.legend()
    _save(fig, out_dir / "figure_4_5")
    fig, axes = plt.subplots(3, 1, figsize=(8, 6), constrained_layout=True, sharex=True)
    for k, name in enumerate(("alpha", "beta", "gamma")):
        axes[k].plot(np.degrees(turned.euler[:, k] - turned.euler[:, k].mean()), "k.-", ms=3, lw=0.7)
        axes[k].set_ylabel(f"{name} [deg]")
    axes[0].set_title("Figure 4.7's kind: D1 with its calibrated six rods, ZYZ Euler angles less their means")
    axes[2].set_xlabel("pose")
    _save(fig, out_dir / "figure_4_7")


def _save(fig, path: Path) -> None:
    for suffix in (".png", ".svg"):
        fig.savefig(path.with_suffix(suffix), dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out_dir", type=Path, nargs="?", default=Path("out/thesis_4_2"))
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--runs", type=int, default=200)
    given = parser.parse_args()
    main(given.out_dir, given.seed, given.runs)
