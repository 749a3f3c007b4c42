"""A recording on disk, read in windows, is the log that reading it at once would give; what is wrong with it is one sentence."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.log import (
    ColumnMap,
    Log,
    Recording,
    copies,
    ensure_even,
    open_log,
    read_log,
    recording as on_disk,
    split_at_gaps,
    split_even_segments,
)

N = 20_000
NAMES = ("q_axis", "tau_axis")


@pytest.fixture(autouse=True)
def everything_is_large(monkeypatch) -> None:
    """Let small files take the way of large ones."""
    monkeypatch.setattr(on_disk, "MAX_IN_MEMORY_SAMPLES", 100)
    monkeypatch.setattr(on_disk, "MAX_IN_MEMORY_BYTES", 1000)
    monkeypatch.setattr(copies, "CHUNK_BYTES", 40_000)


def table(t: np.ndarray | None = None) -> pd.DataFrame:
    """Return a smooth recording at 1 kHz."""
    t = 1e-3 * np.arange(N) if t is None else t
    return pd.DataFrame({"t": t, "q_axis": np.sin(3 * t), "tau_axis": np.cos(5 * t) + 0.01 * np.sin(700 * t)})


def stored(folder, frame: pd.DataFrame, name: str = "log.parquet"):
    frame.to_parquet(folder / name, row_group_size=1777)
    return folder / name


def joined(recording: Recording) -> list[Log]:
    """Return every even stretch, put together from windows of odd sizes."""
    found = []
    for piece in split_even_segments(recording):
        cuts = [*range(0, piece.n_samples, 1313), piece.n_samples]
        logs = [piece.window(a, b, NAMES) for a, b in zip(cuts[:-1], cuts[1:], strict=True) if b - a > 1]
        t, *channels = (
            np.concatenate([log.t if name == "t" else log.channels[name] for log in logs]) for name in ("t", *NAMES)
        )
        found.append(Log(t, dict(zip(NAMES, channels, strict=True))))
    return found


def agree(path, recording: Recording) -> None:
    """Compare with the whole log's even pieces."""
    whole = [ensure_even(piece) for piece in split_at_gaps(read_log(path))]
    pieces = joined(recording)
    assert len(pieces) == len(whole)
    for one, other in zip(pieces, whole, strict=True):
        n = one.n_samples
        assert other.n_samples - n in (0, 1)  # a window needs two samples
        assert_allclose(one.t, other.t[:n], rtol=0, atol=1e-9)
        for name in NAMES:
            assert_allclose(one.channels[name], other.channels[name][:n], rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["even", "gaps", "uneven", "lost", "rounded"])
def test_windows_on_an_even_clock_equal_the_whole_log(tmp_path, kind: str) -> None:
    """Gaps cut, lost samples and jitter interpolated, rounded stamps replaced: as for a log in memory, to 1e-9."""
    rng = np.random.default_rng(3)
    t = np.arange(N) / (1000.0 if kind != "rounded" else 930.0)
    if kind == "gaps":
        t[7000:] += 0.25
        t[15_000:] += 3.0
    if kind == "uneven":
        t = t + 2e-4 * rng.uniform(-1, 1, N)
    frame = table(np.round(t, 3) if kind == "rounded" else t)
    if kind == "lost":
        frame = frame.drop(index=[4000, 4001, 9000])
    path = stored(tmp_path, frame)
    recording = open_log(path)
    assert isinstance(recording, Recording)
    agree(path, recording)


def test_steps_of_two_lengths_by_turns_leave_none_usual(tmp_path) -> None:
    """Where every step is half as long again or half as long as their mean, the mean is the even clock's, as in memory."""
    t = 2.0**-10 * np.arange(N + 1)
    t[1::2] -= 2.0**-11
    path = stored(tmp_path, table(t))
    agree(path, open_log(path))
    assert [piece.dt for piece in split_even_segments(open_log(path))] == pytest.approx([2.0**-10], rel=1e-4)


def test_a_folder_is_one_recording(tmp_path) -> None:
    """Files that follow each other in time are joined in the order of their names, however they are cut."""
    frame = table()
    folder = tmp_path / "run"
    folder.mkdir()
    for k, part in enumerate(np.array_split(np.arange(N), 3)):
        stored(folder, frame.iloc[part], f"part_{k}.parquet")
    recording = open_log(folder)
    assert (recording.n_samples, recording.name, len(recording.paths)) == (N, "run", 3)
    (piece,) = split_even_segments(recording)
    whole = piece.window(0, N, NAMES)
    for name in NAMES:
        assert_allclose(whole.channels[name], frame[name], rtol=0, atol=0)
    assert len(recording.sha256) == 64


