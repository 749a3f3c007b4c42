"""What `fk` and `ik` share: numbers on the command line, tables of poses read, and the outcome."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from tau_dyn.cli.common import Outcome, add_common, format_command_line, get_robot_file, list_written_files
from tau_dyn.cli.kinds import read_csv_file_name
from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes


def add_table_options(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the table to read and the one to write."""
    parser.add_argument("--poses", metavar="POSES.csv", type=Path, help=f"a table of {what}, one a row")
    parser.add_argument(
        "--out", metavar="POSES.csv", type=read_csv_file_name, help="write q_<joint>, x_tool .. qw_tool, reason here"
    )
    add_common(parser)


def read_columns(path: Path) -> dict[str, np.ndarray]:
    """Read a table's columns by name."""
    from tau_dyn.log import parse_delimited

    try:
        data = read_bytes(path)
    except OSError as fault:
        raise InputError("cannot_read", f"{path}: cannot be read ({fault.strerror})") from fault
    return parse_delimited(str(path), data)[0]


def build_outcome(table, args: argparse.Namespace) -> Outcome:
    """Return what to print and write."""
    from tau_dyn.render import build_page, print_result

    return Outcome(
        result=table.to_dict(),
        warnings=[*table.robot.warnings, *table.warnings],
        inputs=[*get_robot_file(args), *([args.poses] if args.poses else [])],
        show=lambda console: print_result(console, table, list_written_files(args, table=args.out)),
        files={args.out: table.to_csv()} if args.out else {},
        report=lambda: build_page(table, command_line=format_command_line()),
    )
