"""A ROS 2 bag is a folder, whatever it is called."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import yaml
from raising import raises_code

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from fuzz_parts import recordings

from tau_dyn.log import ColumnMap, read_log

pytest.importorskip("rosbags")
pytest.importorskip("mcap_ros2")
FILES = {"sqlite3": "run.db3", "mcap": "run.mcap"}


@pytest.mark.parametrize("name", ["run.mcap", "run.mat", "run.db3"])
@pytest.mark.parametrize("storage", FILES)
def test_a_bags_folder_may_be_called_as_a_file(tmp_path: Path, name: str, storage: str) -> None:
    """By its suffix the folder was opened as a file, which ended in a traceback; all its messages are read."""
    (tmp_path / name).mkdir()
    recording, about = recordings.bags2(storage)
    (tmp_path / name / FILES[storage]).write_bytes(recording)
    (tmp_path / name / "metadata.yaml").write_bytes(about)
    log = read_log(tmp_path / name, ColumnMap.from_dict(yaml.safe_load(recordings.MAP)))
    assert log.n_samples == recordings.N


def test_a_folder_called_as_a_ros_1_bag_is_to_be_renamed(tmp_path: Path) -> None:
    """The library below would open it as a file, and blame the folder's content."""
    (tmp_path / "run.bag").mkdir()
    recording, about = recordings.bags2("sqlite3")
    (tmp_path / "run.bag" / "run.db3").write_bytes(recording)
    (tmp_path / "run.bag" / "metadata.yaml").write_bytes(about)
    with raises_code("file_format"):
        read_log(tmp_path / "run.bag", ColumnMap.from_dict(yaml.safe_load(recordings.MAP)))


def test_what_nobody_reads_in_a_bags_metadata_may_be_anything(tmp_path: Path) -> None:
    """A text for the list of files made the library fail when it closed the bag, with all messages read."""
    recording, about = recordings.bags2("sqlite3")
    content = yaml.safe_load(about)
    content["rosbag2_bagfile_information"]["files"] = "4294967296"
    (tmp_path / "run.db3").write_bytes(recording)
    (tmp_path / "metadata.yaml").write_text(yaml.safe_dump(content))
    assert read_log(tmp_path, ColumnMap.from_dict(yaml.safe_load(recordings.MAP))).n_samples == recordings.N
