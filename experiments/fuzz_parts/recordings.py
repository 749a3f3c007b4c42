"""Valid recordings of other programs, small: MCAP, ROS bags, MATLAB files, made by those programs' own libraries.

Times are whole numbers without a clock or chance, so that each call makes the same bytes.
"""

from __future__ import annotations

import io
import json
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from fuzz_parts import seeds

N = 24
"""Messages; less than a log needs would be refused for that alone."""

START = 1_700_000_000_000_000_000  # [ns]
TOPIC = "/arm/joint_states"
JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""
MAP = (
    b"t: arm/joint_states.log_time\nq_axis: arm/joint_states.position.axis\ntau_axis: {column: motor.data, scale: 2}\n"
)
"""A column map for all of them: positions from one topic, forces from another."""


def states() -> list[tuple[int, dict]]:
    """Return joint states with the times [ns] at which they were recorded."""
    columns = seeds.columns()
    found = []
    for k in range(N):
        ns = START + 10_000_000 * k
        stamp = {"sec": ns // 10**9, "nanosec": ns % 10**9}
        lists = {"position": [float(columns["q_axis"][k])], "velocity": [], "effort": [float(columns["tau_axis"][k])]}
        found.append((ns + 1000, {"header": {"stamp": stamp, "frame_id": ""}, "name": ["axis"], **lists}))
    return found


def forces() -> list[tuple[int, dict]]:
    """Return messages of one number."""
    return [(START + 10_000_000 * k, {"data": float(seeds.columns()["tau_axis"][k])}) for k in range(-1, N + 1)]


@cache
def mcaps() -> tuple[bytes, ...]:
    """Return MCAP files: plain JSON, JSON in chunks of both compressions, joint states in CDR."""
    from mcap.writer import CompressionType

    kinds = (CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4)
    plain = _json_mcap(use_chunking=False, enable_crcs=False)
    return (plain, *(_json_mcap(chunk_size=1500, compression=kind) for kind in kinds), _cdr_mcap())


def _json_mcap(**options: object) -> bytes:
    from mcap.writer import Writer

    out = io.BytesIO()
    writer = Writer(out, **options)  # pyright: ignore[reportArgumentType]
    writer.start()
    for topic, messages in ((TOPIC, states()), ("/motor", forces())):
        schema = writer.register_schema(topic.strip("/"), "jsonschema", b"{}")
        channel = writer.register_channel(topic, "json", schema)
        for ns, message in messages:
            writer.add_message(channel, ns, json.dumps(message).encode(), ns)
    writer.finish()
    return out.getvalue()


def _cdr_mcap() -> bytes:
    from mcap_ros2.writer import Writer

    out = io.BytesIO()
    writer = Writer(out, chunk_size=800)
    schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
    for ns, message in states():
        writer.write_message(TOPIC, schema, message, log_time=ns, publish_time=ns)
    writer.finish()
    return out.getvalue()


@cache
def bags1() -> tuple[bytes, ...]:
    """Return ROS 1 bags: one as it is, and one of each compression."""
    from rosbags.rosbag1 import Writer

    found = []
    with TemporaryDirectory() as name:
        for kind in (None, Writer.CompressionFormat.BZ2, Writer.CompressionFormat.LZ4):
            writer = Writer(Path(name) / f"{kind}.bag")
            if kind is not None:
                writer.set_compression(kind)
            _write(writer, 1)
            found.append((Path(name) / f"{kind}.bag").read_bytes())
    return tuple(found)


@cache
def bags2(storage: str) -> tuple[bytes, ...]:
    """Return the recording of a ROS 2 bag, in `sqlite3` or `mcap`, and its metadata."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    with TemporaryDirectory() as name:
        folder = Path(name) / "run"
        _write(Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]), 2)
        recording = next(p for p in folder.iterdir() if p.name != "metadata.yaml")
        return recording.read_bytes(), (folder / "metadata.yaml").read_bytes()


def _write(writer, ros: int) -> None:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    pack = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    types, kind, number = store.types, "sensor_msgs/msg/JointState", "std_msgs/msg/Float64"
    with writer:
        joints = writer.add_connection(TOPIC, kind, typestore=store)
        motor = writer.add_connection("/motor", number, typestore=store)
        for k, (ns, m) in enumerate(states()):
            at = types["builtin_interfaces/msg/Time"](**m["header"]["stamp"])
            header = types["std_msgs/msg/Header"](stamp=at, frame_id="", **({"seq": k} if ros == 1 else {}))
            lists = {f: np.array(m[f], float) for f in ("position", "velocity", "effort")}
            writer.write(joints, ns, pack(types[kind](header=header, name=m["name"], **lists), kind))
        for ns, m in forces():
            writer.write(motor, ns, pack(types[number](data=m["data"]), number))


@cache
def mats() -> tuple[bytes, ...]:
    """Return MATLAB files: variables of our names, plain and compressed, and Simulink's structure with time."""
    from scipy.io import savemat

    columns = {name: x[:N] for name, x in seeds.columns().items()}
    simulink = {
        "out": {
            "time": columns["t"],
            "signals": {"values": np.column_stack([columns["q_axis"], columns["tau_axis"]]), "label": "q"},
            "cells": np.array([columns["q_axis"], "text"], dtype=object),
        }
    }
    found = []
    for content, packed in ((columns, False), (columns, True), (simulink, False), (columns | simulink, False)):
        out = io.BytesIO()
        savemat(out, content, do_compression=packed)
        found.append(b"MATLAB 5.0 MAT-file".ljust(116) + out.getvalue()[116:])  # the header says when it was made
    return tuple(found)
