"""Recorders' own layouts become logs, and `propose_columns` finds a map for each, or says what is missing."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.cli import main
from tau_dyn.log import ColumnMap, open_log, propose_columns, read_log
from tau_dyn.message_codes import get_code

N = 500
T = np.arange(N) * 0.002


@dataclass(frozen=True)
class Arm:
    """A robot as far as a log is concerned."""

    actuated: tuple[str, ...]
    joint_kinds: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray


def make_arm(*joints: str, limit: float = np.inf) -> Arm:
    n = len(joints)
    return Arm(joints, ("revolute",) * n, np.full(n, -limit), np.full(n, limit))


def make_motion(n: int, size: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities (N, n)."""
    k = np.arange(1, n + 1)
    return size * np.sin(np.outer(T, 3.0 + k)), size * (3.0 + k) * np.cos(np.outer(T, 3.0 + k))


UR = make_arm("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3", limit=2 * np.pi)
PANDA = make_arm(*(f"panda_joint{k}" for k in range(1, 8)), limit=2.9)


def name_columns(name: str, n: int, form: str = "{name}_{k}") -> list[str]:
    return [form.format(name=name, k=k) for k in range(n)]


def codes_of(proposal) -> list[str]:
    return [get_code(sentence) for sentence in proposal.warnings]


@pytest.fixture
def rtde(tmp_path) -> Path:
    """A recording of UR's record.py: names with numbers, blanks between (rtde/csv_writer.py of RTDE_Python_Client_Library)."""
    q, v = make_motion(6)
    names = ["timestamp"]
    for name in ("target_q", "actual_q", "actual_qd", "actual_current", "target_moment", "actual_TCP_pose"):
        names += name_columns(name, 6)
    cells = np.column_stack([1000.0 + T, q + 0.01, q, v, 3 * q, 50 * q, q])
    path = tmp_path / "robot_data.csv"
    np.savetxt(path, cells, header=" ".join(names), comments="", fmt="%.9g")
    return path


def test_recordings_of_ur(rtde):
    """Positions and velocities are found in the robot's order; a current needs a torque constant, and none is invented."""
    proposal = propose_columns(rtde, UR)
    assert proposal.entries["t"] == "timestamp" and proposal.entries["q_elbow"] == "actual_q_2"
    assert proposal.entries["v_wrist_3"] == "actual_qd_5" and proposal.entries["q_ref_elbow"] == "target_q_2"
    assert not any(name.startswith("tau_") for name in proposal.entries)
    assert "torque_constant_missing" in codes_of(proposal)
    assert any("target_moment_0" in s and "not mapped" in s for s in proposal.warnings)
    log = read_log(rtde, proposal.to_map())
    assert_allclose(log.channels["q_elbow"], make_motion(6)[0][:, 2], atol=1e-8)


def test_blanks_need_a_map(rtde):
    """Our own logs are CSV: without a map, blanks do not separate cells."""
    with raises_code("missing_column"):
        read_log(rtde)


def test_logs_of_franka(tmp_path):
    """The log of libfranka's logToCSV (src/log.cpp): `state.q[0]`, time in ms; what was asked for is no measurement."""
    q, v = make_motion(7)
    names = ["time", "success_rate"]
    for name in ("state.q", "state.q_d", "state.dq", "state.dq_d", "state.tau_J", "state.tau_ext_hat_filtered", "cmd.q_d",
                 "cmd.tau_J_d"):  # fmt: skip
        names += name_columns(name, 7, "{name}[{k}]")
    path = tmp_path / "log.csv"
    cells = np.column_stack([1000 * T, np.ones(N), q, q, v, v, 30 * q, q, q, q])
    pd.DataFrame(cells, columns=names).to_csv(path, index=False)
    proposal = propose_columns(path, PANDA)
    assert proposal.entries["t"] == {"column": "time", "scale": 1e-3}
    assert proposal.entries["q_panda_joint1"] == "state.q[0]" and proposal.entries["v_panda_joint7"] == "state.dq[6]"
    assert proposal.entries["tau_panda_joint3"] == "state.tau_J[2]"
    assert proposal.entries["q_ref_panda_joint1"] == "state.q_d[0]"
    log = open_log(path, proposal.to_map())
    assert_allclose(np.diff(log.t), 0.002, atol=1e-9)


