"""Foreign logs become ours by names, scales, couplings and files, and a wrong map is named before a log is read."""

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.log import ColumnMap, read_log

MAPS = Path(__file__).parents[2] / "identification" / "columns"
DATA = Path(os.environ.get("TAU_DYN_DATA", Path(__file__).parents[3] / "shared" / "data"))


@pytest.fixture
def map_file(csv_file):
    """Return a writer of maps."""
    return lambda text: csv_file(text, name="map.yaml")


@pytest.fixture
def foreign(csv_file) -> Path:
    """Twenty samples with a clock in ms, two motor angles, two currents and a lamp."""
    rows = [f"{4 * k},{k},{2 * k},{0.1 * k},{0.2 * k},1" for k in range(20)]
    return csv_file(["ms,m1,m2,i1,i2,lamp", *rows], name="foreign.csv")


def test_scale_comes_before_offset(foreign, map_file):
    """Ours = scale * theirs + offset, and unmapped columns keep their names."""
    text = "t: {column: ms, scale: 1e-3}\nq_a: {column: m1, scale: 2, offset: 5}\ntau_a: i1\n"
    log = read_log(foreign, map_file(text))
    assert_allclose(log.t, 0.004 * np.arange(20))
    assert_allclose(log.channels["q_a"], 5 + 2 * np.arange(20))
    assert_allclose(log.channels["tau_a"], 0.1 * np.arange(20))
    assert list(log.channels) == ["m2", "i2", "lamp", "q_a", "tau_a"]


def test_a_log_without_a_clock_gets_one(foreign, map_file):
    """At 250 Hz the 20th sample is at 76 ms."""
    log = read_log(foreign, map_file("t: {rate_hz: 250}\nq_a: m1\n"))
    assert_allclose(log.t[[0, -1]], [0, 0.076])


def test_couplings_follow_the_order_of_keys(foreign, map_file):
    """Ours = matrix @ (scale * theirs + offset) + q_offset, with joints as the map lists them, here b before a."""
    text = """
t: {rate_hz: 100}
q_b: {column: m2, scale: 0.5, offset: 1}
q_a: m1
tau_b: i2
tau_a: i1
couplings: {q: [[1, 10], [0, 2]], q_offset: [100, 200], tau: [[1, 0], [3, 1]]}
"""
    log = read_log(foreign, map_file(text))
    k = np.arange(20)
    m_b, m_a = 0.5 * 2 * k + 1, k
    assert_allclose(log.joint("q", ["b", "a"]), np.column_stack([m_b + 10 * m_a + 100, 2 * m_a + 200]))
    assert_allclose(log.joint("tau", ["b", "a"]), np.column_stack([0.2 * k, 0.6 * k + 0.1 * k]))


def test_a_rate_alone_leaves_all_columns_their_names(csv_file, map_file):
    """A log whose columns are known but has no clock takes a rate; nothing else of it changes."""
    log = read_log(csv_file(["q_a,push", *(f"{k},{-k}" for k in range(20))]), map_file("t: {rate_hz: 50}\n"))
    assert_allclose(log.t, np.arange(20) / 50)
    assert_allclose(log.channels["push"], -np.arange(20.0))


@pytest.fixture
def two_files(csv_file, tmp_path) -> Path:
    """Positions and currents in two files with the same column names."""
    csv_file(["J1", *(str(k) for k in range(20))], name="pos.csv")
    csv_file(["J1", *(str(-k) for k in range(20))], name="cur.csv")
    return tmp_path


TWO = "files: {p: pos.csv, c: cur.csv}\nt: {rate_hz: 100}\nq_a: {file: p, column: J1}\ntau_a: {file: c, column: J1}\n"


@pytest.mark.parametrize("given", ["pos.csv", "cur.csv", "."])
def test_columns_of_one_name_come_from_two_files(two_files, map_file, given):
    """Either file or their folder may be given as the log."""
    log = read_log(two_files / given, map_file(TWO))
    assert_allclose(log.channels["q_a"], np.arange(20))
    assert_allclose(log.channels["tau_a"], -np.arange(20))
    assert len(log.sha256) == 64


def test_a_second_file_may_join_the_log_given(two_files, map_file):
    """Columns without `file` come from the log on the command line."""
    text = "files: {c: cur.csv}\nt: {rate_hz: 100}\nq_a: J1\ntau_a: {file: c, column: J1}\n"
    log = read_log(two_files / "pos.csv", map_file(text))
    assert_allclose(log.channels["q_a"] + log.channels["tau_a"], 0)


