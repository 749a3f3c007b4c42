"""`docs/reference/causes.md` says what the effects say of themselves."""

from __future__ import annotations

import importlib.util
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_is_what_the_classes_say() -> None:
    """The page is written by a script; where it differs, run `python experiments/effects_table.py` again."""
    spec = importlib.util.spec_from_file_location("effects_table", ROOT / "experiments" / "effects_table.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert (ROOT / "docs" / "reference" / "causes.md").read_text(encoding="utf-8") == module.page()
