"""Recordings of other programs become the same `Log`; clocks are chosen aloud, and what cannot be put together is refused."""

from __future__ import annotations

import json
import os
import runpy
import struct
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.io import savemat

from tau_dyn.cli import main
from tau_dyn.exceptions import InputError
from tau_dyn.log import ColumnMap, Log, open_log, propose_columns, read_log, topic_columns as columns_module

pytest.importorskip("mcap_ros2")
pytest.importorskip("rosbags")

made = SimpleNamespace(**runpy.run_path(str(Path(__file__).with_name("recordings.py"))))
START, joint_states, stamp, write_bag, write_mcap = (
    made.START,
    made.joint_states,
    made.stamp,
    made.write_bag,
    made.write_mcap,
)

N = 400
T = np.arange(N) * 0.002
Q = np.column_stack([0.3 * np.sin(5 * T), 0.2 * np.cos(3 * T)])
TAU = np.column_stack([20 * np.cos(7 * T), 5 * np.sin(4 * T)])
JOINTS = ["a", "b"]
NAME = "/arm/joint_states"


def states(**more):
    return joint_states(T, Q, TAU, JOINTS, **more)


def numbers(t: np.ndarray, x: np.ndarray, *, delay: int = 0, own: bool = True):
    """Yield messages of one number, recorded `delay` [ns] after their time."""
    for at, value in zip(t, x, strict=True):
        ns = START + round(float(at) * 1e9)
        yield ns + delay, {**({"header": {"stamp": stamp(ns)}} if own else {}), "data": float(value)}


def wrote(folder: Path, kind: str) -> Path:
    """Write the joint states in one format and return the path of the log."""
    folder = folder / kind.replace(" ", "_")
    folder.mkdir()
    if kind in ("json", "cdr"):
        return write_mcap(folder / "run.mcap", {NAME: states()}, kind=kind)
    if kind == "matlab":
        savemat(folder / "run.mat", {"t": T, **_own_names()}, do_compression=True)
        return folder / "run.mat"
    path = write_bag(
        folder / ("run.bag" if kind == "ros1" else "run"),
        {NAME: states()},
        ros=1 if kind == "ros1" else 2,
        mcap="mcap" in kind,
    )
    return path / "run.db3" if kind == "db3" else path


def _own_names() -> dict[str, np.ndarray]:
    return {f"{s}_{j}": x[:, k] for s, x in (("q", Q), ("tau", TAU)) for k, j in enumerate(JOINTS)}


@pytest.mark.parametrize("kind", ["json", "cdr", "ros1", "ros2", "ros2 mcap", "db3", "matlab"])
def test_every_format_gives_the_recorded_numbers(tmp_path, kind):
    """Positions, forces and times come back as they were sent, though recording them took 3 to 4 ms."""
    log = read_log(wrote(tmp_path, kind))
    assert_allclose(log.t, T, atol=1e-12)
    assert_allclose(log.joint("q", JOINTS), Q, rtol=0, atol=0)
    assert_allclose(log.joint("tau", JOINTS), TAU, rtol=0, atol=0)
    assert log.joints("v") == () and len(log.sha256) == 64
    assert kind == "matlab" or any("stamp" in sentence for sentence in log.warnings)


def test_the_large_reader_and_the_commands_take_them_too(tmp_path, capsys):
    """`open_log` and `check` read a bag's folder and an MCAP file as `read_log` does."""
    folder, file = wrote(tmp_path, "ros2"), wrote(tmp_path, "json")
    opened = open_log(folder)
    assert isinstance(opened, Log) and opened.n_samples == N
    for path in (folder, file):
        assert main(["check", str(path), "--json", str(tmp_path / "c.json")]) in (0, 3)
        read = json.loads((tmp_path / "c.json").read_text())["inputs"]
        assert [row["path"] for row in read] == [str(path)] and len(read[0]["sha256"]) == 64
    assert "Traceback" not in capsys.readouterr().err


