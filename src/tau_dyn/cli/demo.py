"""The main job on made data: simulate the L1 Gantry-Tau with a hidden effect, identify it, diagnose it, write the reports.

The simulated robot has the asymmetric friction of Dressler 2012, Table 6.1, 5 N of force noise, 5 um encoders, and two things
that the model which is fitted does not know: cart 2's pinion pushes once a tooth, and all carts' friction falls with speed.
"""

from __future__ import annotations

import argparse

import numpy as np

from tau_dyn.cli.common import Outcome, add_common, progress

HELP = "the main job on made data with hidden effects: simulate, identify, diagnose, report"

# Dressler 2012, Table 6.1: coulomb_neg, coulomb_pos [N], viscous_neg, viscous_pos [N/(m/s)] of each actuator
TABLE_6_1 = ((145.69, 189.12, 158.01, 205.03), (119.23, 262.59, 133.76, 190.00), (177.22, 239.06, 197.52, 185.94))
_QUANTITIES = ("coulomb_neg", "coulomb_pos", "viscous_neg", "viscous_pos")
RATE_HZ = 500.0
"""Of control and log."""
TOOTH = 0.0209
"""Distance after which cart 2's pinion repeats [m]."""
RIPPLE = 2.0
"""Amplitude of its force [N]."""
PEAK = {"cart1": 18.0, "cart2": 20.0, "cart3": 22.0}
"""What friction at standstill has above Coulomb's [N], about a tenth of it, gone at a few times 25 mm/s."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("--out", metavar="DIR", default="tau_dyn_demo", help="folder (default tau_dyn_demo)")
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Run the demo."""
    with progress(args.quiet) as step:
        step("loading")
        from tau_dyn.diagnose import diagnose
        from tau_dyn.identify import identify
        from tau_dyn.report import diagnosis_page, identification_page
        from tau_dyn.robot import load_robot
        from tau_dyn.simulate import Sensors, named_motion, simulate

        robot = load_robot("gantry_tau", prototype="l1")
        truth = hidden_model(true_model(robot, args.seed))
        sensors = Sensors(encoder_noise=5e-6, force_noise=5.0, log_rate_hz=RATE_HZ)
        logs = []
        for k, (name, duration) in enumerate((("monday", 48.0), ("tuesday", 32.0))):
            path = named_motion("fourier", truth, duration, args.seed + k)
            logs.append(
                simulate(
                    truth,
                    path,
                    sensors=sensors,
                    rate_hz=RATE_HZ,
                    seed=args.seed + k,
                    name=f"{name}.csv",
                    progress=lambda share, day=name: step(f"simulating {day}: {100 * share:.0f} %"),
                )
            )
        fit = identify(robot, logs[0], holdout=logs[1], seed=args.seed, progress=step)
        found = diagnose(robot, logs[0], holdout=logs[1], seed=args.seed, progress=step)
        step("reports")
        values = {p.name: p.value for p in truth.parameters}
        files = f"gantry_tau {args.out}/monday.csv --holdout {args.out}/tuesday.csv"
        page = diagnosis_page(found, command_line=f"tau-dyn diagnose {files}")
        plain = identification_page(fit, command_line=f"tau-dyn identify {files}", truth=values)
    written = {
        "report": str(args.out / "report.html"),
        "extended model": str(args.out / "extended.yaml"),
        "identification": str(args.out / "identification.html"),
        "logs": str(args.out),
    }
    return Outcome(
        result=found.to_dict() | {"truth": values, "hidden": ["cyclic_ripple", "stribeck"], "out": str(args.out)},
        warnings=found.warnings,
        show=lambda console: _show(console, found, written),
        files={
            args.out / "identification.html": plain,
            args.out / "model.yaml": fit.model.save,
            args.out / "extended.yaml": found.extended_model.save,
            **{args.out / log.name: log.to_csv for log in logs},
        },
        report=lambda: page,
    )


def true_model(robot, seed: int):
    """Return the simulated robot: Table 6.1's friction, and masses up to 10 % off the nominal ones."""
    from tau_dyn.effects import friction_model
    from tau_dyn.model import Model

    model = Model.of(robot, friction_model("asymmetric", robot.actuated, robot.force_units))
    rng = np.random.default_rng(seed)
    values = {p.name: p.value * rng.uniform(0.9, 1.1) for p in robot.parameters if p.name.endswith(".mass")}
    for joint, row in zip(robot.actuated, TABLE_6_1, strict=True):
        values |= {f"{joint}.{quantity}": value for quantity, value in zip(_QUANTITIES, row, strict=True)}
    return model.with_values(values)


def hidden_model(model):
    """Return the model with what the fitted one does not know."""
    from dataclasses import replace

    from tau_dyn.effects import CyclicRipple, Stribeck
    from tau_dyn.parameters import Parameters

    joints, units = model.robot.actuated, model.robot.force_units
    effects = (CyclicRipple(joints[1:2], units[1:2], period=TOOTH), Stribeck(joints, units, speed=0.025))
    more = Parameters([p for effect in effects for p in effect.parameters])
    extended = replace(model, effects=(*model.effects, *effects), effect_parameters=model.effect_parameters + more)
    peaks = {f"{joint}.stribeck": value for joint, value in PEAK.items()}
    return extended.with_values({f"{joints[1]}.ripple_sin": RIPPLE, **peaks})


def _show(console, found, written: dict[str, str]) -> None:
    from tau_dyn.report import print_diagnosis

    ripple = f"a ripple of {RIPPLE:g} N every {1e3 * TOOTH:g} mm on cart2"
    console.print(f"Hidden in the made logs: {ripple}, and Stribeck friction on all carts.")
    print_diagnosis(console, found, written)
