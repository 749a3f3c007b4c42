"""`export` for controllers: C kinematics of a robot or a model, references at the controller's period, RAPID."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from tests.log.recordings import write_bag

from tau_dyn.cli import main
from tau_dyn.control import Correction, read_reference, write_correction, write_reference
from tau_dyn.control.interface.reference import compute_digest
from tau_dyn.effects import QuadraticDrag, Stribeck, build_friction_model
from tau_dyn.exchange import build_urdf, describe_price
from tau_dyn.log import read_log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot
from tau_dyn.simulate import Trajectory, build_named_motion, move, simulate

ROBOT = load_robot("gantry_tau")


@pytest.fixture
def motion(tmp_path, monkeypatch) -> Trajectory:
    """Return a move of 1000 Hz and one of 250 Hz, in files here."""
    monkeypatch.chdir(tmp_path)
    move(ROBOT.actuated, ROBOT.home, ROBOT.home + 0.02, 0.6).to_csv("fast.csv")
    slow = move(ROBOT.actuated, ROBOT.home, ROBOT.home + 0.02, 0.6, 250.0)
    slow.to_csv("motion.csv")
    return slow


def test_kinematics_of_a_robot_and_of_a_model(tmp_path, monkeypatch, capsys) -> None:
    """A short name with its arguments, or a model file; the C compiles and the header has the file's name."""
    monkeypatch.chdir(tmp_path)
    Model.of(ROBOT, []).save("m.yaml")
    assert main(["export", "m.yaml", "--to", "c", "--json", "r.json"]) == 0
    found = json.loads((tmp_path / "r.json").read_text())
    assert found["kind"] == "closed" and found["functions"] == [f"gantry_tau_{x}" for x in ("fk", "jacobian", "ik")]
    command = ["export", "gantry_tau", "--set", "arms=complete", "--to", "c", "--out", "my kin.c", "--name", "kin"]
    assert main(command) == 0 and "kin_fk" in capsys.readouterr().out
    assert '#include "my kin.h"' in (tmp_path / "my kin.c").read_text()
    if shutil.which("cc"):
        for name in ("m.c", "my kin.c"):
            subprocess.run(
                ["cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-c", name, "-o", "x.o"], check=True
            )


def test_a_reference_and_a_program(motion, tmp_path) -> None:
    """Every fourth sample of a finer clock is taken as it is; a correction is added; RAPID says the same motion."""
    assert main(["export", "gantry_tau", "--to", "reference", "--motion", "fast.csv", "--out", "ref.csv"]) == 0
    found = read_reference(tmp_path / "ref.csv", ROBOT.actuated)
    assert np.abs(found.q - motion.q).max() < 1e-6
    model = Model.of(ROBOT, [])
    shape = 1e-3 * np.sin(np.linspace(0, np.pi, motion.n_samples))[:, None] ** 2 * np.ones(3)
    given = Trajectory.from_csv("motion.csv", ROBOT.actuated)
    write_correction("c.csv", model, given, Correction(ROBOT.actuated, 0.004, shape, compute_digest(given)))
    command = [
        "export",
        "gantry_tau",
        "--to",
        "reference",
        "--motion",
        "motion.csv",
        "--correction",
        "c.csv",
        "--out",
        "both.csv",
    ]
    assert main(command) == 0
    assert np.abs(read_reference("both.csv", ROBOT.actuated).q - motion.q - shape).max() < 1e-9
    assert (
        main(["export", "gantry_tau", "--to", "rapid", "--motion", "motion.csv", "--by", "tool", "--out", "m.mod"]) == 0
    )
    assert (tmp_path / "m.mod").read_text().startswith("MODULE TauDynMotion\n")
    write_reference("again.csv", model, motion)
    assert len((tmp_path / "again.csv").read_text().splitlines()) == motion.n_samples + 1


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (
            ["--to", "reference", "--motion", "fast.csv", "--period", "0.0025", "--out", "r.csv"],
            "a sample every 1 ms, the controller takes one every 2.5 ms",
        ),
        (
            ["--to", "reference", "--motion", "motion.csv", "--speed", "0.01", "--out", "r.csv"],
            "may no more than 0.01 m/s",
        ),
        (
            ["--to", "reference", "--motion", "motion.csv", "--force", "1", "2", "--out", "r.csv"],
            "force limit must be one number or 3",
        ),
        (["--to", "reference", "--out", "r.csv"], "--to reference needs --motion"),
        (["--to", "c", "--motion", "motion.csv", "--out", "r.c"], "--to c takes no --motion"),
        (["--to", "c", "--out", "r.h"], "ends in .c"),
        (["--to", "c", "--out", 'a"b.c'], "a C file includes its header by name"),
        (["--to", "c", "--name", "a-b", "--out", "r.c"], "cannot name a function in C"),
        (["--to", "rapid", "--motion", "motion.csv", "--name", "while", "--out", "r.mod"], "no word of RAPID"),
        (
            ["--to", "reference", "--motion", "motion.csv", "--correction", "motion.csv", "--out", "r.csv"],
            "is no correction file",
        ),
    ],
)
def test_bad_requests_end_in_a_sentence(more, said, motion, tmp_path, capsys) -> None:
    """Status 2, one line, no file."""
    assert main(["export", "gantry_tau", *more]) == 2
    error = capsys.readouterr().err
    assert said in error and len(error.splitlines()) == 1
    assert {p.name for p in tmp_path.iterdir()} == {"fast.csv", "motion.csv"}