def test_a_log_that_the_map_does_not_read_is_refused(two_files, map_file, csv_file):
    """Nobody who gives other.csv wants the answer for pos.csv."""
    other = csv_file(["J1", *("0" for _ in range(20))], name="other.csv")
    with raises_code("mismatch", "other.csv", "map.yaml", "pos.csv", "cur.csv"):
        read_log(other, map_file(TWO))


def test_files_of_different_length_are_not_one_log(two_files, map_file, csv_file):
    """They cannot have been sampled together, unless the shorter one broke off in its last line."""
    csv_file(["J1", *(str(-k) for k in range(18))], name="cur.csv")
    with raises_code("mismatch", "pos.csv", "20", "cur.csv", "18"):
        read_log(two_files / "pos.csv", map_file(TWO))
    csv_file(["J1", *(str(-k) for k in range(19)), "-"], name="cur.csv", end="")
    log = read_log(two_files / "pos.csv", map_file(TWO))
    assert log.n_samples == 19 and len(log.warnings) == 2


@pytest.mark.parametrize(
    "path", ["/etc/passwd", "../pos.csv", "a/../../pos.csv", "C:\\pos.csv", "..\\pos.csv", "~/pos.csv"]
)
def test_files_stay_in_the_folder_of_the_log(two_files, map_file, path):
    """A map from a stranger cannot point elsewhere on the disk."""
    text = f"files: {{p: '{path}'}}\nt: {{rate_hz: 100}}\nq_a: {{file: p, column: J1}}\n"
    with raises_code("file_format", "files.p"):
        read_log(two_files / "pos.csv", map_file(text))


def test_a_fault_in_a_foreign_log_is_named_in_its_own_words(foreign, map_file):
    """The column of the message is the one that stands in the file."""
    foreign.write_text(foreign.read_text().replace("20,5,10", "20,five,10"))
    with raises_code("bad_sample", "foreign.csv", "7", "m1"):
        read_log(foreign, map_file("t: {column: ms, scale: 0.001}\nq_a: m1\n"))


def test_a_foreign_column_that_is_missing_is_named(foreign, map_file):
    """With the map, our name, and what the log has."""
    with raises_code("missing_column", "foreign.csv", "m9", "map.yaml", "q_a", "m1"):
        read_log(foreign, map_file("t: ms\nq_a: m9\n"))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("q_a: [", "line 1: not valid YAML"),
        ("q_a: m1\nq_a: m2\n", "stands twice"),
        ("q_a: !!python/object/apply:os.getcwd []\n", "not valid YAML"),
        ("- q_a\n", "not a list"),
        ("", "not nothing"),
        ("episode: 3\n", "maps no column"),
        ("angle_a: m1\n", "key angle_a is not one of our column names"),
        ("1: m1\n", "key 1 is not one"),
        ("q_a: 0\n", "q_a has to be a column's name"),
        ("q_a: yes\n", "not yes or no"),
        ("q_a: {column: m1, factor: 2}\n", "q_a has a key factor; it may have column, scale"),
        ("q_a: {scale: 2}\n", "q_a needs a 'column'"),
        ("q_a: {column: m1, scale: pi/180}\n", "q_a.scale is 'pi/180'"),
        ("q_a: {column: m1, scale: .nan}\n", "q_a.scale is nan"),
        ("q_a: {column: m1, scale: true}\n", "q_a.scale is True"),
        ("q_a: {column: m1, scale: 0}\n", "erase the column"),
        ("q_a: {column: m1, file: [pos]}\n", "q_a names file"),
        ("q_a: {column: m1, file: pos}\n", "q_a names file pos, and 'files' has nothing"),
        ("t: {rate_hz: -5}\nq_a: m1\n", "t.rate_hz is -5"),
        ("t: {rate_hz: 5, column: ms}\nq_a: m1\n", "t has rate_hz and column"),
        ("files: [a.csv]\nq_a: m1\n", "files has to be a mapping"),
        ("files: {a: a.csv}\nq_a: m1\n", "no column is taken from file 'a'"),
        ("q_a: m1\ncouplings: {r: [[1]]}\n", "couplings holds r"),
        ("q_a: m1\ncouplings: [[1]]\n", "couplings holds a list"),
        ("q_a: m1\ncouplings: {q: [[1, 0], [0, 1]]}\n", "couplings.q has to hold 1 by 1 numbers"),
        ("q_a: m1\nq_b: m2\ncouplings: {q: [[1, 0], [0]]}\n", "couplings.q has to hold 2 by 2 numbers"),
        ("q_a: m1\ncouplings: {q: [[one]]}\n", "couplings.q is 'one'"),
        ("q_a: m1\ncouplings: {q_offset: [1, 2]}\n", "couplings.q_offset has to hold 1 numbers"),
        ("q_a: m1\ncouplings: {tau: [[1]]}\n", "couplings.tau has to hold"),
    ],
)
def test_a_map_that_means_nothing_is_refused(map_file, text, sentence):
    """Each mistake in a map is one sentence that names the map."""
    with pytest.raises(InputError) as caught:
        ColumnMap.load(map_file(text))
    message = str(caught.value)
    assert sentence in message and "map.yaml" in message.partition(": ")[0] and "\n" not in message


