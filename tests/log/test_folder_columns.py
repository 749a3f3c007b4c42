"""A folder of CSV files is one recording with a file per topic, or several recordings, and its map reads the samples back."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.log import ColumnMap, propose_columns, read_log

ROBOT = SimpleNamespace(
    actuated=("axis", "arm"), joint_kinds=("prismatic", "revolute"), lower=np.array([-2.0, -3.0]), upper=np.array([2.0, 3.0])
)  # fmt: skip


def compute_positions(t: np.ndarray) -> np.ndarray:
    return np.column_stack([0.8 * np.sin(2 * t), 1.5 * np.cos(t)])


def compute_forces(t: np.ndarray) -> np.ndarray:
    return np.column_stack([30.0 * np.cos(2 * t), 4.0 * np.sin(t)])


def write(path: Path, head: str, *columns: np.ndarray) -> None:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=head, comments="")


def test_files_of_topics_are_joined_in_time(tmp_path: Path) -> None:
    """Positions in degrees at 100 Hz and forces at 25 Hz by another clock, in ms, become one log of the recorded signals."""
    t, late = np.arange(0.0, 10.0, 0.01), np.arange(0.003, 9.9, 0.04)
    q = compute_positions(t)
    write(tmp_path / "positions.csv", "time,pos_axis,pos_arm [deg]", t, q[:, 0], np.degrees(q[:, 1]))
    write(tmp_path / "forces.csv", "stamp [ms],force_axis,force_arm", 1e3 * late, compute_forces(late))
    write(tmp_path / "room.csv", "time,temp", t[::50], 20 + 0 * t[::50])
    proposal = propose_columns(tmp_path, ROBOT)
    log = read_log(tmp_path, ColumnMap.from_dict(proposal.entries))
    assert set(log.channels) >= {"q_axis", "q_arm", "tau_axis", "tau_arm"}
    start = 0.0 if abs(log.t[0]) < 1 else log.t[0]
    times = log.t - start
    assert_allclose(log.joint("q", ROBOT.actuated), compute_positions(times), atol=2e-3)
    assert_allclose(log.joint("tau", ROBOT.actuated), compute_forces(times), atol=0.1)
    assert "room" not in "".join(proposal.entries["files"]) and "one recording" in proposal.warnings[0]


def test_files_with_the_same_columns_are_recordings_of_their_own(tmp_path: Path) -> None:
    """The map of one of them reads each."""
    t = np.arange(0.0, 5.0, 0.01)
    for k in range(3):
        write(
            tmp_path / f"run{k}.csv", "time,pos_axis,pos_arm,trq_axis,trq_arm", t + k, compute_positions(t + k), t, -t
        )
    proposal = propose_columns(tmp_path, ROBOT)
    assert "3 files" in proposal.warnings[0] and "run0.csv" in proposal.warnings[0]
    log = read_log(tmp_path / "run2.csv", proposal.to_map())
    assert_allclose(log.joint("q", ROBOT.actuated), compute_positions(t + 2), atol=1e-9)


def test_files_of_several_recordings_by_topic_are_refused(tmp_path: Path) -> None:
    """Two files with the positions of the same joint cannot be one recording."""
    t = np.arange(0.0, 5.0, 0.01)
    write(tmp_path / "a.csv", "time,pos_axis,pos_arm", t, compute_positions(t))
    write(tmp_path / "b.csv", "time,pos_axis,pos_arm,trq_axis,trq_arm", t, compute_positions(t), compute_forces(t))
    with raises_code("mismatch", "a.csv and b.csv both have q_axis", "folder of its own"):
        propose_columns(tmp_path, ROBOT)


@pytest.mark.parametrize(
    ("names", "code"), [((), "file_not_found"), (("forces.csv", "notes.csv"), "positions_missing")]
)
def test_a_folder_without_positions_is_refused(tmp_path: Path, names: tuple[str, ...], code: str) -> None:
    """A folder without logs, and one without positions, end in a sentence with the remedy."""
    t = np.arange(0.0, 5.0, 0.01)
    for k, name in enumerate(names):
        write(tmp_path / name, f"time,{'force_axis,force_arm' if k == 0 else 'volts,amps'}", t, compute_forces(t))
    with raises_code(code, tmp_path.name):
        propose_columns(tmp_path, ROBOT)
