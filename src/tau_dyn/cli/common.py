"""What all commands share: arguments, the robot, progress, and the `Outcome` that a command's `run` hands to `execute.py`."""

from __future__ import annotations

import argparse
import difflib
import json
import math
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from rich.console import Console

from tau_dyn.cli.run_folder import out_argument
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
_NEGATIVE = re.compile(r"^-(\d|\.\d)")


class Parser(argparse.ArgumentParser):
    """A parser whose faults are one sentence, like all others."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Take `-1e-3` for a number: argparse before Python 3.14 takes it for an option."""
        self.writes = False
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = _NEGATIVE

    def add_argument(self, *names: Any, **options: Any) -> argparse.Action:
        """Add an argument; `--out` also takes a run folder, in which the command's own file is called as its metavar."""
        if "--out" in names:
            shown, self.writes = options.get("metavar", "FILE"), True
            options["type"] = out_argument(options.get("type", Path), shown)
            if shown not in ("DIR", "FOLDER/"):
                options["help"] = f"{options.get('help', '')}; FOLDER/ takes it with result, report and run.json"
            self.set_defaults(own_file=shown.lower() if Path(shown).suffix else "")
        return super().add_argument(*names, **options)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse what a command does not know itself, so that its own help is named."""
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            near = did_you_mean(unknown[0], re.findall(r"--[\w-]+", self.format_usage()))
            self.error(f"there is no {unknown[0]} here{near}")
        return known, unknown

    def error(self, message: str) -> NoReturn:
        """Raise instead of printing usage and leaving; in words that say what would be right."""
        raise InputError(f"{self.prog}: {_in_words(message)}; see {self.prog} --help")


_KINDS = {
    "whole_number": "a whole number from zero up",
    "positive": "a number above zero",
    "positive_large": "a number above zero",
    "not_negative": "zero or a number above it",
    "positive_whole": "a whole number above zero",
    "number_of_poses": "a whole number above zero, or auto",
    "finite": "a finite number",
    "float": "a number",
    "int": "a whole number",
    "_port": "a port between 1 and 65535",
    "port": "a port between 1 and 65535",
}
"""What the readers of arguments take, for messages."""


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """Return a question about the nearest known word, in brackets; nothing where none is near."""
    near = difflib.get_close_matches(word, known, n=1)
    return f" (did you mean {near[0]}?)" if near else ""


def _in_words(message: str) -> str:
    """Return argparse's message as a person would say it."""
    if match := re.match(r"argument (.+?): invalid (\w+) value: (.+)$", message):
        kind = _KINDS.get(match[2], match[2].strip("_").replace("_", " "))
        return f"{match[1]} {match[3]}: write {kind}"
    if match := re.match(r"argument (.+?): invalid choice: '?(.+?)'? \(choose from (.+)\)$", message):
        known = [word.strip("' ") for word in match[3].split(",")]
        what = match[1].lower() if match[1] == "COMMAND" else match[1]
        return f"there is no {what} '{match[2]}'{did_you_mean(match[2], known)}; there are {', '.join(known)}"
    if match := re.match(r"the following arguments are required: (.+)$", message):
        if match[1] == "COMMAND":
            return "name a command, such as demo"
        return f"{' and '.join(match[1].rsplit(', ', 1))} {'are' if ',' in match[1] else 'is'} missing"
    return re.sub(r"^argument (\S+): ", r"\1 ", message)


def whole_number(text: str) -> int:
    """Read a whole number from zero up."""
    value = int(text)
    if value < 0:
        raise ValueError
    return value


def positive(text: str) -> float:
    """Read a positive number of sensible size."""
    value = float(text)
    if not 0 < value < 1e9:
        raise ValueError
    return value


def not_negative(text: str) -> float:
    """Read zero or a positive number of sensible size."""
    return 0.0 if float(text) == 0 else positive(text)


def csv_file(text: str) -> Path:
    """Read the name of a CSV file to write."""
    if Path(text).suffix.lower() != ".csv":
        raise argparse.ArgumentTypeError(f"'{text}' must end in .csv, which is what is written")
    return Path(text)


def add_common(parser: argparse.ArgumentParser) -> None:
    """Add the options that every command takes."""
    if isinstance(parser, Parser) and not parser.writes:
        parser.add_argument("--out", metavar="FOLDER/", help=_RUN_FOLDER)
    group = parser.add_argument_group("output")
    group.add_argument("--json", metavar="FILE", type=Path, help="write the result here")
    group.add_argument("--report", metavar="FILE.html", type=Path, help="write one self-contained page here")
    group.add_argument("--seed", type=whole_number, default=0, help="seed of everything random (default 0)")
    group.add_argument("--quiet", action="store_true", help="no progress, no result on the screen; warnings stay")


def add_robot(parser: argparse.ArgumentParser, *, optional: bool = False) -> None:
    """Add the robot and what belongs to loading it."""
    text = "a .urdf or .urdf.xacro file, or the short name of a robot that comes along (a xacro is code: it evaluates Python)"
    parser.add_argument("robot", metavar="ROBOT", nargs="?" if optional else None, help=text)
    add_robot_options(parser)


def add_robot_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of loading a robot."""
    parser.add_argument(
        "--set", metavar="NAME=VALUE", action="append", default=[], help="xacro argument, such as prototype=d1"
    )
    parser.add_argument(
        "--actuated",
        metavar="JOINT",
        nargs="+",
        action="extend",
        help="actuated joints, if not those with a <transmission>",
    )
    parser.add_argument(
        "--no-xacro",
        action="store_true",
        help="take plain URDF only: a xacro is code, and is refused (those that come along, too)",
    )


def load_robot_from(args: argparse.Namespace):
    """Load the robot that the arguments name."""
    from tau_dyn.robot import load_robot

    given = {}
    for text in args.set:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise InputError(f"--set {text}: write NAME=VALUE, such as prototype=d1")
        given[name] = value
    if "actuated" in given:
        raise InputError("--set actuated=...: actuated joints are named with --actuated JOINT ...")
    if "xacro" in given:
        raise InputError("--set xacro=...: --no-xacro refuses every xacro")
    return load_robot(args.robot, actuated=args.actuated, xacro=not args.no_xacro, **given)


def robot_file(args: argparse.Namespace) -> list[Path]:
    """Return the robot's file, for the list of inputs."""
    from tau_dyn.robot.expand import find_robot

    return [find_robot(args.robot)]


def command_line() -> str:
    """Return how the program was called, for a page's provenance."""
    return shlex.join(["tau-dyn", *sys.argv[1:]])


@contextmanager
def progress(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show a spinner with the current step on stderr, if somebody watches."""
    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield lambda step: None
        return
    with console.status("...") as status:
        yield lambda step: status.update(step)


def to_json(value: Any) -> str:
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
