"""Do samples of an identification, its predictive bands and a fleet's intervals hold what they say?

    python experiments/posterior.py speed|calibration|bands|width|fleet|new_unit [--n 300] [--seed 0]

`speed`: 1000 samples of a UR5, a Gantry-Tau and a Stewart platform, their time and the inconsistent among them. `calibration`:
simulation-based calibration (Talts et al. 2018) of two links: truth from the prior, a log with coloured noise, 99 samples; the
truth's rank among them is uniform if the samples are right. `bands`: shares of held-out samples in 90 % bands on recorded data
(`$TAU_DYN_DATA`), with logs held out as `real_robots.py` does and, of the double pendulum, each log in turn. `width`: the bands
beside those of a +-20 % randomisation around the estimate, scaled to the same share. `fleet`: coverage of mean and spread of a
simulated fleet. `new_unit`: held-out error of a unit from 30 s with the fleet as prior, over that of its own full fit.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from real_robots import CASES
from scipy import stats
from scipy.signal import lfilter

from tau_dyn.effects import build_friction_model
from tau_dyn.estimate import pseudo_inertia, solve_least_squares
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify import (
    Data,
    Identification,
    build_model,
    build_physical_constraints,
    draw_samples,
    find_structural_base,
    identify,
    prepare_segment,
)
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.monitor import FleetParameter, estimate_random_effects, find_outlying_units, identify_fleet
from tau_dyn.robot import ROUGH_FILE, Robot, compute_body_size, load_robot, load_robot_from_urdf
from tau_dyn.simulate import build_fourier_motion

COLOUR = 0.6
NOISE_SHARE = 0.02  # of the rms force
RANKED = (
    "l1_link.mass", "l1_link.mx", "l1_link.iyy", "l2_link.mass", "l2_link.mx", "l2_link.iyy", "j1.coulomb_pos", "j1.viscous_neg",
    "j2.coulomb_neg", "j2.viscous_pos",
)  # fmt: skip
"""Ten parameters of the two links: told by the file alone, by both, and by the log alone."""


def build_arm() -> Robot:
    """Return two links that turn about parallel axes."""
    parts = [
        f'<link name="l{k}_link"><inertial><origin xyz="0.2 0 0"/><mass value="{m}"/>'
        f'<inertia ixx="0.02" iyy="0.06" izz="0.06" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        f'<joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="l{k}_link"/><origin xyz="{x} 0 0"/>'
        '<axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="4" effort="200"/></joint>'
        f'<transmission name="t{k}"><type>x</type><joint name="j{k}"/><actuator name="m{k}"/></transmission>'
        for k, m, parent, x in ((1, 4.0, "base_link", 0.0), (2, 2.0, "l1_link", 0.4))
    ]
    return load_robot_from_urdf(f'<robot name="arm"><link name="base_link"/>{"".join(parts)}</robot>', "arm")


def draw_noise(rng: np.random.Generator, n: int, sigma: np.ndarray) -> np.ndarray:
    """Return coloured noise (n, na) of given deviations."""
    white = rng.standard_normal((n + 50, len(sigma))) * np.sqrt(1 - COLOUR**2)
    return lfilter([1.0], [1.0, -COLOUR], white, axis=0)[50:] * sigma


def add_friction(robot: Robot) -> Model:
    """Return the robot with Coulomb and viscous friction of about 5 % of its forces."""
    model = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    drive = (20.0, 40.0) if "N" in robot.force_units else (5.0, 3.0)
    return model.with_values({p.name: drive["viscous" in p.name] for p in model.effect_parameters})


def record(model: Model, seconds: float, seed: int, name: str = "log") -> Log:
    """Return a log at 250 Hz with coloured noise of 2 % of each joint's rms force."""
    motion = build_fourier_motion(model, seconds, seed).every(4)
    tau = model.torque(motion.q, motion.v, motion.a)
    tau = tau + draw_noise(np.random.default_rng([7, seed]), len(tau), NOISE_SHARE * np.sqrt(np.mean(tau**2, axis=0)))
    columns = {f"q_{j}": motion.q[:, k] for k, j in enumerate(model.robot.actuated)}
    return Log(motion.t, columns | {f"tau_{j}": tau[:, k] for k, j in enumerate(model.robot.actuated)}, name)


