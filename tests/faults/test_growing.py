"""A log that is still being written: what was complete at the start is read, the rest is said, the hash is of what was read."""

from __future__ import annotations

import hashlib
from functools import wraps
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from raising import raises_code

from tau_dyn.log import copies, open_log, read_log, recording

N = 4000
T = np.arange(N) / 1000
Q = 0.3 * np.sin(2 * T)
TAU = 12.5 * np.cos(3 * T) + 1e-5 * np.sin(40 * T)


def text(n: int = N, form: str = "%.12g") -> str:
    """Return a log of n samples as a recorder writes it."""
    rows = zip(T[:n], Q[:n], TAU[:n], strict=True)
    return "t,q_axis,tau_axis\n" + "".join(f"{t:.4f},{form % q},{form % tau}\n" for t, q, tau in rows)


@pytest.fixture
def large(monkeypatch) -> None:
    """Let small files take the way of large ones."""
    monkeypatch.setattr(recording, "MAX_IN_MEMORY_SAMPLES", 100)
    monkeypatch.setattr(recording, "MAX_IN_MEMORY_BYTES", 1000)
    monkeypatch.setattr(copies, "CHUNK_BYTES", 20_000)


@pytest.mark.parametrize("form", ["%.12g", "%.6f", "%.5e"])
def test_cut_anywhere_in_its_last_line_a_log_is_its_complete_lines(tmp_path: Path, form: str) -> None:
    """At every byte of the last line: the whole lines, with a warning, or all where a number lost but its last digits."""
    whole = text(200, form)
    start = whole[:-1].rfind("\n") + 1
    path = tmp_path / "growing.csv"
    for cut in range(start, len(whole) + 1):
        path.write_text(whole[:cut])
        log = read_log(path)
        assert log.sha256 == hashlib.sha256(whole[:cut].encode()).hexdigest()
        assert log.n_samples in (199, 200)
        if log.n_samples == 200:
            assert abs(log.channels["tau_axis"][-1] - TAU[199]) <= 1e-5 * abs(TAU[199]), whole[start:cut]
        elif whole[start:cut]:
            assert log.warnings and "incomplete" in log.warnings[0]
        assert np.allclose(log.channels["tau_axis"][:199], TAU[:199], atol=1e-4)


def test_a_large_log_that_grows_while_it_is_copied(tmp_path, large, monkeypatch) -> None:
    """Lines that came after the start are not of this reading: rows and hash are of the file as it was then."""
    path = tmp_path / "growing.csv"
    whole = text()
    now, later = whole[: len(whole) // 2], whole[len(whole) // 2 :]
    path.write_text(now)
    parse = copies.parse_delimited
    pieces = iter([later[:5], later[5:], "9.5,1,2\n", ""])

    def parse_and_grow(*args, **options):
        with path.open("a") as file:
            file.write(next(pieces, "10,1,2\n"))
        return parse(*args, **options)

    monkeypatch.setattr(copies, "parse_delimited", parse_and_grow)
    recording = open_log(path)
    monkeypatch.undo()
    complete = now.count("\n") - 1
    assert path.stat().st_size > len(now) and recording.n_samples == complete
    assert recording.sha256 == hashlib.sha256(now.encode()).hexdigest()
    assert any("incomplete" in warning for warning in recording.warnings)


def test_an_incomplete_line_at_the_seam_of_two_pieces(tmp_path, large, monkeypatch) -> None:
    """Whatever the size of the pieces, the incomplete last line is never alone in one, where it could not be told."""
    path = tmp_path / "growing.csv"
    whole = text(300)
    path.write_text(whole[:-9])
    end = whole[:-1].rfind("\n") + 1
    for size in (end, end - 1, end + 1, end // 2, end // 2 - 1, end // 2 + 1, end // 3, 700):
        monkeypatch.setattr(copies, "CHUNK_BYTES", size)
        recording = open_log(path)
        assert recording.n_samples == 299 and len(recording.warnings) == 1, size


def stored(path: Path, n: int, shift: float = 0.0) -> Path:
    """Write a Parquet recording of n samples."""
    table = pa.table({"t": T[:n], "q_axis": Q[:n] + shift, "tau_axis": TAU[:n]})
    pq.write_table(table, path, row_group_size=500)
    return path


def test_parquet_that_is_written_anew_while_it_is_used_is_refused(tmp_path, large) -> None:
    """The hash would be that of other numbers than those that were used."""
    path = stored(tmp_path / "monday.parquet", 2000)
    recording = open_log(path)
    recording.window(0, 100, ["q_axis"])
    before = recording.sha256
    assert before == hashlib.sha256(path.read_bytes()).hexdigest()
    path.unlink()
    stored(path, 3000)
    with raises_code("damaged_file"):
        _ = recording.sha256


def test_a_file_recorded_anew_is_read_anew(tmp_path, large) -> None:
    """In one session: the second recording under a name is not answered from what is kept of the first."""
    path = stored(tmp_path / "monday.parquet", 2000)
    first = open_log(path).window(0, 1500, ["q_axis"])
    stored(path, 2000, shift=0.125)
    second = open_log(path).window(0, 1500, ["q_axis"])
    assert np.array_equal(second.channels["q_axis"], first.channels["q_axis"] + 0.125)


def test_an_input_that_changes_meanwhile_is_said(tmp_path, monkeypatch, capsys) -> None:
    """Somebody edits the column map while the command runs: the result says that its hash is of the new one."""
    from tau_dyn.cli import COMMANDS, main

    check = COMMANDS["check"]

    (tmp_path / "log.csv").write_text(text(500).replace("q_axis", "pos"))
    map_ = tmp_path / "map.yaml"
    map_.write_text("t: t\nq_axis: pos\ntau_axis: tau_axis\n")

    @wraps(check)
    def edited(*places, **options):
        outcome = check(*places, **options)
        map_.write_text("t: t\nq_axis: tau_axis\ntau_axis: tau_axis\n")
        return outcome

    monkeypatch.setitem(COMMANDS, "check", edited)
    assert main(["check", str(tmp_path / "log.csv"), "--columns", str(map_), "--quiet"]) == 0
    assert "map.yaml changed while it was used" in capsys.readouterr().err
