"""Small recordings in other programs' formats, made on the fly."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

JOINT_STATE = """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""

START = 1_700_000_000_000_000_000  # [ns] some day in 2023
LATE = 3_000_000  # [ns] from the stamp to the recording, at least


def stamp(ns: int) -> dict[str, int]:
    """Return a time as ROS 2 messages hold it."""
    return {"sec": ns // 10**9, "nanosec": ns % 10**9}


def joint_states(
    t: np.ndarray, q: np.ndarray, tau: np.ndarray, names: list[str], *, stamped: bool = True
) -> Iterable[tuple[int, dict[str, Any]]]:
    """Yield times of recording [ns] and joint states; arrays (N, n)."""
    for k, at in enumerate(t):
        ns = START + round(float(at) * 1e9)
        header = {"stamp": stamp(ns if stamped else 0), "frame_id": ""}
        late = LATE + 1_000_000 * (k % 2)  # the way to the recorder jitters
        yield (
            ns + late,
            {"header": header, "name": names, "position": q[k].tolist(), "velocity": [], "effort": tau[k].tolist()},
        )


def write_mcap(
    path: Path, topics: Mapping[str, Iterable[tuple[int, dict[str, Any]]]], *, kind: str = "json", **options: Any
) -> Path:
    """Write topics as JSON, or as joint states in CDR (`kind="cdr"`)."""
    from mcap.writer import Writer
    from mcap_ros2.writer import Writer as Ros2Writer

    with path.open("wb") as file:
        if kind == "cdr":
            ros2 = Ros2Writer(file, **options)
            schema = ros2.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
            for topic, messages in topics.items():
                for ns, message in messages:
                    ros2.write_message(topic, schema, message, log_time=ns, publish_time=ns)
            ros2.finish()
            return path
        writer = Writer(file, **options)
        writer.start()
        for topic, messages in topics.items():
            schema = writer.register_schema(topic.strip("/"), "jsonschema", b"{}")
            channel = writer.register_channel(topic, "json", schema)
            for ns, message in messages:
                writer.add_message(channel, ns, json.dumps(message).encode(), ns)
        writer.finish()
    return path


def write_bag(
    path: Path, topics: Mapping[str, Iterable[tuple[int, dict[str, Any]]]], *, ros: int, mcap: bool = False
) -> Path:
    """Write joint states as a ROS 1 bag file or a ROS 2 bag folder."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    types, kind = store.types, "sensor_msgs/msg/JointState"
    storage = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    writer = Writer1(path) if ros == 1 else Writer2(path, version=9, storage_plugin=storage)
    pack = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    with writer:
        for topic, messages in topics.items():
            connection = writer.add_connection(topic, kind, typestore=store)
            for k, (ns, m) in enumerate(messages):
                at = types["builtin_interfaces/msg/Time"](**m["header"]["stamp"])
                more = {"seq": k} if ros == 1 else {}
                header = types["std_msgs/msg/Header"](stamp=at, frame_id="", **more)
                lists = {f: np.array(m[f], float) for f in ("position", "velocity", "effort")}
                message = types[kind](header=header, name=list(m["name"]), **lists)
                writer.write(connection, ns, pack(message, kind))
    return path
