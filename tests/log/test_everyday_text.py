"""Logs as spreadsheets, databases and recorders write them: the same samples come out, with a remark, or one true sentence."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.log import ColumnMap, Log, check_log, open_log, read_log
from tau_dyn.message_codes import get_code

N = 400
T = 0.004 * np.arange(N)
Q = np.sin(2 * T)
TAU = 3.0 * np.cos(2 * T) + 0.25
START = datetime.datetime(2026, 3, 2, 23, 59, 59, 500_000)  # the log crosses midnight


def write_rows(
    path: Path,
    times: Sequence[str],
    *,
    sign: str = ",",
    decimal: str = ".",
    head: str = "t,q_axis,tau_axis",
    above: str = "",
    below: str = "",
    end: str = "",
    encoding: str = "utf-8",
) -> Path:
    rows = [f"{t},{q:.9f},{tau:.9f}" for t, q, tau in zip(times, Q, TAU, strict=True)]
    rows = [row.replace(",", "\0").replace(".", decimal).replace("\0", sign) + end for row in rows]
    head = head.replace(",", sign) + end
    path.write_bytes((above + "\n".join([head, *([below] if below else []), *rows]) + "\n").encode(encoding))
    return path


def get_numbers() -> list[str]:
    return [f"{t:.3f}" for t in T]


def assert_same(log: Log) -> None:
    assert_allclose(log.t - log.t[0], T, rtol=0, atol=2e-6)
    assert_allclose(log.channels["q_axis"], Q, rtol=0, atol=1e-8)
    assert_allclose(log.channels["tau_axis"], TAU, rtol=0, atol=1e-8)


LAYOUTS = {
    "decimal commas, semicolons": {"sign": ";", "decimal": ","},
    "decimal commas, tabs": {"sign": "\t", "decimal": ","},
    "UTF-16": {"encoding": "utf-16"},
    "UTF-16 without a mark": {"encoding": "utf-16-le"},
    "byte order mark": {"encoding": "utf-8-sig"},
    "blank first rows": {"above": "\n,,\n , ,\n"},
    "sep= of Excel": {"above": "sep=;\n", "sign": ";", "decimal": ","},
    "a separator at the end of each line": {"end": ",", "head": "t,q_axis,tau_axis"},
    "units below the header": {"below": "s,rad,N m"},
    "units in brackets": {"below": "[s],[rad],[Nm]"},
}


@pytest.mark.parametrize("layout", LAYOUTS.values(), ids=LAYOUTS)
def test_layouts_of_spreadsheets_hold_the_same_samples(tmp_path, layout) -> None:
    """Locale, encoding, empty rows and rows of units change no sample."""
    assert_same(read_log(write_rows(tmp_path / "a.csv", get_numbers(), **layout)))


def test_quoted_decimal_commas_between_commas_are_numbers(tmp_path) -> None:
    """Cells in quotes keep their comma."""
    assert_same(read_log(write_quoted(tmp_path / "a.csv")))


def write_quoted(path: Path, *, head: str = "t,q_axis,tau_axis", end: str = "", longer: int = -1) -> Path:
    """Write decimal commas in quotes between commas; one row may have a cell too many."""
    rows = [",".join(f'"{x:.9f}"'.replace(".", ",") for x in row) + end for row in zip(T, Q, TAU, strict=True)]
    path.write_text("\n".join([head, *(row + ",0" * (k == longer) for k, row in enumerate(rows))]) + "\n")
    return path


def test_quoted_cells_may_end_with_a_separator(tmp_path) -> None:
    """A comma at the end of each line makes no column, although quoted cells hold commas as well."""
    assert_same(read_log(write_quoted(tmp_path / "a.csv", head="t,q_axis,tau_axis,", end=",")))


def test_one_row_with_a_cell_too_many_is_named(tmp_path) -> None:
    """A single long row between quoted decimal commas is that row's fault, and no decimal sign's."""
    path = write_quoted(tmp_path / "a.csv", longer=79)
    with raises_code("file_format", "line 81 has 4 cells", "every line needs 3"):
        read_log(path)


def test_one_cell_of_text_is_named_among_decimal_commas(tmp_path) -> None:
    """The refusal names the cell that is no number, and not the first number of its column."""
    path = write_rows(tmp_path / "a.csv", get_numbers(), sign=";", decimal=",")
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:80], lines[80].rpartition(";")[0] + ";ERR", *lines[81:]]) + "\n")
    with raises_code("bad_sample", "line 81", "'ERR' is not a number"):
        read_log(path)


def test_signs_between_thousands_belong_to_the_number(tmp_path) -> None:
    """1.234,5 is 1234.5 where decimal commas are in use."""
    path = tmp_path / "a.csv"
    path.write_text("t;q_axis\n" + "".join(f"{t:.3f};1.234,5\n".replace(".", ",", 1) for t in T))
    assert set(read_log(path).channels["q_axis"]) == {1234.5}


def test_commas_for_decimals_and_cells_at_once_are_refused(tmp_path) -> None:
    """0,004,0,5 has two readings; the sentence names the way out."""
    path = tmp_path / "a.csv"
    path.write_text("t,q_axis\n" + "".join(f"{t:.3f},0.5\n".replace(".", ",") for t in T))
    with raises_code("file_format", "decimal signs and separators", "semicolons"):
        read_log(path)


def test_units_other_than_si_ask_for_a_map(tmp_path) -> None:
    """Degrees below the header are not read as radians; the sentence has the map's line."""
    path = write_rows(tmp_path / "a.csv", get_numbers(), below="s,deg,N m")
    with raises_code("file_format", "q_axis: {column: q_axis, scale: 0.0174532925}"):
        read_log(path)


