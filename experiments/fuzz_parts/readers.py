"""Every reader of the package with its valid files, its mutations, and what is done with what it read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random

import numpy as np
import yaml
from fuzz_parts import mutate_bytes, mutate_records, mutate_tables, mutate_trees, mutate_xml, recordings, seeds

Mutation = Callable[[bytes, Random], bytes]


@dataclass(frozen=True)
class Reader:
    """One reader.

    Attributes:
        name: What `--reader` calls it.
        suffix: Of its files.
        valid: Returns its valid files, given a folder to work in.
        mutations: What is done to them.
        read: Reads a file and uses what it read, as the commands do.
        weight: Share of the campaign's time, in parts.
        needs: Libraries of extras without which it only says which to install.
    """

    name: str
    suffix: str
    valid: Callable[[Path], Sequence[bytes]]
    mutations: Sequence[Mutation]
    read: Callable[[Path], object]
    weight: float = 1.0
    needs: tuple[str, ...] = ()

    def mutated(self, bases: Sequence[bytes], rng: Random) -> bytes:
        """Return a case: a file after one to four mutations."""
        data = rng.choice(bases)
        for _ in range(rng.choice((1, 1, 1, 2, 2, 4))):
            if rng.random() < 0.05:
                data = mutate_bytes.splice(data, rng.choice(bases), rng)
                continue
            try:
                data = rng.choice(self.mutations)(data, rng)
            except Exception:  # noqa: S112  a file so broken that the mutation's own library fails on it stays as it is
                continue
        return data[: mutate_bytes.LARGEST * 4]


@cache
def _pendulum():
    from tau_dyn.robot import robot_from_urdf

    return robot_from_urdf(seeds.PENDULUM, "pendulum.urdf")


def _read_log(path: Path) -> None:
    from tau_dyn.log import check_log, read_log
    from tau_dyn.log.stream import Recording, open_log

    log = read_log(path)
    opened = open_log(path)
    if not isinstance(opened, Recording) and opened.n_samples != log.n_samples:
        raise AssertionError("read at once and opened, a log has another length")
    check_log(log, _pendulum() if log.has("q", ["axis"]) else None)


def _read_mapped(path: Path) -> None:
    from tau_dyn.log import read_log

    log = path.parent / "foreign_log.csv"
    if not log.exists():
        log.write_bytes(seeds.foreign_log())
    read_log(log, path)


def _read_foreign(path: Path) -> None:
    from tau_dyn.log import read_log

    map_ = path.parent / "map_of_ours.yaml"
    if not map_.exists():
        map_.write_bytes(seeds.COLUMN_MAP)
    read_log(path, map_)


def _read_robot(path: Path) -> None:
    from tau_dyn.dynamics import build_mechanism
    from tau_dyn.exceptions import InputError
    from tau_dyn.robot import load_robot

    robot = load_robot(path)
    if not np.isfinite(robot.home).all() or not np.isfinite(robot.parameters.values).all():
        raise AssertionError("a robot with numbers that are not finite")
    mechanism = build_mechanism(robot)
    q = robot.home[None]
    tau = mechanism.inverse_dynamics(q, 0 * q, 0 * q)
    if not np.isfinite(tau).all() and np.abs(robot.parameters.values).max(initial=0) < 1e9:
        raise InputError("forces are not finite")  # huge dimensions; commands say it of their answers


def _read_model(path: Path) -> None:
    from tau_dyn.model import Model

    model = Model.load(path)
    q = np.tile(model.robot.home, (5, 1))
    signals = {"temperature": np.full(q.shape, 20.0)}
    model.torque(q, 0 * q, 0 * q, t=np.arange(5) * 0.01, signals=signals)
    model.save(path.with_suffix(".saved"))


def _read_effects(path: Path) -> None:
    from tau_dyn.simulate.effects_file import read_effects_file

    model = read_effects_file(path, _pendulum())
    q = np.zeros((5, 1))
    model.torque(q, q, q, t=np.arange(5) * 0.01, signals={"temperature": np.full(q.shape, 20.0)})


def _by_name(module: str, function: str, *more: object) -> Callable[[Path], object]:
    def read(path: Path) -> object:
        from importlib import import_module

        return getattr(import_module(module), function)(path, *more)

    return read


def _read_law(path: Path) -> None:
    from tau_dyn.simulate.law_file import read_law_file

    read_law_file(path, _pendulum())


def _read_poses(path: Path) -> None:
    from tau_dyn.calibrate.pose_set import read_poses

    read_poses(path, ("axis",))


def _read_vibration(path: Path) -> None:
    from tau_dyn.log import read_log
    from tau_dyn.modes.record import check_alike, records_of

    check_alike(records_of(read_log(path), ["tau_axis"], ["q_axis", "v_axis"]))


def _read_motion(path: Path) -> None:
    from tau_dyn.simulate.trajectory import Trajectory

    Trajectory.from_csv(path, _pendulum().actuated).resampled(100.0)


def _read_pose_table(path: Path) -> None:
    """Read what `fk` asks for, then what `ik` does."""
    from tau_dyn.cli.pose_tables import read_columns
    from tau_dyn.kinematics.pose_table import read_poses, read_positions

    table = read_columns(path)
    read_positions(table, _pendulum(), str(path))
    read_poses(table, _pendulum(), str(path))


def _read_side(path: Path) -> None:
    from tau_dyn.cli.common import to_json
    from tau_dyn.compare import compare, read_side

    side = read_side(path)
    to_json(compare(side, side).to_dict())


def _read_progress(path: Path) -> None:
    from tau_dyn.calibrate.poses.progress_file import read_progress

    read_progress(path, ("axis",)).measured()


def _view_result(path: Path) -> None:
    from tau_dyn.view.results import read_result

    read_result(path, _pendulum())


def _read_calibrated(path: Path) -> None:
    from tau_dyn.calibrate.compensation_file import load_compensation

    load_compensation(path)


def _read_recording(path: Path) -> None:
    """Read as it stands, else through a map that takes columns from two topics; one answer is enough."""
    from tau_dyn.exceptions import TauDynError
    from tau_dyn.log import ColumnMap, read_log

    try:
        _read_log(path)
    except TauDynError:
        if path.suffix == ".mat":
            raise
        read_log(path, ColumnMap.from_dict(yaml.safe_load(recordings.MAP)))


def _read_bag_metadata(path: Path) -> None:
    from tau_dyn.log import read_log

    folder = path.parent / "bag_of_ours"
    folder.mkdir(exist_ok=True)
    if not (folder / "run.db3").exists():
        (folder / "run.db3").write_bytes(recordings.bags(2)[0])
    (folder / "metadata.yaml").write_bytes(path.read_bytes())
    read_log(folder)


def _read_run(path: Path) -> None:
    """Compare a run folder with itself, make the page, and ask whether a run may be written to it."""
    from tau_dyn.cli.run_folder import RunFolder
    from tau_dyn.compare import compare, read_side
    from tau_dyn.exceptions import InputError
    from tau_dyn.report.comparison import comparison_page

    folder = path.parent / "run_of_ours"
    folder.mkdir(exist_ok=True)
    (folder / "result.json").write_bytes(seeds.as_json(seeds.IDENTIFY)[0])
    (folder / "run.json").write_bytes(path.read_bytes())
    side = read_side(folder)
    comparison_page(compare(side, side), command_line="tau-dyn compare a b")
    try:
        RunFolder(folder).check("identify", {"robot": "r.urdf"}, set())
    except InputError as fault:
        if len(str(fault)) > 1000:
            raise


def _read_calibration(path: Path) -> None:
    from tau_dyn.calibrate.saved import load_calibration

    robot = load_calibration(path)
    seen = robot.seen(np.array([[0.1], [0.2]]))
    if not np.isfinite(seen.position).all() and np.abs(robot.theta).max(initial=0) < 1e9:
        raise AssertionError("a calibrated robot whose poses are not finite")


def _read_journal(path: Path) -> None:
    from tau_dyn.scale.journal import run_journaled

    list(run_journaled(float, range(6), path))


def _read_correction(path: Path) -> None:
    from tau_dyn.control import read_correction

    read_correction(path, ("axis",), period=0.01)


def _read_reference(path: Path) -> None:
    from tau_dyn.control.interface.reference import digest, read_reference

    digest(read_reference(path, ("axis",), period=0.01))


_T, _B, _X, _J, _Y = mutate_tables.CSV, mutate_bytes.TEXT, mutate_xml.XML, mutate_trees.JSON, mutate_trees.YAML
_JOURNAL = (mutate_trees.json_lines,) * 6 + _B
_TABLE, _YAML, _JSON, _XML = _T * 2 + _B, _Y * 3 + _B, _J * 3 + _B, _X * 3 + _B + mutate_xml.RARE


_BINARY = mutate_bytes.ANY


def _of(*files: bytes) -> Callable[[Path], list[bytes]]:
    return lambda folder: list(files)


READERS = {
    reader.name: reader
    for reader in (
        Reader(
            "csv",
            ".csv",
            lambda f: [seeds.csv_of(seeds.columns()), seeds.csv_of(seeds.columns(), "# a comment\n")],
            _TABLE,
            _read_log,
            3,
        ),
        Reader("foreign_csv", ".csv", lambda f: [seeds.foreign_log()], _TABLE, _read_foreign),
        Reader(
            "parquet",
            ".parquet",
            lambda f: [seeds.parquet_of(seeds.columns())],
            mutate_tables.PARQUET * 3 + mutate_bytes.ANY,
            _read_log,
            3,
        ),
        Reader("column_map", ".yaml", _of(seeds.COLUMN_MAP), _YAML, _read_mapped),
        Reader("urdf", ".urdf", _of(seeds.PENDULUM.encode(), seeds.FOUR_BAR.encode()), _XML, _read_robot, 3),
        Reader("xacro", ".urdf.xacro", _of(seeds.XACRO.encode()), _XML, _read_robot, 3),
        Reader("model", ".yaml", lambda f: [seeds.model_file(f)], _YAML, _read_model, 2),
        Reader("effects", ".yaml", _of(seeds.EFFECTS), _YAML, _read_effects, 2),
        Reader("controller", ".yaml", _of(seeds.LAW), _YAML, _read_law),
        Reader(
            "surroundings",
            ".yaml",
            _of(seeds.SURROUNDINGS),
            _YAML,
            _by_name("tau_dyn.kinematics.obstacles", "read_surroundings"),
        ),
        Reader(
            "camera", ".yaml", _of(seeds.CAMERA), _YAML, _by_name("tau_dyn.calibrate.poses.device_file", "read_camera")
        ),
        Reader(
            "tracker",
            ".yaml",
            _of(seeds.TRACKER),
            _YAML,
            _by_name("tau_dyn.calibrate.poses.device_file", "read_tracker"),
        ),
        Reader(
            "errors",
            ".yaml",
            _of(seeds.ERRORS),
            _YAML,
            _by_name("tau_dyn.kinematics.accuracy.errors", "read_errors_file", ("axis",), ()),
        ),
        Reader("cameras", ".yaml", _of(seeds.CAMERAS), _YAML, _by_name("tau_dyn.vision.cameras", "read_cameras")),
        Reader(
            "state_space",
            ".yaml",
            _of(seeds.STATE_SPACE),
            _YAML,
            _by_name("tau_dyn.modes.model_file", "load_state_space"),
        ),
        Reader("compensation", ".yaml", lambda f: [seeds.compensation_file(f)], _YAML, _read_calibrated),
        Reader("calibration_poses", ".csv", lambda f: [seeds.csv_of(seeds.poses())], _TABLE, _read_poses),
        Reader("vibration", ".csv", lambda f: [seeds.csv_of(seeds.columns())], _TABLE, _read_vibration),
        Reader(
            "motion",
            ".csv",
            lambda f: [seeds.csv_of({"t": seeds.columns()["t"], "q_ref_axis": seeds.columns()["q_axis"]})],
            _TABLE,
            _read_motion,
        ),
        Reader("pose_table", ".csv", lambda f: [seeds.csv_of(seeds.poses())], _TABLE, _read_pose_table),
        Reader(
            "result",
            ".json",
            lambda f: seeds.as_json(seeds.IDENTIFY, seeds.DIAGNOSE, seeds.MODES, seeds.CALIBRATE),
            _JSON,
            _read_side,
            2,
        ),
        Reader("view_result", ".json", lambda f: seeds.as_json(seeds.DIAGNOSE), _JSON, _view_result),
        Reader(
            "cloud",
            ".csv",
            lambda f: [seeds.csv_of(seeds.poses())],
            _TABLE,
            _by_name("tau_dyn.view.results", "read_cloud"),
        ),
        Reader("progress", ".json", lambda f: seeds.as_json(seeds.PROGRESS), _JSON, _read_progress),
        Reader(
            "image",
            ".png",
            lambda f: seeds.images(),
            (*mutate_bytes.ANY, mutate_records.integers),
            _by_name("tau_dyn.vision.images", "read_image"),
            needs=("cv2",),
        ),
        Reader(
            "mcap",
            ".mcap",
            lambda f: recordings.mcaps(),
            mutate_records.MCAP * 3 + _BINARY,
            _read_recording,
            3,
            needs=("mcap_ros2",),
        ),
        Reader(
            "bag1",
            ".bag",
            lambda f: recordings.bags(1),
            mutate_records.BAG * 3 + _BINARY,
            _read_recording,
            2,
            needs=("rosbags",),
        ),
        Reader(
            "bag2",
            ".db3",
            lambda f: recordings.bags(2)[:1],
            mutate_records.DATABASE * 3 + _BINARY,
            _read_recording,
            2,
            needs=("rosbags",),
        ),
        Reader(
            "bag2_metadata", ".yaml", lambda f: recordings.bags(2)[1:], _YAML, _read_bag_metadata, needs=("rosbags",)
        ),
        Reader("matlab", ".mat", lambda f: recordings.mats(), mutate_records.MAT * 3 + _BINARY, _read_recording, 2),
        Reader("run", ".json", lambda f: seeds.as_json(seeds.RUN), _JSON, _read_run),
        Reader("calibrated_robot", ".yaml", lambda f: [seeds.calibrated(f)], _YAML, _read_calibration, 2),
        Reader("journal", ".jsonl", lambda f: [seeds.journal(f)], _JOURNAL, _read_journal),
        Reader("correction", ".csv", lambda f: [seeds.correction()], _TABLE, _read_correction),
        Reader("reference", ".csv", lambda f: [seeds.csv_of(seeds.reference())], _TABLE, _read_reference),
        Reader(
            "measured_points",
            ".csv",
            lambda f: [seeds.csv_of(seeds.poses())],
            _TABLE,
            _by_name("tau_dyn.log.measured", "read_measured", ("axis",)),
        ),
        Reader(
            "image_positions",
            ".csv",
            lambda f: [seeds.positions()],
            _TABLE,
            _by_name("tau_dyn.vision.pose_table", "read_positions"),
        ),
    )
}
"""All readers by name."""
