"""What all commands share: arguments, the robot, progress, and the `Outcome` that a command's `run` hands to `execute.py`."""

from __future__ import annotations

import argparse
import json
import math
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tau_dyn.cli.kinds import whole_number
from tau_dyn.cli.parser import Parser
from tau_dyn.exceptions import InputError


@dataclass
class Outcome:
    """What a command has to say, before anything is written.

    Attributes:
        result: The command's part of the JSON result.
        warnings: Sentences.
        inputs: Files read; or pairs of path and hash, where a reader knows the hash already.
        show: Prints the result for a person on a console.
        files: What to write: path -> text, or a function that writes to the path given.
        report: Makes the report page's text; None if the command has none.
        exit_status: 0 where the answer stands; 3 where the data cannot tell, and `result` says so in its own `status`.
    """

    result: dict[str, Any] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    inputs: Sequence[Path | tuple[str, str]] = ()
    show: Callable[[Console], None] = lambda console: None
    files: dict[Path, str | Callable[[Path], None]] = field(default_factory=dict)
    report: Callable[[], str] | None = None
    exit_status: int = 0


_RUN_FOLDER = "result, report and run.json (what went in, options, versions) go here"


def add_common(parser: argparse.ArgumentParser) -> None:
    """Add the options that every command takes."""
    if isinstance(parser, Parser) and not parser.writes:
        parser.add_argument("--out", metavar="FOLDER/", help=_RUN_FOLDER)
    group = parser.add_argument_group("output")
    group.add_argument("--json", metavar="FILE", type=Path, help="write the result here")
    group.add_argument("--report", metavar="FILE.html", type=Path, help="write one self-contained page here")
    group.add_argument("--seed", type=whole_number, default=0, help="seed of everything random (default 0)")
    group.add_argument("--quiet", action="store_true", help="no progress, no result on the screen; warnings stay")


def add_robot(parser: argparse.ArgumentParser, *, or_model: str = "") -> None:
    """Add the robot and what belongs to loading it; where a model file is taken as well, `or_model` says what it brings."""
    code = "(a xacro is code: it evaluates Python)"
    text = f"a .urdf or .urdf.xacro file, or a short name that `tau-dyn robots` lists {code}"
    if or_model:
        text = text.replace("file, or", "file,") + f", or a model file MODEL.yaml of identify or diagnose, {or_model}"
    parser.add_argument("robot", metavar="ROBOT", help=text)
    add_robot_options(parser)


def add_robot_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of loading a robot."""
    parser.add_argument(
        "--set",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="xacro argument or dimension, such as prototype=d1, or a .yaml of them",
    )
    parser.add_argument(
        "--actuated",
        metavar="JOINT",
        nargs="+",
        action="extend",
        help="actuated joints, if not those with a <transmission>",
    )
    parser.add_argument(
        "--tool", metavar="FRAME", help="tool frame, if not tool, tool0, tcp, ee_link or the tree's only leaf"
    )
    parser.add_argument(
        "--no-xacro",
        action="store_true",
        help="accept plain URDF only; refuse xacro files, for they run code. Built-in robots are xacro files too",
    )


def load_robot_from(args: argparse.Namespace):
    """Load the robot that the arguments name: a robot file, a robot of ours, or a calibration's `--out`."""
    from tau_dyn.robot import load_robot

    given = read_arguments(args.set)
    if "actuated" in given:
        raise InputError("bad_option", "--set actuated=...: actuated joints are named with --actuated JOINT ...")
    if "xacro" in given:
        raise InputError("bad_option", "--set xacro=...: --no-xacro refuses every xacro")
    if "tool" in given:
        raise InputError("bad_option", "--set tool=...: the tool frame is named with --tool FRAME")
    if is_model_file(args.robot):
        return _load_calibrated(args, given)
    return load_robot(args.robot, actuated=args.actuated, tool=args.tool, xacro=not args.no_xacro, **given)


def _load_calibrated(args: argparse.Namespace, given: dict[str, str]):
    """Load the robot of a calibration.

    Raises:
        InputError: A model file of another kind, or options that a calibrated robot leaves no choice of.
    """
    from tau_dyn.files import read_yaml

    content = read_yaml(args.robot)
    if not isinstance(content, dict) or "tau_dyn_calibration" not in content:
        raise InputError(
            "file_format",
            f"{args.robot}: a robot file ends in .urdf or .urdf.xacro, a calibration's begins with tau_dyn_calibration; "
            "is it a model file? Then give the robot's file first",
        )
    if given or args.actuated or args.tool:
        raise InputError("bad_option", f"{args.robot}: a calibrated robot has its arguments, joints and tool already")
    from tau_dyn.calibrate import load_calibration

    return load_calibration(args.robot).build_robot(str(args.robot))


def read_arguments(texts: Sequence[str]) -> dict[str, str]:
    """Return xacro arguments and dimensions of `--set`; NAME=VALUE counts before a file."""
    from tau_dyn.robot import read_dimensions_file

    from_files, given = {}, {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals and is_model_file(text):
            from_files |= read_dimensions_file(text)
        elif not equals or not name:
            raise InputError(
                "bad_option", f"--set {text}: write NAME=VALUE, such as prototype=d1, or name a .yaml of dimensions"
            )
        else:
            given[name] = value
    return from_files | given


def is_model_file(path: str | Path) -> bool:
    """Tell whether a path names a model file of ours rather than a robot."""
    return Path(path).suffix.lower() in (".yaml", ".yml")


def get_robot_file(args: argparse.Namespace) -> list[Path]:
    """Return the robot's or the model's file and files of dimensions, for the list of inputs."""
    from tau_dyn.robot import find_robot

    dimensions = [Path(text) for text in getattr(args, "set", []) if "=" not in text]
    return [Path(args.robot) if is_model_file(args.robot) else find_robot(args.robot), *dimensions]


def list_written_files(args: argparse.Namespace, **own: Path | None) -> dict[str, str]:
    """Return what was written and where, for the last line on the screen: a command's own files, the page, the result."""
    files = {**own, "report": args.report, "result": args.json}
    return {name.replace("_", " "): str(path) for name, path in files.items() if path}


def format_command_line() -> str:
    """Return how the program was called, for a page's provenance."""
    return shlex.join(["tau-dyn", *sys.argv[1:]])


@contextmanager
def show_progress(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show a spinner with the current step on stderr, if somebody watches."""
    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield lambda step: None
        return
    with console.status("...") as status:
        yield lambda step: status.update(step)


def format_json(value: Any) -> str:
    """Return strict JSON: arrays as lists, what is not finite as null."""
    return json.dumps(_plain(value), indent=2, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value
