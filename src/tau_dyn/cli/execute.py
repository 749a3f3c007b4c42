"""One command from its arguments to its files: outputs are checked first, all is written whole at the end, then shown.

Nothing is written before `run` has returned its `Outcome`. Exit status: 0 the answer stands, 2 the input is at fault (no file
written), 3 the data cannot answer (`--json` and the run folder say so), 1 a defect of ours.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from rich.console import Console

from tau_dyn.cli.common import Outcome, format_command_line, format_json, get_robot_file
from tau_dyn.cli.run_folder import RunFolder, collect_configuration
from tau_dyn.exceptions import CannotAnswer, InputError, format_one_line
from tau_dyn.files import compute_sha256, resolve_destination, write_atomically
from tau_dyn.message_codes import format_warnings, format_with_code
from tau_dyn.version import __version__

_TWICE = "two outputs are to be written to one file; give each its own"

_OUTPUTS = ("json", "report", "out", "propose", "save_cameras", "rapid", "resume", "corrected")
"""Arguments that name files to write."""


@dataclass(frozen=True)
class _Call:
    """A command with its arguments, and where its results go.

    Attributes:
        command: Its name.
        args: Its arguments; `out`, `json` and `report` name files, in the run folder where there is one.
        folder: The run folder, None where none was asked for.
        configuration: Its options, for the run folder.
        page_asked: Whether `--report` was given.
    """

    command: str
    args: argparse.Namespace
    folder: RunFolder | None
    configuration: dict[str, Any]
    page_asked: bool

    def destinations(self) -> list[Path]:
        """Return every file that will be written."""
        named = [getattr(self.args, name, None) for name in _OUTPUTS]
        files = [path for path in named if isinstance(path, Path)]
        if self.folder is None:
            return files
        files = [path for path in files if path != self.folder.path]
        taken = (None, self.args.json, self.args.report)
        return [*files, *(path for path, named in zip(self.folder.files(), taken, strict=True) if path != named)]


def execute(command: str, run: Callable[[argparse.Namespace], Outcome], args: argparse.Namespace) -> int:
    """Run a command, print, write, and return the exit status."""
    call = _call(command, args)
    before = _checked(call)
    refusal = None
    try:
        outcome = run(args)
    except CannotAnswer as fault:
        refusal, outcome = fault, _unanswered(args, fault)
    if call.page_asked and refusal is None and outcome.report is None:
        raise InputError("bad_option", f"tau-dyn {command} has no report; leave --report out")
    outcome.warnings = [*outcome.warnings, *_changed(outcome.inputs, before)]
    _write(call, outcome)
    errors = Console(stderr=True, soft_wrap=True, highlight=False)
    sentences = [f"warning: {format_with_code(sentence)}" for sentence in dict.fromkeys(outcome.warnings)]
    if refusal is not None:
        said = f"{refusal.missing}. The experiment that would: {refusal.experiment}."
        sentences.append(f"cannot answer: {said} [{refusal.code}]")
    with suppress(OSError):  # a screen that takes nothing; the files say it, too
        for sentence in sentences:
            errors.print(format_one_line(sentence), markup=False)
    if refusal is None and not args.quiet:
        _show(outcome)
    return outcome.exit_status


def _call(command: str, args: argparse.Namespace) -> _Call:
    """Return the call; with a run folder, what was not asked for elsewhere goes there under its usual name."""
    configuration, page_asked = collect_configuration(args), args.report is not None
    folder = getattr(args, "out", None)
    if not isinstance(folder, RunFolder):
        return _Call(command, args, None, configuration, page_asked)
    named: Any = args.own_file
    own = str(named(args) if callable(named) else named)
    args.out = folder.path / own if own else folder.path
    _, result, page = folder.files()
    args.json, args.report = args.json or result, args.report or page
    return _Call(command, args, folder, configuration, page_asked)


def _checked(call: _Call) -> dict[Path, tuple[int, int]]:
    """Refuse outputs that cannot be written or would overwrite something; return how the inputs are now."""
    folder, destinations = call.folder, call.destinations()
    for path in destinations:
        if not resolve_destination(path).parent.is_dir() and not (folder is not None and folder.holds(path)):
            raise InputError("cannot_write", f"{path}: the folder {path.parent} does not exist")
        if path.is_dir():
            raise InputError("cannot_write", f"{path} is a folder; name a file")
    if len({resolve_destination(path) for path in destinations}) < len(destinations):
        raise InputError("cannot_write", _TWICE)
    given = {path.resolve() for path in _given(call.args)}
    for path in destinations:
        if resolve_destination(path) in given:
            raise InputError(
                "cannot_write", f"{path} is an input of this command and would be overwritten; name another file"
            )
    if folder is not None:
        folder.check(call.command, call.configuration, given)
    return {path: _stamp(path) for path in given}


def _show(outcome: Outcome) -> None:
    try:
        outcome.show(_Screen(soft_wrap=False, highlight=False))
    except BrokenPipeError:
        raise
    except OSError as fault:
        raise InputError(
            "cannot_write", f"the result could not be shown ({fault.strerror}); the files asked for are written"
        ) from fault


def _given(args: argparse.Namespace) -> list[Path]:
    """Return every file that the arguments name, as they name it: all that is not an output may be an input."""
    names = [name for name in vars(args) if name not in (*_OUTPUTS, "command", "own_file")]
    values = [x for name in names for x in _flat(getattr(args, name)) if isinstance(x, str | Path) and str(x)]
    values += [x.partition("=")[2] for x in values if isinstance(x, str) and x.partition("=")[2]]  # JOINT=FILE
    items = [Path(x) for x in values]
    folders = [Path(x) for name in ("logs", "holdout", "images") for x in _flat(getattr(args, name, None)) if x]
    items += [file for folder in folders if folder.is_dir() for file in folder.iterdir()]  # a recording in pieces
    items += [path.parent / name for path in list(items) for name in _mapped_files(args)]
    return [item for item in items if _is_file(item)]


def _flat(value: Any) -> list[Any]:
    return [x for item in value for x in _flat(item)] if isinstance(value, list | tuple) else [value]


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a long text, or one with a null byte, is no file
        return False


def _mapped_files(args: argparse.Namespace) -> Sequence[str]:
    """Return the further files that a column map reads beside the log."""
    if getattr(args, "columns", None) is None:
        return ()
    from tau_dyn.log import ColumnMap

    return tuple(ColumnMap.load(args.columns).files.values())


def _stamp(path: Path) -> tuple[int, int]:
    """Return what changes when a file is written: its size and the time of its last change."""
    about = path.stat()
    return about.st_size, about.st_mtime_ns


def _changed(inputs: Sequence[Path | tuple[str, str]], before: dict[Path, tuple[int, int]]) -> list[str]:
    """Return a sentence for each input that somebody wrote to meanwhile; the hash of a log is that of what was read."""
    paths = [item.resolve() for item in inputs if isinstance(item, Path)]
    return [
        f"{path} changed while it was used; the hash in the result is that of the file as it is now"
        for path in paths
        if path in before and (not path.is_file() or _stamp(path) != before[path])
    ]


def _write(call: _Call, outcome: Outcome) -> None:
    """Write everything, the run folder last; all are complete before the first takes its place."""
    args, folder = call.args, call.folder
    about = build_result_envelope(call.command, args, outcome.inputs, "ok", outcome.warnings)
    files = dict(outcome.files)
    _refuse_overwritten(call, files)
    if args.report is not None and outcome.report is not None:
        files |= dict.fromkeys(_twice(args.report, folder, 2), outcome.report())
    else:
        args.report = None  # so that nothing says that it was written
    if args.json is not None:
        files |= dict.fromkeys(
            _twice(args.json, folder, 1), format_json(about | outcome.result | format_warnings(outcome.warnings))
        )
    with ExitStack() as staged:
        room = None if folder is None else staged.enter_context(folder.writing())
        for path, content in files.items():
            inside = room is not None and folder is not None and folder.holds(path)
            temporary = room / path.name if inside and room else staged.enter_context(write_atomically(path))
            if isinstance(content, str):
                temporary.write_text(content, encoding="utf-8", errors="replace")  # halves of characters, from JSON
            else:
                content(temporary)
        if room is not None and folder is not None:
            read = {row["path"]: row["sha256"] for row in about["inputs"]}
            run = folder.record(
                room, call.command, command_line=format_command_line(), configuration=call.configuration, inputs=read,
                seed=args.seed, exit_status=outcome.exit_status,
            )  # fmt: skip
            (room / folder.files()[0].name).write_text(format_json(run), encoding="utf-8")


def _refuse_overwritten(call: _Call, files: Iterable[Path]) -> None:
    """Refuse to write over what came along with an output, as a header does with C code, or what another run put in the folder.

    Known only when all is done, so the work is lost; nothing else is.
    """
    own = {resolve_destination(path) for path in files}
    if own & {resolve_destination(path) for path in (call.args.json, call.args.report) if path is not None}:
        raise InputError("cannot_write", _TWICE)
    given = {path.resolve() for path in _given(call.args)}
    named = {resolve_destination(path) for path in call.destinations()}
    if lost := sorted((own - named) & given):
        raise InputError(
            "cannot_write", f"{lost[0]} is an input of this command and would be overwritten; name another output"
        )
    if call.folder is not None:
        call.folder.check(call.command, call.configuration, given)


def _twice(path: Path, folder: RunFolder | None, which: int) -> list[Path]:
    """Return where a result goes: to the file asked for, and to the run folder."""
    return [path] if folder is None else list(dict.fromkeys([path, folder.files()[which]]))


def _unanswered(args: argparse.Namespace, fault: CannotAnswer) -> Outcome:
    """Return the outcome of a command whose data cannot answer, with the robot and all files that it was given."""
    result = {"status": "cannot_answer", "code": fault.code, "missing": fault.missing, "experiment": fault.experiment}
    inputs = [*(get_robot_file(args) if getattr(args, "robot", None) else []), *_given(args)]
    once = {path.resolve(): path for path in reversed(inputs)}
    return Outcome(
        result=result, warnings=fault.warnings, inputs=list(reversed(once.values())), exit_status=fault.exit_status
    )


class _Screen(Console):
    """A console whose reader may leave early, as `head` does."""

    def on_broken_pipe(self) -> NoReturn:
        """Leave quietly: everything was written already."""
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0)


def build_result_envelope(
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
        **format_warnings(warnings),
    }


def _hashed(item: Path | tuple[str, str]) -> tuple[str, str]:
    if isinstance(item, tuple):
        return item
    return str(item), compute_sha256(item) if item.is_file() else ""
