"""A recording read block by block gives the identification of the whole log: values, errors, warnings, page."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.identify import BlockExecutor, identify
from tau_dyn.log import Recording, open_log, read_log, recording
from tau_dyn.render import write_report


@pytest.fixture
def large(monkeypatch):
    """Let small files take the way of large ones, in many blocks."""
    monkeypatch.setattr(recording, "MAX_IN_MEMORY_SAMPLES", 100)
    monkeypatch.setattr(sys.modules["tau_dyn.identify.streaming"], "SIZE", 1)
    monkeypatch.setattr(sys.modules["tau_dyn.identify.streaming"], "MIN_BLOCK_ROWS", 61)


def stored(folder, log, name: str = "log.parquet", rows: int = 1999):
    log.to_frame().to_parquet(folder / name, row_group_size=rows)
    return folder / name


def same(found, whole) -> None:
    """Compare two identifications: estimates to 1e-9 of their errors, errors and covariances to 1e-7 relative."""
    one, other = found.estimate, whole.estimate
    assert one.base.names == other.base.names and np.array_equal(one.base.kept, other.base.kept)
    assert np.max(np.abs(one.beta - other.beta) / other.stderr) < 1e-7
    assert_allclose(one.beta, other.beta, rtol=1e-9)
    assert_allclose(one.stderr, other.stderr, rtol=1e-7)
    assert one.regression.n_samples == other.regression.n_samples
    for a, b in ((found.train, whole.train), (found.holdout, whole.holdout)):
        assert_allclose(a.rms, b.rms, rtol=1e-9)
        assert_allclose(a.all_samples.rms, b.all_samples.rms, rtol=1e-9)
    assert found.warnings == whole.warnings


@pytest.fixture
def made(l1, monday):
    """Return a robot and a log to identify it from."""
    return l1, monday


def test_blocks_give_what_the_whole_log_gives(tmp_path, made, large, monkeypatch) -> None:
    """Filters forget: cut with enough neighbourhood, blocks leave no trace in estimate, covariance or held-out errors."""
    monkeypatch.setattr(
        sys.modules["tau_dyn.identify.identification"], "build_offset_columns", lambda *_: None
    )  # blocks keep the logged times
    robot, log = made
    path = stored(tmp_path, log)
    recording = open_log(path)
    assert isinstance(recording, Recording)
    whole = identify(robot, read_log(path), estimator="wls")
    found = identify(robot, recording, estimator="wls", engine=BlockExecutor(2))
    same(found, whole)
    write_report(tmp_path / "page.html", found)
    assert len(found.estimate.regression.runs) > 3, "the page shows blocks of the recording"
    assert "from 0 s" in (tmp_path / "page.html").read_text()


def test_who_computes_and_how_files_are_cut_changes_no_bit(tmp_path, made, large) -> None:
    """The sum is taken in the blocks' order: one thread, two, other files and a Dask cluster give the same bits."""
    robot, log = made
    folder = tmp_path / "parts"
    folder.mkdir()
    half = log.n_samples // 3
    stored(folder, log.window(0, half), "a.parquet")
    stored(folder, log.window(half, log.n_samples), "b.parquet", rows=700)
    one = identify(robot, open_log(stored(tmp_path, log)), estimator="wls", engine=BlockExecutor(1))
    two = identify(robot, open_log(folder), estimator="wls", engine=BlockExecutor(2))
    assert np.array_equal(one.estimate.beta, two.estimate.beta)
    assert np.array_equal(one.estimate.cov, two.estimate.cov)


@pytest.mark.filterwarnings("ignore")
def test_a_cluster_gives_the_same_bits(tmp_path, made, large) -> None:
    """Blocks computed by other processes are summed in the same order here."""
    robot, log = made
    path = stored(tmp_path, log)
    here = identify(robot, open_log(path), estimator="wls", engine=BlockExecutor(1))
    there = identify(robot, open_log(path), estimator="wls", engine=BlockExecutor(2, "local"))
    assert np.array_equal(here.estimate.beta, there.estimate.beta)


def test_a_held_out_recording_is_judged_in_blocks(tmp_path, made, large, monkeypatch) -> None:
    """Held-out errors of a recording on disk are those of the log in memory."""
    monkeypatch.setattr(
        sys.modules["tau_dyn.identify.identification"], "build_offset_columns", lambda *_: None
    )  # blocks keep the logged times
    robot, log = made
    first, last = log.split(0.6)
    paths = [stored(tmp_path, first, "train.parquet"), stored(tmp_path, last, "held.parquet")]
    whole = identify(robot, read_log(paths[0]), holdout=read_log(paths[1]), estimator="wls")
    found = identify(robot, open_log(paths[0]), holdout=open_log(paths[1]), estimator="wls")
    same(found, whole)
    assert found.holdout_how == whole.holdout_how


def test_a_jump_in_any_block_is_refused(tmp_path, made, large) -> None:
    """One encoder is set anew late in the recording; the sentence is that of the log in memory."""
    robot, log = made
    q = log.channels["q_cart1"] + np.where(np.arange(log.n_samples) > 0.9 * log.n_samples, 0.05, 0.0)
    with raises_code("bad_sample", "q_cart1", "1", "0.04"):
        identify(robot, open_log(stored(tmp_path, log.with_channels(q_cart1=q))))


def test_what_blocks_cannot_do_is_said(tmp_path, made, large) -> None:
    """A missing joint, an estimator that needs all rows, an effect with a long memory: each one sentence."""
    robot, log = made
    recording = open_log(stored(tmp_path, log))
    with raises_code("unsupported"):
        identify(robot, recording, estimator="ml")
    short = {k: v for k, v in log.channels.items() if k != "tau_cart2"}
    lacking = open_log(stored(tmp_path, type(log)(log.t, short), "lacking.parquet"))
    with raises_code("missing_column", "tau_cart2"):
        identify(robot, lacking, estimator="wls")
