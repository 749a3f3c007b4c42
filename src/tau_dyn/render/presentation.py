"""`present(result)`: words, tables and figures of any result, defined in the file of its kind.

The file of a kind registers its presentation. It is imported with the first result of the kind, so that showing a log does not
load the whole package.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import singledispatch
from importlib import import_module
from typing import Any

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.results import Chapter, Folded, Listing, On, Presentation, count, replace_plus_minus

_KINDS = {
    "calibrate": "calibration",
    "compare": "comparison",
    "control": "motion_plan",
    "control.iterative": "control",
    "control.lead_through": "control",
    "control.observers": "control",
    "evidence": "diagnosis",
    "identify": "identification",
    "kinematics": "kinematics",
    "kinematics.accuracy": "accuracy",
    "kinematics.workspace": "workspace",
    "log": "recording",
    "modes": "modes",
    "modes.springs": "springs",
    "monitor": "monitor",
    "model": "robot",
    "parameters": "robot",
    "render": "motion",
    "servo": "servo",
    "robot": "robot",
}
"""Package of a result's class -> the file that presents it."""
BADGES = {"good": "Ready to use", "care": "Use with care", "poor": "Not usable"}
"""Verdicts on a model in a few words."""
ZOOM = "Drag across to zoom, double-click for the whole log. "
"""Instructions in the note of a time view."""


def present(result: Any, **options: Any) -> Presentation:
    """Return the presentation of a result.

    Args:
        result: The result.
        options: Further options of its kind, such as the true values behind an identification.

    Raises:
        InputError: This type has no presentation.
    """
    for owner in type(result).__mro__:
        parts = owner.__module__.split(".")[1:]
        name = _KINDS.get(".".join(parts[:2])) or _KINDS.get(parts[0] if parts else "")
        if owner.__module__.startswith("tau_dyn.") and name:
            import_module(f"tau_dyn.render.kinds.{name}")
    return present_kind(result, **options)


@singledispatch
def present_kind(result: Any, **options: Any) -> Presentation:
    """Return the presentation of a result of a kind; each kind's file registers its own function."""
    raise InputError(
        "invalid_value", f"an object of type {type(result).__name__} is no result; give a result of this package"
    )


def warn(warnings: tuple[str, ...] | list[str], title: str = "Warnings") -> list[Chapter]:
    """Return a page's section of warnings, those after the third collapsed; an empty list without warnings."""
    texts = [replace_plus_minus(text) for text in warnings]
    if not texts:
        return []
    blocks: list[Any] = [Listing(texts[:3])]
    if len(texts) > 3:
        blocks.append(Folded(count(len(texts) - 3, "more warning"), [Listing(texts[3:])]))
    return [Chapter("warnings", title, lambda: blocks, On.PAGE, "warnings")]


def list_assumptions(assumed: tuple[str, ...] | list[str]) -> list[Chapter]:
    """Return a page's collapsed section of the robot file's assumptions; an empty list without assumptions."""
    if not assumed:
        return []
    return [Chapter("assumed", "Assumptions of the robot file", lambda: [Listing(list(assumed))], On.PAGE, folded=True)]


def list_logs_used(provenance: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return use, name and hash of each log in a model's provenance."""
    pairs = (("training", provenance.get("trained_on", [])), ("held out", provenance.get("held_out", [])))
    return [(use, row["path"], row["sha256"] or "held in memory") for use, rows in pairs for row in rows]


def flatten_rows(rows: Iterable[Mapping[str, Any]]) -> Any:
    """Return rows in the form of the contract as a frame: an interval's ends in separate columns, lists as text."""
    import pandas as pd

    flat = []
    for row in rows:
        new = {k: v for k, v in row.items() if k != "ci95"}
        new = {k: ", ".join(map(str, v)) if isinstance(v, list | tuple) else v for k, v in new.items()}
        low, high = row.get("ci95") or (np.nan, np.nan)
        flat.append({**new, "ci95_low": low, "ci95_high": high})
    frame = pd.DataFrame(flat)
    numbers = [n for n in ("value", "stderr", "nominal", "nominal_stderr", "p_value") if n in frame]
    return frame.astype(dict.fromkeys(numbers, float))


def pad_used(values: np.ndarray, air: float = 0.08) -> tuple[float, float]:
    """Return the range of used values with a margin, or -1 to 1 without values; filter ends and reversals do not widen it."""
    if not values.size:
        return -1.0, 1.0
    low, high = float(values.min()), float(values.max())
    more = air * (high - low) or abs(high) or 1.0
    return low - more, high + more