@pytest.mark.parametrize(("key", "line"), [("q_axis", "scale: 0.0174532925"), ("t", "scale: 0.001")])
def test_a_map_without_a_scale_does_not_make_degrees_radians(tmp_path, key: str, line: str) -> None:
    """Units below the header that differ from SI need the map's scale; with it the samples are those in SI."""
    path = write_rows(tmp_path / "a.csv", get_numbers(), head="clock,angle,torque", below="ms,deg,N m")
    lines = {
        "t": {"column": "clock", "scale": 0.001},
        "q_axis": {"column": "angle", "scale": 0.0174532925},
        "tau_axis": "torque",
    }
    log = read_log(path, ColumnMap.from_dict(lines))
    assert_allclose(log.channels["q_axis"], np.radians(Q), rtol=0, atol=1e-8)
    assert_allclose(log.t - log.t[0], 1e-3 * T, rtol=0, atol=1e-9)
    with raises_code("file_format", f"`{key}: {{column: ", line):
        read_log(path, ColumnMap.from_dict({**lines, key: lines[key]["column"]}))


def get_stamps(form: Callable[[datetime.datetime], str]) -> list[str]:
    return [form(START + datetime.timedelta(microseconds=4000 * k)) for k in range(N)]


STAMPS = {
    "ISO with a blank": lambda x: x.isoformat(" ", "microseconds"),
    "ISO with T and Z": lambda x: x.isoformat("T", "milliseconds") + "Z",
    "ISO with a zone": lambda x: x.isoformat() + "+02:00",
    "ISO without fractions at whole seconds": lambda x: x.isoformat(" "),
    "day first": lambda x: x.strftime("%d.%m.%Y %H:%M:%S.%f"),
    "day first, decimal comma": lambda x: x.strftime("%d.%m.%Y %H:%M:%S") + f";{x.microsecond:06d}".replace(";", ","),
    "month first, AM and PM": lambda x: x.strftime("%m/%d/%Y %I:%M:%S.%f %p"),
    "time of day": lambda x: x.strftime("%H:%M:%S.%f"),
    "minutes and seconds": lambda x: x.strftime("%M:%S.%f"),
    "duration": lambda x: f"0 days {datetime.timedelta(seconds=0.25) + (x - START)}",
}


@pytest.mark.parametrize("form", STAMPS.values(), ids=STAMPS)
def test_dates_and_times_of_day_are_clocks(tmp_path, form) -> None:
    """Seconds from the first sample, over midnight as well; the remark names the column."""
    log = read_log(write_rows(tmp_path / "a.csv", [f'"{x}"' for x in get_stamps(form)]))
    assert_same(log)
    assert any("column t" in sentence for sentence in log.warnings)


def test_dates_of_parquet_files_are_clocks(tmp_path) -> None:
    """Stamps with a time zone and without."""
    for zone in (None, "Europe/Berlin"):
        stamps = pd.date_range("2026-03-02 23:59:59", periods=N, freq="4ms", tz=zone)
        pd.DataFrame({"t": stamps, "q_axis": Q, "tau_axis": TAU}).to_parquet(tmp_path / "a.parquet")
        assert_same(open_log(tmp_path / "a.parquet"))


