"""Journal of a long run over many items: every result is stored as it arrives, so that a killed run resumes where it stopped.

A journal has one JSON object per line: first the task and the hash of the code, then one result per line. Each result is on the
disk before the next is awaited. A kill cuts off the last line at most, and that item is computed again. New results pass
through the same text as those read back, so an interrupted run and an undisturbed one give the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.scale.runner import run_many
from tau_dyn.version import __version__

Item = TypeVar("Item")


def run_journaled(
    function: Callable[[Item], Any],
    items: Iterable[Item],
    path: str | Path,
    *,
    name: Callable[[Item], str] = str,
    about: Mapping[str, Any] | None = None,
    cluster: str | None = None,
    jobs: int = 1,
) -> Iterator[Any]:
    """Yield `function(item)` for every item in their order; those that the journal holds are not computed again.

    Args:
        function: As for `run_many`; it must return numbers, text, lists and mappings.
        items: Arguments of the function.
        path: The journal; remove it after the final output is written.
        name: Function that returns a unique name of an item.
        about: Further inputs that decide the results, such as a seed; plain data.
        cluster: Address of a Dask scheduler.
        jobs: Processes on this machine.

    Raises:
        InputError: The journal belongs to another task or other code, is damaged, or another process writes to it.
    """
    items = list(items)
    head = {"about": _as_read(dict(about or {})), "version": __version__, "code": compute_code_hash()}
    with _opened(Path(path)) as file:
        done = _done(file, Path(path), head)
        rest = run_many(function, [i for i in items if name(i) not in done], cluster=cluster, jobs=jobs)
        for item in items:
            if (key := name(item)) not in done:
                result = _as_read(next(rest))
                _append(file, {"item": key, "result": result})
                done[key] = result
            yield done[key]


@lru_cache(maxsize=1)
def compute_code_hash() -> str:
    """Return a hash of this package's source: results of two versions must not be mixed in one table."""
    root, digest = Path(__file__).resolve().parents[1], hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """Open a journal for this process alone; the lock is released whenever the process ends."""
    try:
        file = path.open("a+b")
    except OSError as fault:
        raise InputError(
            "cannot_write", f"{path} cannot be written: {fault.strerror or fault}; name a file in an existing folder"
        ) from fault
    with file:
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except ImportError:
            pass
        except OSError:
            raise InputError(
                "not_available", f"{path} is being written by another run; let that one end, or name another file"
            ) from None
        yield file


def _done(file: BinaryIO, path: Path, head: dict[str, Any]) -> dict[str, Any]:
    """Return the results in a journal; start it if it is empty, and remove an incomplete last line."""
    file.seek(0)
    text = file.read()
    whole = text[: text.rfind(b"\n") + 1]
    if len(whole) < len(text):
        file.truncate(len(whole))
    rows = [_row(path, number, line) for number, line in enumerate(whole.splitlines(), start=1)]
    if not rows:
        _append(file, head)
        return {}
    if rows[0].get("about") != head["about"]:
        raise InputError(
            "mismatch", f"{path} holds results of {rows[0].get('about')}, not of {head['about']}; name another file"
        )
    if (rows[0].get("version"), rows[0].get("code")) != (head["version"], head["code"]):
        raise InputError("mismatch", f"{path} was begun by other code than this; remove it to begin again")
    return {row["item"]: row["result"] for row in rows[1:]}


def _row(path: Path, number: int, line: bytes) -> dict[str, Any]:
    try:
        row = json.loads(line)
        if isinstance(row, dict) and (number == 1 or ("result" in row and isinstance(row.get("item"), str))):
            return row
    except (ValueError, RecursionError):
        pass
    raise InputError("file_format", f"{path}, line {number} is no line of a journal; remove the file to begin again")


def _append(file: BinaryIO, row: dict[str, Any]) -> None:
    file.write(json.dumps(row).encode() + b"\n")
    file.flush()
    os.fsync(file.fileno())


def _as_read(value: Any) -> Any:
    """Return plain data as it comes back from the journal."""
    return json.loads(json.dumps(value, default=_plain))


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"a journal holds numbers, text, lists and mappings, not {type(value).__name__}")
