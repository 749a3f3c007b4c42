"""The likeliest mistakes in a log have a sentence of their own, which says what would be right."""

import json

import numpy as np
import pandas as pd
import pytest
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.log import ColumnMap, Log, check_log, read_log

T = np.arange(40) * 0.004


def written(path, head="t,q_axis,tau_axis", times=None, before="", after=""):
    """Write a log of 40 samples."""
    times = [f"{t:.3f}" for t in T] if times is None else times
    rows = [f"{t},{0.1 * np.sin(20 * k / 40):.6f},1.5" for k, t in enumerate(times)]
    path.write_text(before + "\n".join([head, *([after] if after else []), *rows]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"times": [f"2026-11-20 10:00:{k // 20:02d}" for k in range(40)]}, "the stamps have whole seconds"),
        ({"times": [f"week 12 day {k}" for k in range(40)]}, "is not a number"),
        ({"times": [str(1_700_000_000_000_000_000 + 4_000_000 * k) for k in range(40)]}, "a scale in a column map"),
        ({"after": "s,mm,N"}, "write `q_axis: {column: q_axis, scale: 0.001}` into a column map"),
        ({"before": "Recorder export\nDevice X\n"}, "line 3 has 3 cells, and line 1, 'Recorder export', is taken for the header"),
        ({"head": "T,Q_AXIS,TAU_AXIS"}, "has no column t (did you mean T?)"),
        ({"head": "Time,q_axis,tau_axis"}, "write `t: Time`, or `t: {rate_hz: F}` without a clock, into a column map"),
    ],
)  # fmt: skip
def test_a_likely_mistake_is_named_with_its_remedy(tmp_path, wrong, words):
    """Dates, nanoseconds, a line of units, lines above the header, capitals: each is told from a cell that is just wrong."""
    with pytest.raises(InputError) as fault:
        read_log(written(tmp_path / "monday.csv", **wrong))
    assert words in str(fault.value) and "monday.csv" in str(fault.value)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"PK\x03\x04" + bytes(300), "Excel workbook"),
        (b"\x1f\x8b\x08" + bytes(300), "gzip"),
        (json.dumps({"t": [0, 1]}, indent=1).encode(), "is JSON"),
        (b'[{"t": 0}]', "is JSON"),
        (b'<?xml version="1.0"?>\n<robot name="arm"/>\n', "is XML, such as a robot file; were robot and log exchanged"),
        (b"tau_dyn_model: 1\nrobot:\n  a: b\n", "is YAML, such as a model file"),
        (b"# map\nq_axis: position\n", "is YAML, such as a model file"),
        (b"- 1\n- two\n", "is YAML, such as a model file"),
        (b"t q_axis tau_axis\n" + b"".join(b"%.3f 0.1 1\n" % t for t in T), "separate names and cells by commas"),
    ],
)
def test_other_programs_files_are_called_by_their_name(tmp_path, data, words):
    """An Excel sheet, an archive, a robot file, JSON or columns between blanks are said to be that, not to lack a header."""
    (tmp_path / "odd.csv").write_bytes(data)
    with pytest.raises(InputError, match=words):
        read_log(tmp_path / "odd.csv")


def test_a_lack_of_memory_is_not_blamed_on_the_file(tmp_path, monkeypatch):
    """Pandas' parser states a lack of memory as an error of the text."""

    def starved(*args, **options):
        raise pd.errors.ParserError("Error tokenizing data. C error: out of memory")

    path = written(tmp_path / "monday.csv")
    monkeypatch.setattr(pd, "read_csv", starved)
    with pytest.raises(MemoryError):
        read_log(path)


def test_a_header_in_brackets_is_a_header(tmp_path):
    """`[t]` begins as JSON does, and is none."""
    with raises_code("missing_column"):
        read_log(written(tmp_path / "a.csv", head="[t],[q_axis],[tau_axis]"))


def test_nanoseconds_are_read_through_a_map(tmp_path):
    """A clock in nanoseconds since 1970 is beyond any SI quantity until its scale brings it to seconds."""
    log = written(tmp_path / "ns.csv", times=[str(1_700_000_000_000_000_000 + 4_000_000 * k) for k in range(40)])
    (tmp_path / "map.yaml").write_text("t: {column: t, scale: 1e-9}\n")
    t = read_log(log, tmp_path / "map.yaml").t
    np.testing.assert_allclose(np.diff(t), 0.004, atol=1e-6)  # doubles of that size have steps of 0.24 us


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({"position": "q_axis"}, "write 'q_axis: position', our name first"),
        ({"q_axis": {"column": "p", "unit": "mm"}}, "scale: 0.001 of mm"),
        ({"q_axis": {"column": "p", "scale": 0, 1: None}}, "decimal point"),
    ],
)
def test_a_map_written_wrongly_says_how(entries, words):
    """A map the wrong way round, a unit in place of a scale, a decimal comma: the sentence shows the right line."""
    with pytest.raises(InputError, match=words):
        ColumnMap.from_dict(entries, "map.yaml")


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
def test_a_clock_in_another_unit_is_told_which(factor, unit):
    """A log at 250 Hz whose clock counts milli-, micro- or nanoseconds is a fault with that unit's scale."""
    t = np.arange(2500) * 0.004
    log = Log(factor * t, {"q_axis": np.sin(t), "tau_axis": np.cos(t)}, "a.csv")
    (fault,) = [f for f in check_log(log).findings if f.severity == "fault" and f.topic == "sampling"]
    assert unit in fault.sentence and f"scale: {1 / factor:.3g}".replace("e-0", "e-") in fault.remedy


def test_another_robots_log_is_suspected():
    """A log with positions of other joints than the robot's names them."""
    from tau_dyn.robot import load_robot

    t = np.arange(2500) * 0.004
    log = Log(t, {"q_cart1": np.sin(t), "tau_cart1": np.cos(t)}, "a.csv")
    first = next(f for f in check_log(log, load_robot("linear_axis")).findings if f.topic == "columns")
    assert "those of cart1: another robot's log?" in first.sentence


def test_exchanged_positions_are_seen_by_their_references():
    """Two joints whose positions follow each other's references have exchanged columns, not delays."""
    t = np.arange(2500) * 0.004
    a, b = np.sin(3 * t), 0.4 * np.sin(5 * t)
    log = Log(t, {"q_a": b, "q_b": a, "q_ref_a": a, "q_ref_b": b, "tau_a": a, "tau_b": b}, "a.csv")
    said = [f.sentence for f in check_log(log).findings if f.severity == "fault"]
    assert said == [
        "a.csv: q_a follows the reference of b, not its own.",
        "a.csv: q_b follows the reference of a, not its own.",
    ]
    straight = Log(t, {"q_a": a, "q_b": b, "q_ref_a": a, "q_ref_b": b, "tau_a": a, "tau_b": b}, "a.csv")
    assert check_log(straight).fit_for_use
