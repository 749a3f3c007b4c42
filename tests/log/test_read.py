"""Files become logs, and every fault of a file is one sentence with its place."""

import hashlib

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from tau_dyn.exceptions import InputError
from tau_dyn.log import read_log


def refusal(path, columns=None) -> str:
    """Return the message with which a file is refused, which has to be one line."""
    with pytest.raises(InputError) as caught:
        read_log(path, columns)
    message = str(caught.value)
    assert "\n" not in message and path.name in message and message.endswith((".", "?"))
    return message


def test_a_good_file_is_read_in_full(csv_file, good_lines):
    """Times, positions and forces arrive, with the hash of the bytes and without warnings."""
    path = csv_file(good_lines)
    log = read_log(path)
    assert log.n_samples == 20 and log.warnings == () and log.name == "monday.csv"
    assert_allclose(log.t, 0.004 * np.arange(20))
    assert_allclose(log.joint("tau", ["axis"])[:, 0], 5.0 - np.arange(20))
    assert log.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("separator", [",", ";", "\t", ", "])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_line_ends_separators_and_byte_order_marks_do_not_matter(csv_file, good_lines, newline, separator, mark):
    """Excel, Windows and old loggers write the same log in other bytes."""
    lines = [line.replace(",", separator) for line in good_lines]
    lines[0] = mark + lines[0]
    log = read_log(csv_file(lines, newline=newline, end=newline))
    assert list(log.channels) == ["q_axis", "tau_axis"]
    assert_allclose(log.channels["q_axis"], 0.1 * np.arange(20))


def test_comments_and_blank_lines_are_skipped_but_counted(csv_file, good_lines):
    """A fault under two comments and a blank line is named by the line an editor shows."""
    good_lines[5] = "0.016,oops,1.0"
    lines = ["# robot 7", "#, second, comment", "", *good_lines]
    assert refusal(csv_file(lines)).startswith("monday.csv, line 9, column q_axis: 'oops' is not a number")


def test_parquet_gives_the_same_log_as_csv(tmp_path, csv_file, good_lines):
    """The suffix decides; the numbers are the same."""
    csv = read_log(csv_file(good_lines))
    csv.to_frame().to_parquet(tmp_path / "monday.parquet")
    log = read_log(tmp_path / "monday.parquet")
    assert_allclose(log.to_frame(), csv.to_frame())


def test_a_parquet_fault_names_its_row(tmp_path):
    """Rows of Parquet count from 1."""
    frame = pd.DataFrame({"t": np.arange(20.0), "q_axis": np.arange(20.0)})
    frame.loc[4, "q_axis"] = np.inf
    frame.to_parquet(tmp_path / "a.parquet")
    assert refusal(tmp_path / "a.parquet").startswith("a.parquet, row 5, column q_axis: inf is not a finite number")


def test_csv_under_a_parquet_name_is_refused(csv_file, good_lines):
    """What is no Parquet is said to be none."""
    assert "is not a Parquet file" in refusal(csv_file(good_lines, name="monday.parquet"))


def test_a_missing_file_a_folder_and_a_foreign_format_are_named(tmp_path, csv_file):
    """There is nothing to read: no traceback, a path."""
    assert "there is no such file" in refusal(tmp_path / "none.csv")
    assert "is a folder" in refusal(tmp_path)
    assert "MCAP" in refusal(csv_file(b"\x89MCAP0\r\n", name="a.mcap"))


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "is empty"),
        (b"# only a comment\n\n", "has no header"),
        (b"t,q_axis\n", "ends after its header in line 1"),
        (b"t,q_axis\n0,1\n0.1,2\n", "has 2 samples"),
        (b"\xff\xfet\x00,", "the UTF-16 text is damaged"),
        (b"0.0,1.0,2.0\n0.1,1.0,2.0\n", "the header is missing"),
        (b"t,q_axis,\n0,1,2\n", "column 3 has no name"),
    ],
)
def test_files_without_a_log_in_them_are_refused(csv_file, content, sentence):
    """Each kind of emptiness has a sentence of its own."""
    assert sentence in refusal(csv_file(content))


def test_bytes_that_are_not_utf8_are_named_by_line(csv_file, good_lines):
    """A Latin-1 degree sign in line 3 is found there."""
    content = "\n".join(good_lines).encode().replace(b"0.004,", b"0.004\xb0,") + b"\n"
    assert refusal(csv_file(content)).startswith("monday.csv, line 3: byte 0xb0 is not UTF-8")


def test_a_column_that_stands_twice_is_named(csv_file, good_lines):
    """Which of two columns q_axis is meant cannot be known."""
    good_lines[0] = "t,q_axis,q_axis"
    assert refusal(csv_file(good_lines)).startswith("monday.csv, line 1: column q_axis occurs twice")


def test_a_log_without_a_clock_says_what_it_has(csv_file, good_lines):
    """The missing t is named, with the columns there are and the way out."""
    good_lines[0] = "time,q_axis,tau_axis"
    message = refusal(csv_file(good_lines))
    assert "has no column t; it has time, q_axis, tau_axis" in message and "rate_hz" in message