def test_a_robot_for_every_simulator(tmp_path, monkeypatch) -> None:
    """URDF and MJCF of a short name, without a model file."""
    monkeypatch.chdir(tmp_path)
    assert main(["export", "gantry_tau", "--to", "mjcf", "--set", "arms=complete"]) == 0
    assert main(["export", "delta", "--to", "urdf"]) == 0
    assert (tmp_path / "gantry_tau.xml").read_text().count("<connect") == 6
    assert load_robot(str(tmp_path / "delta.urdf")).actuated == load_robot("delta").actuated


def test_a_robot_for_gazebo_and_its_drives_for_training(tmp_path, monkeypatch) -> None:
    """SDF, one file of drives for mjlab and Isaac Lab with fitted delays, one a turning joint for BAM; a slide has none."""
    monkeypatch.chdir(tmp_path)
    axes = [{"axis": f"cart{k}", "gain": 1.0, "time_constant": 0.01, "delay": 0.004} for k in (1, 2, 3)]
    (tmp_path / "fitted.yaml").write_text(yaml.safe_dump({"tau_dyn_actuators": 1, "axes": axes}))
    assert main(["export", "gantry_tau", "--to", "sdf"]) == 0
    assert (tmp_path / "gantry_tau.sdf").read_text().count('type="ball"') == 3
    for target in ("mjlab", "isaaclab"):
        assert (
            main(["export", "gantry_tau", "--to", target, "--actuators", "fitted.yaml", "--out", f"{target}.py"]) == 0
        )
        assert "round(0.004 / TIMESTEP)" in (tmp_path / f"{target}.py").read_text()
    assert main(["export", "gantry_tau", "--to", "bam"]) == 2
    assert main(["export", "delta", "--to", "bam", "--json", "r.json"]) == 0
    files = json.loads((tmp_path / "r.json").read_text())["out"]
    assert len(files) == len(load_robot("delta").actuated) and all(json.loads(Path(f).read_text()) for f in files)


def test_the_price_of_what_a_file_leaves_out(tmp_path, monkeypatch, capsys) -> None:
    """Against the held-out log, then against the training log's motion, then unknown; nothing is said where all is carried."""
    monkeypatch.chdir(tmp_path)
    robot = load_robot("linear_axis")
    drag = [*build_friction_model("symmetric", robot.actuated, robot.force_units), QuadraticDrag(("axis",), ("N",))]
    model = Model.of(robot, drag).with_values({"axis.coulomb": 20.0, "axis.viscous": 100.0})
    with_drag = model.with_values({n: 200.0 for n in drag[-1].parameters.names})
    log = simulate(with_drag, build_named_motion("exciting", with_drag, 8.0, 1))
    log.to_csv("log.csv")
    row = {"path": "log.csv", "sha256": hashlib.sha256((tmp_path / "log.csv").read_bytes()).hexdigest()}
    for use, said in (
        ("held_out", "held-out force error is"),
        ("trained_on", "the file leaves out"),
        ("none", "unknown"),
    ):
        replace(with_drag, provenance={use: [row]}).save("m.yaml")
        assert main(["export", "m.yaml", "--to", "urdf", "--json", "r.json"]) == 0
        assert said in capsys.readouterr().err and said in json.loads((tmp_path / "r.json").read_text())["price"]
    drawn = [float(x) for x in re.findall("([0-9.]+) %", describe_price(*_carried(with_drag, "held_out", row)))]
    assert drawn[0] < 1 < 3 < drawn[1]
    model.save("m.yaml")
    assert main(["export", "m.yaml", "--to", "urdf", "--json", "r.json"]) == 0
    assert json.loads((tmp_path / "r.json").read_text())["price"] is None


def _carried(model, use, row):
    return replace(model, provenance={use: [row]}), [build_urdf(model).carried], Path(".")


