"""`to_pandas()`, the terminal's table, JSON and CSV hold the same numbers, in the same order."""

from __future__ import annotations

import io
import re

import numpy as np
import pandas as pd
import pytest
from rich.console import Console

from tau_dyn.render import print_result
from tau_dyn.results import format_with_uncertainty


def _print(result) -> str:
    stream = io.StringIO()
    print_result(Console(file=stream, width=100, highlight=False), result)
    return stream.getvalue()


def test_parameters_are_those_of_json_and_of_the_printed_table(found):
    """Every row is the contract's row, and its value and standard error stand beside its name on the screen."""
    frame, printed = found.to_pandas(), _print(found)
    assert frame["name"].tolist() == [row["name"] for row in found.rows()]
    for row, told in zip(frame.itertuples(), found.rows(), strict=True):
        assert (row.value, row.stderr) == (told["value"], told["stderr"])
        assert [row.ci95_low, row.ci95_high] == told["ci95"]
        line = next(text for text in printed.splitlines() if row.name in text)
        assert format_with_uncertainty(row.value, row.stderr) in line


def test_findings_are_those_of_json(diagnosed):
    """One row a finding, strongest first, also of a slice of them."""
    frame, told = diagnosed.to_pandas(), diagnosed.to_dict()["findings"]
    assert frame["cause"].tolist() == [row["cause"] for row in told] == [f.cause for f in diagnosed.findings]
    assert frame["p_value"].tolist() == [row["p_value"] for row in told]
    assert [f.cause for f in diagnosed.findings[:2]] == frame["cause"][:2].tolist()


def test_modes_are_those_of_json_and_of_the_printed_table(results):
    """Frequency and damping of each mode; the screen shows them to fewer digits."""
    modes = results["modes"]
    frame, told = modes.to_pandas(), modes.to_dict()["modes"]
    for key in ("frequency_hz", "damping_ratio"):
        assert frame[key].tolist() == [row[key] for row in told]
    shown = [float(x) for x in re.findall(r"(\d+\.\d+)(?= ±| ± | Hz)", _print(modes))]
    assert any(abs(x - frame["frequency_hz"][0]) < 0.01 for x in shown)


@pytest.mark.parametrize("part", [slice(None), slice(100, 200), slice(2.0, 3.0)])
def test_a_log_is_the_csv_that_it_writes(results, tmp_path, part):
    """The frame of a log, or of a part of it, is the file that it writes, to the file's twelve digits."""
    log = results["log"][part]
    log.to_csv(tmp_path / "log.csv")
    written = pd.read_csv(tmp_path / "log.csv", dtype=float)
    pd.testing.assert_frame_equal(log.to_pandas(), written, rtol=1e-11, atol=0.0)
    assert len(written) == len(log) and np.all(np.diff(written["t"]) > 0)


def test_poses_are_the_csv_that_they_write(results):
    """A table of poses as a frame has the columns and numbers of the file of `--out`."""
    table = results["poses"]
    written, frame = pd.read_csv(io.StringIO(table.to_csv())), table.to_pandas()
    same = [c for c in written if c in frame and c != "reason"]
    assert {"q_axis", "x_tool", "qw_tool"} <= set(same)
    np.testing.assert_allclose(frame[same].to_numpy(float), written[same].to_numpy(float), rtol=1e-11)
