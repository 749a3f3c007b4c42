"""Recordings made to harm: a few bytes that say they are gigabytes, databases that compute, definitions without end.

Each of them took all memory, all time or the process itself; each is refused in a sentence now, soon.
"""

from __future__ import annotations

import bz2
import json
import sqlite3
import struct
import sys
import zlib
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from raising import raises_code

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from fuzz_parts import recordings
from fuzz_parts.judge import judge
from fuzz_parts.mutate_records import in_cells

from tau_dyn.log import read_log

pytest.importorskip("mcap_ros2")
pytest.importorskip("rosbags")
RULE = "=" * 80 + "\n"
SECOND = 10**9  # [ns]


def refused(path: Path, words: str) -> None:
    """The file is refused within five seconds of processor time, and the sentence says these words."""
    verdict = judge(read_log, path, 5.0)
    assert verdict.kind == "refused" and words in verdict.said, verdict


def mcap(path: Path, messages: list[bytes], encoding: str = "json", definition: str = "") -> Path:
    """Write messages of one topic."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("a/msg/Top", "ros2msg" if definition else "jsonschema", definition.encode())
        channel = writer.register_channel("/joint_states", encoding, schema)
        for k, message in enumerate(messages):
            writer.add_message(channel, k * SECOND, message, k * SECOND)
        writer.finish()
    return path


def database(path: Path, *statements: tuple) -> Path:
    """Write the database of a bag after some changes."""
    with closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(recordings.bags2("sqlite3")[0])
        for words, *values in statements:
            base.execute(words, values)
        base.commit()
        path.write_bytes(base.serialize())
    return path


def defined(path: Path, definition: str, encoding: str = "ros2msg") -> Path:
    """Write a bag whose messages have another definition, and no bytes of their own."""
    return database(
        path,
        ("UPDATE message_definitions SET encoding = ?, encoded_message_definition = ?", encoding, definition),
        ("UPDATE message_definitions SET type_description_hash = ''",),
        ("UPDATE topics SET type_description_hash = ''",),
        ("UPDATE messages SET data = ?", b"\0\1\0\0" + bytes(64)),
    )


def record(data: bytes, **head: bytes) -> bytes:
    """Return a record of a ROS 1 bag."""
    fields = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in head.items())
    return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(data)) + data


def u32(*numbers: int) -> bytes:
    """Return whole numbers of four bytes."""
    return struct.pack(f"<{len(numbers)}I", *numbers)


def bag(
    path: Path, chunks: list[bytes], entries: list[tuple[int, int, int]], definition: bytes = b"float64 data\n"
) -> Path:
    """Write a ROS 1 bag of compressed chunks, and of messages at (chunk, time [ns], place in it)."""
    opening = 13 + len(record(b"", op=b"\3", index_pos=bytes(8), conn_count=u32(1), chunk_count=u32(1)))
    body, places = b"", []
    for k, chunk in enumerate(chunks):
        own = [u32(*divmod(t, SECOND), place) for of, t, place in entries if of == k]
        places.append((opening + len(body), len(own)))
        body += record(bz2.compress(chunk), op=b"\5", compression=b"bz2", size=u32(len(chunk)))
        body += record(b"".join(own), op=b"\4", ver=u32(1), conn=u32(0), count=u32(len(own)))
    about = {"topic": b"/joint", "type": b"a/Top", "md5sum": b"", "message_definition": definition}
    inside = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in about.items())
    index = record(inside, op=b"\7", conn=u32(0), topic=b"/joint")
    for place, n in places:
        index += record(u32(0, n), op=b"\6", ver=u32(1), chunk_pos=struct.pack("<Q", place), start_time=u32(0, 0),
                        end_time=u32(9, 0), count=u32(1))  # fmt: skip
    at = struct.pack("<Q", opening + len(body))
    head = record(b"", op=b"\3", index_pos=at, conn_count=u32(1), chunk_count=u32(len(chunks)))
    path.write_bytes(b"#ROSBAG V2.0\n" + head + body + index)
    return path


def message(t: int, data: bytes) -> bytes:
    """Return a message of a ROS 1 bag."""
    return record(data, op=b"\2", conn=u32(0), time=u32(*divmod(t, SECOND)))


def matlab(path: Path, array: bytes) -> Path:
    """Write one compressed variable."""
    packed = zlib.compress(struct.pack("<II", 14, len(array)) + array)
    path.write_bytes(recordings.mats()[0][:128] + struct.pack("<II", 15, len(packed)) + packed)
    return path


def element(kind: int, data: bytes) -> bytes:
    """Return a part of a MATLAB array."""
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def whole_bytes(n: int) -> bytes:
    """Return a MATLAB array `t` of so many numbers of one byte."""
    head = element(6, struct.pack("<II", 8, 0)) + element(5, struct.pack("<ii", 1, n))
    return head + element(1, b"t") + element(1, bytes(n))


def test_a_number_beyond_a_float_in_a_joint_state_is_refused(tmp_path: Path) -> None:
    """JSON has whole numbers of any length."""
    text = json.dumps({"name": ["axis"], "position": [10**400]}).encode()
    refused(mcap(tmp_path / "x.mcap", [text] * 20), "something else than numbers")


@pytest.mark.parametrize("position", ["0.5", '{"a": 1}', '"x"', "[[1]]", "true"])
def test_positions_that_are_no_list_of_numbers_are_refused(tmp_path: Path, position: str) -> None:
    """A joint state in JSON may hold any tree; found by fuzzing."""
    refused(mcap(tmp_path / "x.mcap", [b'{"name": ["axis"], "position": %s}' % position.encode()] * 20), "numbers")


def test_thousands_of_joints_in_changing_order_are_refused(tmp_path: Path) -> None:
    """Each name was looked up in a list of them all, message by message."""
    names = [f"j{k}" for k in range(5000)]
    texts = [json.dumps({"name": order, "position": [0.0] * 5000}).encode() for order in (names, names[::-1]) * 10]
    refused(mcap(tmp_path / "x.mcap", texts), "5000 joints")


def test_a_list_of_four_billion_entries_in_eight_bytes_is_refused(tmp_path: Path) -> None:
    """Of a list of bytes the decoder takes what is not there; a list of such lists never ends."""
    definition = f"a/Leaf[] data\n{RULE}MSG: a/Leaf\nuint8[4] x\n"
    path = mcap(tmp_path / "x.mcap", [b"\0\1\0\0" + b"\xff" * 4] * 20, "cdr", definition)
    refused(path, "shorter than its definition")


def test_a_chunk_that_inflates_ten_thousandfold_is_refused(tmp_path: Path) -> None:
    """25 kB became eight million messages, all of them in a list."""
    zstandard = pytest.importorskip("zstandard")
    one = struct.pack("<BQHIQQ", 5, 22, 1, 0, 0, 0)
    inside = one * (2**27 // len(one))
    packed = zstandard.ZstdCompressor().compress(inside)
    chunk = struct.pack("<QQQII", 0, 1, len(inside), 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQ", 6, len(chunk)) + chunk)
    refused(tmp_path / "x.mcap", "times its size")


@pytest.mark.parametrize(
    "made",
    [
        "CREATE VIEW message_definitions AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x+1 FROM c) SELECT x AS id,"
        " 'a' AS topic_type, 'ros2msg' AS encoding, 'b' AS encoded_message_definition, '' AS type_description_hash FROM c",
        "CREATE TABLE message_definitions(id, topic_type AS (zeroblob(900000000)), encoding, encoded_message_definition)",
    ],
)
def test_a_database_that_computes_is_refused(tmp_path: Path, made: str) -> None:
    """A view of endless rows is read in C, where not even Ctrl-C gets through; a column may compute gigabytes."""
    path = database(tmp_path / "x.db3", ("ALTER TABLE message_definitions RENAME TO old",), (made,))
    refused(path, "message_definitions is not stored but computed")


@pytest.mark.parametrize("profiles", ["[" * 20_000, "- " * 20_000, "a: &a [*a]"])
def test_settings_of_a_topic_without_end_are_refused(tmp_path: Path, profiles: str) -> None:
    """They are YAML inside the database, and a parser in C goes down one call a level."""
    refused(database(tmp_path / "x.db3", ("UPDATE topics SET offered_qos_profiles = ?", profiles)), "no plain YAML")
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "run.db3").write_bytes(recordings.bags2("sqlite3")[0])
    text = recordings.bags2("sqlite3")[1].decode()
    assert "offered_qos_profiles: []" in text
    (folder / "metadata.yaml").write_text(
        text.replace("offered_qos_profiles: []", f"offered_qos_profiles: '{profiles}'")
    )
    refused(folder, "no plain YAML")


@pytest.mark.parametrize("value", ["noon", None, 1.5, -1, b"\0"])
def test_a_time_that_is_none_is_refused(tmp_path: Path, value: object) -> None:
    """A column of such a database holds any kind of value."""
    with closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(recordings.bags2("sqlite3")[0])
        rows = base.execute("SELECT id, topic_id, data FROM messages").fetchall()
    fill = [("INSERT INTO messages VALUES (?, ?, ?, ?)", n, topic, value, data) for n, topic, data in rows]
    plain = [("DROP TABLE messages",), ("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)",)]
    refused(database(tmp_path / "x.db3", *plain, *fill), "cannot be read as a ROS bag")


@pytest.mark.parametrize(
    ("definition", "words"),
    [
        ("string[100000000] x\n", "an array of 100000000"),
        (f"a/M[1000] x\n{RULE}MSG: a/M\na/N[1000] x\n{RULE}MSG: a/N\nfloat64[0] x\n", "an array of 0"),
        ("float64[-3] x\n", "an array of -3"),
    ],
)
def test_definitions_without_end_are_refused(tmp_path: Path, definition: str, words: str) -> None:
    """Fixed arrays become a line of code for each entry; entries that take no bytes fit into any message."""
    refused(defined(tmp_path / "x.db3", definition), words)


@pytest.mark.parametrize("value", ["1 << 9000000000", "(" * 8 + "1" + ")" * 8])
def test_definitions_that_compute_are_refused(tmp_path: Path, value: str) -> None:
    """A shift makes a number of gigabytes; the parser tries parentheses inside each other in 2^7 ways a level."""
    text = f"module a {{ const long X = {value}; struct B {{ double data; }}; }};"
    refused(defined(tmp_path / "x.db3", text, "ros2idl"), "a definition in IDL")


def test_lists_of_messages_that_hold_nothing_are_refused(tmp_path: Path) -> None:
    """In ROS 1 such a message takes no bytes, so that eight bytes hold a billion."""
    rule = RULE.encode()
    definition = b"M[1000] x\n" + rule + b"MSG: a/M\nEmpty[1000] x\n" + rule + b"MSG: a/Empty\n\n"
    times = [SECOND + k * 10**7 for k in range(20)]
    one = len(message(0, bytes(8)))
    chunk = b"".join(message(t, bytes(8)) for t in times)
    path = bag(tmp_path / "x.bag", [chunk], [(0, t, k * one) for k, t in enumerate(times)], definition)
    refused(path, "list of empty messages")


def test_chunks_that_are_opened_again_and_again_are_refused(tmp_path: Path) -> None:
    """Messages that take turns between two chunks make each of them be opened for every message."""
    one = len(message(0, bytes(8)))
    times = [[SECOND + (2 * k + c) * 10**6 for k in range(300)] for c in range(2)]
    chunks = [b"".join(message(t, bytes(8)) for t in of) + bytes(2**24) for of in times]
    entries = [(c, t, k * one) for c in range(2) for k, t in enumerate(times[c])]
    refused(bag(tmp_path / "x.bag", chunks, entries), "times its size")
    few = bag(tmp_path / "few.bag", [c[: 300 * one] for c in chunks], [e for e in entries if e[2] < 10 * one])
    assert read_log(few).n_samples == 20


def test_other_files_than_those_checked_are_not_opened(tmp_path: Path) -> None:
    """Databases are opened by address: what stands behind ? and % in a name leads to another file."""
    folder = tmp_path / "bag"
    folder.mkdir()
    for name in ("run.db3?x=.db3", "x%2e%2e%2frun.db3", "run.db3#.db3"):
        (folder / name).write_bytes(recordings.bags2("sqlite3")[0])
        (folder / "metadata.yaml").write_text(recordings.bags2("sqlite3")[1].decode().replace("run.db3", name))
        refused(folder, "? % #")


def test_mcap_under_another_suffix_is_read_within_the_same_bounds(tmp_path: Path) -> None:
    """A folder's metadata say that its files are MCAP; a bag's own reader would inflate them without end."""
    (tmp_path / "run.data").write_bytes(recordings.mcaps()[2])
    text = recordings.bags2("sqlite3")[1].decode().replace("run.db3", "run.data").replace("sqlite3", "mcap")
    (tmp_path / "metadata.yaml").write_text(text)
    assert read_log(tmp_path).n_samples == recordings.N
    data = bytearray(recordings.mcaps()[2])
    place = data.index(b"zstd") - 16  # size, checksum and length of the name stand before it
    data[place : place + 8] = struct.pack("<Q", 2**40)
    (tmp_path / "run.data").write_bytes(data)
    refused(tmp_path, "chunks up to 256 MB")


def test_cells_inside_cells_are_not_copied_at_every_level(tmp_path: Path) -> None:
    """260 kB of 30 levels around 256 MB took seven gigabytes."""
    import tracemalloc

    path = matlab(tmp_path / "x.mat", in_cells(whole_bytes(2**23), 30, "<"))
    tracemalloc.start()
    refused(path, "no numbers")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5 * 2**23


def test_bytes_that_become_numbers_of_eight_bytes_are_counted_first(tmp_path: Path, monkeypatch) -> None:
    """Half a gigabyte of zeros in 0.5 MB became four gigabytes a column."""
    monkeypatch.setattr("tau_dyn.log.lab_files.matlab.MAX_CELLS", 10**5)
    refused(matlab(tmp_path / "x.mat", whole_bytes(10**5 + 1)), "100001 numbers")


def test_millions_of_empty_cells_are_refused(tmp_path: Path, monkeypatch) -> None:
    """Each takes eight bytes that pack well."""
    monkeypatch.setattr("tau_dyn.log.lab_files.matlab.MAX_ELEMENTS", 10**4)
    n = 10**4
    head = element(6, struct.pack("<II", 1, 0)) + element(5, struct.pack("<ii", 1, n)) + element(1, b"c")
    refused(matlab(tmp_path / "x.mat", head + struct.pack("<II", 14, 0) * n), "parts")


def test_a_parquet_file_of_billions_of_equal_values_is_refused(tmp_path: Path) -> None:
    """It says in a megabyte that it holds gigabytes; what is asked is its own count of rows."""
    zeros = pa.array(np.zeros(2**20))
    schema = pa.schema([(name, pa.float64()) for name in ("t", "q_axis", "tau_axis")])
    with pq.ParquetWriter(tmp_path / "x.parquet", schema) as writer:
        for _ in range(5):
            writer.write_table(pa.table([zeros] * 3, schema=schema), row_group_size=2**20)
    refused(tmp_path / "x.parquet", "no recording does")


def test_pictures_among_the_messages_are_passed_over(tmp_path: Path) -> None:
    """A message beyond 4 MiB is no signal; as a list of small messages it would take 300 times its bytes."""
    states = [json.dumps(m).encode() for _, m in recordings.states()]
    path = mcap(tmp_path / "x.mcap", [*states, b'{"name": ["axis"], "position": [1], "x": "' + b"a" * 2**22 + b'"}'])
    assert read_log(path).n_samples == recordings.N
    with raises_code("file_format"):
        read_log(mcap(tmp_path / "y.mcap", [b"[" + b"1," * 2**21 + b"1]"] * 12))
