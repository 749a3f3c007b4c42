"""Masses and friction from torque logs, with standard errors; evaluated on data that the fit did not use."""

from __future__ import annotations

import argparse

from tau_dyn.cli.common import (
    Outcome,
    add_common,
    add_robot,
    format_command_line,
    list_written_files,
    load_robot_from,
    show_progress,
)
from tau_dyn.cli.fitting import (
    add_engine,
    add_fitting,
    collect_fitting_inputs,
    collect_fitting_options,
    open_fitting_logs,
)
from tau_dyn.scale import count_cores

HELP = "masses and friction from torque logs"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    add_fitting(
        parser,
        model="friction model: rigid (none), symmetric (.coulomb .viscous .offset), asymmetric (.._pos .._neg; default); or a "
        "model file, which gives start values and effects",
        holdout="held-out logs, for evaluation only",
        out="write the identified model here",
    )
    parser.add_argument(
        "--estimator",
        choices=("auto", "wls", "ml", "iv", "robust"),
        default="auto",
        help="wls: weighted least squares of filtered signals; ml: maximum likelihood at the full rate with encoder noise; "
        "iv: ml with instrumental variables from q_ref_J, for encoder noise that the controller feeds back; robust: ml with "
        "outlier weights; auto (default): iv or ml if the residual is consistent with noise, else wls",
    )
    add_engine(parser)
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Identify."""
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.identify import BlockExecutor, identify

        robot = load_robot_from(args)
        logs, held = open_fitting_logs(args)
        options = collect_fitting_options(args) | {"estimator": args.estimator}
        found = identify(
            robot,
            logs,
            holdout=held,
            progress=step,
            engine=BlockExecutor(args.jobs or count_cores(), args.cluster),
            **options,
        )
    return Outcome(
        result=found.to_dict(),
        warnings=found.warnings,
        inputs=collect_fitting_inputs(args, logs, held),
        show=lambda console: _show(console, found, args),
        files={args.out: found.model.save} if args.out else {},
        report=lambda: _page(found),
    )


def _show(console, found, args: argparse.Namespace) -> None:
    from tau_dyn.render import print_result

    print_result(console, found, list_written_files(args, model=args.out))
    console.print(f"estimator: {found.estimator}")


def _page(found) -> str:
    from tau_dyn.render import build_page

    return build_page(found, command_line=format_command_line())
