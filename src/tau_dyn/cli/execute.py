"""Execution of a command: outputs are checked first, written atomically at the end, then shown.

No file is written before the command has returned its `Outcome`. Exit status: 0 valid answer, 2 wrong input (no file written),
3 the data cannot answer (reported in `--json` and the run folder), 1 a defect of the program.
"""

from __future__ import annotations

import inspect
import json
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

from rich.console import Console

from tau_dyn.cli.arguments import STDOUT, is_model_file
from tau_dyn.cli.progress import LOGGER, log_to_stderr, show_progress
from tau_dyn.cli.run_folder import RunFolder, collect_configuration
from tau_dyn.exceptions import CannotAnswer, InputError, format_one_line
from tau_dyn.files import compute_sha256, resolve_destination, write_atomically
from tau_dyn.message_codes import format_warnings, format_with_code
from tau_dyn.results import to_plain
from tau_dyn.version import __version__

_TWICE = "two outputs are to be written to one file; give each its own"

_OUTPUTS = (
    "json",
    "report",
    "out",
    "propose",
    "save_cameras",
    "save_camera",
    "picture",
    "rapid",
    "resume",
    "corrected",
)
"""Arguments that name files to write."""


@dataclass(frozen=True)
class Call:
    """A command with its arguments.

    Attributes:
        command: Its first word, as in results.
        function: The function of the command.
        bound: Its arguments.
    """

    command: str
    function: Callable[..., Any]
    bound: inspect.BoundArguments

    def run(self) -> Any:
        """Call the function."""
        return self.function(*self.bound.args, **self.bound.kwargs)

    def values(self) -> dict[str, Any]:
        """Return every argument by name, including those of shared options and defaults."""
        complete = inspect.BoundArguments(self.bound.signature, self.bound.arguments.copy())
        complete.apply_defaults()
        return dict(_flatten_options(complete.arguments))

    def replace(self, **values: Any) -> Call:
        """Return the call with some arguments replaced."""
        complete = inspect.BoundArguments(self.bound.signature, self.bound.arguments.copy())
        complete.apply_defaults()
        for name, value in complete.arguments.items():
            if name in values:
                complete.arguments[name] = values[name]
            elif is_dataclass(value) and not isinstance(value, type):
                own = {f.name: values[f.name] for f in fields(value) if f.name in values}
                complete.arguments[name] = replace(value, **own) if own else value
        return Call(self.command, self.function, complete)


