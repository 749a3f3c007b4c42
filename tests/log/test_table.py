"""A table of cells, before anybody asks what they mean: what Parquet may hold, which cells are numbers, what a file must be."""

from __future__ import annotations

import datetime
import hashlib
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_array_equal
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.log import MAX_MAGNITUDE, Table, read_table
from tau_dyn.log.delimited import MAX_COLUMNS
from tau_dyn.log.table import read_parquet_column


def table(**cells: object) -> Table:
    """Return a table of these columns, whose rows stand on lines 10, 11, .."""
    columns = {key: np.asarray(x) for key, x in cells.items()}
    n = len(next(iter(columns.values())))
    return Table("log.csv", Path("log.csv"), "", columns, 10 + np.arange(n))


def parquet(folder: Path, frame: pd.DataFrame | pa.Table, name: str = "log.parquet") -> Path:
    pq.write_table(frame if isinstance(frame, pa.Table) else pa.Table.from_pandas(frame), folder / name)
    return folder / name


@pytest.mark.parametrize("kind", ["f4", "f8", "i2", "u4", "O", "U"])
def test_numbers_are_numbers_however_they_are_kept(kind: str) -> None:
    """Floats, whole numbers, and texts of them."""
    cells = np.array([1, 2, 30]).astype(kind) if kind != "U" else np.array(["1", " 2.0", "3e1"])
    found = table(x=cells).numbers("x")
    assert found.dtype == np.float64
    assert_array_equal(found, [1, 2, 30])


@pytest.mark.parametrize(
    ("cells", "said"),
    [
        (np.array([1.0, np.nan, 3.0]), "log.csv, line 11, column x: nan is not a finite number"),
        (np.array([1.0, 2.0, -np.inf]), "log.csv, line 12, column x: -inf is not a finite number"),
        (np.array(["1", "two", "3"]), "log.csv, line 11, column x: 'two' is not a number"),
        (np.array(["1", "", "3"]), "log.csv, line 11, column x: the cell is empty"),
        (np.array([1.0, 2 * MAX_MAGNITUDE, 3.0]), "log.csv, line 11, column x: 2000000000000000.0 is beyond 1e[+]15"),
        (
            np.array([1.0, -1.1e282, 3.0]),
            "log.csv, line 11, column x: -1.1e[+]282 is no reading .* the file is damaged there",
        ),
        (np.array([-MAX_MAGNITUDE, 2.0, 3.0]), "log.csv, line 10, column x: -1000000000000000.0 is beyond"),
        (np.array([True, False]), "log.csv, line 10, column x: 'True' is not a number"),
        (np.array([10**400, 1, 2], object), "log.csv, line 10, column x: 1000.* is no reading"),
        (np.array(["2020-01-01"] * 3, "M8[s]"), "log.csv, line 10, column x: '2020-01-01.* is a date"),
        (np.array(["m", "0.1", "0.2"]), "log.csv, line 10 holds units"),
    ],
)
def test_a_cell_that_is_no_number_is_named(cells: np.ndarray, said: str) -> None:
    """The first of them, by its line; true, dates and what no quantity can be are none."""
    with pytest.raises(InputError, match=said):
        table(x=cells).numbers("x")


def test_a_size_is_judged_in_our_units() -> None:
    """A foreign number larger than any quantity may be one of ours times 1e9, and the other way round."""
    big = table(x=[1e3 * MAX_MAGNITUDE, 1.0])
    assert_array_equal(big.numbers("x", 1e-4), [1e3 * MAX_MAGNITUDE, 1.0])
    for scale in (1.0, -1e-3, 1e-3):
        with raises_code("bad_sample", "10"):
            big.numbers("x", scale)
    with raises_code("missing_column"):
        big.numbers("y")


@pytest.mark.parametrize("blank", ["", " ", "nan", "NaN", "NA", "null", "<NA>", "None", None, np.nan])
def test_a_column_that_nobody_relies_on_may_have_holes(blank: object) -> None:
    """Not text: then it is no column of numbers at all."""
    assert_array_equal(table(x=np.array(["1", blank, "3"], object)).numbers_or_none("x"), [1, np.nan, 3])
    assert table(x=np.array(["1", blank, "three"], object)).numbers_or_none("x") is None


