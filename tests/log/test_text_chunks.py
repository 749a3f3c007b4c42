"""A large text log some lines at a time: every line once, under its own number, and every byte in the hash."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from raising import raises_code

from tau_dyn.log import copies, open_log, read_log, recording as on_disk
from tau_dyn.log.copies import iterate_text_chunks as chunks

HEADER = "# from the cell next door\n\nt,q_axis\n"
ROWS = [f"{k / 100},{k * k / 7}\n" for k in range(400)]


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch) -> None:
    """Parse a kilobyte at once."""
    monkeypatch.setattr(copies, "CHUNK_BYTES", 1000)


def written(folder: Path, text: str) -> Path:
    (folder / "log.csv").write_text(text)
    return folder / "log.csv"


def rows_of(tables) -> tuple[np.ndarray, np.ndarray]:
    """Return all times, and the lines that they stand on."""
    tables = list(tables)
    return np.concatenate([x.numbers("t") for x in tables]), np.concatenate([x.places for x in tables])


def test_every_row_comes_once_under_its_lines_number(tmp_path) -> None:
    """Blank stretches longer than a piece, in the middle and at the end, count as lines and give no rows."""
    text = HEADER + "".join(ROWS[:100]) + "\n" * 3500 + "".join(ROWS[100:]) + "\n" * 4200
    t, places = rows_of(chunks(written(tmp_path, text)))
    assert_array_equal(t, np.arange(400) / 100)
    assert_array_equal(places, [*range(4, 104), *range(3604, 3904)])


def test_every_byte_goes_into_the_hash_and_nobody_has_to_ask_for_one(tmp_path) -> None:
    """Comments, blank lines and all: the SHA-256 that `sha256sum` gives."""
    text = HEADER + "".join(ROWS[:200]) + "\n" * 3500 + "".join(ROWS[200:])
    path, digest = written(tmp_path, text), hashlib.sha256()
    with_hash, without = rows_of(chunks(path, digest)), rows_of(chunks(path))
    assert digest.hexdigest() == hashlib.sha256(path.read_bytes()).hexdigest()
    for one, other in zip(with_hash, without, strict=True):
        assert_array_equal(one, other)


@pytest.mark.parametrize("more", ["".join(ROWS[:300]), "9", "9,9\n9", "\n"])
@pytest.mark.parametrize("end", ["", "5.0,1", "5.0"])
def test_a_file_that_grows_meanwhile_is_read_as_far_as_it_went(tmp_path, end: str, more: str) -> None:
    """Whole lines, the rest of a line or a line's end may follow while it is read: rows and hash are of what was there."""
    path, digest = written(tmp_path, HEADER + "".join(ROWS) + end), hashlib.sha256()
    before = path.read_bytes()
    expected = rows_of(chunks(path))
    reading = chunks(path, digest)
    first = next(reading)
    with path.open("a") as file:
        file.write(more)
    found = rows_of([first, *reading])
    assert_array_equal(found[0], expected[0])
    assert_array_equal(found[1], expected[1])
    assert digest.hexdigest() == hashlib.sha256(before).hexdigest()


def test_a_file_that_is_cut_short_meanwhile_ends_there(tmp_path) -> None:
    """Nothing is waited for; what is gone is not made up."""
    path = written(tmp_path, HEADER + "".join(ROWS))
    reading = chunks(path)
    first = next(reading)
    with path.open("r+") as file:
        file.truncate(3000)
    t, places = rows_of([first, *reading])
    assert_array_equal(t, np.arange(len(t)) / 100)
    assert_array_equal(places, 4 + np.arange(len(t)))
    assert 100 < len(t) < 300


def test_a_file_without_a_header_is_refused(tmp_path) -> None:
    """Comments and blank lines name no column; a header without a line's end is one."""
    with raises_code("missing_column", "log.csv"):
        list(chunks(written(tmp_path, "# one\n\n  # two\n")))
    assert list(chunks(written(tmp_path, "t,q_axis"))) == []


def test_a_fault_far_down_is_named_by_its_line_in_the_file(tmp_path) -> None:
    """A row of another length in line 304, wherever the pieces are cut."""
    rows = [*ROWS]
    rows[300] = "3.0,1,2\n"
    with raises_code("file_format", "log.csv", "304"):
        list(chunks(written(tmp_path, HEADER + "".join(rows))))


def test_a_large_text_log_carries_the_hash_of_its_file(tmp_path, monkeypatch) -> None:
    """The same as the log read at once; not that of the copy that it is read from."""
    path = written(tmp_path, HEADER + "".join(ROWS))
    whole = read_log(path)
    monkeypatch.setattr(on_disk, "MAX_IN_MEMORY_SAMPLES", 100)
    monkeypatch.setattr(on_disk, "MAX_IN_MEMORY_BYTES", 1000)
    recording = open_log(path)
    assert recording.sha256 == whole.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert_array_equal(recording.window(0, 400, ("q_axis",)).channels["q_axis"], whole.channels["q_axis"])
