"""A log is frozen, gives joints by name, and is cut without losing a sample."""

import pickle

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.log import Log, read_log


@pytest.fixture
def log() -> Log:
    t = np.arange(100) / 250
    channels = {"q_a": t, "q_b": 2 * t, "q_ref_a": 3 * t, "tau_b": 4 * t, "temp_room": 20 + t, "qx_tool": t, "note": t}
    return Log(t, channels, name="two.csv")


def test_arrays_cannot_be_written_and_do_not_follow_their_source():
    """Whoever still holds the array a log was made of cannot change the log."""
    q = np.zeros(5)
    log = Log(np.arange(5.0), {"q_a": q})
    q[0] = 9.0
    assert log.channels["q_a"][0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        log.channels["q_a"][0] = 1.0
    with pytest.raises(TypeError):
        log.channels["q_b"] = q  # type: ignore[index]


def test_joints_are_read_from_column_names(log):
    """`q_ref_a` is a reference of `a` and no position of `ref_a`; room and tool belong to no joint."""
    assert log.joints("q") == ("a", "b")
    assert log.joints("q_ref") == ("a",)
    assert log.joints("tau") == ("b",)
    assert log.joints("temp") == ()


def test_joint_stacks_columns_in_the_order_asked_for(log):
    """The order of names, and not that of the file, decides the columns."""
    assert_array_equal(log.joint("q", ["b", "a"]), np.column_stack([2 * log.t, log.t]))


def test_a_missing_column_is_named_with_those_that_exist(log):
    """The message names the file, the column wanted and the columns there are."""
    with raises_code("missing_column", "two.csv", "tau_a", "q_a", "q_b", "tau_b"):
        log.joint("tau", ["b", "a"])
    assert not log.has("tau", ["a", "b"]) and log.has("tau", ["b"])


def test_rate_is_that_of_the_usual_step():
    """One lost sample moves neither dt nor the rate, and the duration runs from first to last sample."""
    t = np.delete(np.arange(101) / 250, 50)
    log = Log(t, {})
    assert_allclose([log.dt, log.rate_hz, log.duration], [0.004, 250, 0.4])
    assert log.n_samples == 100


def test_split_loses_and_repeats_no_sample(log):
    """70 % and the rest make the whole again."""
    train, held_out = log.split(0.7)
    assert train.n_samples == 70
    assert_array_equal(np.concatenate([train.t, held_out.t]), log.t)
    assert_array_equal(np.concatenate([train.channels["tau_b"], held_out.channels["tau_b"]]), log.channels["tau_b"])


@pytest.mark.parametrize("fraction", [0.0, 1.0, 1.5, -0.2, 0.001])
def test_a_split_without_samples_on_one_side_is_refused(log, fraction):
    """Nobody is held out, or nobody trains: that is a mistake."""
    with raises_code("invalid_value", "two.csv"):
        log.split(fraction)


def test_select_time_includes_both_ends(log):
    """From 0.1 to 0.2 s at 250 Hz there are 26 samples."""
    part = log.select_time(0.1, 0.2)
    assert part.n_samples == 26
    assert_allclose(part.t[[0, -1]], [0.1, 0.2])
    with raises_code("too_little_data", "0", "0.396"):
        log.select_time(5, 6)


def test_a_slice_cuts_by_samples_or_by_time(log):
    """Whole numbers count samples, floats are seconds; parts that meet share no sample and lose none."""
    assert len(log) == 100 and log["q_b"][3] == 2 * log["t"][3]
    assert_array_equal(log[10:20].t, log.t[10:20])
    assert_array_equal(log[10:20]["tau_b"], log["tau_b"][10:20])
    before, after = log[: float(log.t[40])], log[log.t[40] :]
    assert (len(before), len(after), after.t[0]) == (40, 60, log.t[40])
    assert log[::2].rate_hz == pytest.approx(125)


@pytest.mark.parametrize(
    ("key", "code"), [(slice(10, 0.2), "invalid_value"), (slice(5, 6), "too_little_data"), ("tau_a", "missing_column")]
)
def test_a_slice_that_means_nothing_is_refused(log, key, code):
    """Samples and times do not mix, one sample is no log, and a column must exist; a log is not walked through."""
    with raises_code(code, "two.csv"):
        log[key]
    with pytest.raises(TypeError):
        iter(log)


def test_with_channels_leaves_the_first_log_alone(log):
    """A channel is added to a new log."""
    more = log.with_channels(v_a=np.ones(100))
    assert more.joints("v") == ("a",) and log.joints("v") == ()


@pytest.mark.parametrize("t", [[0, 1, 1], [0, 2, 1], [0, 1, np.nan], [0.0]])
def test_a_clock_that_does_not_run_forward_is_refused(t):
    """Time is finite, increases strictly, and has two samples at least."""
    with pytest.raises(InputError):
        Log(np.array(t, dtype=float), {})


def test_channels_are_as_long_as_time():
    """A channel of another length is named."""
    with raises_code("wrong_shape", "q_a"):
        Log(np.arange(5.0), {"q_a": np.arange(4.0)})


def test_an_encoder_step_of_10_nm_survives_the_file(tmp_path):
    """Positions around 1.5 m in steps of 1e-8 m are the same after writing and reading."""
    t = np.arange(50) / 5000 + 3600
    log = Log(t, {"q_axis": 1.5 + 1e-8 * np.arange(50)})
    log.to_csv(tmp_path / "fine.csv")
    back = read_log(tmp_path / "fine.csv")
    assert_allclose(back.channels["q_axis"], log.channels["q_axis"], rtol=0, atol=1e-11)
    assert_allclose(back.t, t, rtol=0, atol=1e-8)
    assert log.to_frame().columns.tolist() == ["t", "q_axis"]


def test_a_csv_is_what_pandas_writes(tmp_path):
    """Twelve digits, empty cells for what is no number, names quoted where they hold a comma; more rows than one block."""
    t = np.arange(10_050) / 1000
    odd = np.where(t % 1 < 0.1, np.nan, 1e-9 * t**7)
    log = Log(t, {"q_a": np.sin(t), 'note, "odd"': odd, "inf": np.where(t > 5, -np.inf, -0.0)})
    log.to_csv(tmp_path / "ours.csv")
    log.to_frame().to_csv(tmp_path / "pandas.csv", index=False, float_format="%.12g", lineterminator="\n")
    assert (tmp_path / "ours.csv").read_bytes() == (tmp_path / "pandas.csv").read_bytes()


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, log, monkeypatch):
    """An interrupted write neither harms the file there was nor leaves a piece beside it."""
    path = tmp_path / "log.csv"
    path.write_text("old")

    def fail(file, **_options):
        file.write("half")
        raise KeyboardInterrupt

    monkeypatch.setattr("csv.writer", fail)
    with pytest.raises(KeyboardInterrupt):
        log.to_csv(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_writing_into_a_missing_folder_is_an_input_error(tmp_path, log):
    """The sentence names the file."""
    with raises_code("cannot_write", "log.csv"):
        log.to_csv(tmp_path / "no" / "log.csv")


def test_a_log_travels_between_processes(log):
    """Workers get the same arrays, still read-only."""
    copy = pickle.loads(pickle.dumps(log))
    assert_array_equal(copy.channels["q_b"], log.channels["q_b"])
    assert not copy.t.flags.writeable
