"""Kinds of arguments: numbers and names of files to write; each says in words what it takes."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import TypeVar

T = TypeVar("T", int, float)


def _kind(words: str, read: Callable[[str], T], holds: Callable[[T], bool]) -> Callable[[str], T]:
    """Return a reader of arguments that refuses in a sentence what it does not take."""

    def reader(text: str) -> T:
        try:
            value = read(text)
        except ValueError:
            value = None
        if value is None or not holds(value):
            raise argparse.ArgumentTypeError(f"{text!r}: write {words}")
        return value

    return reader


whole_number = _kind("a whole number from zero up", int, lambda x: x >= 0)
positive_whole = _kind("a whole number above zero", int, lambda x: 0 < x < 1_000_000)
port = _kind("a port between 1 and 65535", int, lambda x: 0 < x < 65536)
finite = _kind("a finite number", float, isfinite)
positive = _kind("a number above zero, below 1e9", float, lambda x: 0 < x < 1e9)
positive_large = _kind("a number above zero, below 1e15", float, lambda x: 0 < x < 1e15)  # a stiffness
not_negative = _kind("zero or a number above it", lambda text: float(text) + 0.0, lambda x: 0 <= x < 1e9)


def read_whole_between(low: int, high: int) -> Callable[[str], int]:
    """Return a reader of whole numbers from a lowest to a highest."""
    return _kind(f"a whole number from {low} to {high}", int, lambda x: low <= x <= high)


def read_number_of_poses(text: str) -> int | str:
    """Read a number of poses, or auto."""
    try:
        return "auto" if text == "auto" else positive_whole(text)
    except argparse.ArgumentTypeError as fault:
        raise argparse.ArgumentTypeError(f"{fault}, or auto") from None


def read_csv_file_name(text: str) -> Path:
    """Read the name of a CSV file to write."""
    if Path(text).suffix.lower() != ".csv":
        raise argparse.ArgumentTypeError(f"'{text}' must end in .csv, which is what is written")
    return Path(text)
