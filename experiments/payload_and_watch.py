"""How well is a payload told, and how soon and how falsely does a watch raise alarms?

    python experiments/payload_and_watch.py payload|equal|watch|alarms [--robot gantry_tau] [--n 200] [--hours 1000] [--seed 0]

`payload`: 0.5 kg from 20 s without and 20 s with it, on simulated logs: errors of mass and centre, coverage of 95 % intervals.
`equal`: pairs of equal runs, and how many are said to differ. `watch`: 10 % more friction in a joint drawn at random, after 90 s,
and how often it is named within 60 s. `alarms`: false alarms on coloured residuals, at the stated rate and at rates at which some
are to be expected. The model gives the forces along one motion; noise has 1 % of each joint's rms force, coloured by
1 / (1 - 0.6 z^-1) at 250 Hz. Filters are linear, so only the noise passes them again for each seed.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
import pinocchio as pin
from scipy import stats
from scipy.signal import lfilter

from tau_dyn.effects import build_friction_model
from tau_dyn.estimate import Regression, fit_autoregression, solve_least_squares
from tau_dyn.identify import Data, prepare_segment
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.monitor import BlockScore, ChangeDetector, watch_logs
from tau_dyn.monitor.change_detection import BLOCKS_PER_HOUR, LENGTHS
from tau_dyn.monitor.normal_state import NormalState
from tau_dyn.monitor.payload import (
    add_payload_columns,
    describe_payload,
    find_carrying_link,
    solve_payload,
    untie_link,
)
from tau_dyn.robot import load_robot
from tau_dyn.simulate import build_fourier_motion

MASS = 0.5  # kg
COLOUR = 0.6
NOISE_SHARE = 0.01  # of the rms force, as `excitation.Noise.typical` takes for good drives


def build_model(name: str) -> Model:
    """Return a robot with Coulomb and viscous friction of about 5 % of its forces."""
    robot = load_robot(name)
    model = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    drive = (20.0, 40.0) if "N" in robot.force_units else (5.0, 3.0)
    return model.with_values({p.name: drive["viscous" in p.name] for p in model.effect_parameters})


def draw_noise(rng: np.random.Generator, n: int, sigma: np.ndarray) -> np.ndarray:
    """Return coloured noise (n, na) of given deviations."""
    white = rng.standard_normal((n + 50, len(sigma))) * np.sqrt(1 - COLOUR**2)
    return lfilter([1.0], [1.0, -COLOUR], white, axis=0)[50:] * sigma


def write_log(model: Model, name: str, seconds: float, seed: int, mass: float) -> tuple[Log, np.ndarray]:
    """Return a log without noise, and the noise's deviations (na,)."""
    robot = model.robot
    body = find_carrying_link(robot, None)
    motion = build_fourier_motion(model, seconds, seed).every(4)
    tau = model.torque(motion.q, motion.v, motion.a)
    sigma = NOISE_SHARE * np.sqrt(np.mean(tau**2, axis=0))
    if mass:
        wide = untie_link(model, body)
        names = wide.robot.parameters.names
        ten = [k for k, n in enumerate(names) if n.startswith(f"{body.link}.")]
        tau = tau + wide.mechanism.regressor(motion.q, motion.v, motion.a)[:, :, ten] @ describe_truth(mass)
    columns = {f"q_{j}": motion.q[:, k] for k, j in enumerate(robot.actuated)}
    columns |= {f"tau_{j}": tau[:, k] for k, j in enumerate(robot.actuated)}
    return Log(motion.t, columns, name), sigma


def describe_truth(mass: float) -> np.ndarray:
    """Return the ten numbers of the payload in the frame of the last joint."""
    return pin.Inertia(mass, np.array([0.02, -0.01, 0.06]), 2e-3 * mass * np.eye(3)).toDynamicParameters()


def run_payload(name: str, n: int, seed: int, mass: float) -> None:
    """Print errors, coverage and claims of pairs of runs."""
    model = build_model(name)
    body = find_carrying_link(model.robot, None)
    pair = [
        write_log(model, kind, 20.0, 1 if mass == 0 else k, m) for k, (kind, m) in enumerate((("0", 0.0), ("1", mass)))
    ]
    data = Data.of(untie_link(model, body), [log for log, _ in pair])
    built = data.build(data.model)
    made = [prepare_segment(data.model, piece, built.regression.preparation) for piece in built.data.pieces]
    clean = add_payload_columns(model, body, built.regression, {"1"})
    errors, covered, claims, centres = [], [], 0, []
    rng = np.random.default_rng(seed)
    for _ in range(n):
        runs = []
        for run, segment, (_, sigma) in zip(clean.runs, made, pair, strict=True):
            noise = draw_noise(rng, len(segment.force), sigma)
            runs.append(replace(run, y=run.y + segment.passed(segment.gate * noise) / segment.weight))
        regression: Regression = replace(clean, runs=tuple(runs))
        estimate = solve_payload(model, regression) if mass else solve_least_squares(regression)
        found = describe_payload(model, body, estimate, (("0",), ("1",)))
        claims += found.differs
        if mass:
            value, stderr = float(found.mass.values[0]), float(found.mass.stderr[0])
            errors.append(value - mass)
            covered.append(abs(value - mass) < 1.96 * stderr)
            joint = model.robot.tool_frame
            at = model.robot.model.frames[joint].placement if found.frame != body.link else pin.SE3.Identity()
            centre = at.inverse().act(np.array([0.02, -0.01, 0.06]))
            centres.append(np.abs(found.centre.values - centre) < 1.96 * found.centre.stderr)
    print(f"{name}: {n} pairs, {claims} said to differ")
    if mass:
        worst = 100 * np.max(np.abs(errors)) / mass
        print(f"  mass: rms error {100 * np.sqrt(np.mean(np.square(errors))) / mass:.2f} %, largest {worst:.2f} %")
        print(
            f"  coverage of 95 % intervals: mass {100 * np.mean(covered):.1f} %, centre {100 * np.mean(centres, axis=0)}"
        )