def test_a_joints_name_alone_is_its_position(tmp_path):
    """Positions often have no other name than the joint; where another group says `position`, they are left out."""
    q, v = make_motion(6)
    table = pd.DataFrame({"t": T} | dict(zip(UR.actuated, q.T, strict=True)))
    efforts = {f"{joint}_effort": x for joint, x in zip(UR.actuated, v.T, strict=True)}
    table.assign(**efforts).to_csv(tmp_path / "bare.csv", index=False)
    bare = propose_columns(tmp_path / "bare.csv", UR)
    assert bare.entries["q_elbow"] == "elbow" and bare.entries["tau_elbow"] == "elbow_effort"
    assert any("names alone" in sentence for sentence in bare.warnings)
    said = {f"{joint}_position": x for joint, x in zip(UR.actuated, v.T, strict=True)}
    table.assign(**said).to_csv(tmp_path / "both.csv", index=False)
    both = propose_columns(tmp_path / "both.csv", UR)
    assert both.entries["q_elbow"] == "elbow_position" and "column_unsure" not in codes_of(both)


def test_lists_in_brackets(tmp_path):
    """A cell `[0.1, 0.2]` of a text becomes a column each; lists of several lengths stay text."""
    q, v = make_motion(2)
    path = tmp_path / "state.csv"
    lists = {"q": [str(x.tolist()) for x in q], "dq": [f"[{x[0]!s} {x[1]!s}]" for x in v]}
    odd = ["[1]" if k % 2 else "[1, 1]" for k in range(N)]
    pd.DataFrame({"time": T, **lists, "odd": odd}).to_csv(path, index=False)
    log = read_log(path, propose_columns(path, make_arm("a", "b")).to_map())
    assert_allclose(log.channels["q_b"], q[:, 1], atol=1e-15)
    assert_allclose(log.channels["v_a"], v[:, 0], atol=1e-15)


@pytest.mark.parametrize(
    ("separator", "comment"), [(" ", ""), ("\t", "# made\n"), (";", "# t q\n"), ("  ", ""), (",", "")]
)
def test_columns_by_number(tmp_path, separator, comment):
    """A file without a header is read by the columns' numbers, from 1, whatever separates them."""
    path = tmp_path / "a.txt"
    path.write_text(comment + "".join(f"{t:.3f}{separator}{2 * t:.3f}{separator}{-t:.3f}\n" for t in T))
    map_ = ColumnMap.from_dict({"t": 1, "q_j1": 2, "tau_j1": {"column": 3, "scale": 2.0}})
    log = open_log(path, map_)
    assert log.n_samples == N
    assert_allclose(log.channels["q_j1"], 2 * T, atol=1e-9)
    assert_allclose(log.channels["tau_j1"], -2 * T, atol=1e-9)
    with raises_code("missing_column"):
        read_log(path, ColumnMap.from_dict({"t": 1, "q_j1": 4}))


def test_one_value_a_line(tmp_path):
    """A file with one value a line is a log with a rate."""
    path = tmp_path / "q.txt"
    path.write_text("".join(f"{t:.3f}\n" for t in T))
    log = read_log(path, ColumnMap.from_dict({"t": {"rate_hz": 500}, "q_a": 1}))
    assert_allclose(log.channels["q_a"], T, atol=1e-9)


def test_numbers_are_told_by_their_derivative(tmp_path):
    """Without a header, the block whose derivative follows is positions; for blocks that look alike there is a template."""
    q, v = make_motion(2)
    path = tmp_path / "a.txt"
    np.savetxt(path, np.column_stack([T, 40 + 5 * v**2, q, v]))
    proposal = propose_columns(path, make_arm("a", "b"))
    assert [proposal.entries[c] for c in ("t", "q_a", "q_b", "v_a", "v_b")] == [1, 4, 5, 6, 7]
    assert set(codes_of(proposal)) == {"column_unsure", "column_missing"}
    np.savetxt(path, np.column_stack([T, v**2, q**2]))
    blocks = propose_columns(path, make_arm("a", "b"))
    assert set(blocks.entries) == {"t"} and "# q_a: {column: COLUMN, scale: 1.0}" in blocks.template


