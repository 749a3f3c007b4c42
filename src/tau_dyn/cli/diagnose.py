"""What the simulation gets wrong, which physical cause explains it, and how much better the model is with that cause.

The model is fitted first; what it misses is searched for causes, confirmed on a second part of the data, and the gain is
measured on a third. Where the data cannot tell, the answer says which experiment would, and the exit status is 3.
"""

from __future__ import annotations

import argparse

from tau_dyn.cli.common import Outcome, add_common, add_robot, command_line, load_robot_from, progress
from tau_dyn.cli.fitting import add_fitting, fitting_inputs, fitting_options, read_fitting_logs

HELP = "what the simulation gets wrong, and the cause"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    add_fitting(
        parser,
        model="what the simulation has already: rigid, symmetric (.coulomb .viscous .offset), asymmetric (.._pos .._neg; "
        "default), or a model file; its parameters are refitted",
        holdout="logs kept from the search: one half confirms a cause, the other measures its gain (without any, blocks of "
        "the logs do, 60/20/20)",
        out="write the model extended by the confirmed causes here; simulate, identify and the feedforward read it",
    )
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Diagnose."""
    with progress(args.quiet) as step:
        step("loading")
        from tau_dyn.diagnose import diagnose

        robot = load_robot_from(args)
        logs, held = read_fitting_logs(args)
        found = diagnose(robot, logs, holdout=held, progress=step, **fitting_options(args))
    return Outcome(
        result=found.to_dict(),
        warnings=found.warnings,
        inputs=fitting_inputs(args, logs, held),
        show=lambda console: _show(console, found, args),
        files={args.out: found.extended_model.save} if args.out else {},
        report=lambda: _page(found),
        exit_status=found.exit_status,
    )


def _show(console, found, args: argparse.Namespace) -> None:
    from tau_dyn.report import print_diagnosis

    written = {"extended model": args.out, "report": args.report, "result": args.json}
    print_diagnosis(console, found, {k: str(v) for k, v in written.items() if v})


def _page(found) -> str:
    from tau_dyn.report import diagnosis_page

    return diagnosis_page(found, command_line=command_line())
