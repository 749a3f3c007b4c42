"""What a recording on disk says of itself: where it is cut, and which bytes it was."""

from __future__ import annotations

import hashlib
import tracemalloc

import numpy as np
import pandas as pd
import pytest

from tau_dyn.exceptions import InputError
from tau_dyn.log import open_log, read_log, stream, stretch, stretches

N = 2000


@pytest.fixture(autouse=True)
def everything_is_large(monkeypatch) -> None:
    """Let small files take the way of large ones."""
    monkeypatch.setattr(stream, "LARGE", 100)


def stored(path, t: np.ndarray):
    pd.DataFrame({"t": t, "q_axis": np.sin(3 * t), "tau_axis": np.cos(5 * t)}).to_parquet(path)
    return path


@pytest.mark.parametrize(("gaps", "more"), [(1, ""), (3, ""), (5, " and 2 more")])
def test_three_gaps_are_named_and_the_rest_counted(tmp_path, gaps: int, more: str) -> None:
    """A pause of 0.5 s before every 300th sample: the first three with their places, and how many there are."""
    t = 1e-3 * np.arange(N)
    for k in range(1, gaps + 1):
        t[300 * k :] += 0.5
    pieces = stretches(open_log(stored(tmp_path / "log.parquet", t)))
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
    with pytest.raises(InputError, match="a.parquet was written to while it was read"):
        _ = recording.sha256


def test_scanning_the_clock_keeps_no_clock() -> None:
    """Of ten million times less than a sixth is kept; at 10^8 all of them were 1.6 GB."""
    n, size = 10_000_000, 100_000
    tracemalloc.start()
    try:
        scan = stretch._Scan(n)
        for first in range(0, n, size):
            scan.add(1e-3 * np.arange(first, first + size))
        kept = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert kept < 16 * n / 6
