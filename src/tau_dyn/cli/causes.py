"""The causes that `diagnose` and `calibrate` can name, with the law of each and the motion that reveals it."""

from __future__ import annotations

import argparse

from tau_dyn.cli.common import Outcome, add_common
from tau_dyn.exceptions import UnknownName

HELP = "the causes that can be named, or one of them in full"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("cause", metavar="CAUSE", nargs="?", help="one cause in full, such as stribeck")
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """List causes."""
    rows = _list_causes()
    if args.cause is not None:
        rows = [row for row in rows if row["cause"] == args.cause] or _refuse(args.cause, rows)
    return Outcome(result={"causes": rows}, show=lambda console: _show(console, rows, whole=args.cause is not None))


def _refuse(cause: str, rows: list[dict[str, str]]) -> list[dict[str, str]]:
    raise UnknownName("cause", cause, dict.fromkeys(row["cause"] for row in rows))


def _list_causes() -> list[dict[str, str]]:
    """Return one row a cause and a measurement that shows it."""
    from tau_dyn.calibrate import CAUSE_EQUATIONS
    from tau_dyn.diagnose import PARAMETER_CAUSES
    from tau_dyn.effects import EFFECTS, describe_ranges

    rows = [
        {"cause": name, "named_by": "diagnose", "equation": effect.equation, "range": describe_ranges(effect.plausible),
         "revealed_by": effect.reveals}
        for name, effect in EFFECTS.items()
        if effect.cause
    ]  # fmt: skip
    empty = {"range": "", "revealed_by": ""}
    rows += [{"cause": n, "named_by": "diagnose", "equation": x, **empty} for n, x in PARAMETER_CAUSES.items()]
    return rows + [{"cause": n, "named_by": "calibrate", "equation": x, **empty} for n, x in CAUSE_EQUATIONS.items()]


def _show(console, rows: list[dict[str, str]], *, whole: bool) -> None:
    from rich.table import Table
    from rich.text import Text

    if whole:
        for row in rows:
            for key, value in row.items():
                if value:
                    console.print(Text(f"{key.replace('_', ' ') + ':':<13} {value}"))
        return
    table = Table("cause", "named by", "law", box=None, pad_edge=False)
    for row in rows:
        table.add_row(Text(row["cause"]), Text(row["named_by"]), Text(row["equation"]))
    console.print(table)
