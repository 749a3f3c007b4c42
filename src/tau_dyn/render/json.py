"""A presentation as data: what it says, and the table behind it."""

from __future__ import annotations

from typing import Any

import numpy as np

from tau_dyn.render.present import present
from tau_dyn.results import Presentation, to_plain


def render_json(result: Any, **options: Any) -> dict[str, Any]:
    """Return any result as plain data for `json.dumps`: headline, verdict, warnings, and the main table.

    Args:
        result: The result, or its presentation.
        options: What `present` may be told of such a result.
    """
    shown = result if isinstance(result, Presentation) else present(result, **options)
    rows = shown.data()
    if hasattr(rows, "to_dict"):  # a pandas frame
        rows = {name: rows[name].to_numpy() for name in rows}
        rows = [dict(zip(rows, line, strict=True)) for line in zip(*rows.values(), strict=True)]
    verdict = None if shown.verdict is None else shown.verdict._asdict()
    return to_plain(
        {
            "kind": shown.kind,
            "about": shown.about,
            "headline": shown.headline,
            "verdict": verdict,
            "warnings": list(shown.warnings),
            "table": [{k: None if _is_missing(v) else v for k, v in row.items()} for row in rows],
        }
    )


def _is_missing(value: Any) -> bool:
    return isinstance(value, float | np.floating) and not np.isfinite(value)
