"""Valid files of every kind, small, made by the package itself or written by hand."""

from __future__ import annotations

import io
import json
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

N = 60

PENDULUM = """<?xml version="1.0"?>
<robot name="pendulum" xmlns:drake="http://drake.mit.edu" xmlns:tau_dyn="urn:tau_dyn">
  <link name="base_link"/>
  <link name="rod_link"><inertial><origin xyz="0 0 -0.5" rpy="0 0 0"/><mass value="2"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.01"/></inertial></link>
  <joint name="axis" type="revolute"><parent link="base_link"/><child link="rod_link"/><origin xyz="0 0 1" rpy="0 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3" velocity="10" effort="100"/></joint>
  <link name="tool"/><joint name="hand" type="fixed"><parent link="rod_link"/><child link="tool"/><origin xyz="0 0 -0.5"/></joint>
  <transmission name="d"><type>transmission_interface/SimpleTransmission</type><joint name="axis"/>
    <actuator name="m"><drake:rotor_inertia value="0.01"/><drake:gear_ratio value="3"/></actuator></transmission>
  <tau_dyn:home joint="axis" value="0.1"/>
</robot>
"""

_LEG = """  <link name="{n}_link"><inertial><origin xyz="{h} 0 0"/><mass value="1"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <joint name="{n}" type="revolute"><parent link="{p}"/><child link="{n}_link"/><axis xyz="0 0 1"/>
    <origin xyz="{x} 0 0" rpy="0 0 {yaw}"/><limit lower="-3" upper="3" velocity="10" effort="100"/></joint>
"""

FOUR_BAR = (
    '<robot name="four_bar" xmlns:drake="http://drake.mit.edu" xmlns:tau_dyn="urn:tau_dyn">\n  <link name="base_link"/>\n'
    + _LEG.format(n="crank", p="base_link", h=0.25, x=0, yaw=1.5708)
    + _LEG.format(n="coupler", p="crank_link", h=0.5, x=0.5, yaw=-1.5708)
    + _LEG.format(n="rocker", p="base_link", h=0.25, x=1.0, yaw=1.5708)
    + """  <drake:ball_constraint><drake:ball_constraint_body_A name="coupler_link"/>
    <drake:ball_constraint_body_B name="rocker_link"/>
    <drake:ball_constraint_p_AP value="1 0 0"/><drake:ball_constraint_p_BQ value="0.5 0 0"/></drake:ball_constraint>
  <transmission name="d"><joint name="crank"/><actuator name="m"/></transmission>
</robot>
"""
)

XACRO = """<robot name="axis" xmlns:xacro="http://www.ros.org/wiki/xacro" xmlns:tau_dyn="urn:tau_dyn">
  <xacro:arg name="mass" default="95"/>
  <xacro:property name="m" value="$(arg mass)"/>
  <xacro:macro name="body" params="name mass:=1 *more"><link name="${name}_link"><inertial><mass value="${mass*1.0}"/>
    <inertia ixx="${mass/12}" ixy="0" ixz="0" iyy="${mass/12}" iyz="0" izz="${mass/12}"/></inertial>
    <xacro:insert_block name="more"/></link>
  </xacro:macro>
  <link name="base_link"/>
  <xacro:body name="carriage" mass="${m}"><visual><geometry><box size="1 1 1"/></geometry></visual></xacro:body>
  <joint name="axis" type="prismatic"><parent link="base_link"/><child link="carriage_link"/><axis xyz="1 0 0"/>
    <limit lower="-0.5" upper="${0.5 + 0.0}" velocity="1" effort="500"/></joint>
  <xacro:if value="${m > 1}"><transmission name="d"><joint name="axis"/><actuator name="a"/></transmission></xacro:if>
  <tau_dyn:link name="carriage_link" parameters="mass"/>
</robot>
"""


SERVO_LAW = b"""law: servo
position_gain: {axis: 40.0}
force_per_unit: [2.9]
back_emf: {estimate: 0.2}
command_delay: 0.02
dead_band: 0.001
limit: 1.0
logs: {"log*": {position_gain: 30.0}}
encoder: link
enabled: active
supply: {column: volts, nominal: 7}
"""