def test_the_price_with_and_without_the_callback(tmp_path, monkeypatch, capsys) -> None:
    """A Stribeck peak stands in MuJoCo's callback, so the file alone costs and the pair costs nothing."""
    monkeypatch.chdir(tmp_path)
    robot = load_robot("linear_axis")
    effects = [*build_friction_model("symmetric", robot.actuated, robot.force_units), Stribeck(("axis",), ("N",))]
    model = Model.of(robot, effects).with_values({"axis.coulomb": 20.0, "axis.viscous": 100.0, "axis.stribeck": 30.0})
    simulate(model, build_named_motion("exciting", model, 8.0, 1)).to_csv("log.csv")
    row = {"path": "log.csv", "sha256": hashlib.sha256((tmp_path / "log.csv").read_bytes()).hexdigest()}
    replace(model, provenance={"held_out": [row]}).save("m.yaml")
    assert main(["export", "m.yaml", "--to", "mjcf", "--json", "r.json"]) == 0
    made = json.loads((tmp_path / "r.json").read_text())
    whole, alone, told = (float(x) for x in re.findall("([0-9.]+(?:e-[0-9]+)?) %", made["price"]))
    assert whole == told < 0.01 < 0.1 < alone
    assert made["left_out"] == [] and made["callback"] == "m_effects.py" and (tmp_path / "m_effects.py").is_file()
    assert made["by_callback"] == ["effect stribeck of axis is in the callback"]


TRIANGLES = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0], [0, 1, 0], [0, 0, 1]]], dtype="<f4")
ARM = """<robot name="arm"><link name="base_link"/><link name="arm_link"><inertial><origin xyz="0.2 0 0"/><mass value="2"/>
<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="meshes/arm.stl"/></geometry></visual></link>
<joint name="j" type="revolute"><parent link="base_link"/><child link="arm_link"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="100" velocity="5"/></joint></robot>"""


@pytest.fixture(scope="module")
def mapped(tmp_path_factory) -> Path:
    """Return the folder of a robot with a mesh, a log under foreign names, a map and the model identified from them."""
    folder = tmp_path_factory.mktemp("mapped")
    (folder / "meshes").mkdir()
    rows = [bytes(12) + triangle.tobytes() + bytes(2) for triangle in TRIANGLES]
    (folder / "meshes" / "arm.stl").write_bytes(bytes(80) + len(rows).to_bytes(4, "little") + b"".join(rows))
    (folder / "arm.urdf").write_text(ARM)
    t = np.arange(3000) / 250
    q = 0.8 * np.sin(2 * t) + 0.3 * np.sin(7 * t)
    v, a = np.gradient(q, t), np.gradient(np.gradient(q, t), t)
    tau = 0.1 * a - 2 * 9.81 * 0.2 * np.cos(q) + 3.0 * np.sign(v) + np.where(v > 0, 2.0, 1.0) * v
    noise = np.random.default_rng(0).normal(size=(2, t.size))
    table = np.column_stack([t, q + 2e-5 * noise[0], tau + 0.05 * noise[1]])
    np.savetxt(folder / "log.csv", table, delimiter=",", header="time_s,q_j,tau_j", comments="", fmt="%.9g")
    (folder / "map.yaml").write_text("t: time_s\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["identify", "arm.urdf", "log.csv", "--columns", "map.yaml", "--out", "m.yaml", "--quiet"]) == 0
    return folder


def test_a_bag_folder_gives_the_price(mapped) -> None:
    """A ROS 2 bag is a folder; its hash covers its files, and the price is that of the same samples in one file."""
    pytest.importorskip("rosbags")
    table = np.loadtxt(mapped / "log.csv", delimiter=",", skiprows=1)
    states = [
        (ns, {"header": {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}}, "name": ["j"], "position": [q],
              "velocity": [], "effort": [tau]})
        for ns, q, tau in ((round(t * 1e9), q, tau) for t, q, tau in table)
    ]  # fmt: skip
    write_bag(mapped / "run", {"/joint_states": states}, ros=2)
    model = Model.load(mapped / "m.yaml")
    rows = model.provenance["trained_on"], [{"path": "run", "sha256": read_log(mapped / "run").sha256}]
    prices = [
        describe_price(replace(model, provenance={"trained_on": r}), [build_urdf(model).carried], mapped) for r in rows
    ]
    assert prices[0] == prices[1] and "N m at j" in prices[0]


@pytest.mark.parametrize("form", ["urdf", "xml", "sdf"])
def test_a_model_of_mapped_logs_is_exported_in_the_folder_of_its_logs(mapped, monkeypatch, capsys, form) -> None:
    """The model file holds the column map, so that its logs give the price of what the file leaves out."""
    monkeypatch.chdir(mapped)
    assert yaml.safe_load((mapped / "m.yaml").read_text())["provenance"]["trained_on"][0]["columns"] == {"t": "time_s"}
    assert main(["export", "m.yaml", "--to", "mjcf" if form == "xml" else form, "--out", f"x.{form}"]) == 0
    assert "N m at j" in capsys.readouterr().err