def write_lerobot(path: Path, episodes: int = 2, degrees: bool = True) -> np.ndarray:
    """Write a LeRobot data set's file (v3: several episodes, lists, `timestamp` from 0 in each), and return positions."""
    q, _ = make_motion(6, 80.0 if degrees else 1.0)
    rows = np.tile(q, (episodes, 1))
    kind = pa.list_(pa.float32(), 6)
    lists = pa.FixedSizeListArray.from_arrays(pa.array(rows.ravel(), pa.float32()), type=kind)
    table = pa.table({
        "action": lists, "observation.state": lists, "timestamp": pa.array(np.tile(T, episodes)),
        "frame_index": np.tile(np.arange(N), episodes), "episode_index": np.repeat(np.arange(episodes), N),
        "index": np.arange(N * episodes), "task": [{"name": "pick"}] * (N * episodes),
    })  # fmt: skip
    pq.write_table(table, path)
    return q


def test_lerobot_datasets(tmp_path):
    """Lists are spread, degrees told by the limits, and episodes are logs of their own, never joined."""
    path = tmp_path / "file-000.parquet"
    q = write_lerobot(path)
    arm = make_arm("pan", "lift", "elbow", "flex", "roll", "jaw", limit=1.9)
    proposal = propose_columns(path, arm)
    assert proposal.entries["episode"] == 0 and proposal.entries["q_elbow"]["column"] == "observation.state[2]"
    assert (
        proposal.entries["cmd_elbow"]["column"] == "action[2]"
    )  # without forces, servos are identified by their commands
    assert "unit_unsure" in codes_of(proposal)
    for episode in (0, 1):
        log = open_log(path, ColumnMap.from_dict({**proposal.entries, "episode": episode}))
        assert log.n_samples == N
        assert_allclose(log.channels["q_elbow"], np.radians(q[:, 2]), atol=1e-6)
    whole = {k: v for k, v in proposal.entries.items() if k != "episode"}
    for entries, code in (
        (whole, "time_stamps"),
        ({**whole, "episode": 2}, "unknown_name"),
        ({**whole, "episode": "a"}, "file_format"),
    ):
        with raises_code(code):
            open_log(path, ColumnMap.from_dict(entries))


@pytest.mark.parametrize(("step", "scale"), [(2.0, 1e-3), (2000.0, 1e-6), (2e6, 1e-9)])
def test_clocks_by_their_step(tmp_path, step, scale):
    """Milliseconds, microseconds and nanoseconds are told by the step, and said."""
    path = tmp_path / "a.csv"
    pd.DataFrame({"stamp": step * np.arange(N), "angle": np.sin(T)}).to_csv(path, index=False)
    proposal = propose_columns(path, make_arm("a"))
    assert proposal.entries["t"] == {"column": "stamp", "scale": scale}
    assert "unit_unsure" in codes_of(proposal)


def test_velocity_has_to_be_the_derivative(tmp_path):
    """A velocity in deg/s is told by its slope; what is no derivative is not mapped."""
    q, v = make_motion(1)
    path = tmp_path / "a.csv"
    pd.DataFrame({"time": T, "pos": q[:, 0], "speed": np.degrees(v[:, 0])}).to_csv(path, index=False)
    assert_allclose(propose_columns(path, make_arm("a")).entries["v_a"]["scale"], np.pi / 180)
    pd.DataFrame({"time": T, "pos": q[:, 0], "speed": -v[:, 0]}).to_csv(path, index=False)
    proposal = propose_columns(path, make_arm("a"))
    assert "v_a" not in proposal.entries and "column_unsure" in codes_of(proposal)


def test_names_win_over_order(tmp_path):
    """Columns that carry the joints' names go by them, in whatever order they stand."""
    q, _ = make_motion(2)
    path = tmp_path / "a.csv"
    pd.DataFrame({"time": T, "position_elbow": q[:, 1], "position_hip": q[:, 0]}).to_csv(path, index=False)
    entries = propose_columns(path, make_arm("hip", "elbow")).entries
    assert entries["q_hip"] == "position_hip" and entries["q_elbow"] == "position_elbow"


