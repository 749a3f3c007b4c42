"""The robots that a command takes by name, and what `--set` takes for one of them."""

from __future__ import annotations

import argparse

from tau_dyn.cli.common import Outcome, add_common, get_robot_file, read_arguments
from tau_dyn.exceptions import InputError

HELP = "list built-in and installed robots by name, or the arguments and dimensions of one"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("robot", metavar="ROBOT", nargs="?", help="list what --set takes for it, with values")
    parser.add_argument(
        "--set", metavar="NAME=VALUE", action="append", default=[], help="with other values, such as prototype=d1"
    )
    parser.add_argument("--no-xacro", action="store_true", help="refuse xacro files, for they run code")
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """List robots, or what one takes."""
    if args.robot:
        return _list_dimensions(args)
    if args.set:
        raise InputError("bad_option", "--set goes with a ROBOT whose arguments and dimensions are listed")
    from tau_dyn.robot import describe_robot, list_robots, list_stock_robots

    stock = list_stock_robots()
    rows = [
        {"name": name, "file": str(path), "from": "example-robot-data" if name in stock else "tau_dyn",
         "about": describe_robot(path)}
        for name, path in list_robots().items()
    ]  # fmt: skip
    return Outcome(result={"robots": rows}, show=lambda console: _show(console, rows))


def _list_dimensions(args: argparse.Namespace) -> Outcome:
    """List arguments and dimensions of one robot."""
    from tau_dyn.robot import find_robot, list_dimensions

    path = find_robot(args.robot)
    found = list_dimensions(path, read_arguments(args.set), evaluate=not args.no_xacro)
    rows = [{"name": name, "value": value} for name, value in found.items()]
    return Outcome(
        result={"robot": args.robot, "dimensions": rows},
        inputs=get_robot_file(args),
        show=lambda console: _show_dimensions(console, rows),
    )


def _show_dimensions(console, rows: list[dict[str, str]]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table("--set name", "value", box=None, pad_edge=False)
    for row in rows:
        table.add_row(Text(row["name"]), Text(row["value"]))
    console.print(table if rows else Text("no xacro arguments and no tables of dimensions"))


def _show(console, rows: list[dict[str, str]]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table("name", "about", box=None, pad_edge=False)
    for row in rows:
        if row["from"] == "tau_dyn":
            table.add_row(Text(row["name"]), Text(row["about"]))
    console.print(table)
    others = sorted({row["from"] for row in rows} - {"tau_dyn"})
    for package in others:
        names = ", ".join(row["name"] for row in rows if row["from"] == package)
        console.print(Text(f"\n{package}: {names}"))