def test_a_missing_map_is_named(tmp_path):
    """The path stands in the sentence."""
    with raises_code("file_not_found", "none.yaml"):
        ColumnMap.load(tmp_path / "none.yaml")


def measured(name: str) -> Path:
    """Return a file of measured data, or skip where it is absent and not required."""
    path = DATA / name
    if not path.exists() and os.environ.get("TAU_DYN_REQUIRE_DATA") != "1":
        pytest.skip(f"{name} is not here; set TAU_DYN_DATA to the folder of measured data")
    return path


def test_the_tx40_map_inverts_the_wrist_coupling():
    """Power is the same on both sides of the gears: tau' (R^-1 dm) = current' dm, for every pair of motions."""
    map_ = ColumnMap.load(MAPS / "tx40.yaml")
    R = np.diag([32.0, 32, 45, -48, 45, 32])
    R[5, 4] = 32
    assert_allclose(map_.couplings["q"].matrix @ R, np.eye(6), atol=1e-12)
    assert_allclose(map_.couplings["tau"].matrix, R.T)
    assert_allclose(map_.couplings["q"].offset, [0, -np.pi / 2, np.pi / 2, 0, 0, 0])


def test_the_tx40_log_stays_within_the_robots_limits():
    """45000 samples at 5 kHz, all six joints inside the limits of tx40.urdf."""
    log = read_log(measured("tx40/pos_read_data.csv"), MAPS / "tx40.yaml")
    q = log.joint("q", [f"joint_{k}" for k in range(1, 7)])
    assert q.shape == (45000, 6) and log.rate_hz == pytest.approx(5000)
    assert np.all(np.abs(q) < [3.14, 2.18, 2.40, 4.71, 2.33, 4.71])


def test_the_emps_log_is_read_in_newtons():
    """24841 samples at 1 kHz of a quarter-metre stroke; the controller's 10 V are 351.5 N."""
    log = read_log(measured("emps/DATA_EMPS.csv"), MAPS / "emps.yaml")
    assert log.n_samples == 24841 and log.rate_hz == pytest.approx(1000, rel=1e-6)
    assert 0.2 < np.ptp(log.channels["q_axis"]) < 0.3
    assert 50 < np.abs(log.channels["tau_axis"]).max() < 351.6


@pytest.mark.parametrize(
    ("ours", "column", "scale"),
    [
        ("q_axis", "pos [deg]", "0.0174532925"),
        ("t", "time_ms", "0.001"),
        ("tau_axis", "torque [mNm]", "0.001"),
        ("v_axis", "speed_rpm", "0.104719755"),
    ],
)
def test_a_unit_in_a_name_needs_its_scale(ours: str, column: str, scale: str) -> None:
    """Degrees are not read as radians because a map has no scale; a scale of 1 that is written out decides."""
    with raises_code("file_format", f"{ours} takes {column}", f"scale: {scale}}}"):
        ColumnMap.from_dict({"q_other": "x", ours: column})
    given = ColumnMap.from_dict({"q_other": "x", ours: {"column": column, "scale": 1}})
    assert given.sources[ours].scale == 1.0
    assert ColumnMap.from_dict(given.to_dict()).sources[ours] == given.sources[ours]