def test_exact_names_are_kept_beside_one_of_other_words(tmp_path):
    """One torque in other words and one joint by a part of its name are proposed with a doubt; the others keep theirs."""
    joints = ("hip_joint", "knee_joint", "elbow_joint")
    q, _ = make_motion(3)
    names = ["q_hip_joint", "q_knee_joint", "q_elbow", "tau_hip_joint", "torque_knee_joint", "tau_elbow_joint"]
    path = tmp_path / "a.csv"
    pd.DataFrame(dict(zip(["t", *names], [T, *q.T, *q.T], strict=True))).to_csv(path, index=False)
    proposal = propose_columns(path, make_arm(*joints))
    wanted = [f"{signal}_{joint}" for signal in ("q", "tau") for joint in joints]
    assert dict(proposal.entries) == dict(zip(["t", *wanted], ["t", *names], strict=True))
    assert codes_of(proposal) == ["column_unsure"] * 2 and "torque_knee_joint" in proposal.warnings[1]


def test_what_one_joint_lacks_is_named_and_the_rest_is_proposed(tmp_path):
    """A position without a match and a torque with a word in it: the map has the rest, the sentences name joint and columns."""
    joints = ("hip_joint", "knee_joint")
    q, _ = make_motion(2)
    table = pd.DataFrame({"t": T, "q_hip_joint": q[:, 0], "foo": q[:, 1], "tau_hip_joint": T, "tau_knee_joint": T})
    table["tau_knee_joint"] = [str(x) if k != 5 else "lost" for k, x in enumerate(T)]
    path = tmp_path / "a.csv"
    table.to_csv(path, index=False)
    proposal = propose_columns(path, make_arm(*joints))
    assert list(proposal.entries) == ["t", "q_hip_joint", "tau_hip_joint", "tau_knee_joint"]
    assert codes_of(proposal) == ["column_unsure", "column_missing", "column_unsure"]
    assert "knee_joint; not mapped: foo." in proposal.warnings[1]


def test_a_servos_switch_is_no_torque(tmp_path):
    """`torque_enable` of 0 and 1 switches the motor; the goals are commands, and the switch keeps its name in the log."""
    path = tmp_path / "servo.csv"
    q, _ = make_motion(1)
    on = np.arange(N) % 3 > 0
    table = {"timestamp": T, "position": q[:, 0], "goal_position": 1.1 * q[:, 0], "torque_enable": on.astype(int)}
    pd.DataFrame(table).to_csv(path, index=False)
    proposal = propose_columns(path, make_arm("shoulder"))
    assert proposal.entries == {"t": "timestamp", "q_shoulder": "position", "cmd_shoulder": "goal_position"}
    assert open_log(path, proposal.to_map()).channels["torque_enable"].tolist() == on.tolist()


def test_proposals_agree_with_the_maps_of_the_data_sets():
    """Published logs: the columns and units of the maps kept here; torque constants, gears and couplings are left to people."""
    import os

    data, maps = (
        Path(os.environ.get("TAU_DYN_DATA", Path(__file__).parents[3] / "shared" / "data")),
        Path(__file__).parents[2] / "identification" / "columns",
    )
    if not data.is_dir():
        pytest.skip("the data sets are not here")
    kr300 = propose_columns(data / "kr300" / "rec_A.csv", make_arm(*(f"axis{k}" for k in range(1, 7)), limit=6.0))
    kept = yaml.safe_load((maps / "kr300.yaml").read_text())
    assert all(kr300.entries[c] == kept[c] for c in kept if c == "t" or c.startswith("q_axis"))
    assert all(_column(kr300.entries[c]) == _column(kept[c]) for c in kept if c.startswith("tau_"))
    emps = propose_columns(data / "emps" / "DATA_EMPS.csv", make_arm("axis"))
    assert emps.entries == {"t": "t", "q_axis": "qm"} and codes_of(emps) == ["column_missing"]
    tx40 = propose_columns(
        data / "tx40" / "pos_read_data.csv", make_arm(*(f"joint_{k}" for k in range(1, 7)), limit=3.2)
    )
    assert _column(tx40.entries["q_joint_6"]) == "Joint_6" and set(codes_of(tx40)) == {"column_missing", "unit_unsure"}
    xl330 = propose_columns(data / "xl330" / "kp100_sin_sin.csv", make_arm("axis"))
    assert xl330.entries == {"t": "t", "q_axis": "position", "v_axis": "speed", "cmd_axis": "goal_position"}
    joints = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
    so101 = propose_columns(data / "so101" / "multisine.parquet", make_arm(*joints))
    assert so101.entries == {"t": "t", **{f"q_{j}": f"q_{j}" for j in joints}}
    two = propose_columns(data / "double_pendulum" / "A.0_11.parquet", make_arm("joint1", "joint2"))
    assert [two.entries[c] for c in ("q_joint1", "v_joint2", "tau_joint2")] == ["pos_meas1", "vel_meas2", "tau_meas2"]


