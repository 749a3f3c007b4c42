"""`tau-dyn robots`, `causes`, `data` and `compare`: lists of built-in content, and differences between runs."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from tau_dyn.cli.arguments import FolderOutput, Output, RobotOptions, read_arguments
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError, TauDynError, UnknownName


def robots(
    robot: str | None = None,
    /,
    *,
    set: Annotated[tuple[str, ...], Parameter(metavar="NAME=VALUE")] = (),
    no_xacro: bool = False,
    output: FolderOutput = FolderOutput(),
) -> Outcome:
    """The built-in robots, or joints, masses and dimensions of one robot.

    Args:
        robot: List its joints, masses and the names that --set takes
        set: Other values, such as prototype=d1
        no_xacro: Refuse xacro files, because they run code
    """
    if robot:
        return _list_dimensions(robot, set, no_xacro)
    if set:
        raise InputError("bad_option", "--set goes with a ROBOT whose arguments and dimensions are listed")
    from tau_dyn.robot import describe_robot, list_robots, list_stock_robots

    stock = list_stock_robots()
    rows = [
        {"name": name, "file": str(path), "from": "example-robot-data" if name in stock else "tau_dyn",
         "about": describe_robot(path)}
        for name, path in list_robots().items()
    ]  # fmt: skip
    return Outcome(result={"robots": rows}, show=lambda console, written: _show_robots(console, rows))


def _list_dimensions(robot: str, given: tuple[str, ...], no_xacro: bool) -> Outcome:
    """List arguments and dimensions of one robot, and its joints and bodies if the file can be loaded without further options."""
    from tau_dyn.render import print_result
    from tau_dyn.robot import find_robot, list_dimensions

    found = list_dimensions(find_robot(robot), read_arguments(given), evaluate=not no_xacro)
    rows = [{"name": name, "value": value} for name, value in found.items()]
    options = RobotOptions(set=given, no_xacro=no_xacro)
    try:
        machine, warnings = options.load(robot), ()
    except TauDynError as fault:
        machine, warnings = None, (str(fault),)

    def show(console, written) -> None:
        _show_dimensions(console, rows)
        if machine is not None:
            print_result(console, machine)

    return Outcome(
        result={"robot": robot, "dimensions": rows}, warnings=warnings, inputs=options.list_files(robot), show=show
    )


def _show_table(console, rows: Iterable[dict[str, str]], **columns: str) -> None:
    """Print rows; `columns` are the shown keys and their headers."""
    from rich.table import Table
    from rich.text import Text

    table = Table(*columns.values(), box=None, pad_edge=False)
    for row in rows:
        table.add_row(*(Text(row[key]) for key in columns))
    console.print(table)


def _show_dimensions(console, rows: list[dict[str, str]]) -> None:
    if rows:
        _show_table(console, rows, name="--set name", value="value")
    else:
        console.print("no xacro arguments and no tables of dimensions")


def _show_robots(console, rows: list[dict[str, str]]) -> None:
    _show_table(console, (row for row in rows if row["from"] == "tau_dyn"), name="name", about="about")
    for package in sorted({row["from"] for row in rows} - {"tau_dyn"}):
        names = ", ".join(row["name"] for row in rows if row["from"] == package)
        console.print(f"\n{package}: {names}", markup=False)


def causes(cause: str | None = None, /, *, output: FolderOutput = FolderOutput()) -> Outcome:
    """The causes that `diagnose` and `calibrate` can name, with the law of each and the motion that reveals it.

    Args:
        cause: One cause in full, such as stribeck
    """
    from tau_dyn.effects import list_causes

    rows = list_causes()
    if cause is not None:
        known = dict.fromkeys(row["cause"] for row in rows)
        if cause not in known:
            raise UnknownName("cause", cause, known)
        rows = [row for row in rows if row["cause"] == cause]
    return Outcome(
        result={"causes": rows}, show=lambda console, written: _show_causes(console, rows, whole=cause is not None)
    )


def _show_causes(console, rows: list[dict[str, str]], *, whole: bool) -> None:
    if not whole:
        _show_table(console, rows, cause="cause", named_by="named by", equation="law")
        return
    for key, value in ((key, value) for row in rows for key, value in row.items() if value):
        console.print(f"{key.replace('_', ' ') + ':':<13} {value}", markup=False)


def data(
    name: str | None = None,
    /,
    *,
    folder: Annotated[Path | None, Parameter(name="--out", metavar="DIR")] = None,
    output: Output = Output(),
) -> Outcome:
    """Public measured logs of robots; with NAME, its logs, robot file and column map in a folder.

    Files come from $TAU_DYN_DATA/NAME if they are there, else from their published address (extra `data`).

    Args:
        name: One of the listed names, such as emps
        folder: Write the files here (default: a folder of that name)
    """
    from tau_dyn.measured_data import fetch_data, list_sets

    if name is None:
        if folder is not None:
            raise InputError("bad_option", "--out goes with a NAME; `tau-dyn data` alone lists the names")
        rows = [one.to_dict() for one in list_sets()]
        return Outcome(result={"data": rows}, show=lambda console, written: _show_sets(console, rows))
    with show_progress(output.quiet) as step:
        step("collecting the files")
        found = fetch_data(name, folder, step)
    lines = [
        f"{found.set.about}; {len(found.files)} files -> {found.folder}",
        f"Licence: {found.set.licence}. Source: {found.set.source}",
        f"Question: {found.set.question}",
        "",
        "Next:",
        *(f"  {command}" for command in found.next),
    ]

    def show(console, written) -> None:
        for line in lines:
            console.print(line, markup=False, soft_wrap=True)

    return Outcome(result=found.to_dict(), warnings=found.warnings, show=show)


def _show_sets(console, rows: list[dict[str, Any]]) -> None:
    """Print the sets as a table: name, size, question, licence."""
    shown = [{**row, "size": _format_size(row["bytes"]) + ("" if row["downloadable"] else " *")} for row in rows]
    _show_table(console, shown, name="name", size="size", question="what it answers", licence="licence")
    console.print("\n* only from $TAU_DYN_DATA: published in a form that is not read", markup=False)
    console.print("`tau-dyn data NAME` writes logs, robot file and column map into a folder", markup=False)


def _format_size(n_bytes: int) -> str:
    return f"{n_bytes / 1e6:.1f} MB" if n_bytes >= 1e5 else f"{n_bytes / 1e3:.0f} kB"


Side = Annotated[
    Path, Parameter(help="A run folder (--out FOLDER/), the --json result of a command, or a model file (.yaml)")
]


def compare(a: Side, b: Side, /, *, output: FolderOutput = FolderOutput()) -> Outcome:
    """Significant changes between two runs, results or models in parameters, errors and findings."""
    with show_progress(output.quiet) as step:
        step("comparing")
        from tau_dyn.compare import compare as compare_sides, read_side

        found = compare_sides(read_side(a), read_side(b))

    return Outcome(result=found.to_dict(), warnings=found.warnings, inputs=[found.a.path, found.b.path], found=found)
