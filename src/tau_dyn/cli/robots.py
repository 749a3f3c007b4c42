"""The robots that a command takes by name: those that come along, and those of the installed `example-robot-data`."""

from __future__ import annotations

import argparse

from tau_dyn.cli.common import Outcome, add_common

HELP = "list built-in and installed robots by name"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """List robots."""
    from tau_dyn.robot import describe_robot, list_robots, list_stock_robots

    stock = list_stock_robots()
    rows = [
        {"name": name, "file": str(path), "from": "example-robot-data" if name in stock else "tau_dyn",
         "about": describe_robot(path)}
        for name, path in list_robots().items()
    ]  # fmt: skip
    return Outcome(result={"robots": rows}, show=lambda console: _show(console, rows))


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
