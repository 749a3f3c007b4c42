"""What `identify` and `diagnose` share: the logs, the model to fit, and what is chosen about its parameters."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from tau_dyn.cli.common import get_robot_file
from tau_dyn.cli.kinds import whole_number
from tau_dyn.exceptions import InputError

if TYPE_CHECKING:
    from tau_dyn.log import Log, Recording


def add_fitting(parser: argparse.ArgumentParser, *, model: str, holdout: str, out: str) -> None:
    """Add the arguments of fitting a model to logs; the texts say what model, held-out logs and written model are for."""
    parser.add_argument(
        "logs",
        metavar="LOG",
        nargs="+",
        help="CSV, Parquet, MCAP, a ROS bag or .mat with t, q_JOINT, tau_JOINT; or a folder of Parquet files; each log is "
        "processed separately",
    )
    parser.add_argument("--holdout", metavar="LOG", nargs="+", action="extend", default=[], help=holdout)
    parser.add_argument("--columns", metavar="MAP.yaml", type=Path, help="how to read foreign column names and units")
    parser.add_argument("--model", default="asymmetric", help=model)
    parser.add_argument("--out", metavar="MODEL.yaml", type=Path, help=out)
    choices = parser.add_argument_group("parameters, by name or pattern")
    choices.add_argument(
        "--fix",
        metavar="NAME[=VALUE[+-SIGMA]]",
        action="append",
        default=[],
        help="hold the nominal value, set a value, or give a value measured beforehand with its standard error",
    )
    choices.add_argument(
        "--free",
        metavar="NAME",
        action="append",
        default=[],
        help="estimate what is fixed by default, such as *.armature",
    )
    choices.add_argument("--bound", metavar="NAME=LO:HI", action="append", default=[], help="constrain the estimate")
    parser.add_argument(
        "--exclude",
        metavar="COLUMN",
        action="append",
        default=[],
        help="leave out samples where this column is not zero",
    )


def add_engine(parser: argparse.ArgumentParser) -> None:
    """Add who computes recordings that are larger than memory."""
    group = parser.add_argument_group("large recordings, which are read block by block")
    group.add_argument("--jobs", metavar="N", type=whole_number, default=0, help="threads (default: one a core)")
    group.add_argument(
        "--cluster",
        metavar="tcp://HOST:PORT",
        help="a Dask scheduler whose workers see the same files; 'local' starts one here with N processes",
    )


def open_fitting_logs(args: argparse.Namespace) -> tuple[list[Log | Recording], list[Log | Recording]]:
    """Return the logs to fit and those held out; large ones stay on disk."""
    from tau_dyn.log import open_log

    logs, held = ([open_log(path, args.columns) for path in paths] for paths in (args.logs, args.holdout))
    return logs, held


def read_fitting_logs(args: argparse.Namespace) -> tuple[list[Log], list[Log]]:
    """Return the logs to fit and those held out, in memory."""
    from tau_dyn.log import Log

    opened = open_fitting_logs(args)
    for log in (*opened[0], *opened[1]):
        if not isinstance(log, Log):
            raise InputError(
                "file_too_large",
                f"{log.name} has {log.n_samples} samples, too many for this command; give an excerpt (identify takes it whole)",
            )
    logs, held = ([log for log in found if isinstance(log, Log)] for found in opened)
    return logs, held


def collect_fitting_options(args: argparse.Namespace) -> dict:
    """Return what `identify` and `diagnose` take by name, besides the logs."""
    from tau_dyn.identify import Choices

    choices = Choices(tuple(args.fix), tuple(args.free), tuple(args.bound))
    return {"model": args.model, "choices": choices, "exclude": tuple(args.exclude), "seed": args.seed}


def collect_fitting_inputs(args: argparse.Namespace, logs, held) -> list[Path | tuple[str, str]]:
    """Return every file that went in, logs with the hash that their reader knows."""
    read = [(str(path), log.sha256) for path, log in zip([*args.logs, *args.holdout], [*logs, *held], strict=True)]
    others = [args.columns, Path(args.model)]
    return [*get_robot_file(args), *read, *(p for p in others if p is not None and p.is_file())]
