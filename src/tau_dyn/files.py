"""Files that appear whole or not at all, and YAML read safely; every fault becomes a sentence."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from tau_dyn.exceptions import InputError


def read_yaml(path: str | Path) -> Any:
    """Read YAML with the safe loader; faults become sentences."""
    try:
        return yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as fault:
        raise InputError(f"{path}: no such file") from fault
    except (OSError, UnicodeDecodeError) as fault:
        raise InputError(f"{path}: cannot be read as text ({fault})") from fault
    except (yaml.YAMLError, ValueError, RecursionError) as fault:  # ValueError: a date such as 2026-13-01
        raise InputError(f"{path}: not valid YAML ({' '.join(str(fault).split())})") from fault


@contextmanager
def writing_whole(path: str | Path) -> Iterator[Path]:
    """Give a temporary file to write; it takes the place of `path` when the block ends well, and goes away when it does not.

    Raises:
        InputError: The destination cannot be written.
    """
    path = Path(path).resolve()  # a link keeps pointing where it did
    if path.is_dir():
        raise InputError(f"{path} cannot be written: it is a folder; name a file")
    if path.exists() and not path.is_file():  # a pipe or a device is written to, never replaced
        yield path
        return
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as fault:
        reason = fault.strerror or str(fault)
        raise InputError(f"{path} cannot be written: {reason}; name a file in an existing folder") from fault
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: str | Path, text: str) -> None:
    """Write a text file so that it appears whole or not at all."""
    with writing_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
