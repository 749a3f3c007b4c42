"""What a bag must be before a library that believes everything reads it: plain tables, short definitions, no lists of nothing."""

from __future__ import annotations

import bz2
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from raising import raises_code

from tau_dyn.log import rosbag_log
from tau_dyn.log.rosbag_log import check_database, check_definitions, check_profiles, limit_decompression
from tau_dyn.log.table import DecompressionLimit

GOOD = (
    "CREATE TABLE topics(id INTEGER, name TEXT, offered_qos_profiles TEXT)",
    "CREATE TABLE messages(topic_id INTEGER, timestamp INTEGER, data BLOB)",
    "CREATE TABLE message_definitions(topic_type TEXT, encoding TEXT, encoded_message_definition TEXT)",
    "CREATE INDEX by_time ON messages(timestamp)",
    "INSERT INTO topics VALUES (1, '/joint_states', '- history: 1')",
    "INSERT INTO message_definitions VALUES ('T', 'ros2msg', 'float64 x  # (of (two)) parts')",
)


def database(folder: Path, *more: str, name: str = "run.db3") -> Path:
    """Return a small database with these statements after the good ones."""
    with closing(sqlite3.connect(folder / name)) as base:
        for statement in (*GOOD, *more):
            base.execute(statement)
        base.commit()
    return folder / name


def test_plain_tables_pass(tmp_path) -> None:
    """Tables, an index, settings in YAML, a definition with brackets in a comment."""
    check_database(database(tmp_path))


DEFINED = "INSERT INTO message_definitions VALUES ('T', 'idl', '{}')"


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        ("CREATE VIEW endless AS SELECT * FROM messages", "endless is not stored but computed"),
        ("CREATE TABLE more(a INTEGER, b INTEGER GENERATED ALWAYS AS (a * 2))", "more is not stored but computed"),
        ("CREATE TRIGGER t AFTER INSERT ON messages BEGIN SELECT 1; END", "t is not stored but computed"),
        ("CREATE VIRTUAL TABLE v USING fts5(x)", "is not stored but computed"),
        ("INSERT INTO topics VALUES (2, '/x', '!!python/name:os.system')", "the settings of a topic are no plain YAML"),
        (DEFINED.format("module m { const long a = ((1)); }"), "a definition in IDL computes in parentheses"),
        (DEFINED.format("const long a = 1 << 40;"), "a definition in IDL shifts numbers"),
    ],
)  # fmt: skip
def test_what_computes_is_refused(tmp_path, statement: str, said: str) -> None:
    """Views, generated columns, triggers, virtual tables; settings with tags; arithmetic in definitions."""
    try:
        path = database(tmp_path, statement)
    except sqlite3.OperationalError as fault:  # a SQLite without this kind of table
        pytest.skip(str(fault))
    with pytest.raises(ValueError, match=said):
        check_database(path)


@pytest.mark.parametrize(
    "text",
    ["module m { const long a = (1) + (2); }", "module m { // ((\n long a; }", 'module m { /* (( << */ string s = "(("; }'],
)  # fmt: skip
def test_what_only_looks_like_arithmetic_passes(tmp_path, text: str) -> None:
    """One level of parentheses; brackets and shifts in comments and texts."""
    check_database(database(tmp_path, DEFINED.format(text)))


def test_sizes_have_bounds(tmp_path, monkeypatch) -> None:
    """As many topics and as long definitions as the bounds say, and not one more."""
    path = database(tmp_path, "INSERT INTO topics VALUES (2, '/x', '')", "INSERT INTO topics VALUES (3, '/y', NULL)")
    size = len("float64 x  # (of (two)) parts")
    monkeypatch.setattr(rosbag_log, "MAX_TOPICS", 3)
    monkeypatch.setattr(rosbag_log, "MAX_DEFINITION_BYTES", size)
    check_database(path)
    monkeypatch.setattr(rosbag_log, "MAX_TOPICS", 2)
    with pytest.raises(ValueError, match="more than 2 topics"):
        check_database(path)
    monkeypatch.setattr(rosbag_log, "MAX_DEFINITION_BYTES", size - 1)
    with pytest.raises(ValueError, match=f"its message definitions have {size} bytes"):
        check_database(path)