def _flatten_options(arguments: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in arguments.items():
        if is_dataclass(value) and not isinstance(value, type) and hasattr(type(value), "__cyclopts__"):
            yield from _flatten_options({f.name: getattr(value, f.name) for f in fields(value)})
        else:
            yield name, value


@dataclass(frozen=True)
class Outcome:
    """The results of a command, before files are written.

    Attributes:
        result: The command's part of the JSON result.
        warnings: Sentences.
        inputs: Files read; or pairs of path and hash, if a reader knows the hash already. None for a file not given.
        found: The result object, which `render` prints and turns into a page; None without either.
        context: Further arguments of `render`.
        printed: Whether the result object is also printed.
        lines: Lines for a person, below the result object.
        show: Prints the result for a person instead; its argument is the names of written files.
        files: Files to write: path -> text, or a function that writes to the given path. None for a file not requested.
        named: Names of files that were written, for the last line on the screen.
        report: Builds the report page's text instead, from the command line that repeats it.
        exit_status: 0 for a valid answer; 3 if the data cannot answer, with the reason in the `status` of `result`.
    """

    result: dict[str, Any] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    inputs: Sequence[Path | tuple[str, str] | None] = ()
    found: Any = None
    context: Mapping[str, Any] = field(default_factory=dict)
    printed: bool = True
    lines: Sequence[str] = ()
    show: Callable[[Console, dict[str, str]], None] | None = None
    files: Mapping[Path, Any] | Mapping[Path | None, Any] = field(default_factory=dict)
    named: Mapping[str, Path | None] = field(default_factory=dict)
    report: Callable[[str], str] | None = None
    exit_status: int = 0

    def has_page(self) -> bool:
        """Return whether there is a report page."""
        return self.report is not None or self.found is not None

    def build_page(self, command_line: str) -> str:
        """Return the report page's text."""
        if self.report is not None:
            return self.report(command_line)
        from tau_dyn.render import build_page

        return build_page(self.found, command_line=command_line, **self.context)

    def print(self, console: Console, written: dict[str, str]) -> None:
        """Print the result for a person."""
        if self.show is not None:
            self.show(console, written)
        elif self.found is not None and self.printed:
            from tau_dyn.render import print_result

            wide = not console.is_terminal and "COLUMNS" not in os.environ
            print_result(console, self.found, written, wide_tables=wide, **self.context)
        for line in self.lines:
            console.print(line, markup=False, soft_wrap=line.startswith("tau-dyn "))  # a command stays one line


@dataclass(frozen=True)
class _Run:
    """A call and its destinations.

    Attributes:
        call: The call with `out`, `json` and `report` as files, in the run folder if there is one.
        values: Its arguments by name.
        folder: The run folder, or None.
        configuration: Its options, for the run folder.
        page_asked: Whether `--report` was given.
        to_stdout: Whether stdout receives the JSON result instead of text for a person (`--json -`).
    """

    call: Call
    values: dict[str, Any]
    folder: RunFolder | None
    configuration: dict[str, Any]
    page_asked: bool
    to_stdout: bool = False

    def destinations(self) -> list[Path]:
        """Return every file that will be written."""
        files = [path for name in _OUTPUTS if isinstance(path := self.values.get(name), Path)]
        if self.folder is None:
            return files
        files = [path for path in files if path != self.folder.path]
        taken = (None, self.values["json"], self.values["report"])
        return [*files, *(path for path, named in zip(self.folder.files(), taken, strict=True) if path != named)]


def execute(call: Call, own_file: str = "") -> int:
    """Run a command, print, write, and return the exit status.

    Args:
        call: The command with its arguments.
        own_file: Usual name of the command's own file in a run folder; empty if it has no own file.
    """
    with log_to_stderr(call.values()["verbose"]):
        return _run(_place_results(call, own_file))


def _run(run: _Run) -> int:
    before = _check_destinations(run)
    refusal = None
    try:
        outcome = run.call.run()
    except CannotAnswer as fault:
        refusal, outcome = fault, _build_unanswered(run.values, fault)
    if run.page_asked and refusal is None and not outcome.has_page():
        raise InputError("bad_option", f"tau-dyn {run.call.command} has no report; leave --report out")
    inputs = [item for item in outcome.inputs if item is not None]
    outcome = replace(outcome, inputs=inputs, warnings=[*outcome.warnings, *_list_changed(inputs, before)])
    with show_progress(run.values["quiet"]) as step:
        step("writing")
        text, written = _write(run, outcome)
    for path in written.values():
        LOGGER.info("wrote %s", path)
    errors = Console(stderr=True, soft_wrap=True, highlight=False)
    sentences = [f"warning: {format_with_code(sentence)}" for sentence in dict.fromkeys(outcome.warnings)]
    if refusal is not None:
        said = f"{refusal.missing}. The experiment that would: {refusal.experiment}."
        sentences.append(f"cannot answer: {said} [{refusal.code}]")
    with suppress(OSError):  # a closed screen; the files hold the same
        for sentence in sentences:
            errors.print(format_one_line(sentence), markup=False)
    if run.to_stdout:
        _show(lambda screen: screen.file.write(text))
    elif refusal is None and not run.values["quiet"]:
        _show(lambda screen: outcome.print(screen, written))
    return outcome.exit_status


def _place_results(call: Call, own_file: str) -> _Run:
    """Return the run; in a run folder, files without another destination get their usual names."""
    values = call.values()
    configuration, page_asked = collect_configuration(values), values["report"] is not None
    to_stdout = values["json"] == STDOUT
    values |= {"json": None} if to_stdout else {}
    folder = values.get("out")
    if not isinstance(folder, RunFolder):
        return _Run(call, values, None, configuration, page_asked, to_stdout)
    _, result, page = folder.files()
    placed = {
        "out": folder.path / own_file if own_file else folder.path,
        "json": values["json"] or result,
        "report": values["report"] or page,
    }
    told = placed | {"json": STDOUT} if to_stdout else placed
    return _Run(call.replace(**told), values | placed, folder, configuration, page_asked, to_stdout)


def _check_destinations(run: _Run) -> dict[Path, tuple[int, int]]:
    """Reject outputs that cannot be written or would overwrite a file; return size and time of the inputs."""
    folder, destinations = run.folder, run.destinations()
    for path in destinations:
        if not resolve_destination(path).parent.is_dir() and not (folder is not None and folder.holds(path)):
            raise InputError("cannot_write", f"{path}: the folder {path.parent} does not exist")
        if path.is_dir():
            raise InputError("cannot_write", f"{path} is a folder; name a file")
    if len({resolve_destination(path) for path in destinations}) < len(destinations):
        raise InputError("cannot_write", _TWICE)
    given = {path.resolve() for path in _list_given(run.values)}
    for path in destinations:
        if resolve_destination(path) in given:
            raise InputError(
                "cannot_write", f"{path} is an input of this command and would be overwritten; name another file"
            )
    if folder is not None:
        folder.check(run.call.command, run.configuration, given)
    return {path: _stamp(path) for path in given}


def _show(put: Callable[[Console], Any]) -> None:
    screen = _Screen(soft_wrap=False, highlight=False)
    try:
        put(screen)
        screen.file.flush()
    except BrokenPipeError:
        screen.on_broken_pipe()
    except OSError as fault:
        raise InputError(
            "cannot_write", f"the result could not be shown ({fault.strerror}); the files asked for are written"
        ) from fault


def _list_given(values: dict[str, Any]) -> list[Path]:
    """Return every file that the arguments name, unresolved: every file that is not an output may be an input."""
    named = [x for name, value in values.items() if name not in _OUTPUTS for x in _flat(value)]
    texts = [x for x in named if isinstance(x, str | Path) and str(x)]
    texts += [x.partition("=")[2] for x in texts if isinstance(x, str) and x.partition("=")[2]]  # JOINT=FILE
    items = [Path(x) for x in texts]
    folders = [Path(x) for name in ("logs", "holdout", "images") for x in _flat(values.get(name)) if x]
    items += [file for folder in folders if folder.is_dir() for file in folder.iterdir()]  # a recording's parts
    items += [path.parent / name for path in list(items) for name in _list_mapped_files(values)]
    return [item for item in items if _is_file(item)]


def _flat(value: Any) -> list[Any]:
    return [x for item in value for x in _flat(item)] if isinstance(value, list | tuple) else [value]


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a long text, or one with a null byte, is not a file
        return False


def _list_mapped_files(values: dict[str, Any]) -> Sequence[str]:
    """Return the files that a column map reads in addition to the log."""
    if values.get("columns") is None:
        return ()
    from tau_dyn.log import ColumnMap

    return tuple(ColumnMap.load(values["columns"]).files.values())


def _stamp(path: Path) -> tuple[int, int]:
    """Return size and modification time of a file, which change when it is written."""
    about = path.stat()
    return about.st_size, about.st_mtime_ns


def _list_changed(inputs: Sequence[Path | tuple[str, str] | None], before: dict[Path, tuple[int, int]]) -> list[str]:
    """Return a sentence for each input that was changed during the run; the hash of a log is that of the content read."""
    paths = [item.resolve() for item in inputs if isinstance(item, Path)]
    return [
        f"{path} changed while it was used; the hash in the result is that of the file as it is now"
        for path in paths
        if path in before and (not path.is_file() or _stamp(path) != before[path])
    ]


def _write(run: _Run, outcome: Outcome) -> tuple[str, dict[str, str]]:
    """Write all files, the run folder last; all are complete before the first is moved to its destination.

    Returns:
        The result as JSON, empty if it is not requested, and the written files by name.
    """
    values, folder, command_line = run.values, run.folder, format_command_line()
    about = build_result_envelope(run.call.command, values["seed"], outcome.inputs, "ok", outcome.warnings)
    files = {path: content for path, content in outcome.files.items() if path is not None}
    own, named = set(files), dict(outcome.named)
    if values["report"] is not None and outcome.has_page():
        files |= dict.fromkeys(_twice(values["report"], folder, 2), outcome.build_page(command_line))
        named["report"] = values["report"]
    text = ""
    if values["json"] is not None or run.to_stdout:
        text = format_json(about | outcome.result | format_warnings(outcome.warnings))
    if values["json"] is not None:
        files |= dict.fromkeys(_twice(values["json"], folder, 1), text)
        named["result"] = values["json"]
    with ExitStack() as staged:
        if folder is not None:
            staged.enter_context(folder.locked())
        _refuse_overwritten(run, own)
        room = None if folder is None else staged.enter_context(folder.writing())
        for path, content in files.items():
            inside = room is not None and folder is not None and folder.holds(path)
            temporary = room / path.name if inside and room else staged.enter_context(write_atomically(path))
            if isinstance(content, str):
                temporary.write_text(content, encoding="utf-8", errors="replace")  # lone surrogates, from JSON
            else:
                content(temporary)
        if room is not None and folder is not None:
            read = {row["path"]: row["sha256"] for row in about["inputs"]}
            record = folder.record(
                room, run.call.command, command_line=command_line, configuration=run.configuration, inputs=read,
                seed=values["seed"], exit_status=outcome.exit_status,
            )  # fmt: skip
            (room / folder.files()[0].name).write_text(format_json(record), encoding="utf-8")
    return text, {name.replace("_", " "): str(path) for name, path in named.items() if path}


def _refuse_overwritten(run: _Run, files: Iterable[Path]) -> None:
    """Reject overwriting of an output's companion files, such as the header of C code, and of another run's files.

    These files are known only at the end, so the computation is lost, but no file is.
    """
    own = {resolve_destination(path) for path in files}
    if own & {resolve_destination(path) for path in (run.values["json"], run.values["report"]) if path is not None}:
        raise InputError("cannot_write", _TWICE)
    given = {path.resolve() for path in _list_given(run.values)}
    named = {resolve_destination(path) for path in run.destinations()}
    if lost := sorted((own - named) & given):
        raise InputError(
            "cannot_write", f"{lost[0]} is an input of this command and would be overwritten; name another output"
        )
    if run.folder is not None:
        run.folder.check(run.call.command, run.configuration, given)


def _twice(path: Path, folder: RunFolder | None, which: int) -> list[Path]:
    """Return the destinations of a result: the requested file, and the run folder."""
    return [path] if folder is None else list(dict.fromkeys([path, folder.files()[which]]))


def _build_unanswered(values: dict[str, Any], fault: CannotAnswer) -> Outcome:
    """Return the outcome of a command whose data cannot answer, with the robot and all files that it was given."""
    inputs = _list_given(values)
    if values.get("robot") and not is_model_file(values["robot"]):
        from tau_dyn.robot import find_robot

        inputs = [find_robot(str(values["robot"])), *inputs]
    once = {path.resolve(): path for path in reversed(inputs)}
    return Outcome(
        result=describe_unanswered(fault),
        warnings=fault.warnings,
        inputs=list(reversed(once.values())),
        exit_status=fault.exit_status,
    )


def describe_unanswered(fault: CannotAnswer) -> dict[str, str]:
    """Return the fields of a result whose data cannot answer."""
    return {"status": "cannot_answer", "code": fault.code, "missing": fault.missing, "experiment": fault.experiment}


class _Screen(Console):
    """A console whose reader may leave early, as `head` does."""

    def on_broken_pipe(self) -> NoReturn:
        """Exit without a message: all files are already written."""
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0)


def build_result_envelope(
    command: str, seed: int, inputs: Sequence[Path | tuple[str, str] | None], status: str, warnings: Sequence[str]
) -> dict[str, Any]:
    """Return the fields that every result has."""
    return {
        "tool_version": __version__,
        "command": command,
        "inputs": [
            {"path": path, "sha256": sha256} for path, sha256 in map(_hash_input, filter(None, inputs)) if sha256
        ],
        "seed": seed,
        "status": status,
        **format_warnings(warnings),
    }


def _hash_input(item: Path | tuple[str, str]) -> tuple[str, str]:
    if isinstance(item, tuple):
        return item
    return str(item), compute_sha256(item) if item.is_file() else ""


def format_command_line() -> str:
    """Return the command line of this run, for a page's provenance."""
    return shlex.join(["tau-dyn", *sys.argv[1:]])


def format_json(value: Any) -> str:
    """Return strict JSON: arrays as lists, values that are not finite as null."""
    return json.dumps(to_plain(value), indent=2, allow_nan=False) + "\n"