@pytest.mark.parametrize("column", [0, 1, 2])
@pytest.mark.parametrize(
    ("cell", "complaint"),
    [
        ("-inf", "-inf is not a finite number"),
        ("1e999", "is not"),
        ("ERR", "'ERR' is not a number"),
        ("True", "'True' is not a number"),
        ("1_000", "'1_000' is not a number"),
    ],
)
def test_a_cell_that_is_no_number_is_named_by_line_and_column(csv_file, good_lines, column, cell, complaint):
    """t, q and tau are used, so every cell of theirs counts."""
    cells = good_lines[11].split(",")
    name, cells[column] = good_lines[0].split(",")[column], cell
    good_lines[11] = ",".join(cells)
    message = refusal(csv_file(good_lines))
    assert message.startswith(f"monday.csv, line 12, column {name}: ") and complaint in message


def test_time_running_backwards_is_named_with_both_times(csv_file, good_lines):
    """Two recordings joined in one file are the usual cause, and the sentence says so."""
    lines = [good_lines[0], *(f"{18.8 + 0.004 * k:.3f},0,0" for k in range(12)), "18.840,0,0"]
    assert refusal(csv_file(lines)) == (
        "monday.csv, line 14: t = 18.840 s comes after 18.844 s; logs must run forward in time. "
        "Two recordings joined? Pass them as two files."
    )


def test_a_repeated_time_is_named(csv_file, good_lines):
    """Rounded stamps stand twice."""
    good_lines[7] = good_lines[6]
    assert refusal(csv_file(good_lines)).startswith("monday.csv, line 8: t = 0.020 s occurs twice")


@pytest.mark.parametrize("row", ["0.020,0.5", "0.020,0.5,1.0,9.9", "# a late comment"])
def test_a_row_of_another_length_is_named(csv_file, good_lines, row):
    """Neither a missing nor a surplus cell may shift the others."""
    good_lines[6] = row
    assert refusal(csv_file(good_lines)).startswith("monday.csv, line 7 has ")


def test_a_surplus_cell_in_the_last_line_is_no_incomplete_line(csv_file, good_lines):
    """An unfinished line is shorter, never longer."""
    good_lines[-1] += ",7"
    assert "line 21 has 4 cells" in refusal(csv_file(good_lines))


@pytest.mark.parametrize("last", ["0.080", "0.080,1.0", "0.080,1.0,", "0.080,1.0,-", "0.080,1.0,3e-", "0.080,1.0,\0\0"])
def test_an_incomplete_last_line_is_left_out_with_a_warning(csv_file, good_lines, last):
    """A logger that was switched off in mid-line costs one sample."""
    log = read_log(csv_file([*good_lines, last], end=""))
    assert log.n_samples == 20
    assert log.warnings == ("monday.csv, line 22: the last line is incomplete and was left out.",)


def test_a_number_cut_short_does_not_pass_for_another(csv_file):
    """`1.5` of `1.523e-05` at the end of an unfinished file is not a position of 1.5 m."""
    lines = ["t,q_axis", *(f"{0.01 * k:.2f},{1.523e-05 * (k + 1):.3e}" for k in range(20)), "0.20,1.5"]
    log = read_log(csv_file(lines, end=""))
    assert log.n_samples == 20 and log.channels["q_axis"].max() < 1e-3
    assert read_log(csv_file(lines, end="\n")).n_samples == 21


def test_a_complete_last_line_needs_no_newline(csv_file, good_lines):
    """Many programs end a file without one."""
    log = read_log(csv_file(good_lines, end=""))
    assert log.n_samples == 20 and log.warnings == ()


def test_text_in_the_last_line_of_a_finished_file_is_a_fault(csv_file, good_lines):
    """With a newline behind it, the line was meant."""
    assert "line 22, column tau_axis" in refusal(csv_file([*good_lines, "0.080,1.0,x"]))


def test_foreign_columns_are_kept_if_they_are_numbers(csv_file, good_lines):
    """Holes and text in columns that nobody uses harm nobody."""
    lines = [good_lines[0] + ",lamp,mode,a_comment,sparse"]
    lines += [f"{line},{k},AUTO,fine,{k if k % 5 == 0 else ''}" for k, line in enumerate(good_lines[1:])]
    log = read_log(csv_file(lines))
    assert list(log.channels) == ["q_axis", "tau_axis", "lamp", "sparse"]
    assert np.isnan(log.channels["sparse"]).sum() == 16


def test_an_acceleration_of_a_joint_has_to_be_complete(csv_file, good_lines):
    """`a_axis` with `q_axis` is ours, and a row without it is a gap."""
    lines = [good_lines[0] + ",a_axis", *(f"{line},{k if k != 3 else ''}" for k, line in enumerate(good_lines[1:]))]
    log = read_log(csv_file(lines))
    assert log.n_samples == 19 and "line 5: 1 sample without a number (empty or nan) in a_axis" in log.warnings[0]


def test_quoted_cells_may_hold_separators(csv_file, good_lines):
    """A quoted comma is text, and a quote left open is a fault."""
    lines = [good_lines[0] + ",note", *(f'{line},"a, b"' for line in good_lines[1:])]
    assert read_log(csv_file(lines)).n_samples == 20
    lines[5] = good_lines[5] + ',"open'
    lines[6] = good_lines[6] + ',close"'
    assert refusal(csv_file(lines))


def test_of_several_rows_of_another_length_the_first_is_named(csv_file, good_lines):
    """Lines 5 and 9 have a cell more: whoever mends the file begins at the top."""
    good_lines[4] += ",7"
    good_lines[8] += ",7"
    assert "line 5 has 4 cells" in refusal(csv_file(good_lines))