def test_a_path_that_would_be_an_option_is_refused(tmp_path) -> None:
    """`?`, `%` and `#` mean something where a database is opened by its address; what is no database says so."""
    for sign in "?%#":
        with pytest.raises(ValueError, match="rename it"):
            check_database(database(tmp_path, name=f"run{sign}.db3"))
    (tmp_path / "text.db3").write_text("t,q_axis\n" * 100)
    with pytest.raises(sqlite3.Error):
        check_database(tmp_path / "text.db3")


def test_settings_are_yaml_or_nothing(monkeypatch) -> None:
    """What is no text is not looked at; text beyond all settings, or deeper than a stack, is refused."""
    for fine in (None, "", 3, b"x", "- history: 1\n  depth: 10"):
        check_profiles(fine)
    for bad in ("[" * 5000, "a: [", "!!python/object/apply:os.system ['true']"):
        with pytest.raises(ValueError, match="no plain YAML"):
            check_profiles(bad)
    monkeypatch.setattr(rosbag_log, "MAX_DEFINITION_BYTES", 5)
    check_profiles("a: bc")
    with pytest.raises(ValueError, match="no plain YAML"):
        check_profiles("a: bcd")


def test_definitions_hold_something_and_not_too_much(monkeypatch) -> None:
    """Lists of empty messages, arrays of nothing or of millions, and texts unrolled without end are named."""
    kinds = pytest.importorskip("rosbags.interfaces").Nodetype
    number, text = (kinds.BASE, ("float64", 0)), (kinds.BASE, ("string", 0))
    point, empty = (kinds.NAME, "Point"), (kinds.NAME, "Empty")
    known = {"Point": ([], [("x", number)]), "Empty": ([], [("structure_needs_at_least_one_member", number)])}

    def check(*fields: tuple[str, tuple]) -> None:
        check_definitions({**known, "Msg": ([], list(fields))})

    many, list_of = (lambda kind, n: (kinds.ARRAY, (kind, n))), (lambda kind: (kinds.SEQUENCE, (kind, 0)))
    check(("a", many(number, 1)), ("b", many(number, 2**24)), ("c", list_of(text)), ("d", list_of(point)), ("e", empty))
    for n in (0, -1, 2**24 + 1):
        with pytest.raises(ValueError, match=f"a of Msg is an array of {n}"):
            check(("a", many(number, n)))
    nested = {"Outer": ([], [("inside", empty), ("more", many(empty, 3))])}
    for fields in ([("a", list_of(empty))], [("a", many(empty, 3))], [("a", list_of((kinds.NAME, "Outer")))]):
        with pytest.raises(ValueError, match="a of Msg is a list of empty messages"):
            check_definitions(
                {
                    **known,
                    "Msg": ([], fields),
                    **({} if "Outer" not in str(fields) else {"Outer": ([], [("i", empty)])}),
                }
            )
    with pytest.raises(ValueError, match="empty messages"):
        check_definitions({**known, **nested})
    check_definitions({**known, "Self": ([], [("me", (kinds.NAME, "Self")), ("all", list_of((kinds.NAME, "Self")))])})
    check_definitions({"Msg": ([], [("a", list_of((kinds.NAME, "Unknown")))])})
    monkeypatch.setattr(rosbag_log, "MAX_UNROLLED_ENTRIES", 10)
    check(("a", many(text, 4)), ("b", many(point, 6)), ("c", many(number, 1000)))
    with pytest.raises(ValueError, match="b of Msg is an array of 7"):
        check(("a", many(text, 4)), ("b", many(point, 7)))


@pytest.mark.parametrize("kind", ["plain", "bz2", "lz4", "other"])
def test_chunks_open_no_further_than_what_is_left(tmp_path, kind: str) -> None:
    """A megabyte of zeros packs into nothing; with room for it it is opened, counted, and a second time is too much."""
    plain = b"\0" * 2**20
    data = {"plain": plain, "other": plain, "bz2": bz2.compress(plain)}.get(kind)
    if kind == "lz4":
        data = pytest.importorskip("lz4.frame").compress(plain)
    assert data is not None
    (tmp_path / "run.bag").write_bytes(b"x")
    inflated = DecompressionLimit(tmp_path / "run.bag")
    inflated.left = 2**20 + 10
    calls = []

    def decompress(x: bytes) -> bytes:
        calls.append(len(x))
        return x

    opened = limit_decompression(decompress, inflated)
    assert opened(data) == plain and inflated.left == 10
    with raises_code("file_too_large", "run.bag"):
        opened(data)
    assert calls == ([2**20] if kind in ("plain", "other") else [])
