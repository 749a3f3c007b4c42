"""Does a designed motion tell more than the best of 50 random ones, and are the standard errors as predicted?

    python experiments/excitation.py [--robots l1 axis 6r] [--criteria worst d] [--runs 5] [--random 50] [--seconds 90] [--seed 0]

Three robots with asymmetric friction: the L1 (simplified Gantry-Tau), the linear axis, and a 6R (an elbow arm of 1.3 m reach and
70 kg). Each gets 30 s, the robot file's limits, and the same speeds (90 % of the limit, at most 1 m/s or 2 rad/s) for random and
designed motions alike. All standard errors of that comparison are predicted by the same code (`tau_dyn.excitation.information`);
"worst" is the largest standard error relative to the parameter's value (of a small one, to a tenth of its unit's largest).

Then the design is driven, with other draws than its own prediction: the true robot is simulated with controller and sensors
`--runs` times, each log is identified, and scatter and reported standard errors are divided by the predicted ones (medians over
parameters; with few runs scatter is itself uncertain by 1 / sqrt(2 runs)).
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from tau_dyn.estimate import solve_least_squares
from tau_dyn.excitation import ExcitationDesign, InformationPrediction, Noise, design_motion, predict
from tau_dyn.identify import build_model, build_regression
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf
from tau_dyn.simulate import Sensors, build_fourier_motion, simulate

ROBOTS = {
    "l1": ("gantry_tau", 5.0, 5e-6, 90.0),
    "axis": ("linear_axis", 5.0, 5e-6, 20.0),
    "6r": ("", 1.0, 1e-5, 10.0),
}
"""Robot, force noise [N or N m], encoder noise [m or rad], size of Coulomb friction [N or N m]."""


def main(argv: list[str] | None = None) -> None:
    """Run the study and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", choices=tuple(ROBOTS), default=list(ROBOTS))
    parser.add_argument("--criteria", nargs="+", default=["worst", "d"])
    for name, default in (("runs", 5), ("random", 50), ("seconds", 90), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args(argv)
    for name in args.robots:
        study(name, args)


def study(name: str, args: argparse.Namespace) -> None:
    """Compare and check one robot."""
    model, noise = truth(name)
    seeds = np.random.default_rng(args.seed).integers(2**31, size=args.random)
    random = [predict(model, build_fourier_motion(model, 30.0, int(s)), noise, args.seed) for s in seeds]
    best = min(random, key=lambda p: p.worst[1])
    print(
        f"\n{name}: best of {args.random} random: worst {100 * best.worst[1]:.3g} % ({best.worst[0]}), "
        f"condition {best.condition:.3g}"
    )
    for criterion in args.criteria:
        begun = time.process_time()
        design = design_motion(
            model, 30.0, args.seed, criterion=criterion, noise=noise, seconds=args.seconds, rate_hz=noise.rate_hz
        )
        told(criterion, design, best, time.process_time() - begun, model, noise, args.seed)
        if args.runs:
            checked(model, design, noise, args.runs, args.seed)


def truth(name: str) -> tuple[Model, Noise]:
    """Return the true robot, with friction, and its sensors' noise."""
    source, force, encoder, coulomb = ROBOTS[name]
    robot = load_robot(source) if source else six_axes()
    model = build_model(robot, "asymmetric")
    sizes = {"coulomb_pos": 1.0, "coulomb_neg": 0.8, "viscous_pos": 1.4, "viscous_neg": 1.2}
    values = {f"{j}.{k}": coulomb * x for j in robot.actuated for k, x in sizes.items()}
    return model.with_values(values), Noise.given(robot, [force], [encoder])


def six_axes() -> Robot:
    """Return an elbow arm with a spherical wrist: offset, axis, mass, centre, inertia and limits, axis by axis, in SI."""
    rows = (
        ("0 0 0.3", "0 0 1", 20, "0 0.02 -0.05", "0.3 0.3 0.25", 2.9, 2.5, 600),
        ("0.05 0 0.1", "0 1 0", 22, "0.02 0.08 0.25", "0.9 0.85 0.15", 1.6, 2.5, 900),
        ("0 0 0.55", "0 1 0", 14, "0.1 -0.03 0.05", "0.12 0.2 0.2", 1.8, 3.0, 450),
        ("0.25 0 0.06", "1 0 0", 7, "0.12 0 0.01", "0.02 0.08 0.08", 3.0, 4.0, 150),
        ("0.3 0 0", "0 1 0", 4, "0.02 0.01 0.01", "0.01 0.012 0.011", 1.9, 4.0, 120),
        ("0.08 0 0", "1 0 0", 3, "0.05 0.02 0.01", "0.006 0.008 0.008", 3.0, 5.0, 80),
    )
    parts, parent = ['<robot name="six_r"><link name="base_link"/>'], "base_link"
    for k, (xyz, axis, mass, centre, inertia, reach, speed, effort) in enumerate(rows, 1):
        ixx, iyy, izz = inertia.split()
        parts.append(
            f'<link name="l{k}_link"><inertial><origin xyz="{centre}"/><mass value="{mass}"/><inertia ixx="{ixx}" iyy="{iyy}" '
            f'izz="{izz}" ixy="0.001" ixz="0.002" iyz="-0.001"/></inertial></link><joint name="j{k}" type="revolute">'
            f'<parent link="{parent}"/><child link="l{k}_link"/><origin xyz="{xyz}"/><axis xyz="{axis}"/>'
            f'<limit lower="-{reach}" upper="{reach}" velocity="{speed}" effort="{effort}"/></joint>'
            f'<transmission name="t{k}"><type>transmission_interface/SimpleTransmission</type><joint name="j{k}"/>'
            f'<actuator name="m{k}"/></transmission>'
        )
        parent = f"l{k}_link"
    return load_robot_from_urdf("".join([*parts, "</robot>"]), "six_r")


def told(
    criterion: str,
    design: ExcitationDesign,
    best: InformationPrediction,
    cpu: float,
    model: Model,
    noise: Noise,
    seed: int,
) -> None:
    """Print what one design gains."""
    p = predict(model, design.motion, noise, seed)
    same = p.expressions == best.expressions
    ratio = np.median(best.stderr / p.stderr) if same else float("nan")
    print(
        f"  design '{criterion}': worst {100 * p.worst[1]:.3g} % ({p.worst[0]}), {best.worst[1] / p.worst[1]:.2f} times better; "
        f"median parameter {ratio:.2f} times; condition {p.condition:.3g}; {design.evaluations} evaluations, {cpu:.0f} s CPU, "
        f"{design.seconds:.0f} s by the clock, {'settled' if design.finished else 'stopped by time'}"
    )


def checked(model: Model, design: ExcitationDesign, noise: Noise, runs: int, seed: int) -> None:
    """Drive a design and print scatter and reported errors over the predicted ones."""
    sensors = Sensors(force_noise=tuple(noise.force), encoder_noise=tuple(noise.encoder))
    found, reported = [], []
    p = design.prediction
    for k in range(runs):
        log = simulate(model, design.motion, sensors=sensors, seed=seed + 1000 + k, rate_hz=noise.rate_hz)
        estimate = solve_least_squares(build_regression(model, [log]))
        if tuple(estimate.base.expression(r) for r in range(estimate.base.rank)) != p.expressions:
            print("  the experiment regroups parameters in another way; not compared")
            return
        found.append(estimate.beta_plain - p.values)
        reported.append(np.sqrt(np.diag(estimate.cov)))
    z = np.array(found) / p.stderr
    share = np.mean(reported, axis=0) / p.stderr
    print(
        f"    driven {runs} times: rms error over predicted {np.sqrt(np.mean(z**2)):.2f} (all parameters pooled); reported over "
        f"predicted: median {np.median(share):.2f}, from {share.min():.2f} to {share.max():.2f}"
    )


if __name__ == "__main__":
    main()
