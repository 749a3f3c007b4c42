"""Readers of recordings and tables: logs of every kind, column maps, motions, poses, points."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import yaml
from fuzz_parts import mutate_records, recordings, seed_motions, seeds
from fuzz_parts.reader import BINARY, PARQUET, TABLE, YAML, Reader, axis, beside, by_name, of, pendulum


def _log(path: Path) -> None:
    from tau_dyn.log import Recording, check_log, open_log, read_log

    log = read_log(path)
    opened = open_log(path)
    if not isinstance(opened, Recording) and opened.n_samples != log.n_samples:
        raise AssertionError("read at once and opened, a log has another length")
    check_log(log, pendulum() if log.has("q", ["axis"]) else None)


@contextmanager
def _as_if_large() -> Iterator[None]:
    """Let small files be read as recordings larger than memory are: copied in pieces, read in windows."""
    from tau_dyn.log import copies, recording

    new = {
        (recording, "MAX_IN_MEMORY_SAMPLES"): 12,
        (recording, "MAX_IN_MEMORY_BYTES"): 64,
        (recording, "GROUP_ROWS"): 16,
        (copies, "_ROWS"): 16,
        (copies, "CHUNK_BYTES"): 300,
    }
    kept = {(module, name): getattr(module, name) for module, name in new}
    try:
        for (module, name), value in new.items():
            setattr(module, name, value)
        yield
    finally:
        for (module, name), value in kept.items():
            setattr(module, name, value)


def _streamed(path: Path) -> None:
    """Read in windows; where a file is read at once, too, the samples must be the same."""
    from tau_dyn.exceptions import TauDynError
    from tau_dyn.log import Recording, open_log, read_log

    with _as_if_large():
        opened = open_log(path)
        if not isinstance(opened, Recording):
            return
        for _ in opened.clock():
            pass
        n = opened.n_samples
        windows = [opened.window(k, k + 7 if k + 8 < n else n, opened.channels) for k in range(0, n - 1, 7)]
    if path.is_dir():
        return
    try:
        log = read_log(path)
    except TauDynError:
        return
    if not np.array_equal(np.concatenate([w.t for w in windows]), log.t):
        raise AssertionError("read at once and in windows, a log has other times")


def _folder_of_parquet(path: Path) -> None:
    """Read a folder in which a good file stands before this one."""
    folder = path.parent / "parts_of_ours"
    folder.mkdir(exist_ok=True)
    columns = seeds.columns()
    beside(folder, "a.parquet", lambda: seeds.parquet_of({**columns, "t": columns["t"] - 10}))
    (folder / "b.parquet").write_bytes(path.read_bytes())
    _streamed(folder)


def _map(path: Path) -> None:
    """Read the foreign log that a map speaks of; a second file of the same recording lies beside it."""
    from tau_dyn.log import read_log

    beside(path.parent, "second_log.csv", seeds.foreign_log)
    read_log(beside(path.parent, "foreign_log.csv", seeds.foreign_log), path)


def _mapped(path: Path) -> None:
    from tau_dyn.log import read_log

    read_log(path, beside(path.parent, "map_of_ours.yaml", lambda: seeds.COLUMN_MAP))


def _topic_map(path: Path) -> None:
    """Read a recording through a map that names topics."""
    from tau_dyn.log import read_log

    read_log(beside(path.parent, "recording_of_ours.mcap", lambda: recordings.mcaps()[0]), path)


def _vibration(path: Path) -> None:
    from tau_dyn.log import read_log
    from tau_dyn.modes.record import build_records, check_alike

    check_alike(build_records(read_log(path), ["tau_axis"], ["q_axis", "v_axis"]))


def _motion(path: Path) -> None:
    from tau_dyn.simulate import Trajectory

    Trajectory.from_csv(path, pendulum().actuated).resampled(100.0)


def _view_log(path: Path) -> None:
    """Read a log as the viewer does: positions to play, a ghost, and the tool's trail."""
    from tau_dyn.log import read_log
    from tau_dyn.view import build_playback
    from tau_dyn.view.playback import compute_trail

    log = read_log(path)
    shown = build_playback(log, pendulum(), log)
    shown.apart(), shown.at(0.1), compute_trail(pendulum(), shown.q)


def _pose_table(path: Path) -> None:
    """Read what `fk` asks for, then what `ik` does."""
    from tau_dyn.cli.arguments import read_columns
    from tau_dyn.kinematics import read_poses, read_positions

    table = read_columns(path)
    read_positions(table, pendulum(), str(path))
    read_poses(table, pendulum(), str(path))


def _path_points(path: Path) -> None:
    """Read the points of a path, and lay the spline through them, as `plan-motion --path` does."""
    from tau_dyn.cli.plan import Ends
    from tau_dyn.control.motion import MotionLimits
    from tau_dyn.control.motion.coordinates import build_tool_path

    points = Ends(path=str(path)).read_path()
    build_tool_path(axis(), np.array([-0.3]), np.array([0.3]), points, MotionLimits.of(axis()))