@cache
def columns() -> dict[str, np.ndarray]:
    """Return the columns of a small log of the pendulum."""
    t = np.arange(N) * 0.01
    q = 0.3 * np.sin(6 * t)
    tau = 0.6 * -0.3 * 36 * np.sin(6 * t) + 9.81 * np.sin(q) + 0.2 * np.sign(np.cos(6 * t))
    tool = {"x_tool": -np.sin(q), "y_tool": 0 * q, "z_tool": 1 - np.cos(q)}
    return {"t": t, "q_axis": q, "tau_axis": tau, "v_axis": 1.8 * np.cos(6 * t), "temp_room": 20 + t, **tool}


def loop_columns() -> dict[str, np.ndarray]:
    """Return the columns of a small log of the pendulum's commands and positions, which come 60 ms late and sag by gravity."""
    t = np.arange(320) * 0.02
    cmd = 0.3 * np.sin(3 * t) + 0.2 * np.sign(np.sin(1.3 * t))
    q = np.interp(t - 0.06, t, cmd) * 0.9
    return {"t": t, "cmd_axis": cmd, "q_axis": q, "volts": 7 + 0 * t, "active": 1 + 0 * t}


def csv_of(table: dict[str, np.ndarray], more: str = "") -> bytes:
    """Return columns as CSV."""
    rows = [",".join(f"{x:.9g}" for x in row) for row in zip(*table.values(), strict=True)]
    return (more + ",".join(table) + "\n" + "\n".join(rows) + "\n").encode()


def parquet_of(table: dict[str, np.ndarray]) -> bytes:
    """Return columns as Parquet."""
    out = io.BytesIO()
    pq.write_table(pa.table(table), out)
    return out.getvalue()


@cache
def poses() -> dict[str, np.ndarray]:
    """Return measured poses of the pendulum's tool."""
    q = np.linspace(-1, 1, 14)
    turned = {"qx_tool": 0 * q, "qy_tool": np.sin(q / 2), "qz_tool": 0 * q, "qw_tool": np.cos(q / 2)}
    return {
        "q_axis": q,
        "x_tool": -0.5 * np.sin(q),
        "y_tool": 0 * q,
        "z_tool": 1 - 0.5 * np.cos(q),
        **turned,
        "campaign": np.repeat([1.0, 2.0], 7),
    }


COLUMN_MAP = b"""t: {column: time_ms, scale: 0.001}
q_axis: {column: position, scale: 0.0174532925, offset: 0.1}
tau_axis: current
v_axis: speed
temp_room: {column: temperature}
couplings: {q: [[1.0]], q_offset: [0.0]}
"""

COLUMN_MAPS = (
    COLUMN_MAP,
    b"""files: {axes: foreign_log.csv, drives: second_log.csv}
t: {column: time_ms, scale: 0.001, file: axes}
q_axis: {column: position, scale: 0.0174532925, file: axes}
q_other: {column: speed, file: drives}
tau_axis: {column: current, offset: -0.2, file: drives}
tau_other: {column: temperature, file: drives}
couplings:
  q: [[1.0, 0.0], [-0.5, 1.0]]
  tau: [[1.0, 0.5], [0.0, 1.0]]
  q_offset: [0.0, 0.1]
""",
    b"""t: {rate_hz: 100}
q_axis: position
v_axis: {column: speed, offset: 1}
""",
)


def foreign_log() -> bytes:
    """Return the log that the column map reads."""
    names = {"time_ms": "t", "position": "q_axis", "current": "tau_axis", "speed": "v_axis", "temperature": "temp_room"}
    return csv_of({ours: columns()[name] * (1000 if ours == "time_ms" else 1) for ours, name in names.items()})


