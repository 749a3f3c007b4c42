"""How close to the Cramer-Rao bound are the estimators, and which are biased by noisy encoders and feedback?

    python experiments/estimators.py [--runs 24] [--seed 0] [--scenario NAME ...] [--estimators E ...] [--jobs N] [--out DIR]

In: nothing; logs of L1 are simulated, 5 N of white force noise, 19 parameters. Out: one CSV a run in DIR/runs, which a later
call does not compute again, and `estimators.csv`: for each scenario and estimator the bias (mean error in standard errors, rms
over parameters and worst; `chance` is what no bias would show), the RMSE over the bound (pooled and worst), and the coverage of
the 95 % intervals. Where the controller knows true positions, one drive of a plant is measured with every seed; with encoders in
its feedback each run is a drive of its own, 30 s of CPU. Set OMP_NUM_THREADS=1, as many small products are slower on threads.

The bound: `(Y' Sigma^-1 Y)^-1` along the true motion, `Sigma = sigma_f^2 I + D sigma_q^2 D'`, all samples in which a joint
neither stands still nor reverses. It holds for any motion: true positions are unknowns, of which encoders and forces both
speak.

The estimators: `plain`, least squares with the widest filters that the log's rate allows (forces and columns at 0.16 of it,
positions at 0.4), as one uses them who does not look at the noise; `wls`, `ml`, `iv`, `robust` as `identify --estimator` has
them.
"""

import argparse
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
from recovery import true_plant

from tau_dyn.estimate import PositionNoise, solve_least_squares
from tau_dyn.identify import Preparation, build_model, build_regression
from tau_dyn.identify.full_rate import estimate_full_rate
from tau_dyn.log import Log, compute_noise_gain
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot
from tau_dyn.simulate import Sensors, build_named_motion, simulate_drive
from tau_dyn.simulate.simulation import Feedback

ESTIMATORS = ("plain", "wls", "ml", "iv", "robust")
FORCE_NOISE = 5.0  # N
CONTROL_HZ = 1000.0
_KEYS = ("t", "q", "v", "a", "tau", "stuck", "q_ref", "q_read")


@dataclass(frozen=True)
class Scenario:
    """What is simulated and how it is measured."""

    name: str
    encoder_noise: float = 5e-6  # m
    feedback: Feedback = "ideal"
    motion: str = "fourier"
    duration: float = 100.0
    every: int = 2  # control periods between two log samples
    outliers: float = 0.0  # share of force samples that are off by 100 N


SCENARIOS = (
    Scenario("5um"),
    Scenario("1um", 1e-6),
    Scenario("20um", 20e-6),
    Scenario("5um-prbs", motion="prbs"),
    Scenario("20um-prbs", 20e-6, motion="prbs"),
    Scenario("5um-outliers", outliers=0.01),
    Scenario("20um-feedback", 20e-6, "encoder", duration=60.0, every=1),
)


@lru_cache(maxsize=2)
def recording(scenario: Scenario, seed: int, plants: int, folder: Path) -> dict[str, np.ndarray]:
    """Return what happened on a plant, kept on disk."""
    number = seed % plants
    own = seed if scenario.feedback == "encoder" else 0
    noise = scenario.encoder_noise if scenario.feedback == "encoder" else 0.0
    path = folder / f"{scenario.motion}-{scenario.duration:g}s-plant{number}-{scenario.feedback}-{noise:g}-{own}.npz"
    if not path.is_file():
        truth = true_plant("l1", number)
        motion = build_named_motion(scenario.motion, truth, scenario.duration, 100 + number)
        rng = np.random.default_rng([own, number])
        sensors = Sensors(encoder_noise=noise)
        run = simulate_drive(truth, motion, None, sensors, rng, rate_hz=CONTROL_HZ, feedback=scenario.feedback)
        assert run.reference is not None
        read = run.q if run.q_read is None else run.q_read
        values = (run.t, run.q, run.v, run.a, run.tau, run.stuck, run.reference.q, read)
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{seed}.part.npz")
        np.savez(part, **dict(zip(_KEYS, values, strict=True)))
        part.replace(path)
    with np.load(path) as kept:
        return {key: kept[key][:: scenario.every] for key in _KEYS}


@cache
def plant(number: int) -> tuple[Robot, Model, Model]:
    """Return the nominal robot, the model to fit, and the true plant."""
    robot = load_robot("gantry_tau", prototype="l1")
    return robot, build_model(robot, "asymmetric"), true_plant("l1", number)


def log_of(scenario: Scenario, true: dict[str, np.ndarray], joints: Iterable[str], seed: int) -> Log:
    """Return what sensors make of it."""
    rng = np.random.default_rng([20, seed])
    q = true["q_read"]
    if scenario.feedback == "ideal":
        q = q + scenario.encoder_noise * rng.standard_normal(q.shape)
    tau = true["tau"] + FORCE_NOISE * rng.standard_normal(q.shape)
    wild = rng.random(tau.shape) < scenario.outliers
    tau = tau + 100.0 * wild * rng.choice([-1.0, 1.0], tau.shape)
    signals = {"q": q, "tau": tau, "q_ref": true["q_ref"]}
    return Log(true["t"], {f"{key}_{j}": x[:, k] for key, x in signals.items() for k, j in enumerate(joints)}, "log")


