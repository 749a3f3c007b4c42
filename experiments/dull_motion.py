"""A dull motion gives a rod a negative mass (Dressler 2012, section 6.2). What does identification make of it?

    python experiments/dull_motion.py [--seeds 20] [--out DIR]

In: nothing; logs of L1 are computed along a tool path, with 5 N of force noise and 5 um encoders. Motion A swings mostly along
the guideways, 40 s fast and 40 s six times slower, and the truth has what no model here has: a friction moment of 1 N m in each
ball joint (two a rod, one, two and three rods in the arms). Motion B is duller still, and its truth has nothing hidden. Out:
`dull_motion.csv`, one row a motion, seed and rod, and a printed answer: how often plain least squares gives a negative
mass, what the consistent estimate gives, which parameters the warning names, and what the constraint costs on a held-out
motion that is not dull. About half a minute.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from tau_dyn.cli.demo import build_true_model
from tau_dyn.identify import build_force_errors, build_regression, identify
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

RATE_HZ = 250.0
CENTRE = (1.5, -0.65, 0.62)  # of the tool's path [m]
RODS_IN_ARM = (1, 2, 3)
SLOWER = 6.0
HELD_OUT = (
    ((0.16, 0.31, 0.0), (0.05, 0.79, 1.0)),
    ((0.13, 0.27, 0.5), (0.04, 0.83, 1.7)),
    ((0.13, 0.37, 1.1), (0.04, 0.91, 0.2)),
)
ALONG_X = ((0.28, 0.3, 0.0), (0.035, 0.9, 1.0))  # (amplitude [m], frequency [Hz], phase [rad])
MOTIONS = {
    "A": (ALONG_X, ((0.08, 0.45, 0.5),), ((0.08, 0.5715, 1.1),)),
    "B": (ALONG_X, ((0.05, 0.11, 0.5),), ((0.05, 0.1397, 1.1),)),
}
HIDDEN_MOMENT = {"A": 1.0, "B": 0.0}  # [N m] in each ball joint


def path(terms: tuple, duration: float, slower: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tool's position, velocity and acceleration (N, 3) along sums of sines."""
    t = np.arange(0, duration, 1 / RATE_HZ)
    T, V, A = np.tile(CENTRE, (len(t), 1)), np.zeros((len(t), 3)), np.zeros((len(t), 3))
    for k, sines in enumerate(terms):
        for amplitude, f, phase in sines:
            w = 2 * np.pi * f / slower
            T[:, k] += amplitude * np.sin(w * t + phase)
            V[:, k] += amplitude * w * np.cos(w * t + phase)
            A[:, k] -= amplitude * w**2 * np.sin(w * t + phase)
    return T, V, A