@pytest.mark.parametrize("cells", [[b"\xff", b"\x00"], [[1.0, 2.0], [3.0, 4.0]], [[1.0], [3.0, 4.0]], [{"a": 1}, None]])
def test_bytes_and_lists_are_no_numbers(cells: list[object]) -> None:
    """A column of bytes, such as an image, of lists or of records is no column of numbers; it is text by its type's name."""
    column = read_parquet_column("log.parquet", "x", pa.chunked_array([pa.array(cells)]))
    assert table(x=column).numbers_or_none("x") is None
    with pytest.raises(InputError, match="x"):
        table(x=column).numbers("x")


def test_the_first_rows_keep_their_places_and_say_why() -> None:
    """A table that ends earlier, with one sentence more."""
    first = table(x=[1.0, 2.0, 3.0], y=[4.0, 5.0, 6.0]).first_rows(2, "cut")
    assert (first.n_rows, first.warnings, first.where(1)) == (2, ("cut",), "log.csv, line 11")
    assert_array_equal(first.cells["y"], [4, 5])


def test_parquet_comes_with_rows_and_the_hash_of_its_bytes(tmp_path) -> None:
    """Rows count from 1."""
    path = parquet(tmp_path, pd.DataFrame({"t": [0.0, 0.1], "note": ["a", "b"]}))
    found = read_table(path)
    assert (found.where(1), list(found.cells), found.n_rows) == ("log.parquet, row 2", ["t", "note"], 2)
    assert found.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert found.numbers_or_none("note") is None


def test_parquet_that_is_no_log_is_refused(tmp_path) -> None:
    """Names that stand twice, no rows, columns beyond all logs, dates that no clock shows."""
    twice = pa.Table.from_arrays([pa.array([1.0]), pa.array([2.0])], names=["t", "t"])
    wide = pa.Table.from_arrays([pa.array([1.0])] * (MAX_COLUMNS + 1), names=[f"c{k}" for k in range(MAX_COLUMNS + 1)])
    for content, said in (
        (twice, "log.parquet names column t twice; every column needs a name of its own"),
        (pd.DataFrame({"t": np.zeros(0)}), "log.parquet has columns but no rows"),
        (wide, f"log.parquet has {MAX_COLUMNS + 1} columns; a log has {MAX_COLUMNS} at most"),
    ):
        with pytest.raises(InputError, match=said):
            read_table(parquet(tmp_path, content))
    assert read_table(parquet(tmp_path, wide.select(range(MAX_COLUMNS)))).n_rows == 1


def test_parquet_that_claims_more_than_bytes_can_hold_is_refused(tmp_path) -> None:
    """A column of one number, twenty million times in kilobytes, is no recording; a hundred thousand times it may be."""
    for n, fits in ((10**5, True), (2 * 10**7, False)):
        whole = pa.Table.from_arrays([pa.array(np.zeros(n))], names=["t"])
        pq.write_table(whole, tmp_path / "log.parquet", compression="zstd")
        if fits:
            assert read_table(tmp_path / "log.parquet").n_rows == n
        else:
            with raises_code("file_format", f"{n}", "1"):
                read_table(tmp_path / "log.parquet")


def test_dates_are_no_numbers(tmp_path) -> None:
    """A clock in dates is refused with its row, not taken for nanoseconds."""
    day = [datetime.datetime(2024, 5, 1, 12, 0, k) for k in range(3)]
    with raises_code("bad_sample", "log.parquet", "1"):
        read_table(parquet(tmp_path, pd.DataFrame({"t": day}))).numbers("t")


def test_what_cannot_be_read_is_said(tmp_path) -> None:
    """Absent, a folder, empty, another program's."""
    with raises_code("file_not_found", "none.csv"):
        read_table(tmp_path / "none.csv")
    with raises_code("cannot_read"):
        read_table(tmp_path)
    (tmp_path / "empty.csv").touch()
    with raises_code("damaged_file", "empty.csv"):
        read_table(tmp_path / "empty.csv")
    (tmp_path / "run.mcap").write_bytes(b"\x89MCAP0\r\n")
    with raises_code("file_format", "run.mcap"):
        read_table(tmp_path / "run.mcap")
    (tmp_path / "log.pq").write_text("t,q_axis\n")
    with raises_code("file_format", "log.pq"):
        read_table(tmp_path / "log.pq")
    if os.geteuid():
        (tmp_path / "shut.csv").write_text("t\n")
        (tmp_path / "shut.csv").chmod(0)
        with pytest.raises(InputError, match="shut.csv cannot be read: Permission denied"):
            read_table(tmp_path / "shut.csv")
