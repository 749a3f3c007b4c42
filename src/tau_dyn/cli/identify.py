"""Masses and friction from torque logs, with uncertainty, judged on data the fit never saw."""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli.common import Outcome, add_common, add_robot, command_line, load_robot_from, progress, robot_file

HELP = "masses and friction from torque logs"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    parser.add_argument(
        "logs", metavar="LOG", nargs="+", help="CSV or Parquet with t, q_JOINT, tau_JOINT; never joined"
    )
    parser.add_argument(
        "--holdout",
        metavar="LOG",
        nargs="+",
        action="extend",
        default=[],
        help="logs to judge on, used for nothing else",
    )
    parser.add_argument("--columns", metavar="MAP.yaml", type=Path, help="how to read foreign column names and units")
    parser.add_argument(
        "--model",
        default="asymmetric",
        help="rigid, symmetric (.coulomb .viscous .offset), asymmetric (.._pos .._neg; default), or a model file",
    )
    parser.add_argument("--out", metavar="MODEL.yaml", type=Path, help="write the identified model here")
    choices = parser.add_argument_group("parameters, by name or pattern")
    choices.add_argument(
        "--fix",
        metavar="NAME[=VALUE[+-SIGMA]]",
        action="append",
        default=[],
        help="keep, set, or say what was measured beforehand",
    )
    choices.add_argument(
        "--free",
        metavar="NAME",
        action="append",
        default=[],
        help="estimate what is fixed by default, such as *.armature",
    )
    choices.add_argument("--bound", metavar="NAME=LO:HI", action="append", default=[], help="keep within")
    parser.add_argument(
        "--exclude",
        metavar="COLUMN",
        action="append",
        default=[],
        help="leave out samples where this column is not zero",
    )
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Identify."""
    with progress(args.quiet) as step:
        step("loading")
        from tau_dyn.identify import Choices, identify
        from tau_dyn.log import read_log

        robot = load_robot_from(args)
        train, held = ([read_log(path, args.columns) for path in paths] for paths in (args.logs, args.holdout))
        found = identify(
            robot,
            train,
            holdout=held,
            model=args.model,
            choices=Choices(tuple(args.fix), tuple(args.free), tuple(args.bound)),
            exclude=tuple(args.exclude),
            seed=args.seed,
            progress=step,
        )
    logs = [(str(path), log.sha256) for path, log in zip([*args.logs, *args.holdout], [*train, *held], strict=True)]
    others = [args.columns, Path(args.model)]
    files = [*robot_file(args), *logs, *(p for p in others if p is not None and p.is_file())]
    return Outcome(
        result=found.to_dict(),
        warnings=found.warnings,
        inputs=files,
        show=lambda console: _show(console, found, args),
        files={args.out: found.model.save} if args.out else {},
        report=lambda: _page(found),
    )


def _show(console, found, args: argparse.Namespace) -> None:
    from tau_dyn.report import print_identification

    written = {"model": args.out, "report": args.report, "result": args.json}
    print_identification(console, found, {k: str(v) for k, v in written.items() if v})


def _page(found) -> str:
    from tau_dyn.report import identification_page

    return identification_page(found, command_line=command_line())
