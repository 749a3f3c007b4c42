"""A run folder: a command's options, inputs, versions and output files; and the differences of two runs in these.

`run.json` is next to `result.json`, `report.html` and the command's own file; a folder with `run.json` is a run. The
command line writes it (`cli/run_folder.py`), `compare` reads it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes
from tau_dyn.results import to_plain

RUN, RESULT, REPORT = "run.json", "result.json", "report.html"
FORMAT = 1  # version of the run folder's layout
_MAX_FILE_BYTES = 2**20  # [bytes] a run.json is a few kB


@dataclass(frozen=True, eq=False)
class RecordedRun:
    """One run of a command.

    Attributes:
        command: `identify`, `diagnose`, ...
        command_line: The command line.
        configuration: Every option by name, defaults included; outputs left out.
        inputs: SHA-256 of each input file, by its path.
        versions: Versions of tau_dyn, Python and the libraries, and the platform.
        seed: Seed of all random numbers.
        started: Date and time, ISO 8601 with the zone.
        duration_s: Wall-clock time [s].
        exit_status: 0, or 3 if the data could not answer.
        files: SHA-256 of each file that the run wrote, by its name in the folder.
    """

    command: str
    command_line: str
    configuration: Mapping[str, Any]
    inputs: Mapping[str, str]
    versions: Mapping[str, str]
    seed: int
    started: str
    duration_s: float
    exit_status: int
    files: Mapping[str, str]

    def to_dict(self) -> dict[str, Any]:
        """Return the content of run.json."""
        inputs = [{"path": path, "sha256": sha256} for path, sha256 in self.inputs.items()]
        return {"run_format": FORMAT} | to_plain(self) | {"inputs": inputs}


def is_run(folder: Path) -> bool:
    """Return whether a folder is a run folder."""
    return (folder / RUN).is_file()


def read_run(folder: Path) -> RecordedRun:
    """Read a run folder's run.json.

    Raises:
        InputError: The file is missing, or is not a run of tau_dyn.
    """
    path = folder / RUN
    try:
        held = json.loads(read_bytes(path, _MAX_FILE_BYTES))
    except OSError as fault:
        raise InputError("file_format", f"{folder}: no run folder; it has no {RUN}") from fault
    except InputError:
        raise
    except (ValueError, RecursionError) as fault:
        raise InputError("file_format", f"{path}: not valid JSON ({fault})") from fault
    if not isinstance(held, dict) or held.get("run_format") != FORMAT:
        raise InputError("file_format", f"{path}: not a run of ours; its run_format is not {FORMAT}")
    try:
        return RecordedRun(
            command=_text(held["command"]),
            command_line=_text(held["command_line"]),
            configuration={_text(k): v for k, v in held["configuration"].items()},
            inputs={_text(x["path"]): _text(x["sha256"]) for x in held["inputs"]},
            versions={_text(k): _text(v) for k, v in held["versions"].items()},
            seed=int(held["seed"]),
            started=_text(held["started"]),
            duration_s=float(held["duration_s"]),
            exit_status=int(held["exit_status"]),
            files={_text(k): _text(v) for k, v in held["files"].items()},
        )
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as fault:
        raise InputError("file_format", f"{path}: an entry is missing or of the wrong kind ({fault})") from fault


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not text")
    return value


@dataclass(frozen=True)
class InputChange:
    """An input file of one or both runs.

    Attributes:
        a: Its path in the first run, None if only the second read it.
        b: Its path in the second run, None if only the first read it.
        same: Whether the content is the same, by its hash.
    """

    a: str | None
    b: str | None
    same: bool

    @property
    def state(self) -> str:
        """`same`, `renamed`, `changed`, `only in the first` or `only in the second`."""
        if self.a is None or self.b is None:
            return "only in the second" if self.a is None else "only in the first"
        if not self.same:
            return "changed"
        return "same" if self.a == self.b else "renamed"

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return to_plain(self, leave_out=("same",)) | {"state": self.state}


@dataclass(frozen=True)
class CircumstanceDifference:
    """An option, version or number that differs; None if one side lacks it."""

    name: str
    a: Any
    b: Any


def list_differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> tuple[CircumstanceDifference, ...]:
    """Return the differences between two mappings, in the first's order."""
    names = dict.fromkeys([*a, *b])
    return tuple(CircumstanceDifference(n, a.get(n), b.get(n)) for n in names if a.get(n) != b.get(n))


def list_input_changes(a: Mapping[str, str], b: Mapping[str, str]) -> tuple[InputChange, ...]:
    """Match the files of two runs: by path, else by content, else by name; only one run read the remaining files.

    Args:
        a: Hashes by path of the first run.
        b: Hashes by path of the second run.
    """
    left, right = dict(a), dict(b)
    both = tuple(_matched(left, right))
    return (*both, *(InputChange(p, None, False) for p in left), *(InputChange(None, p, False) for p in right))


def _matched(left: dict[str, str], right: dict[str, str]) -> Iterator[InputChange]:
    """Remove matching pairs from both mappings, the surest first."""
    alike = (
        lambda p, q: p == q,
        lambda p, q: left[p] == right[q],
        lambda p, q: PurePath(p).name == PurePath(q).name,
    )
    for rule in alike:
        for p in list(left):
            q = next((q for q in right if rule(p, q)), None)
            if q is not None:
                yield InputChange(p, q, left.pop(p) == right.pop(q))
