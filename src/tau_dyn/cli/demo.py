"""The main job on made data: simulate the L1 Gantry-Tau, identify it, compare with the truth, write the report.

The simulated robot has the asymmetric friction of Dressler 2012, Table 6.1, 5 N of force noise and 5 um encoders.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from tau_dyn.cli.common import Outcome, add_common, progress
from tau_dyn.exceptions import InputError

HELP = "the main job on made data: simulate, identify, compare with the truth, report"

# Dressler 2012, Table 6.1: coulomb_neg, coulomb_pos [N], viscous_neg, viscous_pos [N/(m/s)] of each actuator
TABLE_6_1 = ((145.69, 189.12, 158.01, 205.03), (119.23, 262.59, 133.76, 190.00), (177.22, 239.06, 197.52, 185.94))
_QUANTITIES = ("coulomb_neg", "coulomb_pos", "viscous_neg", "viscous_pos")


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("tau_dyn_demo"), help="folder (default tau_dyn_demo)"
    )
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Run the demo."""
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise InputError(f"--out {args.out}: {fault.strerror}; name a folder") from fault
    with progress(args.quiet) as step:
        step("loading")
        from tau_dyn.identify import identify
        from tau_dyn.report import identification_page
        from tau_dyn.robot import load_robot
        from tau_dyn.simulate import Sensors, named_motion, simulate

        robot = load_robot("gantry_tau", prototype="l1")
        truth = true_model(robot, args.seed)
        sensors = Sensors(encoder_noise=5e-6, force_noise=5.0, log_rate_hz=500.0)
        logs = []
        for k, (name, motion, duration) in enumerate((("monday", "fourier", 60.0), ("tuesday", "prbs", 20.0))):
            path = named_motion(motion, truth, duration, args.seed + k)
            logs.append(
                simulate(
                    truth,
                    path,
                    sensors=sensors,
                    seed=args.seed + k,
                    name=f"{name}.csv",
                    progress=lambda share, day=name: step(f"simulating {day}: {100 * share:.0f} %"),
                )
            )
        found = identify(robot, logs[0], holdout=logs[1], seed=args.seed, progress=step)
        step("report")
        values = {p.name: p.value for p in truth.parameters}
        command = f"tau-dyn identify gantry_tau {args.out}/monday.csv --holdout {args.out}/tuesday.csv"
        page = identification_page(found, command_line=command, truth=values)
    written = {"report": str(args.out / "report.html"), "model": str(args.out / "model.yaml"), "logs": str(args.out)}
    return Outcome(
        result=found.to_dict() | {"truth": values, "out": str(args.out)},
        warnings=found.warnings,
        show=lambda console: _show(console, found, values, written),
        files={
            args.out / "report.html": page,
            args.out / "model.yaml": found.model.save,
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


def _show(console, found, truth: dict[str, float], written: dict[str, str]) -> None:
    from tau_dyn.report import print_identification

    print_identification(console, found, written, truth=truth)
