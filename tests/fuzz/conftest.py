"""What the tests of hostile input share: a run of the command line that must be refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tau_dyn.cli import main


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Return a function that runs a command which must end with status 2, one line and no new file; it gives the line."""
    monkeypatch.chdir(tmp_path)

    def run(*argv: object) -> str:
        before = sorted(tmp_path.rglob("*"))
        assert main([str(word) for word in argv]) == 2
        lines = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
        assert len(lines) == 1 and lines[0].startswith("error: ") and len(lines[0]) < 1200 and lines[0].isprintable()
        assert sorted(tmp_path.rglob("*")) == before
        return lines[0]

    return run
