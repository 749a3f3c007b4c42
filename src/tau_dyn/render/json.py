"""A presentation as data: what it says, and the table behind it."""

from __future__ import annotations

from typing import Any

from tau_dyn.render.notebook import build_frame
from tau_dyn.render.presentation import present
from tau_dyn.results import Presentation, to_plain


def render_json(result: Any, **options: Any) -> dict[str, Any]:
    """Return any result as plain data for `json.dumps`: headline, verdict, warnings, and the main table, one row a thing.

    Args:
        result: The result, or its presentation.
        options: What `present` may be told of such a result.
    """
    shown = result if isinstance(result, Presentation) else present(result, **options)
    said = {name: getattr(shown, name) for name in ("kind", "about", "headline", "summary", "warnings")}
    verdict = None if shown.verdict is None else shown.verdict._asdict()
    return to_plain({**said, "verdict": verdict, "table": build_frame(shown).to_dict("records")})