def count_inconsistent(robot: Robot, names: tuple[str, ...], values: np.ndarray) -> int:
    """Return how many draws have a body that cannot exist."""
    bad = np.zeros(len(values), bool)
    for link in robot.links:
        pi = values[:, [names.index(name) for name in link.names]] @ link.map.T
        if len(link.own) > 1:
            bad |= np.linalg.eigvalsh(np.array([pseudo_inertia(row) for row in pi]))[:, 0] <= 0
        else:
            bad |= pi[:, 0] < 0
    return int(bad.sum())


def run_speed(seed: int) -> None:
    """Print time and consistency of 1000 samples."""
    for name in ("ur5", "gantry_tau", "stewart"):
        found = identify(load_robot(name), record(add_friction(load_robot(name)), 20.0, seed))
        begun, used = time.perf_counter(), time.process_time()
        samples = found.sample(1000, seed=seed)
        took, used = time.perf_counter() - begun, time.process_time() - used
        bad = count_inconsistent(found.model.robot, samples.names, samples.values)
        free = int(found.parameters.free.sum())
        about = f"{name}: {free} parameters, rank {found.estimate.base.rank}"
        print(f"{about}: 1000 samples in {took:.1f} s ({used:.1f} s of one core), {bad} inconsistent")
        print(f"  {samples.widening}; warnings: {samples.warnings}")


def draw_truth(model: Model, rng: np.random.Generator) -> np.ndarray:
    """Return parameters (p,) from the prior: 25 % of each body, rejected until consistent; friction that any log tells."""
    robot, values = model.robot, dict(zip(model.parameters.names, model.parameters.values, strict=True))
    total = sum(float(link.nominal[0]) for link in robot.links)
    for link in robot.links:
        sizes = ROUGH_FILE * compute_body_size(link, total)
        while True:
            pi = link.nominal + sizes * rng.standard_normal(10)
            if np.linalg.eigvalsh(pseudo_inertia(pi))[0] > 0:
                break
        values |= dict(zip(link.names, pi, strict=True))
    values |= {p.name: rng.uniform(1.0, 3.0) for p in model.effect_parameters}
    values |= {n: rng.uniform(0.0, 0.5) for n in values if n.endswith(".armature") and model.parameters[n].free}
    return np.array([values[n] for n in model.parameters.names])


def run_calibration(n: int, seed: int) -> None:
    """Print the p-value of each parameter's ranks being uniform."""
    model, rng = build_model(build_arm(), "asymmetric"), np.random.default_rng(seed)
    nominal, draws = model.parameters, 99
    data = Data.of(model, [record(add_friction(model.robot), 24.0, seed)])
    built = data.build(model)
    made = [prepare_segment(model, piece, built.regression.preparation) for piece in built.data.pieces]
    structural, physics = find_structural_base(model, seed), build_physical_constraints(model)
    ranks, said, truth_names = [], 0, model.parameters.names
    for k in range(n):
        theta, runs = draw_truth(model, rng), []
        for run, segment in zip(built.regression.runs, made, strict=True):
            clean = run.W @ theta
            sigma = NOISE_SHARE * np.sqrt(np.mean(clean**2, axis=0))
            noise = draw_noise(rng, len(segment.force), sigma)
            runs.append(replace(run, y=clean + segment.passed(segment.gate * noise) / segment.weight))
        estimate = solve_least_squares(
            replace(built.regression, runs=tuple(runs)), physics=physics, structural=structural
        )
        samples = draw_samples(model, estimate, nominal, draws, seed=1000 * seed + k)
        said += bool(samples.warnings)
        ranks.append(np.sum(samples.values < theta, axis=0))
    table = np.array(ranks)
    print(f"two links, {n} runs, {draws} samples each; {said} runs with a warning")
    p_values = {}
    for name in RANKED:
        r = table[:, truth_names.index(name)]
        counts = np.histogram(r, bins=np.linspace(0, draws + 1, 11) - 0.5)[0]
        p_values[name] = float(stats.chisquare(counts).pvalue)
        inside = np.mean((r >= 5) & (r < draws - 4))
        print(
            f"  {name:16s} p = {p_values[name]:.3f}   90 % interval holds {100 * inside:.1f} %   ranks by tenths {counts}"
        )
    least = min(p_values.values())
    print(f"  smallest of ten p-values {least:.3f}, over all together (Bonferroni) {min(1.0, 10 * least):.2f}")


