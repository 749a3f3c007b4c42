"""Killed at any moment, a command leaves each output as it was or complete, and nothing that confuses the next run."""

from __future__ import annotations

import os
import signal
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tau_dyn import files
from tau_dyn.cli import execute, parse
from tau_dyn.cli.execute import Outcome
from tau_dyn.exceptions import InputError
from tau_dyn.files import write_atomically
from tau_dyn.log import Log
from tau_dyn.model import Model

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks, and counts file events as Linux has them")
NAMES = ("model.yaml", "log.csv", "report.html", "result.json")


def command(folder: Path, model: Model) -> int:
    """Write four outputs as every command does: a model, a log, a page and a result."""
    log = Log(np.arange(300.0), {"q_axis": np.sin(np.arange(300.0))})
    words = ["identify", "linear_axis", "log.csv", "--quiet", "--json", folder / "result.json"]
    call = parse([*map(str, words), "--report", str(folder / "report.html")])
    outcome = Outcome(
        result={"numbers": list(range(800))},
        files={folder / "model.yaml": model.save, folder / "log.csv": log.to_csv},
        report=lambda command_line: "<p>" + 4000 * "x" + "</p>",
    )
    return execute(replace(call, function=lambda *_, **__: outcome))


@pytest.fixture
def model(block) -> Model:
    return Model.of(block)


@pytest.fixture
def new(model, tmp_path, child) -> dict[str, bytes]:
    """What the outputs are when nothing goes wrong."""
    folder = tmp_path / "undisturbed"
    folder.mkdir()
    assert child(partial(command, folder, model)) == 0
    return {name: (folder / name).read_bytes() for name in NAMES}


@pytest.mark.parametrize("there", [False, True], ids=["absent", "old"])
def test_killed_at_every_file_event(model, new, tmp_path, child, check_whole, there: bool) -> None:
    """SIGKILL before each opening, renaming and removing of a file; then a rerun that completes and tidies up."""
    old = {name: b"old " + name.encode() if there else None for name in NAMES}
    reached = set()
    for event in range(1, 100):
        folder = tmp_path / str(event)
        folder.mkdir()
        for name, content in old.items():
            if content is not None:
                (folder / name).write_bytes(content)
        status = child(partial(command, folder, model), kill_at=event)
        check_whole(folder, old, new)
        if status == 0:
            break
        assert status == -signal.SIGKILL
        reached.add(tuple((folder / name).exists() and (folder / name).read_bytes() == new[name] for name in NAMES))
        assert child(partial(command, folder, model)) == 0
        assert {p.name: p.read_bytes() for p in folder.iterdir()} == new, "the rerun's folder"
    assert event > 12, "that many file events there are at least; else nothing was tried"
    assert {(False,) * 4, (False, False, False, True)} <= reached, "killed before all, and between, the replacements"


@pytest.mark.parametrize("deadly", [True, False], ids=["killed", "full"])
def test_stopped_within_a_write(model, new, tmp_path, child, check_whole, deadly: bool) -> None:
    """A process killed in the middle of a write, or a disk that is full there, leaves what was."""
    old = {name: b"old" for name in NAMES}
    sizes = sorted(map(len, new.values()))
    for most in (0, 1, 512, 1000, sizes[0] - 1, sizes[1] - 1, sizes[2] - 1, sizes[3] - 1):
        folder = tmp_path / str(most)
        folder.mkdir()
        for name, content in old.items():
            (folder / name).write_bytes(content)

        def run(folder: Path = folder) -> int:
            try:
                return command(folder, model)
            except InputError as fault:
                assert "File too large" in str(fault) and ".part" not in str(fault) and str(folder) in str(fault)
                return fault.exit_status

        status = child(run, most_bytes=most, deadly=deadly)
        assert status == (-signal.SIGXFSZ if deadly else 2)
        assert {name: (folder / name).read_bytes() for name in NAMES} == old
        left = [p.name for p in folder.iterdir() if p.name not in NAMES]
        assert bool(left) <= deadly, f"a run that ends by itself leaves nothing behind: {left}"


def test_only_the_dead_are_tidied_up(tmp_path) -> None:
    """The temporary file of a living process, of another machine or of another output stays."""
    dead = 2**22 + 1  # above Linux' largest process number
    machine = files.get_owner_name().rpartition("-")[0]
    gone = tmp_path / f".a.json.{machine}-{dead}.3.part"
    kept = [
        tmp_path / f".a.json.{machine}-{os.getppid()}.3.part",
        tmp_path / f".a.json.elsewhere-{dead}.3.part",
        tmp_path / f".b.json.{machine}-{dead}.3.part",
        tmp_path / ".a.json.part",
    ]
    for path in (gone, *kept):
        path.write_text("half")
    with write_atomically(tmp_path / "a.json") as temporary:
        temporary.write_text("whole")
    assert not gone.exists() and all(path.exists() for path in kept)


def test_a_killed_copy_of_a_large_log_goes(tmp_path, monkeypatch, child) -> None:
    """The temporary folder of a run that was killed, which may hold gigabytes, is removed by the next one."""
    from tau_dyn.log.copies import TemporaryFolder

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def work() -> int:
        folder = TemporaryFolder()
        (folder.path / "copy.parquet").write_bytes(b"x" * 1000)
        os.kill(os.getpid(), signal.SIGKILL)
        return 0

    held: list[TemporaryFolder] = [TemporaryFolder()]
    assert child(work) == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 2
    held.append(TemporaryFolder())
    assert {p.name for p in tmp_path.iterdir()} == {folder.path.name for folder in held}