def test_without_stamps_the_time_of_recording_counts_and_is_said(tmp_path):
    """A header that was never filled in says zero; t then jitters as the recording did."""
    log = read_log(write_mcap(tmp_path / "run.mcap", {"/joint_states": states(stamped=False)}))
    assert np.ptp(np.diff(log.t)) > 1e-3
    assert any("recorded" in sentence and "no stamps" in sentence for sentence in log.warnings)


def test_a_map_may_ask_for_the_time_of_recording(tmp_path):
    """`t: TOPIC.log_time` takes the recorder's clock although there are stamps."""
    path = write_mcap(tmp_path / "run.mcap", {"/joint_states": states()})
    log = read_log(path, ColumnMap.from_dict({"t": "joint_states.log_time", "q_a": "joint_states.position.a"}))
    assert np.ptp(np.diff(log.t)) > 1e-3


def test_joints_are_told_by_name_not_by_place(tmp_path):
    """A driver that lists its joints in another order in every second message moves nobody's numbers."""

    def shuffled():
        for k, (ns, message) in enumerate(states()):
            turned = {f: message[f][::-1] for f in ("name", "position", "effort")}
            yield ns, {**message, **turned} if k % 2 else message

    assert_allclose(
        read_log(write_mcap(tmp_path / "run.mcap", {"/joint_states": shuffled()})).joint("q", JOINTS), Q, atol=0
    )


def test_other_joints_under_the_same_topic_are_another_clock(tmp_path):
    """A gripper that publishes on /joint_states as well does not mix with the arm."""

    def both():
        for k, (ns, message) in enumerate(states()):
            yield ns, message
            if k % 10 == 0:
                yield ns + 1, {**message, "name": ["grip"], "position": [0.1], "effort": []}

    log = read_log(write_mcap(tmp_path / "run.mcap", {"/joint_states": both()}))
    assert log.n_samples == N and log.joints("q") == ("a", "b")


def test_a_slower_topic_is_interpolated_with_its_error_said(tmp_path):
    """Motor currents at 250 Hz beside positions at 500 Hz: the map's scale holds, and the error is below what is said."""
    t = np.arange(-5, 210) * 0.004 + 0.0007
    path = write_mcap(
        tmp_path / "run.mcap", {"/joint_states": states(), "/motor": numbers(t, 3 * np.cos(7 * t), delay=9_000_000)}
    )
    log = read_log(
        path, ColumnMap.from_dict({"q_a": "joint_states.position.a", "tau_a": {"column": "motor.data", "scale": 2}})
    )
    assert_allclose(log.channels["tau_a"], 6 * np.cos(7 * log.t), atol=6e-4)
    assert any("motor.data" in s and "250 Hz" in s and "error about 0.01 %" in s for s in log.warnings)


def test_one_topic_without_stamps_puts_all_on_the_recorders_clock(tmp_path):
    """Two kinds of clocks are never mixed: where one topic has no stamps, both take the time of recording."""
    path = write_mcap(tmp_path / "run.mcap", {"/joint_states": states(), "/motor": numbers(T, np.cos(T), own=False)})
    log = read_log(path, ColumnMap.from_dict({"q_a": "joint_states.position.a", "tau_a": "motor.data"}))
    assert any("motor has no stamps" in sentence for sentence in log.warnings)


def test_what_changes_too_fast_for_its_own_clock_is_not_interpolated(tmp_path, rng):
    """White noise cannot be told between its samples; neither can a gap be bridged, nor another day be joined."""
    map_ = ColumnMap.from_dict({"q_a": "joint_states.position.a", "tau_a": "motor.data"})
    t = T + 0.0007
    for name, at, x, why in (
        ("noise", t, rng.standard_normal(N), "cannot be found from their neighbours"),
        ("gap", np.delete(t, slice(100, 150)), np.cos(np.delete(t, slice(100, 150))), "has a gap of 0.102 s"),
        ("later", t + 100, np.cos(t), "recorded together for 0%"),
    ):
        path = write_mcap(tmp_path / f"{name}.mcap", {"/joint_states": states(), "/motor": numbers(at, x)})
        with pytest.raises(InputError, match=why):
            read_log(path, map_)