def run_bands() -> None:
    """Print the shares that bands hold on recorded data."""
    for key in ("emps", "tx40", "double_pendulum"):
        for name, robot, train, held in CASES[key]():
            print_bands(name, identify(robot, train, holdout=held))
            if held:
                logs, shares = [*train, *held], []
                for k, log in enumerate(logs):
                    try:
                        found = identify(robot, [*logs[:k], *logs[k + 1 :]], holdout=[log])
                    except CannotAnswer as fault:
                        print(f"  without {log.name}: {fault}")
                        continue
                    shares.append((log.name, None if found.bands is None else found.bands.share))
                told = [s for _, s in shares if s is not None]
                listed = ", ".join(f"{log} {'-' if s is None else format(s, '.2f')}" for log, s in shares)
                print(f"  each log in turn: mean {100 * np.mean(told):.1f} % ({listed})")


def print_bands(name: str, found: Identification) -> None:
    """Print the shares of one identification."""
    if found.bands is None:
        print(f"{name}: no bands")
        return
    about = found.bands.to_dict()
    joints = ", ".join(f"{j} {100 * x['share']:.0f} %" for j, x in about["per_joint"].items() if x["share"] is not None)
    error = found.holdout.relative_error_percent if found.holdout else float("nan")
    print(f"{name}: 90 % bands hold {100 * about['share']:.1f} % ({joints})")
    print(
        f"  of all samples {100 * about['share_all_samples']:.1f} %; held-out error {error:.1f} %; {found.holdout_how}"
    )