def cart_motion(model: Model, T: np.ndarray, V: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the carts' motion (N, 3) under a tool path, guideways along x; `d` (N, 3 arms, 3) points along the rods."""
    geometry = model.mechanism
    across = T[:, None, :] - geometry.origin
    along = np.sqrt(geometry.length**2 - across[..., 1] ** 2 - across[..., 2] ** 2)
    q = across[..., 0] - along
    d = np.stack([along, across[..., 1], across[..., 2]], axis=2)
    v = np.einsum("nij,nj->ni", d, V) / along
    relative = V[:, None, :] - v[..., None] * [1.0, 0, 0]
    a = (np.einsum("nij,nj->ni", d, A) + np.sum(relative**2, axis=2)) / along
    return q, v, a, d


def passive_friction(V: np.ndarray, v: np.ndarray, d: np.ndarray, moment: float) -> np.ndarray:
    """Return cart forces (N, 3) that overcome a moment in each ball joint, two a rod, by virtual work.

    A rod that turns at |w| = |V - v e| / L loses the power `2 moment |w|`, which is a force `2 moment / L` along its
    ends' relative velocity; with `J` the tool's velocity per cart velocity it reaches the carts as `J' f - f.e`.
    """
    relative = V[:, None, :] - v[..., None] * [1.0, 0, 0]
    speed = np.linalg.norm(relative, axis=2, keepdims=True)
    length = np.linalg.norm(d, axis=2, keepdims=True)
    f = 2 * moment * np.array(RODS_IN_ARM)[:, None] * relative / np.maximum(speed, 1e-12) / length
    J = np.linalg.inv(d) * d[:, None, :, 0]
    return np.einsum("nji,nj->ni", J, f.sum(axis=1)) - f[..., 0]


def log_of(truth: Model, motion: list[tuple], moment: float, rng: np.random.Generator, name: str) -> list[Log]:
    """Return a log for each piece of a motion."""
    logs = []
    for T, V, A in motion:
        q, v, a, d = cart_motion(truth, T, V, A)
        tau = truth.torque(q, v, a) + passive_friction(V, v, d, moment) + 5.0 * rng.normal(size=q.shape)
        q = q + 5e-6 * rng.normal(size=q.shape)
        channels = {
            f"{key}_{j}": x[:, k] for key, x in (("q", q), ("tau", tau)) for k, j in enumerate(truth.robot.actuated)
        }
        logs.append(Log(np.arange(len(q)) / RATE_HZ, channels, name))
    return logs


def trial(name: str, seed: int) -> list[dict]:
    """Return a row a rod."""
    robot = load_robot("gantry_tau", prototype="l1")
    truth, rng = build_true_model(robot, 0), np.random.default_rng([6, seed])
    dull = [path(MOTIONS[name], 40.0), path(MOTIONS[name], 40.0, SLOWER)]
    moment = HIDDEN_MOMENT[name]
    train = log_of(truth, dull, moment, rng, f"dull {name}")
    held = log_of(truth, [path(HELD_OUT, 30.0)], moment, rng, "held out")
    found = identify(robot, train, holdout=held)
    e = found.estimate
    plain = e.theta.copy()
    names = e.parameters.names
    for column, value in zip(e.base.kept, e.beta_plain, strict=True):
        plain[names.index(e.base.names[column])] = value
    regression = build_regression(found.model, held, preparation=e.regression.preparation)
    errors = {
        "rms_consistent": build_force_errors(regression, e.theta).rms,
        "rms_plain": build_force_errors(regression, plain).rms,
    }
    rows = []
    for rod in (f"rod{k}_link.mass" for k in (1, 2, 3)):
        p = e.parameters[rod]
        rows.append({"motion": name, "seed": seed, "rod": rod, "truth": truth.parameters[rod].value, "stderr": p.stderr,
                     "plain": plain[names.index(rod)], "consistent": p.value, "cond": e.cond,
                     "at_bound": p.at_bound, "named": any(text.startswith(rod) for text in found.warnings),
                     **{key: float(np.sqrt(np.mean(x**2))) for key, x in errors.items()}})  # fmt: skip
    return rows


def main(seeds: int, out_dir: Path) -> None:
    table = pd.DataFrame([row for name in MOTIONS for seed in range(seeds) for row in trial(name, seed)])
    out_dir.mkdir(parents=True, exist_ok=True)
    table.to_csv(out_dir / "dull_motion.csv", index=False)
    for name, part in table.groupby("motion"):
        negative = part["plain"] < 0
        runs = part.assign(negative=negative).groupby("seed")
        print(f"\nmotion {name}, hidden moment {HIDDEN_MOMENT[name]:g} N m, condition number {part['cond'].mean():.0f}: "
              f"a negative rod mass in {100 * runs['negative'].any().mean():.0f} % of {seeds} seeds by plain least squares, "
              f"in {100 * (part['consistent'] < 0).mean():.0f} % by the consistent estimate; "
              f"{100 * part['named'][negative].mean():.0f} % of the negative ones named by a warning; held-out rms "
              f"{part['rms_plain'].mean():.2f} N plain, {part['rms_consistent'].mean():.2f} N consistent")  # fmt: skip
        print(
            part.groupby("rod")[["truth", "plain", "stderr", "consistent"]]
            .mean()
            .to_string(float_format="{:.2f}".format)
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    args = parser.parse_args()
    main(args.seeds, args.out)
