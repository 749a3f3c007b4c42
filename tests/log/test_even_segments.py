"""What a recording on disk says of itself: where it is cut, and which bytes it was."""

from __future__ import annotations

import hashlib
import tracemalloc

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.log import (
    MAX_MAGNITUDE,
    ColumnMap,
    Log,
    ensure_even,
    even_segments,
    open_log,
    read_log,
    recording,
    split_at_gaps,
    split_even_segments,
)

N = 2000


@pytest.fixture(autouse=True)
def everything_is_large(monkeypatch) -> None:
    """Let small files take the way of large ones."""
    monkeypatch.setattr(recording, "MAX_IN_MEMORY_SAMPLES", 100)


def stored(path, t: np.ndarray):
    pd.DataFrame({"t": t, "q_axis": np.sin(3 * t), "tau_axis": np.cos(5 * t)}).to_parquet(path)
    return path


@pytest.mark.parametrize(("gaps", "more"), [(1, ""), (3, ""), (5, " and 2 more")])
def test_three_gaps_are_named_and_the_rest_counted(tmp_path, gaps: int, more: str) -> None:
    """A pause of 0.5 s before every 300th sample: the first three with their places, and how many there are."""
    t = 1e-3 * np.arange(N)
    for k in range(1, gaps + 1):
        t[300 * k :] += 0.5
    pieces = split_even_segments(open_log(stored(tmp_path / "log.parquet", t)))
    places = ", ".join(f"0.501 s before sample {300 * k + 1}" for k in range(1, min(gaps, 3) + 1))
    assert [piece.n_samples for piece in pieces] == [300] * gaps + [N - 300 * gaps]
    (said,) = pieces[0].warnings
    assert said.startswith(f"log.parquet has {gaps} gap")
    assert said.endswith(f" in time: {places}{more}; it is cut there, not bridged.")


def test_a_recording_carries_the_hash_of_its_file(tmp_path) -> None:
    """One file: its SHA-256, as `sha256sum` gives it and as the log in memory has it; several: that of their hashes, in order."""
    t = 1e-3 * np.arange(N)
    path = stored(tmp_path / "a.parquet", t)
    own = hashlib.sha256(path.read_bytes()).hexdigest()
    assert open_log(path).sha256 == own == read_log(path).sha256
    other = hashlib.sha256(stored(tmp_path / "b.parquet", t + 10).read_bytes()).hexdigest()
    assert open_log(tmp_path).sha256 == hashlib.sha256((own + other).encode()).hexdigest()


def test_a_file_that_is_written_to_meanwhile_has_no_hash(tmp_path) -> None:
    """Nobody knows which bytes were read."""
    recording = open_log(stored(tmp_path / "a.parquet", 1e-3 * np.arange(N)))
    stored(tmp_path / "a.parquet", 1e-3 * np.arange(N + 50))
    with raises_code("damaged_file", "a.parquet"):
        _ = recording.sha256


def test_scanning_the_clock_keeps_no_clock() -> None:
    """Of ten million times less than a sixth is kept; at 10^8 all of them were 1.6 GB."""
    n, size = 10_000_000, 100_000
    tracemalloc.start()
    try:
        scan = even_segments._Scan(n)
        for first in range(0, n, size):
            scan.add(1e-3 * np.arange(first, first + size))
        kept = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert kept < 16 * n / 6