def run_width(seed: int) -> None:
    """Print widths of bands and of a +-20 % randomisation at the same share."""
    rng = np.random.default_rng(seed)
    for key in ("emps", "tx40", "double_pendulum"):
        for name, robot, train, held in CASES[key]():
            found = identify(robot, train, holdout=held)
            if found.bands is None or found.held is None:
                continue
            theta = found.parameters.values
            factors = rng.uniform(0.8, 1.2, (300, len(theta)))
            rows = []
            for run in found.held.runs:
                step = max(1, len(run.t) // 500)
                drawn = np.quantile(np.einsum("nmp,sp->snm", run.W[::step], factors * theta), (0.05, 0.5, 0.95), axis=0)
                rows.append((*drawn, run.y[::step], run.usable[::step]))
            low, middle, high, y, usable = (np.concatenate(part) for part in zip(*rows, strict=True))
            for j, joint in enumerate(found.held.outputs):
                k, used = usable[:, j], found.bands.used[j]
                if not used:
                    continue
                share = found.bands.inside[j] / used
                up, down = np.maximum(high - middle, 1e-12)[k, j], np.maximum(middle - low, 1e-12)[k, j]
                off = (y - middle)[k, j]
                scale = float(np.quantile(np.where(off > 0, off / up, -off / down), share))
                plain = float(np.mean(up + down))
                own = float(np.mean(np.abs(off) <= np.where(off > 0, up, down)))
                width = found.bands.width[j]
                print(
                    f"{name} {joint}: band {width:.3g} holds {100 * share:.0f} %; +-20 % {plain:.3g} holds {100 * own:.0f} %, "
                    f"at the same share {plain * scale:.3g}: ratio {width / (plain * scale):.2f}"
                )


def run_fleet(n: int, seed: int) -> None:
    """Print coverage of mean and spread, how often equal units are said to differ, and false and true outlying units."""
    rng = np.random.default_rng(seed)
    for units in (3, 4, 6, 10):
        for spread in (0.0, 1.0, 3.0):  # in units of a unit's own standard error, which varies by a factor of three
            mean, width, claims, false, right = 0, 0, 0, 0, 0
            for _ in range(n):
                stderr = rng.uniform(0.5, 1.5, units)
                values = spread * rng.standard_normal(units) + stderr * rng.standard_normal(units)
                found = estimate_random_effects(values, stderr)
                mean += found.mean_ci95[0] <= 0 <= found.mean_ci95[1]
                width += found.spread_ci95[0] <= spread <= found.spread_ci95[1]
                claims += found.spread_ci95[0] > 0
                false += bool(find_outlying_units([describe_units(values, stderr)]))
                values[0] += 10 * np.hypot(spread, stderr[0])
                right += any(row.unit == "0" for row in find_outlying_units([describe_units(values, stderr)]))
            shares = (100 * x / n for x in (mean, width, claims, false, right))
            told = "mean {:.1f} %, spread {:.1f} %, said to differ {:.1f} %, false outlying {:.2f} %, of 10 sigma found {:.0f} %"
            print(f"{units} units, spread {spread:g} of an error, {n} fleets: {told.format(*shares)}")


def describe_units(values: np.ndarray, stderr: np.ndarray) -> FleetParameter:
    """Return units' values of one parameter as a fleet holds them."""
    units = {str(k): (float(x), float(s)) for k, (x, s) in enumerate(zip(values, stderr, strict=True))}
    return FleetParameter("x", "x", "1", len(values), 0.0, (0.0, 0.0), 0.0, (0.0, 0.0), 0.0, units)


def run_new_unit(n: int, seed: int) -> None:
    """Print the held-out error of new units from 30 s with six others as prior, over that of their own fit of 180 s."""
    for robot in (build_arm(), load_robot("gantry_tau"), load_robot("ur5")):
        ratios, alone = [], []
        for k in range(n):
            rng = np.random.default_rng([seed, k])
            typical = add_friction(robot)
            made = [vary(typical, rng) for _ in range(7)]
            units = {f"unit{i}": [record(m, 60.0, 100 * k + i, f"unit{i}")] for i, m in enumerate(made[:6])}
            fleet = identify_fleet(robot, units)
            new, held = made[6], record(made[6], 60.0, 100 * k + 50, "held")
            short, long = record(new, 30.0, 100 * k + 51, "short"), record(new, 180.0, 100 * k + 52, "long")
            errors = [
                identify(robot, log, holdout=held, model=model).holdout
                for log, model in ((short, fleet.model), (long, "asymmetric"), (short, "asymmetric"))
            ]
            with_fleet, full, without = (e.relative_error_percent if e else np.nan for e in errors)
            ratios.append(with_fleet / full)
            alone.append(without / full)
        print(
            f"{robot.name}, {n} fleets of six: 30 s with the fleet over the own full fit, mean {np.mean(ratios):.3f}, largest "
            f"{np.max(ratios):.3f}; 30 s alone {np.mean(alone):.3f}, {np.max(alone):.3f}"
        )


def vary(model: Model, rng: np.random.Generator) -> Model:
    """Return a unit: masses and their moments and inertias 3 % off, friction 25 %."""
    values = {}
    for link in model.robot.links:
        factor = 1 + 0.03 * rng.standard_normal()
        values |= {name: factor * model.parameters[name].value for name in link.names}
    values |= {p.name: p.value * np.exp(0.25 * rng.standard_normal()) for p in model.effect_parameters}
    return model.with_values(values)


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=("speed", "calibration", "bands", "width", "fleet", "new_unit"))
    parser.add_argument("--n", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if given.part == "speed":
        run_speed(given.seed)
    elif given.part == "calibration":
        run_calibration(given.n, given.seed)
    elif given.part == "bands":
        run_bands()
    elif given.part == "fleet":
        run_fleet(given.n, given.seed)
    elif given.part == "new_unit":
        run_new_unit(given.n, given.seed)
    else:
        run_width(given.seed)


if __name__ == "__main__":
    main()