EFFECTS = b"""effects:
  - effect: asymmetric_friction
    joints: [axis]
    parameters: {coulomb_pos: 1.5, coulomb_neg: 1.0, viscous_pos: 0.2, viscous_neg: 0.1}
  - {effect: stribeck, joints: [axis], settings: {speed: 0.02}, label: "", parameters: {}}
  - {effect: cyclic_ripple, joints: [axis]}
parameters: {rod_link.mass: 2.2}
"""
LAW = b"""position_gain: 160.18
velocity_gain: [243.45]
integral_rate: {axis: 0}
speed_feedforward: 0.5
force_per_unit: 35.15
limit: 10
"""
SURROUNDINGS = b"""limits: {x: [0.5, 2.5], z: [-1, .inf]}
obstacles:
  - {name: table, box: {centre: [1, 0, 0], size: [1, 1, 0.1], rpy: [0, 0, 0.1]}, margin: 0.05, blocks: robot}
  - {name: ball, sphere: {centre: [0, 0, 1], radius: 0.2}, blocks: tool}
  - {name: post, cylinder: {centre: [0, 1, 0], radius: 0.1, height: 2, axis: [0, 0, 1]}}
  - {name: floor, half_space: {point: [0, 0, -1], normal: [0, 0, 1]}}
"""
CAMERA = b"""camera: {position: [5.5, -0.6, 0.8], look_at: [1.7, -0.6, 0.7], image: [1280, 960], focal: 1400, noise: 0.2}
pattern: {columns: 8, rows: 6, square: 0.04, position: [0, 0, 0], normal: [1, 0, 0], up: [0, 0, 1]}
limits: {distance: [0.5, 6], incidence: 60, margin: 5}
"""
TRACKER = b"""tracker: {position: [5, -0.6, 1], noise: 10e-6, noise_per_metre: 5e-6}
reflector: {position: [0, 0, 0], normal: [1, 0, 0], orientation_noise: 50e-6}
limits: {distance: [0.5, 30], incidence: 30, elevation: [-45, 45]}
"""
FIXTURES = b"""target: [0, 0, 0.1]
fixtures:
  - {kind: distance, name: wire, position: [1.5, 0.2, 0.4], noise: 20e-6}
  - {kind: hole, name: A, position: [0.6, 0.1, 0.2], normal: [0, 0, 1], noise: 30e-6, obstacle: table}
  - {kind: sphere, name: ball, position: [0.4, -0.3, 0.3], radius: 0.0127, noise: 20e-6, target: [0.02, 0, 0.1]}
"""
ERRORS = b"""actuators: {all: 0.0001, axis: {along: 0.0001, across: 0.0002}}
rods: {}
"""
CAMERAS = b"""format: tau_dyn cameras 1
lens: brown
cameras:
- {size: [1280, 960], fx: 1400.0, fy: 1400.0, cx: 640.0, cy: 480.0, k1: 0.01, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0}
- {size: [1280, 960], fx: 1400.0, fy: 1400.0, cx: 640.0, cy: 480.0, quaternion: [0, 0, 0, 1], position: [1, 0, 0]}
"""
STATE_SPACE = b"""tau_dyn_state_space: 1
dt: 0.01
delay: 1
inputs: [u]
outputs: [y]
A: [[0.9, 0.1], [-0.1, 0.9]]
B: [[1.0], [0.0]]
C: [[1.0, 0.0]]
D: [[0.0]]
K: [[0.1], [0.0]]
noise: [[0.01]]
provenance: {logs: []}
"""

_ROW = {"name": "rod_link.mass", "value": 2.0, "unit": "kg", "stderr": 0.1, "ci95": [1.8, 2.2], "identifiable": True}
IDENTIFY = {
    "tool_version": "0.1.0",
    "command": "identify",
    "inputs": [{"path": "a.csv", "sha256": "00"}],
    "seed": 0,
    "status": "ok",
    "warnings": [],
    "parameters": [_ROW, {**_ROW, "name": "axis.coulomb_pos", "unit": "N m", "stderr": None}],
    "train": {"relative_error_percent": 3.0},
    "holdout": {"relative_error_percent": 4.0},
}
DIAGNOSE = {
    "command": "diagnose",
    "status": "ok",
    "inputs": [{"path": "a.csv", "sha256": "00"}],
    "verdict": "named",
    "extended": {"relative_error_percent": 1.0},
    "findings": [{"cause": "stribeck", "joints": ["axis"], "status": "confirmed", "parameters": [_ROW], "gain": None}],
}
MODES = {
    "command": "modes",
    "status": "ok",
    "inputs": [],
    "fit_percent": {"train": 90.0, "holdout": 80.0},
    "modes": [{"frequency_hz": 12.0, "damping_ratio": 0.02, "frequency_stderr": 0.1, "damping_stderr": 0.001}] * 2,
}
CALIBRATE = {
    "command": "calibrate",
    "status": "ok",
    "inputs": [],
    "chosen": "rods",
    "models": [
        {"name": "rods", "parameters": [_ROW], "holdout": {"position": {"mean": 1e-4, "rms": 1e-4, "max": 3e-4}}}
    ],
}
PROGRESS = {
    "version": 1,
    "actuated": ["axis"],
    "places": [
        {"pose": 1, "q": [0.1], "state": "measured", "position": [0, 0, 1], "quaternion": [0, 0, 0, 1]},
        {"pose": 0, "q": [0.2], "state": "passed"},
        {"pose": 2, "q": [0.3], "state": "open"},
    ],
}