def test_a_large_text_file_is_the_same_recording(tmp_path) -> None:
    """Text is copied piece by piece; numbers come out to the last digit."""
    frame = table()
    path = tmp_path / "log.csv"
    path.write_text("# a comment\n" + frame.to_csv(index=False))
    recording = open_log(path)
    assert isinstance(recording, Recording) and recording.n_samples == N
    log = recording.whole()
    for name in NAMES:
        assert np.array_equal(log.channels[name], frame[name])


def test_foreign_columns_of_large_text_are_those_of_the_whole_log(tmp_path) -> None:
    """A flag to leave samples out by is kept, holes and all; what is text anywhere is left out, as in a log read at once."""
    flag = (np.arange(N) % 100 == 7).astype(float)
    flag[12_345] = np.nan
    frame = table().assign(flag=flag, mode="auto", state=[*[1] * (N - 1), "stop"])
    frame = frame.rename(columns={"q_axis": "pos"}).assign(temp_axis=30.0)
    path = tmp_path / "log.csv"
    frame.to_csv(path, index=False)
    map_ = ColumnMap.from_dict({"q_axis": {"column": "pos", "scale": 2.0}})
    whole, recording = read_log(path, map_), open_log(path, map_)
    assert isinstance(recording, Recording)
    log = recording.whole()
    assert set(log.channels) == set(whole.channels) == {"q_axis", "tau_axis", "temp_axis", "flag"}
    for name, values in whole.channels.items():
        assert np.array_equal(log.channels[name], values, equal_nan=True)


def test_huge_row_groups_are_cut(tmp_path, monkeypatch) -> None:
    """A file written as one row group does not have to fit in memory."""
    monkeypatch.setattr(on_disk, "GROUP_ROWS", 5000)
    frame = table()
    frame.to_parquet(tmp_path / "one.parquet", row_group_size=N)
    recording = open_log(tmp_path / "one.parquet")
    assert recording.paths == (tmp_path / "one.parquet",) and recording.copied is not None
    assert np.array_equal(recording.whole().channels["q_axis"], frame["q_axis"])


def test_foreign_columns_are_converted_window_by_window(tmp_path) -> None:
    """A column map scales and shifts what each window reads, and a rate stands in for a clock."""
    frame = table().rename(columns={"q_axis": "pos", "tau_axis": "cur"}).drop(columns="t")
    path = stored(tmp_path, frame)
    (tmp_path / "map.yaml").write_text(
        "t: {rate_hz: 1000}\nq_axis: {column: pos, scale: 0.001, offset: 0.2}\ntau_axis: {column: cur, scale: 2.5}\n"
    )
    map_ = ColumnMap.load(tmp_path / "map.yaml")
    whole, recording = read_log(path, map_), open_log(path, map_)
    part = split_even_segments(recording)[0].window(5000, 9000, NAMES)
    assert_allclose(part.t, whole.t[5000:9000], rtol=0, atol=1e-12)
    for name in NAMES:
        assert np.array_equal(part.channels[name], whole.channels[name][5000:9000])


def test_every_coupled_signal_is_mixed_as_in_the_whole_log(tmp_path) -> None:
    """Shared reducers couple references and load-side positions too, whose names hold an underscore."""
    frame = pd.DataFrame(
        {"t": 1e-3 * np.arange(N), **{c: np.sin(3e-3 * k * np.arange(N)) for k, c in enumerate("abcd", 1)}}
    )
    map_ = ColumnMap.from_dict(
        {
            "t": "t",
            "q_one": "a",
            "q_two": "b",
            "q_ref_one": "c",
            "q_ref_two": "d",
            "couplings": {"q": [[1, 0], [1, 1]], "q_ref": [[1, 0], [0.5, 2]]},
        }
    )
    path = stored(tmp_path, frame)
    whole, recording = read_log(path, map_), open_log(path, map_)
    part = recording.window(0, N, ("q_two", "q_ref_two"))
    for name in ("q_two", "q_ref_two"):
        assert_allclose(part.channels[name], whole.channels[name], rtol=0, atol=1e-15)