def test_a_clock_that_goes_back_is_refused_with_the_remedy(tmp_path):
    """A simulation that was restarted within the recording is no one motion."""
    first, again = list(states()), list(states())
    later = [(ns + 2 * 10**9, message) for ns, message in again]
    path = write_mcap(tmp_path / "run.mcap", {"/joint_states": first + later})
    with raises_code("time_stamps", "401", "joint_states", "log_time"):
        read_log(path)


def test_messages_sent_twice_are_taken_once(tmp_path):
    """A state that is published again, stamp and all, is left out with a warning."""
    twice = [item for ns, message in states() for item in ((ns, message), (ns + 10, message))]
    log = read_log(write_mcap(tmp_path / "run.mcap", {"/joint_states": twice}))
    assert log.n_samples == N and any(f"{N} message(s)" in sentence for sentence in log.warnings)


def test_positions_lead_where_several_topics_are_ours(tmp_path):
    """Forces in our names come first in the file and more often; the clock is still that of the positions."""
    often = np.arange(2 * N) * 0.001
    force = [(START + round(t * 1e9), {"t": t, "tau_a": 1.0}) for t in often]
    place = [(START + round(t * 1e9), {"t": t, "q_a": float(q)}) for t, q in zip(T, Q[:, 0], strict=True)]
    path = write_mcap(tmp_path / "run.mcap", {"/force": force, "/place": place}, kind="json")
    log = read_log(path)
    assert log.n_samples <= N and log.dt == pytest.approx(0.002)


def test_efforts_that_are_not_measured_are_no_column(tmp_path):
    """A driver without torque sensing says NaN throughout; a message with a single NaN is a gap."""
    nan = (({**m, "effort": [float("nan"), 1.0]}) for _, m in states())
    path = write_mcap(
        tmp_path / "nan.mcap", {"/joint_states": [(ns, m) for (ns, _), m in zip(states(), nan, strict=True)]}
    )
    assert read_log(path).joints("tau") == ("b",)
    once = [(ns, {**m, "effort": [float("nan"), 1.0]} if k == 16 else m) for k, (ns, m) in enumerate(states())]
    log = read_log(write_mcap(tmp_path / "once.mcap", {"/joint_states": once}))
    assert log.n_samples == N - 1 and any("17: 1 sample" in w for w in log.warnings)


def test_messages_in_our_own_names_are_ours(tmp_path):
    """JSON with fields t, q_J, tau_J needs no map; its t is its clock."""
    ours = ((START + 10**7 * k, {"t": float(T[k]), "q_a": Q[k, 0], "tau_a": TAU[k, 0], "note": "x"}) for k in range(N))
    log = read_log(write_mcap(tmp_path / "run.mcap", {"/log": ours}))
    assert_allclose(log.t, T, atol=1e-9)
    assert_allclose(log.channels["tau_a"], TAU[:, 0], atol=0)


def test_a_recording_that_breaks_off_is_read_to_there(tmp_path):
    """Power was lost while recording: whole messages count, with a warning; a chunk with one changed digit does not."""
    from mcap.writer import CompressionType

    whole = write_mcap(tmp_path / "whole.mcap", {"/joint_states": states()}, chunk_size=4000).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    log = read_log(tmp_path / "cut.mcap")
    assert 50 < log.n_samples < N and any("breaks off" in sentence for sentence in log.warnings)
    assert_allclose(log.joint("q", JOINTS), Q[: log.n_samples], atol=0)
    plain = write_mcap(
        tmp_path / "plain.mcap", {"/joint_states": states()}, compression=CompressionType.NONE
    ).read_bytes()
    damaged = bytearray(plain)
    place = plain.index(b'"position": [0.') + 15  # one digit of one position: still JSON, still a number
    damaged[place] = ord("7") if damaged[place] != ord("7") else ord("8")
    (tmp_path / "bad.mcap").write_bytes(damaged)
    with raises_code("damaged_file", "bad.mcap"):
        read_log(tmp_path / "bad.mcap")


