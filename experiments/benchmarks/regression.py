"""What a sample costs in the regression step: columns, friction, triangular factor; a bare Pinocchio loop beside it.

    python experiments/benchmarks/regression.py [--samples 1000000] [--out DIR]

The step takes positions, speeds and accelerations in memory to each output's triangular factor of all columns and forces.
`bare Pinocchio loop` is what a user writes without us: per sample close loops, `computeJointTorqueRegressor`, project, map. It
sees the first samples only. `NumPy's limit` is one multiplication and one addition a column and sample, blocked alike. Tapes
(`equations/tape.py`) are in use from the first sample; `TAU_DYN_COMPILE=0` in the environment shows the step without a compiler.
"""

import argparse
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from bench import show, stop_watch

from tau_dyn.effects import Motion, SymmetricFriction, TorqueOffset
from tau_dyn.equations import tape
from tau_dyn.estimate import SufficientStatistics
from tau_dyn.identify.regression import compute_columns
from tau_dyn.mechanism import TreeMechanism, build_mechanism
from tau_dyn.mechanism.tree import SamplewiseTree
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

BLOCK = 2048
tape.TRACE_FROM = tape.BUILD_FROM = 0
FEW = 1000
DATA = Path(os.environ.get("TAU_DYN_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def gantry(arms: str) -> Model:
    robot = load_robot("gantry_tau", prototype="l1", arms=arms)
    return Model.of(robot, [SymmetricFriction(robot.actuated, robot.force_units)])


def six_axes() -> Model:
    robot = load_robot(DATA / "tx40" / "tx40.urdf")
    effects = [SymmetricFriction(robot.actuated, robot.force_units), TorqueOffset(robot.actuated, robot.force_units)]
    return Model.of(robot, effects)


def motion_of(model: Model, samples: int) -> tuple[np.ndarray, ...]:
    """Return a smooth path around home and random speeds, accelerations and forces, each (N, na)."""
    rng, na = np.random.default_rng(0), model.robot.na
    q = model.robot.home + 0.15 * np.sin(1e-3 * np.arange(samples)[:, None] * rng.uniform(0.5, 4, na))
    return q, *rng.standard_normal((3, samples, na))


def step(model: Model, data: tuple[np.ndarray, ...]) -> SufficientStatistics:
    """Return the totals of one block."""
    q, v, a, tau = data
    return SufficientStatistics.of(compute_columns(model, Motion.of(model.robot.actuated, q, v, a)), tau)


def whole(models: list[Model], data: tuple[np.ndarray, ...]) -> SufficientStatistics:
    """Return the totals of all samples, block by block, one thread a model."""
    parts, threads, model = (
        [tuple(x[s : s + BLOCK] for x in data) for s in range(0, len(data[0]), BLOCK)],
        len(models),
        models[0],
    )

    def some(k: int) -> list[SufficientStatistics]:
        return [step(models[k], part) for part in parts[k::threads]]

    with ThreadPoolExecutor(threads) as pool:
        found = list(pool.map(some, range(threads)))
    return sum(
        (t for totals in found for t in totals), SufficientStatistics.zero(model.robot.na, len(model.parameters))
    )


def limit(model: Model, samples: int) -> None:
    """Multiply and add once a column and sample."""
    rows = model.robot.na * len(model.parameters)
    x, y, out = np.ones((rows, 1024)), np.ones(1024), np.zeros((rows, 1024))
    for _ in range(0, samples, 1024):
        np.multiply(x, y, out=out)
        out += x


def rows_of(name: str, model: Model, samples: int) -> list[list]:
    data = motion_of(model, samples)
    found, columns = [], len(model.parameters)
    bare = SamplewiseTree(model.robot)
    few = [x[:FEW] for x in data[:3]]
    bare.regressor(*(x[:10] for x in few))
    with stop_watch() as watch:
        bare.regressor(*few)
    slow = watch.cpu / FEW
    found.append([name, columns, "bare Pinocchio loop", FEW, 1e6 * watch.wall / FEW, 1e6 * slow, FEW / watch.wall, 1.0])
    kinds = {"any URDF": TreeMechanism} if "loops" in name else {"as built": build_mechanism}
    if "closed" in name:
        kinds["any URDF"] = TreeMechanism
    for label, build in kinds.items():
        models = [Model(model.robot, model.effects, model.effect_parameters, {}) for _ in range(2)]
        for each in models:
            each.__dict__["mechanism"] = build(each.robot)
            whole([each], tuple(x[:BLOCK] for x in data))
        n = samples if label == "as built" or "loops" in name else samples // 20
        for threads in (1, 2):
            with stop_watch() as watch:
                whole(models[:threads], tuple(x[:n] for x in data))
            row = [1e6 * watch.wall / n, 1e6 * watch.cpu / n, n / watch.wall]
            found.append([name, columns, f"{label}, {threads} threads", n, *row, slow / (watch.cpu / n)])
    with stop_watch() as watch:
        limit(model, samples)
    each = [1e6 * watch.wall / samples, 1e6 * watch.cpu / samples, samples / watch.wall]
    found.append([name, columns, "NumPy's limit", samples, *each, slow / (watch.cpu / samples)])
    return found


def main(samples: int, out_dir: Path) -> None:
    rows = rows_of("Gantry-Tau simplified, closed form", gantry("simplified"), samples)
    rows += rows_of("Gantry-Tau complete, loops", gantry("complete"), samples // 20)
    if (DATA / "tx40").exists():
        rows += rows_of("6R (TX40)", six_axes(), samples // 10)
    header = ["robot", "columns", "path", "samples", "wall us/sample", "cpu us/sample", "samples/s", "faster (cpu)"]
    show("The regression step", header, rows, out_dir / "benchmark_regression.md")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    args = parser.parse_args()
    main(args.samples, args.out)
