"""Every JSON result that a test of the command line makes agrees with the published schema."""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

SCHEMA = Path(__file__).resolve().parents[2] / "docs" / "reference" / "result.schema.json"


@pytest.fixture(scope="session")
def schema() -> Draft202012Validator:
    """The schema of all results."""
    return Draft202012Validator(json.loads(SCHEMA.read_text(encoding="utf-8")))


@pytest.fixture(autouse=True)
def results_agree_with_the_schema(schema: Draft202012Validator, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Check what is written; a test's own stand-in for a command may say what it likes."""
    execute, found = import_module("tau_dyn.cli.execute"), []
    write = execute._write

    def write_and_check(run: Any, outcome: Any) -> tuple[str, dict[str, str]]:
        text, written = write(run, outcome)
        if text and run.call.function.__module__.startswith("tau_dyn."):
            found.extend(f"{run.call.command}: {e.json_path} {e.message}" for e in schema.iter_errors(json.loads(text)))
        return text, written

    monkeypatch.setattr(execute, "_write", write_and_check)
    yield
    assert not found, "\n".join(found)
