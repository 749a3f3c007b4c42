"""Which codes do errors and warnings carry? Writes `docs/reference/message_codes.md` from `message_codes.py`.

    python experiments/codes_page.py

A test compares the page with the tables, so the two cannot drift apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tau_dyn.files import write_whole
from tau_dyn.message_codes import DEFECT_CODES, INPUT_CODES, UNANSWERED_CODES, WARNING_CODES, MessageCode

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "message_codes.md"

INTRODUCTION = """# Codes of errors and warnings

Sentences may be reworded; codes stay. An error ends in its code, `error: ... [missing_column]`; in Python it is
`TauDynError.code`. Warnings end in theirs; `--json` holds `warnings` and `warning_codes` in one order.

This page is written by `experiments/codes_page.py`.
"""


def build_page() -> str:
    """Return the page."""
    return "\n".join(
        (
            INTRODUCTION,
            "## Faulty input, exit status 2\n",
            _table(INPUT_CODES),
            "## Data that cannot answer, exit status 3\n",
            "`--json` holds `status: cannot_answer`, `code`, `missing` and `experiment`.\n",
            _table(UNANSWERED_CODES),
            "## Failures, exit status 1\n",
            _table(DEFECT_CODES),
            "## Warnings\n",
            "[How logs are tested](../how_to/check_a_log.md), "
            "[false-alarm rates](../results/identification.md#log-integrity).\n",
            _table(WARNING_CODES),
        )
    )


def _table(codes: Mapping[str, MessageCode]) -> str:
    rows = (f"| `{code}` | {said.cause} | {said.remedy} |" for code, said in codes.items())
    return "\n".join(("| code | says | remedy |", "|---|---|---|", *rows, ""))


if __name__ == "__main__":
    write_whole(PAGE, build_page())