def _column(entry) -> str:
    return entry["column"] if isinstance(entry, dict) else entry


def test_the_command(tmp_path, capsys):
    """`tau-dyn columns` writes a map that `check --columns` reads, and JSON; without positions it ends with status 3."""
    log, out, result = tmp_path / "a b.csv", tmp_path / "map.yaml", tmp_path / "r.json"
    frame = pd.DataFrame({"time [ms]": 1000 * T, "Axis: position": 0.2 * np.sin(9 * T), "motor current": np.cos(9 * T)})
    frame.to_csv(log, index=False)
    assert main(["columns", str(log), "linear_axis", "--out", str(out), "--json", str(result)]) == 0
    written = json.loads(result.read_text())
    assert written["columns"]["q_axis"] == "Axis: position" and "torque_constant_missing" in written["warning_codes"]
    assert yaml.safe_load(out.read_text()) == written["columns"]
    assert read_log(log, out).n_samples == N
    assert "q_axis" in capsys.readouterr().out
    frame[["time [ms]", "motor current"]].to_csv(log, index=False)
    out.unlink()
    assert main(["columns", str(log), "linear_axis", "--out", str(out), "--json", str(result)]) == 0
    assert "motor current (-1 to 1)" in json.loads(result.read_text())["template"][-1]
    assert yaml.safe_load(out.read_text()) == {"t": {"column": "time [ms]", "scale": 0.001}}
    frame[["time [ms]"]].to_csv(log, index=False)
    assert main(["columns", str(log), "linear_axis", "--json", str(result)]) == 3
    assert json.loads(result.read_text())["status"] == "cannot_answer"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x00\xff\x00",
        b"q w\n1 2\n3\n4 5\n",
        b"{}",
        b"1 2 3\n4 5\n6 7 8\n",
        b"t,t\n1,2\n",
        b"PK\x03\x04",
        b"# only\n",
    ],
)
def test_hostile_files(tmp_path, content):
    """Damaged text ends in one sentence, status 2 and no file."""
    log, out = tmp_path / "a.csv", tmp_path / "map.yaml"
    log.write_bytes(content)
    assert main(["columns", str(log), "linear_axis", "--out", str(out)]) == 2
    assert not out.exists()


def test_hostile_names_are_quoted(tmp_path):
    """Names with colons, quotes, digits of other scripts and control characters come back from the map as they are."""
    log = tmp_path / "a.csv"
    for name in ("position: {x}", "position #1\x7f", "pos \u0663\u00b2", 'position "a"', "position \U0001f600"):
        pd.DataFrame({"t": T, name: np.sin(T)}).to_csv(log, index=False)
        proposal = propose_columns(log, make_arm("a"))
        assert yaml.safe_load(proposal.to_yaml())["q_a"] == name


def test_turns_of_a_joint_without_limits_are_no_degrees(tmp_path):
    """A spindle turns 22 times: a velocity in rad/s shows the unit of its positions; without one it is doubted."""
    q, v = make_motion(1, 140.0)
    for size, scale in ((1.0, 1.0), (np.degrees(1.0), np.pi / 180)):
        path = tmp_path / "a.csv"
        pd.DataFrame({"t": T, "q_s": size * q[:, 0], "v_s": v[:, 0]}).to_csv(path, index=False)
        entries = propose_columns(path, make_arm("s")).entries
        assert entries["q_s"] == ("q_s" if scale == 1.0 else {"column": "q_s", "scale": pytest.approx(scale)})
        assert entries["v_s"] == "v_s"
    pd.DataFrame({"t": T, "q_s": q[:, 0]}).to_csv(path, index=False)
    alone = propose_columns(path, make_arm("s"))
    assert alone.entries["q_s"] == "q_s" and "unit_unsure" in codes_of(alone)