def test_small_files_cannot_ask_for_all_memory(tmp_path, monkeypatch):
    """A chunk or variable that inflates beyond bounds is refused before it does, and so are too many numbers."""
    from mcap.data_stream import RecordBuilder
    from mcap.records import Chunk
    from zstandard import compress

    for size, why in ((2**40, "chunks up to 256 MB"), (1000, "does not have the 1000 bytes")):
        record = RecordBuilder()
        Chunk(compression="zstd", data=compress(b"\0" * 2**26), message_start_time=0, message_end_time=1,
              uncompressed_crc=0, uncompressed_size=size).write(record)  # fmt: skip
        (tmp_path / "bomb.mcap").write_bytes(b"\x89MCAP0\r\n" + record.end())
        with pytest.raises(InputError, match=why):
            read_log(tmp_path / "bomb.mcap")
    savemat(tmp_path / "s.mat", {"s": {"v": T}})
    data = (tmp_path / "s.mat").read_bytes()
    monkeypatch.setattr("tau_dyn.log.lab_files.matlab.MAX_INFLATED_BYTES", 2**20)
    inflating = zlib.compress(b"\0" * 2**24)
    (tmp_path / "zip.mat").write_bytes(data[:128] + struct.pack("<II", 15, len(inflating)) + inflating)
    with raises_code("file_too_large", "1"):
        read_log(tmp_path / "zip.mat")
    many = data.replace(struct.pack("<IIII", 5, 8, 1, 1), struct.pack("<IIII", 5, 8, 1, 2**31 - 1), 1)
    (tmp_path / "many.mat").write_bytes(many)
    with raises_code("damaged_file", "2147483647"):
        read_log(tmp_path / "many.mat")
    monkeypatch.setattr(columns_module, "MAX_CELLS", 100)
    with raises_code("file_too_large", "100"):
        read_log(write_mcap(tmp_path / "run.mcap", {"/joint_states": states()}))


def test_matlab_structs_are_topics(tmp_path):
    """Simulink's structure with time, in two structs at two clocks: one is put on the other's with a warning."""
    positions = {"time": T, "signals": {"values": Q, "label": "position"}}
    savemat(tmp_path / "run.mat", {"pos": positions, "cur": {"time": T + 0.0005, "signals": {"values": TAU}}})
    map_ = ColumnMap.from_dict({"q_a": "pos.signals.values[0]", "tau_a": "cur.signals.values[0]"})
    log = read_log(tmp_path / "run.mat", map_)
    assert_allclose(log.channels["tau_a"], 20 * np.cos(7 * (log.t - 0.0005)), atol=1e-4)
    assert any("cur.signals.values[0] was put on the clock of pos" in s for s in log.warnings)
    savemat(tmp_path / "one.mat", {"run": {"t": T, "q_axis": Q[:, 0], "tau_axis": TAU[:, 0]}})
    assert read_log(tmp_path / "one.mat").joints("tau") == ("axis",)


def test_matlab_without_a_clock_takes_the_maps_rate(tmp_path):
    """Variables without t are refused as a CSV without t is, and read with a rate."""
    savemat(tmp_path / "run.mat", _own_names())
    with raises_code("missing_column"):
        read_log(tmp_path / "run.mat")
    log = read_log(tmp_path / "run.mat", ColumnMap.from_dict({"t": {"rate_hz": 500.0}, "q_a": "q_a"}))
    assert_allclose(log.t, T, atol=1e-12)