@pytest.mark.parametrize("column", ["tau_axis", "temp_axis"])
def test_a_hole_in_what_a_map_takes_is_no_sample(tmp_path, column: str) -> None:
    """Whatever a foreign column is called: in memory a row without a number is left out, and no window hides one."""
    frame = table().rename(columns={"q_axis": "pos", "tau_axis": "cur"})
    frame.loc[12_345, "cur"] = np.nan
    map_, path = ColumnMap.from_dict({"t": "t", "q_axis": "pos", column: "cur"}), stored(tmp_path, frame)
    assert read_log(path, map_).n_samples == N - 1
    with raises_code("bad_sample", "12346"):
        open_log(path, map_).window(0, N, ("q_axis", column))


def test_a_hole_in_a_temperature_is_no_sample(tmp_path) -> None:
    """Columns that count only beside a `q_` of their joint are checked there, as in a log read at once."""
    frame = table().assign(temp_axis=30.0)
    frame.loc[12_345, "temp_axis"] = np.nan
    path = stored(tmp_path, frame)
    assert read_log(path).n_samples == N - 1
    with raises_code("bad_sample", "12346", "temp_axis"):
        open_log(path).window(0, N, ("temp_axis",))


def test_a_column_that_a_map_took_is_not_there_under_its_own_name(tmp_path) -> None:
    """A foreign `temp_axis` that the map calls a force is no temperature any more."""
    frame = table().rename(columns={"tau_axis": "temp_axis"})
    map_, path = ColumnMap.from_dict({"t": "t", "q_axis": "q_axis", "tau_axis": "temp_axis"}), stored(tmp_path, frame)
    whole, recording = read_log(path, map_), open_log(path, map_)
    assert set(recording.whole().channels) == set(whole.channels)
    assert not recording.has("temp_axis") and recording.has("tau_axis")


def test_a_clock_since_1970_has_the_rate_of_the_whole_log(tmp_path) -> None:
    """There a double counts in steps of 2.4e-7 s, which moves the median step, and not the mean, by 1e-4 of 1 ms."""
    path = stored(tmp_path, table().assign(t=1.7e9 + 1e-3 * np.arange(N)))
    (piece,) = split_even_segments(open_log(path))
    assert_allclose(piece.rate_hz, read_log(path).rate_hz, rtol=1e-9)
    assert_allclose(piece.rate_hz, 1000.0, rtol=1e-6)


def broken(folder, kind: str):
    """Make something that cannot be read, and return what to open."""
    frame = table()
    if kind == "empty folder":
        return folder
    if kind == "other columns":
        stored(folder, frame, "a.parquet")
        stored(folder, frame.rename(columns={"tau_axis": "torque"}), "b.parquet")
        return folder
    if kind == "files back in time":
        stored(folder, frame, "a.parquet")
        stored(folder, frame, "b.parquet")
        return folder
    if kind == "nan":
        frame.loc[12_345, "tau_axis"] = np.nan
    if kind == "back in time":
        frame.loc[12_345, "t"] = 1.0
    if kind == "at rest":
        frame.loc[12_345, "t"] = frame.loc[12_344, "t"]
    if kind == "group begins late":
        frame.loc[1777, "t"] = frame.loc[1770, "t"]
    if kind == "no clock":
        frame = frame.drop(columns="t")
    if kind == "cut":
        path = stored(folder, frame)
        path.write_bytes(path.read_bytes()[:5000])
        return path
    if kind == "bad cell in text":
        path = folder / "log.csv"
        path.write_text(frame.to_csv(index=False).replace("\n0.005,", "\noops,"))
        return path
    return stored(folder, frame)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("empty folder", "no Parquet file"),
        ("other columns", "b.parquet has a column torque and a.parquet has none|the same columns"),
        ("files back in time", "b.parquet begins at t = 0 s, and a.parquet before it ends at 19.999 s"),
        ("nan", "row 12346, column tau_axis"),
        ("back in time", "row 12346: t = 1 s comes after"),
        ("at rest", "row 12346: t = 12.344 s occurs twice"),
        ("group begins late", "row 1778: t = 1.77 s comes after 1.776 s"),
        ("no clock", "no column t"),
        ("cut", "not a Parquet file"),
        ("bad cell in text", "line 7, column t: 'oops' is not a number"),
    ],
)
def test_what_is_wrong_is_one_sentence(tmp_path, kind: str, words: str) -> None:
    """A fault anywhere in a recording is named with its file and row."""
    with pytest.raises(InputError, match=words) as fault:
        for piece in split_even_segments(open_log(broken(tmp_path, kind))):
            piece.window(0, piece.n_samples, NAMES)
    assert "\n" not in str(fault.value)
