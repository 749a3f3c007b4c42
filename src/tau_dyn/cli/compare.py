"""Two runs, results or models: what changed in parameters, errors and findings, by more than chance, and what was different."""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli.common import Outcome, add_common, format_command_line, show_progress

HELP = "what changed between two runs, results or models, with intervals"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    text = "a run folder (--out FOLDER/), the --json result of a command, or a model file (.yaml)"
    parser.add_argument("a", metavar="A", type=Path, help=text)
    parser.add_argument("b", metavar="B", type=Path, help="another one")
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Compare two files."""
    with show_progress(args.quiet) as step:
        step("comparing")
        from tau_dyn.compare import compare, read_side
        from tau_dyn.render import build_page, print_result

        found = compare(read_side(args.a), read_side(args.b))
    return Outcome(
        result=found.to_dict(),
        warnings=found.warnings,
        inputs=[found.a.path, found.b.path],
        show=lambda console: print_result(console, found),
        report=lambda: build_page(found, command_line=format_command_line()),
    )
