"""Two models or results: what changed in parameters, errors and findings, and whether by more than chance."""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli.common import Outcome, add_common, command_line, progress

HELP = "what changed between two models or results, with intervals"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    text = "a model file (.yaml) or the --json result of identify, diagnose, modes or calibrate"
    parser.add_argument("a", metavar="A", type=Path, help=text)
    parser.add_argument("b", metavar="B", type=Path, help="another one")
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Compare two files."""
    with progress(args.quiet) as step:
        step("comparing")
        from tau_dyn.compare import compare, read_side
        from tau_dyn.report.comparison import comparison_page, print_comparison

        found = compare(read_side(args.a), read_side(args.b))
    return Outcome(
        result=found.to_dict(),
        warnings=found.warnings,
        inputs=[args.a, args.b],
        show=lambda console: print_comparison(console, found),
        report=lambda: comparison_page(found, command_line=command_line()),
    )