FAULTS = {
    "empty.mcap": (b"", "is empty"),
    "text.mcap": (b"t,q_axis,tau_axis\n0,1,2\n", "is not an MCAP file"),
    "start.mcap": (b"\x89MCAP0\r\n", "is an MCAP file without messages"),
    "text.bag": (b"t,q_axis,tau_axis\n", "cannot be read as a ROS bag"),
    "text.db3": (b"t,q_axis,tau_axis\n", "cannot be read as a ROS bag"),
    "text.mat": (b"t,q_axis,tau_axis\n", "is not a MATLAB file"),
    "new.mat": (b"MATLAB 7.3 MAT-file" + b" " * 200, "version 7.3.*'-v7'"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_wrong_file_is_one_sentence_and_status_2(tmp_path, capsys, name):
    """Each wrong file ends in exit status 2 with one line, and no file is written."""
    data, why = FAULTS[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=why):
        read_log(tmp_path / name)
    assert main(["check", str(tmp_path / name), "--json", str(tmp_path / "c.json")]) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "c.json").exists()


@pytest.mark.parametrize(("module", "path", "extra"), [("mcap", "run.mcap", "mcap"), ("rosbags", "run.bag", "rosbag")])
def test_a_missing_extra_is_named(tmp_path, monkeypatch, module, path, extra):
    """Without the library the sentence says what to install."""
    for name in [n for n in sys.modules if n.partition(".")[0] == module]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / path).write_bytes(b"x")
    with raises_code("missing_package", f"tau_dyn[{extra}]"):
        read_log(tmp_path / path)


def test_several_possible_topics_are_asked_about(tmp_path):
    """Two topics of joint states, neither of the usual name: the sentence lists them and shows a map's line."""
    path = write_mcap(tmp_path / "run.mcap", {"/left/states": states(), "/right/states": states()})
    with raises_code("file_format", "left/states", "right/states", "q_axis", "left/states.position.a"):
        read_log(path)
    log = read_log(path, ColumnMap.from_dict({"q_a": "right/states.position.a"}))
    assert log.n_samples == N
    with raises_code("missing_column", "right/states.position.z", "q_b"):
        read_log(path, ColumnMap.from_dict({"q_a": "right/states.position.a", "q_b": "right/states.position.z"}))


@pytest.mark.parametrize("kind", ["json", "cdr", "ros1", "db3", "matlab"])
def test_damage_anywhere_is_a_sentence(tmp_path, rng, kind):
    """Cut at any byte, or with bytes changed, a file reads or is refused; nothing else happens."""
    path = wrote(tmp_path, kind)
    data, target = path.read_bytes(), path.with_name(f"x{path.suffix}")
    for k in range(24):
        changed = bytearray(data)
        if k % 2:
            changed = changed[: rng.integers(len(data))]
        else:
            for _ in range(3):
                changed[rng.integers(len(data))] = rng.integers(256)
        target.write_bytes(changed)
        try:
            assert read_log(target).n_samples >= 10
        except InputError as fault:
            assert "\n" not in str(fault).strip()


def test_a_silent_pipe_is_refused_at_once(tmp_path):
    """A recording is sought through; a pipe that nobody writes to would be waited for without end."""
    os.mkfifo(tmp_path / "log.mcap")
    with raises_code("cannot_read", "pipe"):
        read_log(tmp_path / "log.mcap")


@pytest.mark.parametrize("kind", ["json", "cdr", "ros1", "ros2", "matlab"])
def test_a_map_can_be_proposed(tmp_path, kind):
    """Joint states' fields are proposed under our names, and the map reads the log."""
    n = len(JOINTS)
    arm = SimpleNamespace(actuated=JOINTS, joint_kinds=["revolute"] * n, lower=np.full(n, -3.0), upper=np.full(n, 3.0))
    path = wrote(tmp_path, kind)
    log = read_log(path, propose_columns(path, arm).to_map())
    assert_allclose(log.joint("q", JOINTS), Q, atol=1e-12)
    assert_allclose(log.joint("tau", JOINTS), TAU, atol=1e-12)