@pytest.mark.parametrize("first", [46_083.427431, 739_678.25, 0.0])
def test_numbers_that_count_days_become_seconds(tmp_path, first) -> None:
    """Excel's and MATLAB's day numbers, and days from the start: as seconds they would be a recording at 21.6 MHz."""
    log = read_log(write_rows(tmp_path / "a.csv", [f"{first + t / 86400:.12f}" for t in T]))
    assert_allclose(log.t - log.t[0], T, rtol=0, atol=2e-5)
    assert any("counts days" in sentence for sentence in log.warnings)


def test_a_short_fast_recording_in_seconds_counts_no_days(tmp_path) -> None:
    """A hammer blow at 51.2 kHz, and one at 1 MHz that starts at 12 s."""
    for t in (np.arange(N) / 51_200, 12.0 + np.arange(N) / 1e6):
        assert_allclose(read_log(write_rows(tmp_path / "a.csv", [f"{x:.9f}" for x in t])).t, t, atol=1e-9)


def test_whole_seconds_are_no_clock(tmp_path) -> None:
    """250 samples share a stamp; the sentence has their rate."""
    path = write_rows(tmp_path / "a.csv", [f"10:15:{30 + k // 100}" for k in range(N)])
    with raises_code("time_stamps", "whole seconds", "{rate_hz: 100}"):
        read_log(path)


@pytest.mark.parametrize("cell", ["", "nan", "NaN", "NULL", "#N/A"])
def test_samples_without_numbers_are_gaps(tmp_path, cell) -> None:
    """Rows without a number are left out with a remark; the first may be one, and is no row of units."""
    frame = pd.DataFrame({"t": get_numbers(), "q_axis": Q.astype(str), "tau_axis": TAU.astype(str)})
    frame.loc[[0, 7, 8], "tau_axis"] = cell
    frame.to_csv(tmp_path / "a.csv", index=False)
    log = read_log(tmp_path / "a.csv")
    kept = np.delete(np.arange(N), [0, 7, 8])
    assert_allclose(log.t, T[kept])
    assert_allclose(log.channels["tau_axis"], TAU[kept])
    assert [get_code(w) for w in log.warnings] == ["samples_left_out"] and "3 samples" in log.warnings[0]


def test_a_column_without_numbers_is_missing(tmp_path) -> None:
    """A driver that writes nan throughout has no effort: whoever asks for it reads the column's name."""
    pd.DataFrame({"t": T, "q_axis": Q, "tau_axis": np.nan}).to_csv(tmp_path / "a.csv", index=False, na_rep="nan")
    log = read_log(tmp_path / "a.csv")
    assert log.joints("tau") == () and [get_code(w) for w in log.warnings] == ["column_without_numbers"]
    with raises_code("missing_column", "tau_axis has no number in it"):
        log.joint("tau", ["axis"])
    assert not any("finish its file" in finding.remedy for finding in check_log(log).findings)


def test_a_part_beyond_the_end_states_the_range_of_the_log(tmp_path) -> None:
    """`log[100.0:]` of a log of 1.6 s holds nothing; the sentence gives the range."""
    log = read_log(write_rows(tmp_path / "a.csv", get_numbers()))
    with raises_code("too_little_data", "0 of 400 samples from 0 to 1.596 s"):
        log[100.0:]


def test_signals_in_rows_are_refused_with_the_way_to_turn_them(tmp_path) -> None:
    """One value a line with its topic's name: a log has a column for each signal."""
    rows = [(t, name, x) for t, q, tau in zip(T, Q, TAU, strict=True) for name, x in (("q_axis", q), ("tau_axis", tau))]
    pd.DataFrame(rows, columns=["t", "topic", "value"]).to_csv(tmp_path / "a.csv", index=False)
    with raises_code("file_format", "column topic", "pivot"):
        read_log(tmp_path / "a.csv")


def test_the_clock_that_is_advised_carries_its_scale(tmp_path) -> None:
    """`time_ms` in place of t: the map's line brings it to seconds."""
    path = write_rows(tmp_path / "a.csv", [f"{1000 * t:.0f}" for t in T], head="time_ms,q_axis,tau_axis")
    with raises_code("missing_column", "t: {column: time_ms, scale: 0.001}"):
        read_log(path)


