"""What all commands share: arguments, faults as one line, results as JSON, and files that appear whole or not at all.

A command's `run` returns an `Outcome`; nothing is written before it is complete. Exit status: 0 the answer stands, 2 the
input is at fault (no file written), 3 the data cannot answer (`--json` is written and says so), 1 a defect of ours.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from rich.console import Console

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.files import write_whole, writing_whole
from tau_dyn.version import __version__


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


_NEGATIVE = re.compile(r"^-(\d|\.\d)")


class Parser(argparse.ArgumentParser):
    """A parser whose faults are one sentence, like all others."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Take `-1e-3` for a number: argparse before Python 3.14 takes it for an option."""
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = _NEGATIVE

    def error(self, message: str) -> NoReturn:
        """Raise instead of printing usage and leaving."""
        raise InputError(f"{self.prog}: {message}; see {self.prog} --help")


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
    return load_robot(args.robot, actuated=args.actuated, **given)


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


class _Screen(Console):
    """A console whose reader may leave early, as `head` does."""

    def on_broken_pipe(self) -> NoReturn:
        """Leave quietly: everything was written already."""
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0)


def execute(command: str, run: Callable[[argparse.Namespace], Outcome], args: argparse.Namespace) -> int:
    """Run a command, print, write, and return the exit status."""
    out = getattr(args, "out", None) if command != "demo" else None  # the demo makes its folder
    proposed = getattr(args, "propose", None)
    destinations = [p for p in (args.json, args.report, out, proposed) if p is not None]
    for path in destinations:
        if not path.resolve().parent.is_dir():
            raise InputError(f"{path}: the folder {path.parent} does not exist")
        if path.is_dir():
            raise InputError(f"{path} is a folder; name a file")
    if len({path.resolve() for path in destinations}) < len(destinations):
        raise InputError("two outputs are to be written to one file; give each its own")
    for path in destinations:
        if path.resolve() in _given(args):
            raise InputError(f"{path} is an input of this command and would be overwritten; name another file")
    try:
        outcome = run(args)
    except CannotAnswer as fault:
        _cannot_answer(command, args, fault)
        return fault.exit_status
    if args.report is not None and outcome.report is None:
        raise InputError(f"tau-dyn {command} has no report; leave --report out")
    report = outcome.report() if args.report is not None and outcome.report else None
    _write(command, args, outcome, report)
    errors = Console(stderr=True, soft_wrap=True, highlight=False)
    for sentence in dict.fromkeys(outcome.warnings):
        errors.print(f"warning: {sentence}", markup=False)
    if not args.quiet:
        outcome.show(_Screen(soft_wrap=False, highlight=False))
    return outcome.exit_status


def _given(args: argparse.Namespace) -> set[Path]:
    """Return every file that the arguments name as an input."""
    single = (
        getattr(args, name, None)
        for name in (
            "robot",
            "log",
            "columns",
            "effects",
            "model",
            "motion",
            "controller",
            "noise_from",
            "a",
            "b",
            "errors",
            "poses",
            "obstacles",
            "result",
            "cloud",
            "positions",
            "cameras",
        )  # fmt: skip
    )
    named = (text.partition("=")[2] or text for text in getattr(args, "measured", None) or [])  # JOINT=FILE or FILE
    many = [*(getattr(args, "logs", None) or []), *(getattr(args, "holdout", None) or []), *named]
    return {Path(item).resolve() for item in (*single, *many) if item is not None and Path(item).is_file()}


def _write(command: str, args: argparse.Namespace, outcome: Outcome, report: str | None) -> None:
    files = dict(outcome.files)
    if report is not None:
        files[args.report] = report
    if args.json is not None:
        files[args.json] = to_json(envelope(command, args, outcome.inputs, "ok", outcome.warnings) | outcome.result)
    with ExitStack() as staged:  # all are complete before the first takes its place
        for path, content in files.items():
            temporary = staged.enter_context(writing_whole(path))
            if isinstance(content, str):
                temporary.write_text(content, encoding="utf-8")
            else:
                content(temporary)


def _cannot_answer(command: str, args: argparse.Namespace, fault: CannotAnswer) -> None:
    errors = Console(stderr=True, soft_wrap=True, highlight=False)
    for sentence in fault.warnings:
        errors.print(f"warning: {sentence}", markup=False)
    errors.print(f"cannot answer: {fault.missing}. The experiment that would: {fault.experiment}.", markup=False)
    if args.json is not None:
        inputs = [Path(p) for p in getattr(args, "logs", [])]
        result = envelope(command, args, inputs, "cannot_answer", fault.warnings)
        write_whole(args.json, to_json(result | {"missing": fault.missing, "experiment": fault.experiment}))


def envelope(
    command: str,
    args: argparse.Namespace,
    inputs: Sequence[Path | tuple[str, str]],
    status: str,
    warnings: Sequence[str],
) -> dict[str, Any]:
    """Return what every result says of itself."""
    return {
        "tool_version": __version__,
        "command": command,
        "inputs": [{"path": path, "sha256": sha256} for path, sha256 in map(_hashed, inputs) if sha256],
        "seed": args.seed,
        "status": status,
        "warnings": list(dict.fromkeys(warnings)),
    }


def _hashed(item: Path | tuple[str, str]) -> tuple[str, str]:
    if isinstance(item, tuple):
        return item
    return str(item), hashlib.sha256(item.read_bytes()).hexdigest() if item.is_file() else ""


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