def test_a_log_that_cannot_be_read_costs_the_price_alone(mapped, tmp_path) -> None:
    """Unusable provenance, or a log of another content, ends in a sentence and not in a refusal."""
    model = Model.load(mapped / "m.yaml")
    (row,) = model.provenance["trained_on"]
    for odd in (
        {**row, "columns": {"t": "nowhere"}},
        {**row, "columns": [1]},
        {**row, "sha256": "0"},
        {"path": 5},
        "log.csv",
    ):
        found = describe_price(replace(model, provenance={"trained_on": [odd]}), [model], mapped)
        assert found.startswith("the loss of accuracy is unknown")


def test_meshes_resolve_from_another_folder(mapped, tmp_path, monkeypatch) -> None:
    """A relative path of a mesh starts at the robot's file: MJCF copies the mesh, URDF has the path from its new place."""
    monkeypatch.chdir(tmp_path)
    model = str(mapped / "m.yaml")
    assert main(["export", model, "--to", "mjcf", "--out", "x.xml"]) == 0 and (tmp_path / "x.arm.stl").is_file()
    assert main(["export", model, "--to", "urdf", "--out", "x.urdf"]) == 0
    (name,) = re.findall('mesh filename="([^"]+)"', (tmp_path / "x.urdf").read_text())
    assert (tmp_path / name).resolve() == (mapped / "meshes" / "arm.stl").resolve()


@pytest.mark.parametrize("to", ["shaper", "notch"])
def test_filters_for_a_resonance_compile_and_state_what_they_leave(to, tmp_path, monkeypatch, capsys) -> None:
    """From a result of `modes` with its intervals: a wider interval leaves more of the resonance, and C states as much."""
    monkeypatch.chdir(tmp_path)
    key = {"shaper": "residual_over_interval", "notch": "gain_over_interval"}[to]
    left = []
    for stderr in (0.02, 0.2):
        mode = {"frequency_hz": 6.0, "damping_ratio": 0.02, "frequency_stderr": stderr, "damping_stderr": 0.001}
        Path("m.json").write_text(json.dumps({"command": "modes", "modes": [mode]}))
        assert main(["export", "m.json", "--to", to, "--period", "0.001", "--json", "r.json", "--quiet"]) == 0
        found = json.loads(Path("r.json").read_text())
        assert found["period"] == 0.001 and found["warnings"] == []
        left.append(found["modes"][0][key])
    assert 0 < left[0] < 0.5 * left[1]
    assert f"{100 * left[1] if to == 'shaper' else left[1]:.3g}" in Path("m.h").read_text()
    if shutil.which("cc"):
        command = ["cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-c", "m.c", "-o", "x.o"]
        subprocess.run(command, check=True)
    assert main(["export", "m.json", "--to", to, "--mode", "2"]) == 2
    assert "1 at 6 Hz" in capsys.readouterr().err


def test_a_robot_with_springs_has_modes_to_shape_for(tmp_path, monkeypatch) -> None:
    """The slowest mode of its springs at home, without an interval, which is stated."""
    monkeypatch.chdir(tmp_path)
    robot = ["gantry_tau", "--set", "flexible=true", "--set", "arms=complete"]
    command = ["export", *robot, "--to", "shaper", "--shaper", "ei", "--json", "r.json"]
    assert main([*command, "--period", "0.0001"]) == 0
    found = json.loads(Path("r.json").read_text())
    assert found["modes"][0]["residual_at_estimate"] == pytest.approx(0.05, abs=5e-3)
    assert any("no standard errors" in w for w in found["warnings"])


def test_a_program_that_leaves_its_motion_carries_a_code(tmp_path) -> None:
    """Moves of 0.1 s cut a swing of 12.5 Hz: RAPID is written with the warning `path_deviates` and the size in the result."""
    robot = load_robot("gantry_tau")
    t = np.arange(0, 1, 0.004)[:, None]
    q = robot.home + 1e-3 * np.sin(2 * np.pi * 12.5 * t) * np.sin(np.pi * t) ** 2
    columns = {"t": t[:, 0]} | {f"q_ref_{j}": q[:, k] for k, j in enumerate(robot.actuated)}
    pd.DataFrame(columns).to_csv(tmp_path / "fast.csv", index=False)
    words = ["export", "gantry_tau", "--to", "rapid", "--motion", str(tmp_path / "fast.csv"), "--acceleration", "20"]
    out, result = tmp_path / "m.mod", tmp_path / "r.json"
    assert main([*words, "--force", "1e5", "--out", str(out), "--json", str(result)]) == 0
    found = json.loads(result.read_text())
    assert found["deviation"] > 1e-4 and "path_deviates" in found["warning_codes"]