def _guideway(path: Path) -> None:
    """Read the measured points of a cart twice: its guideway, and what a load moves."""
    from tau_dyn.cli.accuracy import read_measured_files

    read_measured_files((str(path), f"axis={path}"), axis().robot)


def _recording(path: Path) -> None:
    """Read as it stands, else through a map that takes columns from two topics; one answer is enough."""
    from tau_dyn.exceptions import TauDynError
    from tau_dyn.log import ColumnMap, read_log

    try:
        _log(path)
    except TauDynError:
        if path.suffix == ".mat":
            raise
        read_log(path, ColumnMap.from_dict(yaml.safe_load(recordings.MAP)))


def _in_bag(path: Path, others: dict[str, int], name: str) -> None:
    """Read a folder of a ROS 2 bag in which this file stands under a name."""
    from tau_dyn.log import read_log

    folder = path.parent / f"bag_with_{name}"
    folder.mkdir(exist_ok=True)
    kind = "mcap" if "run.mcap" in {name, *others} else "sqlite3"
    for other, k in others.items():
        beside(folder, other, lambda k=k: recordings.bags2(kind)[k])
    (folder / name).write_bytes(path.read_bytes())
    read_log(folder)


_BAG = ("rosbags",)
LOGS = (
    Reader("csv", ".csv", lambda f: [seeds.csv_of(seeds.columns()), seeds.csv_of(seeds.columns(), "# a comment\n")],
           TABLE, _log, 2),
    Reader("foreign_csv", ".csv", of(seeds.foreign_log()), TABLE, _mapped),
    Reader("parquet", ".parquet", lambda f: [seeds.parquet_of(seeds.columns())], PARQUET, _log, 2),
    Reader("large_csv", ".csv", lambda f: [seeds.csv_of(seeds.columns())], TABLE, _streamed),
    Reader("large_parquet", ".parquet", lambda f: [seeds.parquet_of(seeds.columns())], PARQUET, _streamed),
    Reader("parquet_folder", ".parquet", lambda f: [seeds.parquet_of(seeds.columns())], PARQUET, _folder_of_parquet),
    Reader("column_map", ".yaml", of(*seeds.COLUMN_MAPS), YAML, _map),
    Reader("topic_map", ".yaml", of(recordings.MAP), YAML, _topic_map, needs=("mcap_ros2",)),
    Reader("vibration", ".csv", lambda f: [seeds.csv_of(seeds.columns())], TABLE, _vibration),
    Reader("view_log", ".csv", lambda f: [seeds.csv_of(seeds.columns())], TABLE, _view_log),
    Reader("motion", ".csv", lambda f: [seed_motions.motion()], TABLE, _motion),
    Reader("pose_table", ".csv", lambda f: [seeds.csv_of(seeds.poses())], TABLE, _pose_table),
    Reader("path_points", ".csv", of(seed_motions.way()), TABLE, _path_points),
    Reader("calibration_poses", ".csv", lambda f: [seeds.csv_of(seeds.poses())], TABLE,
           by_name("calibrate.measured", "read_poses", ("axis",))),
    Reader("measured_points", ".csv", lambda f: [seeds.csv_of(seeds.poses())], TABLE,
           by_name("log.read", "read_measured", ("axis",))),
    Reader("guideway", ".csv", of(seed_motions.guideway()), TABLE, _guideway),
    Reader("image_positions", ".csv", of(seed_motions.positions()), TABLE, by_name("vision.robot_positions", "read_positions")),
    Reader("cloud", ".csv", lambda f: [seeds.csv_of(seeds.poses())], TABLE, by_name("view.results", "read_cloud")),
    Reader("image", ".png", lambda f: seeds.images(), (*BINARY, mutate_records.integers),
           by_name("vision.images", "read_image"), needs=("cv2",)),
    Reader("mcap", ".mcap", lambda f: recordings.mcaps(), mutate_records.MCAP * 3 + BINARY, _recording, 2, needs=("mcap_ros2",)),
    Reader("bag1", ".bag", lambda f: recordings.bags1(), mutate_records.BAG * 3 + BINARY, _recording, 2, needs=_BAG),
    Reader("bag2", ".db3", lambda f: recordings.bags2("sqlite3")[:1], mutate_records.DATABASE * 3 + BINARY, _recording, 6,
           needs=_BAG),
    Reader("bag2_metadata", ".yaml", lambda f: recordings.bags2("sqlite3")[1:], YAML,
           lambda path: _in_bag(path, {"run.db3": 0}, "metadata.yaml"), 2, needs=_BAG),
    Reader("bag2_mcap", ".mcap", lambda f: recordings.bags2("mcap")[:1], mutate_records.MCAP * 3 + BINARY,
           lambda path: _in_bag(path, {"metadata.yaml": 1}, "run.mcap"), needs=("rosbags", "mcap_ros2")),
    Reader("matlab", ".mat", lambda f: recordings.mats(), mutate_records.MAT * 3 + BINARY, _recording, 2),
)  # fmt: skip
"""Each with its share of time."""