def test_a_stretch_is_judged_by_its_own_clock_alone(tmp_path) -> None:
    """Before a gap steps stray by 20 % and are interpolated; after it they do not, and samples are taken as they are."""
    t = 1e-3 * np.arange(N) + np.where(np.arange(N) < N // 2, 0.0, 1.0)
    t[: N // 2] += 2e-4 * np.random.default_rng(5).uniform(-1, 1, N // 2)
    t[:2] = [0.0, 1e-3]
    pd.DataFrame({"t": t, "q_axis": t, "tau_axis": t}).to_parquet(tmp_path / "log.parquet", row_group_size=N // 2)
    pieces = split_even_segments(open_log(tmp_path / "log.parquet"))
    assert [piece.clock for piece in pieces] == ["uneven", "even"]


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_an_uneven_stretch_reaches_from_its_first_to_its_last_sample(tmp_path, lost: int) -> None:
    """As many even samples as steps and one more, first and last where the recording's are, as for a log in memory."""
    rng = np.random.default_rng(5)
    t = 1e-3 * np.arange(N) + 2e-4 * rng.uniform(-1, 1, N)
    t = np.delete(t, 400 + np.arange(lost))
    path = stored(tmp_path / "log.parquet", t)
    (piece,) = split_even_segments(open_log(path))
    (whole,) = [ensure_even(part) for part in split_at_gaps(read_log(path))]
    assert (piece.clock, piece.n_samples, piece.n_recorded) == ("uneven", whole.n_samples, len(t))
    end = piece.window(piece.n_samples - 3, piece.n_samples, ("q_axis",))
    assert end.t[-1] == pytest.approx(t[-1], abs=1e-9) and piece.t0 == t[0]
    assert_allclose(end.channels["q_axis"], whole.channels["q_axis"][-3:], atol=1e-9)
    assert sum("interpolated" in said for said in piece.warnings) == 1


def test_numbers_are_judged_by_their_size_in_our_units(tmp_path) -> None:
    """Without a map a foreign file's own; with one, after its scale: what is too large then is refused, with its row."""
    big = 0.75 * MAX_MAGNITUDE
    frame = pd.DataFrame({"t": 1e-3 * np.arange(N), "q_axis": np.full(N, big), "tau_axis": np.zeros(N)})
    frame.to_parquet(tmp_path / "big.parquet")
    plain = open_log(tmp_path / "big.parquet")
    assert plain.window(3, 5, ("q_axis",)).channels["q_axis"].tolist() == [big, big]
    for scale, fits in ((1.0, True), (2.0, False), (-2.0, False)):
        map_ = ColumnMap.from_dict({"t": "t", "q_axis": {"column": "q_axis", "scale": scale}})
        scaled = open_log(tmp_path / "big.parquet", map_)
        if fits:
            assert scaled.window(3, 5, ("q_axis",)).channels["q_axis"].tolist() == [big, big]
        else:
            with raises_code("bad_sample", "big.parquet", "1", "q_axis"):
                scaled.window(3, 5, ("q_axis",))


@pytest.mark.parametrize("clock", ["even", "uneven", "in memory"])
def test_a_survey_is_the_whole_or_windows_spread_over_it(tmp_path, clock: str) -> None:
    """Eight windows of an eighth each, from the first sample to the last; a log in memory is always whole."""
    t = 1e-3 * np.arange(N) + (2e-4 * np.random.default_rng(5).uniform(-1, 1, N) if clock == "uneven" else 0.0)
    path = stored(tmp_path / "log.parquet", t)
    if clock == "in memory":
        log = read_log(path)
        piece = even_segments.InMemorySegment(log)
        assert (piece.name, piece.n_samples, piece.rate_hz) == (log.name, N, log.rate_hz)
        assert piece.survey(("q_axis",), 100) == [log]
        assert piece.window(5, 9, ("q_axis",)).t.tolist() == log.t[5:9].tolist()
        return
    (piece,) = split_even_segments(open_log(path))
    assert piece.name == "log.parquet" and piece.rate_hz == pytest.approx(1000, rel=1e-3)
    (whole,) = piece.survey(("q_axis",), piece.n_samples)
    assert whole.n_samples == piece.n_samples
    parts = piece.survey(("q_axis",), piece.n_samples - 1)
    size = (piece.n_samples - 1) // 8
    assert [part.n_samples for part in parts] == [size] * 8
    assert_allclose([parts[0].t[0], parts[-1].t[-1]], [whole.t[0], whole.t[-1]])
    assert_allclose(np.diff([part.t[0] for part in parts]), (piece.n_samples - size) / 7 * piece.dt, atol=2 * piece.dt)
    assert len(piece.survey(("q_axis",), 100, count=3)) == 3


def test_a_joints_temperature_is_its_own_else_the_rooms() -> None:
    """Of all joints asked for, or of none."""
    log = Log(
        np.arange(3.0),
        {"temp_a": np.array([1.0, 2, 3]), "temp_b": np.array([4.0, 5, 6]), "temp_room": np.array([7.0, 8, 9])},
    )
    assert log.temperatures(name for name in "ba").tolist() == [[4, 1], [5, 2], [6, 3]]  # type: ignore[union-attr]
    assert log.temperatures("ac").tolist() == [[7, 7], [8, 8], [9, 9]]  # type: ignore[union-attr]
    assert Log(np.arange(3.0), {"temp_a": np.ones(3)}).temperatures("ac") is None