def run_watch(name: str, n: int, seed: int) -> None:
    """Print how often 10 % more friction of a joint is named within 60 s, and its size and time are covered."""
    model = build_model(name)
    joints = model.robot.actuated
    rng = np.random.default_rng(seed)
    named, inside, since, wrong = 0, 0, 0, 0
    for k in range(n):
        log, sigma = write_log(model, "log", 152.0, 100 + k, 0.0)
        joint = joints[rng.integers(len(joints))]
        motion = build_fourier_motion(model, 152.0, 100 + k).every(4)
        more = {p.name: 0.1 * p.value for p in model.effect_parameters if p.name.startswith(f"{joint}.")}
        only = model.with_values({p.name: more.get(p.name, 0.0) for p in model.effect_parameters})
        extra = only.effect_force(only.motion(motion.q, motion.v, motion.a)) * (motion.t >= 90)[:, None]
        tau = log.joint("tau", joints) + extra + draw_noise(rng, log.n_samples, sigma)
        found = watch_logs(model, [log.with_channels(**{f"tau_{j}": tau[:, i] for i, j in enumerate(joints)})])
        rows = found.rows()
        right = [r for r in rows if r["what"] == "friction" and r["joint"] == joint and r["detected_t"] < 150]
        named += bool(right)
        wrong += len(rows) - len(right)
        inside += bool(right) and right[0]["ci95"][0] < 0.1 < right[0]["ci95"][1]
        since += bool(right) and right[0]["since_ci95"][0] - 2 < 90 < right[0]["since_ci95"][1] + 2
    print(
        f"{name}: +10 % friction named within 60 s in {named} of {n}; size covered {inside}, time {since}; wrong {wrong}"
    )


def run_alarms(hours: float, seed: int) -> None:
    """Print false alarms of a watch of eight directions on coloured residuals, every robot with a reference of its own."""
    rng, D, n, m, each = np.random.default_rng(seed), 8, 60, 3, 10.0  # 30 Hz, three joints, hours a robot
    blocks = int(each * BLOCKS_PER_HOUR)
    rates = (1e-4, 1e-2, 1e-1, 1.0)
    counts, watched, begun = dict.fromkeys(rates, 0), 0.0, time.monotonic()
    while watched < hours:
        X = rng.standard_normal((n, m, D)) * (rng.random((m, D)) < 0.6)
        phi = rng.uniform(0.3, 0.9, m)
        white = rng.standard_normal(((blocks + 30) * n, m))
        e = np.column_stack([lfilter([1.0], [1.0, -p], white[:, k]) for k, p in enumerate(phi)]).reshape(-1, n, m)
        s, G = np.zeros((len(e), D)), np.zeros((D, D))
        for k in range(m):  # white by what the reference shows, each block on its own
            model = fit_autoregression([x[:, k] for x in e[:30]], 4)
            filtered = lfilter(model.denominator, [1.0], e[:, :, k], axis=1)[:, len(model.phi) :]
            columns = lfilter(model.denominator, [1.0], X[:, k], axis=0)[len(model.phi) :]
            sigma = float(np.std(filtered[:30]))
            s += filtered @ columns / sigma**2
            G += columns.T @ columns / sigma**2
        normal = NormalState.of([BlockScore((0.0, 2.0), "", z, G, np.nan, 0) for z in s[:30]], np.full(D, 1e3))
        total = np.vstack([np.zeros(D), np.cumsum(s[30:] - G @ normal.theta, axis=0)])
        largest = np.zeros(len(total) - 1)
        for length in LENGTHS:
            T = normal.compute_statistics(total[length:] - total[:-length], length * G)
            np.maximum(largest[length - 1 :], T.max(axis=1), out=largest[length - 1 :])
        watched += each
        for rate in rates:
            detector = ChangeDetector(np.ones(D), 30, rate, normal=normal)
            counts[rate] += count_alarms(np.sqrt(largest) > detector.threshold)
    print(f"{watched:g} h of coloured residuals, {time.monotonic() - begun:.0f} s")
    for rate, count in counts.items():
        low, high = (stats.chi2.ppf(p, 2 * (count + k)) / 2 / watched for p, k in ((0.025, 0), (0.975, 1)))
        ends = f"95 %: {np.nan_to_num(low):.2g} to {high:.2g}"
        print(f"  stated {rate:g} an hour: {count} alarms, {count / watched:.2g} an hour ({ends})")


def count_alarms(over: np.ndarray) -> int:
    """Return how often a detector would raise an alarm: after each it is silent for the reference and the longest window."""
    count, at = 0, 0
    for k in np.flatnonzero(over):
        if k >= at:
            count, at = count + 1, k + 30 + 5
    return count


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("payload", "equal", "watch", "alarms"))
    parser.add_argument("--robot", default="gantry_tau")
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--hours", type=float, default=1000.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if given.part == "watch":
        run_watch(given.robot, given.n, given.seed)
    elif given.part == "alarms":
        run_alarms(given.hours, given.seed)
    else:
        run_payload(given.robot, given.n, given.seed, MASS if given.part == "payload" else 0.0)


if __name__ == "__main__":
    main()
