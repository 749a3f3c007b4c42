"""Many items, slowly: every result is written down as it comes, so that a killed run goes on where it stopped.

A journal is one JSON object a line: first what is computed and by which code, then one result a line, on the disk before the
next is waited for. What a kill cut off is the last line at most, and is done again. Results that were just computed pass
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
        function: As for `run_many`; what it returns must be numbers, text, lists and mappings.
        items: What it is called with.
        path: The journal; remove it when what came of it is written.
        name: From an item to a name that no other item has.
        about: What else decides the results, such as a seed; plain data.
        cluster: Address of a Dask scheduler.
        jobs: Processes on this machine.

    Raises:
        InputError: The journal is of something else, of other code, damaged, or another process writes to it.
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
    """Return a hash of this package's source: results of two versions must not meet in one table."""
    root, digest = Path(__file__).resolve().parents[1], hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """Open a journal for this process alone; a lock ends with its process, however that ends."""
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
    """Return the results that stand in a journal; begin it if it is empty, cut off what a kill left of a line."""
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
        raise InputError("mismatch", f"{path} was begun by other code than this; remove it to begin anew")
    return {row["item"]: row["result"] for row in rows[1:]}


def _row(path: Path, number: int, line: bytes) -> dict[str, Any]:
    try:
        row = json.loads(line)
        if isinstance(row, dict) and (number == 1 or ("result" in row and isinstance(row.get("item"), str))):
            return row
    except (ValueError, RecursionError):
        pass
    raise InputError("file_format", f"{path}, line {number} is no line of a journal; remove the file to begin anew")


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
