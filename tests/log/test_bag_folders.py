"""A ROS 2 bag's folder: what its metadata must say before anybody opens a file in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from tau_dyn.exceptions import InputError
from tau_dyn.log.rosbag_log import is_bag_folder, read_bag

pytest.importorskip("rosbags")


def folder(path: Path, about: Any, *files: str) -> Path:
    """Return a bag's folder with these files, whose metadata says this."""
    path.mkdir(exist_ok=True)
    (path / "metadata.yaml").write_text(
        yaml.safe_dump({"rosbag2_bagfile_information": about} if isinstance(about, dict) else about)
    )
    for name in files:
        (path / name).write_bytes(b"x" * 200)
    return path


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as fault:
        read_bag(path)
    assert "\n" not in str(fault.value)
    return str(fault.value)


@pytest.mark.parametrize(
    "about",
    [[], 3, {}, {"relative_file_paths": []}, {"relative_file_paths": "a.db3"}, {"relative_file_paths": ["a.db3", 3]}],
)
def test_a_bag_lists_its_files(tmp_path, about: Any) -> None:
    """Without a list of names there is nothing to read."""
    path = folder(tmp_path / "run", about, "a.db3")
    assert is_bag_folder(path) and not is_bag_folder(tmp_path) and not is_bag_folder(path / "a.db3")
    assert "does not list the bag's files; 'ros2 bag reindex' writes it again" in refusal(path)


def test_a_missing_file_and_a_compressed_bag_are_named(tmp_path) -> None:
    """The whole folder is wanted, written plainly."""
    names = {"relative_file_paths": ["a.db3", "sub/b.db3"]}
    assert "run lacks b.db3, which its metadata.yaml lists" in refusal(folder(tmp_path / "run", names, "a.db3"))
    endless = {"relative_file_paths": ["a.db3", f"{300 * 'b'}.db3"]}  # longer than a name can be
    assert "run lacks bbb" in refusal(folder(tmp_path / "run", endless, "a.db3"))
    for more in ({"compression_mode": "FILE"}, {"compression_mode": "message"}):
        assert "run is compressed as a whole" in refusal(folder(tmp_path / "run", names | more, "a.db3", "b.db3"))
    packed = {"relative_file_paths": ["a.db3.zstd"], "compression_mode": ""}
    assert "run is compressed as a whole" in refusal(folder(tmp_path / "run", packed, "a.db3.zstd"))


def test_settings_of_a_topic_that_are_no_plain_yaml_are_refused_before_the_library_reads_them(tmp_path) -> None:
    """Deep enough brackets would fill its stack; rows that are none are left to it."""
    bad = {"topic_metadata": {"name": "/x", "offered_qos_profiles": "[" * 3000}}
    fine = [3, {"topic_metadata": 3}, {"topic_metadata": {"offered_qos_profiles": "- history: 1"}}]
    names = {"relative_file_paths": ["a.db3"]}
    said = refusal(folder(tmp_path / "run", {**names, "topics_with_message_count": [*fine, bad]}, "a.db3"))
    assert "the settings of a topic are no plain YAML" in said
    for rows in (fine, "rows", None):
        said = refusal(folder(tmp_path / "run", {**names, "topics_with_message_count": rows}, "a.db3"))
        assert "no plain YAML" not in said and "cannot be read as a ROS bag" in said
