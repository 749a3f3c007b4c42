"""A log, a file's path and a table of pandas are the same recording."""

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.log import Log, as_log, read_log


@pytest.fixture
def log() -> Log:
    """A sine of 4 s."""
    t = np.arange(0, 4, 0.01)
    return Log(t, {"q_axis": np.sin(t), "tau_axis": np.cos(t)}, "sine.csv")


def test_a_path_and_a_table_give_the_log(log, tmp_path) -> None:
    """Channels and clock are those of the log, to what the file's digits hold."""
    log.to_csv(tmp_path / "sine.csv")
    table = log.to_frame()
    for source in (log, tmp_path / "sine.csv", str(tmp_path / "sine.csv"), table, table.set_index("t")):
        found = as_log(source)
        assert_allclose(found.t, log.t, atol=1e-9)
        assert_allclose(found["tau_axis"], log["tau_axis"], atol=1e-9)


@pytest.mark.parametrize(
    ("source", "code", "names"),
    [
        (pd.DataFrame({"time": [0.0, 1.0], "q_axis": [0.0, 1.0]}), "missing_column", ("no column t", "time, q_axis")),
        (pd.DataFrame({"t": [0.0, 1.0], "q_axis": ["a", "b"]}), "bad_sample", ("column q_axis",)),
        (3.0, "invalid_value", ("type float",)),
    ],
)
def test_what_is_no_log_is_refused(source, code, names) -> None:
    """The sentence names the column or the type."""
    with raises_code(code, *names):
        as_log(source)


def test_a_table_is_no_path(log) -> None:
    """`read_log` says where a table goes."""
    with raises_code("invalid_value", "identify"):
        read_log(log.to_frame())  # type: ignore[arg-type]


def test_negative_times_count_from_the_end(log) -> None:
    """The last second of a log, and of a log with a trigger at zero the time after -1 s."""
    assert_allclose(log[-1.0:].t[0], 2.99, atol=1e-9)
    before = Log(log.t - 2.0, dict(log.channels))
    assert_allclose(before[-1.0:].t[0], -1.0, atol=1e-9)
    with raises_code("invalid_value", "log[5]"):
        log[5]  # type: ignore[call-overload]
