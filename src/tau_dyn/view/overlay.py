"""What is shown beside the robot: a log to play, a result's findings, a cloud of points."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from tau_dyn.exceptions import InputError
from tau_dyn.log import Log
from tau_dyn.robot import Robot

_FRAMES_HZ = 30.0
_MOST_POINTS = 200_000


@dataclass(frozen=True, eq=False)
class Playback:
    """A motion thinned to what an eye sees.

    Attributes:
        t: Time (n,) [s] from zero.
        q: Measured actuated positions (n, na).
        ghost: Their references (n, na), or None where the log has none.
    """

    t: np.ndarray
    q: np.ndarray
    ghost: np.ndarray | None


@dataclass(frozen=True)
class Finding:
    """What a result says of some joints."""

    text: str
    joints: tuple[str, ...]


def playback_of(log: Log, robot: Robot) -> Playback:
    """Return a log as a playback of this robot.

    Raises:
        InputError: The log lacks a joint's position.
    """
    q = log.joint("q", robot.actuated)
    keep = slice(None, None, max(1, round(log.rate_hz / _FRAMES_HZ)))
    ghost = log.joint("q_ref", robot.actuated)[keep] if log.has("q_ref", robot.actuated) else None
    return Playback((log.t - log.t[0])[keep], q[keep], ghost)


def findings_in(path: Path) -> list[Finding]:
    """Return the findings of a diagnosis' JSON result.

    Raises:
        InputError: The file is not one.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        rows = content["findings"]
        return [Finding(f"{r['cause']} ({r['status']})", tuple(map(str, r["joints"]))) for r in rows]
    except OSError as fault:
        raise InputError(f"{path}: {fault.strerror or 'cannot be read'}") from fault
    except (ValueError, KeyError, TypeError, RecursionError) as fault:
        raise InputError(f"{path}: not a result of tau-dyn diagnose with findings") from fault


def cloud_in(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Return points (n, 3) [m] of a CSV with x y z or x_tool y_tool z_tool, and its first further numeric column (n,) if any.

    Raises:
        InputError: The file is not such a table.
    """
    try:
        table = pd.read_csv(path, comment="#")
    except (OSError, ValueError) as fault:
        raise InputError(f"{path}: cannot be read as CSV") from fault
    names = _first(table.columns, (("x_tool", "y_tool", "z_tool"), ("x", "y", "z")))
    if names is None:
        raise InputError(
            f"{path}: a cloud needs columns x y z or x_tool y_tool z_tool; there are {', '.join(table.columns)}"
        )
    table = table.iloc[:: max(1, len(table) // _MOST_POINTS)]
    points = table[list(names)].apply(pd.to_numeric, errors="coerce").to_numpy(float)
    good = np.isfinite(points).all(axis=1)
    further = [c for c in table.columns if c not in names and pd.api.types.is_numeric_dtype(table[c])]
    value = table[further[0]].to_numpy(float)[good] if further else None
    return points[good], value


def _first(columns: Iterable[str], wanted: Iterable[tuple[str, ...]]) -> tuple[str, ...] | None:
    there = set(columns)
    return next((names for names in wanted if set(names) <= there), None)
