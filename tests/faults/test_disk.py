"""A disk that is full, a folder that may not be written to, an output that is an input: status 2, one sentence, nothing lost."""

from __future__ import annotations

import errno
import os
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.cli import COMMANDS, build_app, main
from tau_dyn.cli.app import is_path, list_options
from tau_dyn.exceptions import InputError
from tau_dyn.files import write_atomically, write_whole
from tau_dyn.log import Log, copies, open_log, recording

linux = pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full and fork")


@pytest.fixture
def log(tmp_path) -> Path:
    """A file that `check` takes: 4 s of an axis at 250 Hz."""
    t = np.arange(1000) / 250
    path = tmp_path / "monday.csv"
    Log(t, {"q_axis": 0.2 * np.sin(3 * t), "tau_axis": np.cos(3 * t)}).to_csv(path)
    return path


def says(capsys, argv: list, *words: str) -> None:
    """Check that a command ends with status 2 and one line with these words."""
    assert main([str(a) for a in argv]) == 2
    lines = capsys.readouterr().err.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    assert len(errors) == 1 and not any("Traceback" in line for line in lines)
    assert all(word in errors[0] for word in words), errors


@linux
@pytest.mark.parametrize("option", ["--json", "--report"])
def test_a_full_device_is_a_sentence(log, capsys, option: str) -> None:
    """/dev/full takes no byte."""
    says(capsys, ["check", log, "--quiet", option, "/dev/full"], "/dev/full cannot be written", "No space left", "free")


@linux
def test_a_screen_that_takes_nothing_does_not_undo_the_files(log, tmp_path, capsys, monkeypatch) -> None:
    """The terminal's log file is on a full disk: one sentence, and the result stands."""
    full = open("/dev/full", "w")  # noqa: SIM115 - closing it fails as well
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", full)
        status = main(["check", str(log), "--json", str(tmp_path / "r.json")])
    with suppress(OSError):
        full.close()
    said = capsys.readouterr().err
    assert status == 2 and "could not be shown (No space left on device)" in said and "written" in said
    assert (tmp_path / "r.json").read_text().endswith("}\n")


@linux
def test_a_folder_of_somebody_else(log, open_folder, child) -> None:
    """Without the right to write there is one sentence, and no file; a write-protected file stays, too."""
    closed = open_folder / "closed"
    closed.mkdir(mode=0o555)
    mine = open_folder / "mine.json"
    mine.write_text("mine")
    mine.chmod(0o444)

    def refused(path: Path) -> int:
        try:
            write_whole(path, "new")
        except InputError as fault:
            known = (
                "Permission denied; name a file in a folder that you may write to",
                "is write-protected; name another file",
            )
            return 2 if any(words in str(fault) for words in known) else 3
        return 0

    assert child(partial(refused, closed / "r.json"), nobody=True) == 2
    assert child(partial(refused, mine), nobody=True) == 2
    assert list(closed.iterdir()) == [] and mine.read_text() == "mine"
    closed.chmod(0o755)


def test_what_a_file_may_and_who_may_read_it_stays(tmp_path) -> None:
    """A result that only its owner may read is not shown to others by being written anew."""
    path = tmp_path / "secret.json"
    path.write_text("old")
    path.chmod(0o600)
    write_whole(path, "new")
    assert path.read_text() == "new" and path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.ENOSPC, "free some space, or name a file on another disk"),
        (errno.EROFS, "name a file on a disk that can be written to"),
        (errno.EIO, "the disk reports a fault"),
        (errno.ENOENT, "name a file in an existing folder"),
    ],
)
@pytest.mark.parametrize("where", ["write", "settle", "replace"])
def test_every_fault_of_a_disk_leaves_the_old_file(tmp_path, monkeypatch, number: int, words: str, where: str) -> None:
    """Wherever the disk fails - writing, settling (network disks say it only there), renaming - the old file stays alone."""
    path = tmp_path / "r.json"
    path.write_text("old")

    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    if where != "write":
        monkeypatch.setattr(f"os.{'fsync' if where == 'settle' else 'replace'}", fail)
    with pytest.raises(InputError, match=words), write_atomically(path) as temporary:
        temporary.write_text("new")
        if where == "write":
            fail()
    monkeypatch.undo()
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("r.json", "old")]


def test_no_room_for_a_copy_of_a_large_log(log, tmp_path, monkeypatch) -> None:
    """A log that must be copied first says where the room is missing."""
    monkeypatch.setattr(recording, "MAX_IN_MEMORY_BYTES", 1000)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(copies.pq.ParquetWriter, "write_table", full)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with raises_code("file_too_large"):
        open_log(log)


def test_a_very_long_name_is_written(tmp_path) -> None:
    """A name as long as file systems allow leaves no room for a longer temporary one, and needs none."""
    path = tmp_path / (251 * "x" + ".csv")
    write_whole(path, "whole")
    assert path.read_text() == "whole"


def test_no_output_overwrites_an_input(tmp_path, capsys) -> None:
    """For every command and every argument that names a file to read: naming it as an output as well is refused."""
    app, tried = build_app(), 0
    written = {"--json", "--report", "--out", "--propose", "--save-cameras", "--save-camera", "--picture", "--rapid"}
    written |= {"--resume", "--corrected"}
    for command in COMMANDS:
        options = list_options(app, command)
        for label, argument in options.items():
            reads = is_path(argument) or label in ("LOG", "ROBOT", "A", "B")
            if not reads or label in written:
                continue
            path = tmp_path / "input.csv"
            path.write_text("q_axis: precious\n")
            argv = [*command.split(), *_list_needed(options, label, path), "--json", str(path)]
            if label.startswith("-"):
                argv += [label, str(path)]
            status = main(argv)
            said = capsys.readouterr().err
            assert status == 2 and "would be overwritten" in said, f"{' '.join(argv)}: {said}"
            assert path.read_text() == "q_axis: precious\n"
            tried += 1
    assert tried > 20


def _list_needed(options: dict[str, Any], label: str, path: Path) -> list[str]:
    """Return the arguments that a command cannot do without, one of them naming the file."""
    found = []
    for name, argument in options.items():
        plain = {"--pattern": "8x6", "--square": "0.04", "--out": "made.csv"}.get(name, "linear_axis")
        value = str(path) if name == label else next(iter(argument.get_choices() or [plain]))
        if not name.startswith("-") and (argument.required or name == label):
            found.append(value)
        elif name.startswith("-") and argument.required and name != label:
            found += [name, value]
    return found


def test_the_files_of_a_column_map_are_inputs(log, tmp_path, capsys) -> None:
    """A map that takes columns from further files makes these inputs, too."""
    (tmp_path / "map.yaml").write_text(
        "files: {force: force.csv}\nq_axis: q_axis\ntau_axis: {column: f, file: force}\n"
    )
    (tmp_path / "force.csv").write_text("f\n" + "1\n" * 1000)
    argv = ["check", log, "--columns", tmp_path / "map.yaml", "--json", tmp_path / "force.csv"]
    says(capsys, argv, "force.csv is an input of this command and would be overwritten")


def test_a_recording_in_pieces_is_not_overwritten(log, tmp_path, capsys) -> None:
    """Nor is one of a folder's files."""
    folder = tmp_path / "day"
    folder.mkdir()
    log.rename(folder / "a.parquet")
    argv = ["identify", "linear_axis", folder, "--json", folder / "a.parquet"]
    says(capsys, argv, "a.parquet is an input of this command and would be overwritten")