@pytest.mark.parametrize(("size", "unit"), [(2**32, 1e-6), (2**16, 1e-3)])
def test_a_counter_that_restarts_goes_on(tmp_path, size: int, unit: float) -> None:
    """A counter of microseconds or milliseconds is full in the middle of the log: its range is added, with a remark."""
    ticks = np.round(T / unit).astype(np.int64)
    path = write_rows(tmp_path / "a.csv", [str(x) for x in (ticks + size - ticks[150] + 1) % size])
    log = read_log(path)
    assert_allclose((log.t - log.t[0]) * unit, T, rtol=0, atol=1e-6)
    assert "restarts at" in log.warnings[0] and get_code(log.warnings[0]) == "clock_converted"


def test_recordings_that_follow_each_other_are_no_counter(tmp_path) -> None:
    """A clock that restarts anywhere else goes backwards."""
    with raises_code("bad_sample", "comes after", "Two recordings joined"):
        read_log(write_rows(tmp_path / "a.csv", [f"{t:.3f}" for t in np.where(T < 0.8, T, T - 0.8)]))


def test_the_end_of_summer_time_is_named(tmp_path) -> None:
    """Local time goes back by one hour within the night of the change."""
    back = np.where(np.arange(N) < 200, 0, 3600)
    stamps = [(START + datetime.timedelta(seconds=float(t - b))).isoformat(" ") for t, b in zip(T, back, strict=True)]
    with raises_code("bad_sample", "line 202", "goes back by one hour", "UTC"):
        read_log(write_rows(tmp_path / "a.csv", stamps))


@pytest.mark.parametrize("names", [("sec", "nanosec"), ("header.stamp.secs", "header.stamp.nsecs")])
def test_seconds_and_nanoseconds_are_one_clock(tmp_path, names: tuple[str, str]) -> None:
    """Stamps of ROS in two columns: their sum is the time, without a map and with the line that `columns` proposes."""
    whole, part = (np.divmod(np.round(1e9 * (T + 0.3)).astype(np.int64), 10**9)[k] for k in (0, 1))
    frame = pd.DataFrame({names[0]: whole + 1764489600, names[1]: part, "q_axis": Q, "tau_axis": TAU})
    frame.to_csv(tmp_path / "a.csv", index=False)
    assert_same(read_log(tmp_path / "a.csv"))
    (tmp_path / "map.yaml").write_text(f"t: {names[0]}\nq_axis: q_axis\ntau_axis: tau_axis\n")
    assert_same(read_log(tmp_path / "a.csv", tmp_path / "map.yaml"))


def test_a_header_in_the_middle_joins_two_recordings(tmp_path) -> None:
    """A logger that appends writes its header again; the line is named, not the word that is no number."""
    path = write_rows(tmp_path / "a.csv", get_numbers())
    path.write_text(path.read_text() + path.read_text())
    with raises_code("file_format", "line 402 repeats the header", "two files"):
        read_log(path)


def test_the_index_that_pandas_writes_is_no_signal(tmp_path) -> None:
    """A first column without a name counts the rows; one that does not count has to have a name."""
    frame = pd.DataFrame({"t": get_numbers(), "q_axis": Q, "tau_axis": TAU})
    frame.to_csv(tmp_path / "a.csv")
    assert_same(read_log(tmp_path / "a.csv"))
    frame.iloc[::2].to_csv(tmp_path / "b.csv")
    with raises_code("missing_column", "column 1 has no name"):
        read_log(tmp_path / "b.csv")


@pytest.mark.parametrize(("marker", "rows"), [(-9999, [7, 8, 90]), (65535, [7])])
def test_a_marker_of_missing_readings_is_no_force(tmp_path, marker: int, rows: list[int]) -> None:
    """A whole number ten times beyond all others stands for a reading that was lost: those samples are gaps."""
    frame = pd.DataFrame({"t": T, "q_axis": Q, "tau_axis": TAU})
    frame.loc[rows, "tau_axis"] = marker
    frame.to_csv(tmp_path / "a.csv", index=False)
    log = read_log(tmp_path / "a.csv")
    assert_allclose(log.channels["tau_axis"], np.delete(TAU, rows))
    assert f"tau_axis is {marker} in {len(rows)} sample" in log.warnings[0]