def test_each_joint_shows_its_own_unit(tmp_path):
    """A joint in degrees leaves its neighbours in rad; one that hardly moves takes the unit of most, and this is said."""
    q, v = make_motion(3)
    arm, path, still = make_arm("hip", "knee", "toe", limit=2.0), tmp_path / "a.csv", 1e-3 * q
    for sizes, scales, doubts in (
        ((57.3 * q[:, 0], q[:, 1], q[:, 2]), (np.pi / 180, 1.0, 1.0), 1),
        ((57.3 * q[:, 0], 57.3 * q[:, 1], q[:, 2]), (np.pi / 180, np.pi / 180, 1.0), 2),
        ((57.3 * q[:, 0], 57.3 * q[:, 1], still[:, 2]), (np.pi / 180,) * 3, 3),
        ((57.3 * q[:, 0], q[:, 1], still[:, 2]), (np.pi / 180, 1.0, 1.0), 2),
        ((q[:, 0], q[:, 1], still[:, 2]), (1.0,) * 3, 0),
    ):
        pd.DataFrame(dict(zip(["t", "q_hip", "q_knee", "q_toe"], [T, *sizes], strict=True))).to_csv(path, index=False)
        found = propose_columns(path, arm)
        assert [found.to_map().sources[f"q_{j}"].scale for j in arm.actuated] == pytest.approx(scales)
        assert codes_of(found).count("unit_unsure") == doubts
    pd.DataFrame({"t": T, "q_hip": np.degrees(0.02 * q[:, 0]), "v_hip": 0.02 * v[:, 0]}).to_csv(path, index=False)
    assert propose_columns(path, make_arm("hip", limit=2.0)).entries["q_hip"] != "q_hip"


def test_encoders_and_currents_by_number_have_a_template_or_a_map(tmp_path):
    """`enc1` is a position by its word; names without a word are listed with their ranges."""
    q, v = make_motion(2)
    path = tmp_path / "a.csv"
    table = {"time": T, "enc1": q[:, 0], "enc2": q[:, 1], "i1_A": v[:, 0], "i2_A": v[:, 1]}
    pd.DataFrame(table).to_csv(path, index=False)
    found = propose_columns(path, make_arm("hip", "knee"))
    assert found.entries["q_knee"] == "enc2" and {"column_unsure", "torque_constant_missing"} <= set(codes_of(found))
    pd.DataFrame({"time": T, "chan_x": q[:, 0], "chan_y": q[:, 1]}).to_csv(path, index=False)
    found = propose_columns(path, make_arm("a", "b"))
    assert found.entries == {"t": "time"} and any("chan_y (" in line for line in found.template)
    assert yaml.safe_load(found.to_yaml()) == {"t": "time"}


@pytest.mark.parametrize(
    ("times", "entry"),
    [
        (1.77e12 + 1000 * T, {"column": "time", "scale": 1e-3}),
        (1_770_000_000_000_000 + np.round(1e6 * T).astype(np.int64), {"column": "time", "scale": 1e-6}),
        (1e6 * T, {"column": "time", "scale": 1e-6}),
        (46_000.5 + T / 86400, "time"),
        ([f"10:00:{x:06.3f}" for x in T % 60], "time"),
    ],
)
def test_clocks_are_proposed_with_their_unit(tmp_path, times, entry):
    """By size where they count from 1970, else by step; the log has the same steps when it is read by the map."""
    q, _ = make_motion(1)
    path = tmp_path / "a.csv"
    pd.DataFrame({"time": np.asarray(times)[:1000], "q_s": q[:1000, 0]}).to_csv(path, index=False)
    found = propose_columns(path, make_arm("s"))
    assert found.entries["t"] == entry
    assert read_log(path, found.to_map()).dt == pytest.approx(T[1], rel=1e-3)
