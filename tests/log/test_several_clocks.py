"""Signals of several clocks in text files: put on the slowest clock that a fit compares, with the error, or refused."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.log import ColumnMap, read_log
from tau_dyn.message_codes import get_code

FAST, SLOW = 0.002 * np.arange(5000), 0.0007 + 0.008 * np.arange(1240)


def position(t):
    return np.sin(3 * t) + 0.2 * np.sin(11 * t)


def force(t):
    return 4.0 * np.cos(5 * t)


def write_pair(folder: Path, clock: str = "t", slow=SLOW, fast=FAST) -> Path:
    pd.DataFrame({"t": fast, "q_axis": position(FAST[: len(fast)])}).to_csv(folder / "q.csv", index=False)
    pd.DataFrame({clock: slow, "tau_axis": force(SLOW[: len(slow)])}).to_csv(folder / "f.csv", index=False)
    return folder / "q.csv"


def build_map(file: object = "f.csv", **more: object) -> ColumnMap:
    return ColumnMap.from_dict(
        {
            "files": {"q": "q.csv", "f": file},
            "t": {"file": "q", "column": "t"},
            "q_axis": {"file": "q", "column": "q_axis"},
            "tau_axis": {"file": "f", "column": "tau_axis"},
            **more,
        }
    )


def assert_truth(log, atol=2e-6) -> None:
    assert_allclose(log.dt, 0.008, rtol=1e-6)
    t = log.t - log.t[0] + SLOW[0] if log.t[0] < SLOW[0] else log.t
    assert_allclose(log.channels["q_axis"], position(t), atol=atol)
    assert_allclose(log.channels["tau_axis"], force(t), atol=atol)


@pytest.mark.parametrize(("clock", "file"), [("t", "f.csv"), ("stamp", {"path": "f.csv", "t": "stamp"})])
def test_files_of_two_rates_are_put_on_the_slower_clock(tmp_path, clock, file) -> None:
    """Positions at 500 Hz and forces at 125 Hz: forces keep their samples, positions are interpolated to 2e-6 rad."""
    log = read_log(write_pair(tmp_path, clock), build_map(file))
    assert_truth(log)
    assert {get_code(w) for w in log.warnings} == {"clocks_joined"}


def test_a_file_s_clock_has_a_unit_of_its_own(tmp_path) -> None:
    """Milliseconds in one file, seconds in the other."""
    log = read_log(
        write_pair(tmp_path, "ms", 1000 * SLOW), build_map({"path": "f.csv", "t": {"column": "ms", "scale": 1e-3}})
    )
    assert_truth(log)


def test_wall_clocks_of_two_files_are_one_time(tmp_path) -> None:
    """Stamps of both files count from one moment, whatever sample comes first."""
    start = datetime.datetime(2026, 3, 2, 10, 15, 30)
    fast, slow = ([(start + datetime.timedelta(seconds=float(x))).isoformat(" ") for x in t] for t in (FAST, SLOW))
    log = read_log(write_pair(tmp_path, "t", slow, fast), build_map())
    assert_allclose(log.channels["q_axis"], position(SLOW[: log.n_samples]), atol=3e-6)
    assert_allclose(log.channels["tau_axis"], force(SLOW[: log.n_samples]), atol=1e-9)


def test_columns_filled_in_rows_of_their_own_have_clocks_of_their_own(tmp_path) -> None:
    """An outer join of two topics leaves half of each row empty; no row is complete."""
    one = pd.DataFrame({"t": FAST, "q_axis": position(FAST)})
    two = pd.DataFrame({"t": SLOW, "tau_axis": force(SLOW)})
    pd.merge(one, two, on="t", how="outer").sort_values("t").to_csv(tmp_path / "a.csv", index=False)
    assert_truth(read_log(tmp_path / "a.csv"))


def test_a_slow_temperature_sets_no_clock(tmp_path) -> None:
    """One reading a second is interpolated onto the forces' clock."""
    slow = np.where(np.arange(FAST.size) % 500 == 0, 20.0 + FAST, np.nan)
    frame = pd.DataFrame({"t": FAST, "q_axis": position(FAST), "tau_axis": force(FAST), "temp_axis": slow})
    frame.to_csv(tmp_path / "a.csv", index=False)
    log = read_log(tmp_path / "a.csv")
    assert log.rate_hz == pytest.approx(500) and log.n_samples == 4501
    assert_allclose(log.channels["temp_axis"], 20.0 + log.t, atol=1e-9)


def test_recordings_of_two_days_are_not_joined(tmp_path) -> None:
    """Clocks with nothing in common are no parts of one recording."""
    with raises_code("mismatch", "too little time in common"):
        read_log(write_pair(tmp_path, "t", 100.0 + SLOW), build_map())


def test_lengths_without_clocks_name_the_map_that_would_do(tmp_path) -> None:
    """Two rates and no clock for the second file."""
    with raises_code("mismatch", "have a clock each", "t: COLUMN"):
        read_log(write_pair(tmp_path, "stamp"), build_map())


def test_a_map_gives_its_entries_back() -> None:
    """Files with clocks, couplings, scales: the entries of a map make the same map."""
    entries = {
        "files": {"q": "q.csv", "f": {"path": "f.csv", "t": {"column": "ms", "scale": 0.001}}},
        "couplings": {"tau": [[1.0, 0.5], [0.0, 1.0]], "tau_offset": [0.0, 1.0]},
        "t": {"column": "t", "file": "q"},
        "q_a": {"column": "a", "scale": 2.0, "offset": 1.0, "file": "q"},
        "q_b": {"column": "b", "file": "q"},
        "tau_a": {"column": "a", "file": "f"},
        "tau_b": {"column": "b", "file": "f"},
    }
    kept = ColumnMap.from_dict(entries).to_dict()
    assert kept == entries == yaml.safe_load(yaml.safe_dump(kept))
    assert ColumnMap.from_dict(kept).to_dict() == entries
    assert ColumnMap.from_dict({"t": {"rate_hz": 50}, "q_a": 3}).to_dict() == {"t": {"rate_hz": 50.0}, "q_a": "3"}