RUN = {
    "run_format": 1,
    "command": "identify",
    "command_line": "tau-dyn identify r.urdf a.csv --out run/",
    "configuration": {"robot": "r.urdf", "logs": ["a.csv"], "seed": 0, "physical": True, "lowpass": None},
    "inputs": [{"path": "a.csv", "sha256": "00"}],
    "versions": {"tau_dyn": "0.1.0", "python": "3.11.2"},
    "seed": 0,
    "started": "2026-01-01T10:00:00+01:00",
    "duration_s": 3.5,
    "exit_status": 0,
    "files": {"result.json": "00", "model.yaml": "11"},
}


def as_json(*results: dict) -> list[bytes]:
    """Return results as JSON files."""
    return [json.dumps(result).encode() for result in results]


@cache
def model_file(folder: Path) -> bytes:
    """Return a model file of the pendulum with effects."""
    from tau_dyn.effects import read_effects
    from tau_dyn.model import Model
    from tau_dyn.robot import load_robot_from_urdf

    robot = load_robot_from_urdf(PENDULUM, "pendulum.urdf")
    rows = [{"effect": "asymmetric_friction"}, {"effect": "cyclic_ripple"}]
    made = Model.of(robot, read_effects(rows, robot, "seed"), {"logs": [{"path": "a.csv", "sha256": "00"}]})
    made.save(folder / "seed.yaml")
    return (folder / "seed.yaml").read_bytes()


@cache
def compensation_file(folder: Path) -> bytes:
    """Return a compensation file of the pendulum."""
    from tau_dyn.calibrate import build_compensation
    from tau_dyn.calibrate.saved import save_compensation
    from tau_dyn.calibrate.tree_geometry import build_tree_geometry
    from tau_dyn.robot import load_robot_from_urdf

    robot = load_robot_from_urdf(PENDULUM, "pendulum.urdf")
    geometry = build_tree_geometry(robot)
    save_compensation(build_compensation(robot, geometry, geometry.parameters.values), folder / "seed_c.yaml")
    return (folder / "seed_c.yaml").read_bytes()


def images() -> list[bytes]:
    """Return a small picture in several formats."""
    import cv2

    picture = (np.indices((48, 64)).sum(axis=0) // 8 % 2 * 255).astype(np.uint8)
    return [bytes(cv2.imencode(suffix, picture)[1]) for suffix in (".png", ".jpg", ".bmp", ".tiff", ".pgm")]


@cache
def calibrated(folder: Path) -> bytes:
    """Return a calibrated pendulum."""
    from tau_dyn.calibrate import calibrate, read_poses, save_calibration
    from tau_dyn.robot import load_robot_from_urdf

    (folder / "seed_poses.csv").write_bytes(csv_of(poses()))
    found = calibrate(load_robot_from_urdf(PENDULUM, "pendulum.urdf"), read_poses(folder / "seed_poses.csv", ("axis",)))
    save_calibration(folder / "seed_calibrated.yaml", found)
    return (folder / "seed_calibrated.yaml").read_bytes()


@cache
def journal(folder: Path) -> bytes:
    """Return the journal of a run that was killed after three of six items."""
    from tau_dyn.scale import run_journaled

    list(run_journaled(float, range(3), folder / "seed.jsonl"))
    return (folder / "seed.jsonl").read_bytes()