@lru_cache(maxsize=8)
def bound(scenario: Scenario, seed: int, plants: int, folder: Path, kept: tuple[int, ...]) -> np.ndarray:
    """Return the smallest standard errors (r,) that the log of a run allows, of the free columns that are kept."""
    truth, true = plant(seed % plants)[2], recording(scenario, seed, plants, folder)
    keep = ~true["stuck"]
    turns = np.sign(true["v"][1:]) != np.sign(true["v"][:-1])
    keep[1:] &= ~turns
    keep[:-1] &= ~turns
    keep[:3] = keep[-3:] = False
    Y = truth.regressor(true["q"], true["v"], true["a"])[:, :, truth.parameters.free][:, :, kept]
    na, dt = keep.shape[1], float(true["t"][1] - true["t"][0])
    deviations = np.full(na, FORCE_NOISE), np.full(na, scenario.encoder_noise)
    white = PositionNoise(truth.mechanism.inertia(true["q"]), keep, dt, *deviations).whiten(Y).reshape(-1, Y.shape[2])
    return np.sqrt(np.diag(np.linalg.inv(white.T @ white)))


def widest(chosen: Preparation, log: Log, encoder_noise: float) -> Preparation:
    """Return filters as wide as the log's rate allows."""
    force, position = 0.16 * log.rate_hz, 0.4 * log.rate_hz
    threshold = np.full(len(chosen.speed_threshold), 10 * encoder_noise * compute_noise_gain(log.rate_hz, position))
    return replace(chosen, position_cutoff_hz=position, force_cutoff_hz=force, rate_hz=2.5 * force,
                   speed_threshold=threshold, window_s=2 / position)  # fmt: skip


def trial(scenario: Scenario, seed: int, plants: int, estimators: tuple[str, ...], out: Path) -> Path:
    """Compute one run of a scenario, unless it is there; return its file."""
    path = out / "runs" / f"{scenario.name}-{seed:04d}-{plants}.csv"
    done = pd.read_csv(path) if path.is_file() else pd.DataFrame({"estimator": []})
    missing = [e for e in estimators if e not in set(done["estimator"])]
    if missing:
        table = pd.concat([done, pd.DataFrame(rows(scenario, seed, plants, missing, out / "plants"))])
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        table.to_csv(part, index=False)
        part.replace(path)
    return path


def rows(scenario: Scenario, seed: int, plants: int, estimators: list[str], folder: Path) -> Iterator[dict]:
    """Yield one row an estimator and base parameter."""
    own = seed if scenario.feedback == "encoder" else seed % plants  # runs of one plant share its drive and its bound
    robot, model, truth = plant(seed % plants)
    log = log_of(scenario, recording(scenario, own, plants, folder), robot.actuated, seed)
    regression = build_regression(model, [log])
    first = solve_least_squares(regression)
    base = first.base
    limit = bound(scenario, own, plants, folder, tuple(base.kept.tolist()))
    sought = base.combine(truth.parameters.select(base.names).values)
    names = [base.names[k] for k in base.kept]
    for name in estimators:
        if name == "wls":
            e = first
        elif name == "plain":
            wide = widest(regression.preparation, log, scenario.encoder_noise)
            e = solve_least_squares(build_regression(model, [log], preparation=wide))
        else:
            e = estimate_full_rate(model, [log], first, name).estimate
        for parameter, value, stderr, x, least in zip(names, e.beta_plain, e.stderr, sought, limit, strict=True):
            row = {"scenario": scenario.name, "seed": seed, "estimator": name, "parameter": parameter, "truth": x}
            yield row | {"value": value, "stderr": stderr, "bound": least}


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Return one row a scenario and estimator."""
    error = table["value"] - table["truth"]
    table = table.assign(e=error / table["bound"], z=error / table["stderr"])
    out = []
    for (scenario, estimator), part in table.groupby(["scenario", "estimator"], sort=False):
        by = part.groupby("parameter")
        rmse, bias, n = by["e"].agg(lambda x: np.sqrt(np.mean(x**2))), by["z"].mean(), part["seed"].nunique()
        row = {"scenario": scenario, "estimator": estimator, "runs": n}
        row |= {"bias": np.sqrt(np.mean(bias**2)), "worst_bias": bias.abs().max(), "chance": 1 / np.sqrt(n)}
        row |= {"rmse": np.sqrt(np.mean(rmse**2)), "worst_rmse": rmse.max(), "worst_of": rmse.idxmax()}
        out.append(row | {"coverage": 100 * float((part["z"].abs() < 1.959964).mean())})
    return pd.DataFrame(out)


def main(args: argparse.Namespace) -> pd.DataFrame:
    chosen = [s for s in SCENARIOS if s.name in args.scenario]
    tasks = [(s, args.seed + k) for s in chosen for k in range(args.runs)]
    fixed = (args.plants, tuple(args.estimators), args.out)
    if args.jobs == 1:
        files = [trial(s, seed, *fixed) for s, seed in tasks]
    else:
        for s in chosen:  # the drives that several runs share come first
            for k in range(min(args.plants, args.runs) if s.feedback == "ideal" else 0):
                recording(s, args.seed + k, args.plants, args.out / "plants")
        with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
            files = [f.result() for f in [pool.submit(trial, s, seed, *fixed) for s, seed in tasks]]
    everything = pd.concat([pd.read_csv(f) for f in files])
    table = summary(everything[everything["estimator"].isin(args.estimators)])
    args.out.mkdir(parents=True, exist_ok=True)
    table.to_csv(args.out / "estimators.csv", index=False)
    print(table.to_string(index=False, float_format="{:.3f}".format))
    return table


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plants", type=int, default=1, help="plants with masses and motions of their own, in turn")
    parser.add_argument("--scenario", nargs="+", default=[s.name for s in SCENARIOS])
    parser.add_argument("--estimators", nargs="+", default=list(ESTIMATORS))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out") / "estimators", metavar="DIR")
    main(parser.parse_args())
