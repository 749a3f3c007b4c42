"""The exported feedforward: compiled, it is Python's to 1e-10; what cannot be written out is refused in a sentence."""

from __future__ import annotations

import ctypes
import importlib.util
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.cli import main
from tau_dyn.codegen import Program, build_program, draw_random_states, write_c_source, write_python_source
from tau_dyn.control import Feedforward
from tau_dyn.effects import EFFECTS, Effect, JointwiseEffect, build_friction_model
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler here")
BY_STATE = (
    "coulomb_asymmetry", "viscous_asymmetry", "stribeck", "load_friction", "position_friction", "passive_joint_friction",
    "quadratic_drag", "torque_offset", "drive_gain", "cyclic_ripple", "thermal_drift",
)  # fmt: skip
STATES = 12


def serial_text(write) -> str:
    """Return four bodies off axis: oblique hinge, slide, endless hinge, hinge; with a motor's inertia."""
    body = write.link, "0.05 -0.02 0.1", "0.2 0.3 0.25"
    rows = (("a", "revolute", "0.6 0 0.8", 0.3), ("b", "prismatic", "0 1 0", 0.1), ("c", "continuous", "1 0 0", -0.7),
            ("d", "revolute", "0 0 1", 0.2))  # fmt: skip
    parts, parent = [], "base_link"
    for k, (name, kind, axis, yaw) in enumerate(rows):
        parts += [body[0](f"{name}_link", 2.0 + k, *body[1:])]
        parts += [write.joint(name, kind, parent, f"{name}_link", axis, f"0.1 {0.1 * k} 0.3", yaw), write.drive(name)]
        parent = f"{name}_link"
    return write.text("serial", *parts)


def made(robot: Robot, *effects: Effect, size: float = 5.0) -> Model:
    """Return a model with asymmetric friction and effects, all amplitudes of one size."""
    model = Model.of(robot, [*build_friction_model("asymmetric", robot.actuated, robot.force_units), *effects])
    return model.with_values({name: size * (1 + 0.1 * k) for k, name in enumerate(model.effect_parameters.names)})


def built(name: str, write) -> Model:
    """Return a model by a short name."""
    if name == "serial":
        model = made(load_robot_from_urdf(serial_text(write), "serial"))
        return model.with_values({"c.armature": 0.4})
    if name == "coupled":  # a drive with a follower behind a joint that stands still
        follows = '<joint name="d" type="revolute"><mimic joint="a" multiplier="-0.5" offset="0.2"/>'
        text = serial_text(write).replace('<joint name="d" type="revolute">', follows)
        return made(load_robot_from_urdf(text, "coupled", actuated=["a", "c"]))
    if name == "four_bar":
        return made(load_robot_from_urdf(write.four_bar(), "four_bar"))
    if name == "complete":
        return made(load_robot("gantry_tau", arms="complete"))
    robot = load_robot(name)
    several = [EFFECTS[cause](robot.actuated, robot.force_units) for cause in BY_STATE] if name == "gantry_tau" else []
    return made(robot, *several, size=0.3)


class Compiled:
    """A compiled feedforward."""

    def __init__(self, program: Program, folder: Path) -> None:
        """Write, compile with every warning on, and load."""
        self.program = program
        source, header = write_c_source(program)
        (folder / "tau_ff.c").write_text(source)
        (folder / "tau_ff.h").write_text(header)
        flags = ["-std=c99", "-O0", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-shared", "-fPIC"]
        library = folder / "tau_ff.so"
        subprocess.run(["cc", *flags, "-o", str(library), str(folder / "tau_ff.c"), "-lm"], check=True)
        self.code = ctypes.CDLL(str(library))
        na = program.feedforward.model.robot.na
        self.start = np.zeros(na + (len(program.loops.passive) if program.loops else 0))
        if program.loops:
            self.code.tau_ff_start(self._at(self.start))

    def __call__(self, *state: np.ndarray) -> tuple[int, np.ndarray]:
        """Return status and forces of one state."""
        tau = np.full(len(state[0]), -7.0)
        kept = [np.ascontiguousarray(x, float) for x in state]
        first = [self._at(self.start)] if self.program.loops else []
        return self.code.tau_ff(*first, *(self._at(x) for x in kept), self._at(tau)), tau

    @staticmethod
    def _at(x: np.ndarray):
        return x.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


def imported(text: str, folder: Path):
    """Return the module of an exported Python file."""
    (folder / "tau_ff.py").write_text(text)
    spec = importlib.util.spec_from_file_location("tau_ff", folder / "tau_ff.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@needs_compiler
@pytest.mark.parametrize(
    ("name", "shape"),
    [
        *(
            (name, s)
            for name in ("linear_axis", "gantry_tau", "serial", "coupled", "four_bar")
            for s in ("ramp", "tanh")
        ),
        ("complete", "ramp"),  # one shape is enough for the largest
    ],
)
def test_c_and_python_files_are_the_feedforward(name: str, shape: str, write, tmp_path, rng) -> None:
    """Closed form, trees and loops with friction of every kind: random states agree to 1e-10 of the largest force."""
    model = built(name, write)
    feedforward = Feedforward(model, width=0.02, shape=shape)
    program = build_program(feedforward)
    q, v, a = draw_random_states(model, STATES, rng)
    felt = {signal: rng.uniform(10, 60, q.shape) for signal in program.signals}
    assert bool(felt) == (name == "gantry_tau")
    expected = feedforward(q, v, a, signals=felt)
    scale = np.abs(expected).max()
    compiled = Compiled(program, tmp_path)
    within = np.all(np.abs(expected) <= model.robot.effort_limit, axis=1)
    python = imported(write_python_source(program), tmp_path).tau_ff
    assert within.sum() > STATES / 4
    for k in range(len(q)):
        state = [q[k], v[k], a[k], *(x[k] for x in felt.values())]
        status, tau = compiled(*state)
        if within[k]:
            assert status == 0 and np.abs(tau - expected[k]).max() < 1e-10 * scale
        else:
            assert status == 3 and np.all(tau == -7.0)
            with pytest.raises(ValueError, match="beyond its joint's limit"):
                python(*state)
    found = python(*(x[within] for x in (q, v, a, *felt.values())))
    assert np.abs(found - expected[within]).max() < 1e-10 * scale


@needs_compiler
@pytest.mark.parametrize("name", ["gantry_tau", "four_bar", "complete"])
def test_out_of_reach_is_a_status_and_leaves_the_forces_alone(name: str, write, tmp_path) -> None:
    """A controller is never handed a NaN: carts too far apart, a position that is no number, and back to work after it."""
    robot = load_robot("gantry_tau", arms="complete") if name == "complete" else None
    model = made(robot or (load_robot(name) if name == "gantry_tau" else load_robot_from_urdf(write.four_bar(), name)))
    compiled, home = Compiled(build_program(Feedforward(model)), tmp_path), model.robot.home
    rest = np.zeros_like(home)
    wrong = [np.full_like(home, np.nan)] + ([home + np.array([0.0, 3.0, -3.0])] if name != "four_bar" else [])
    for q in wrong:
        status, tau = compiled(q, rest, rest)
        assert status > 0 and np.all(tau == -7.0)
    status, tau = compiled(home, rest, rest)
    np.testing.assert_allclose(tau, Feedforward(model)(home, rest, rest), rtol=1e-9)
    assert status == 0


@pytest.mark.parametrize("cause", ["delay", "hysteresis", "lugre", "friction_change"])
def test_what_needs_a_history_is_refused_by_name(cause: str) -> None:
    """`tau_ff(q, v, a)` cannot remember; the sentence says which effect would have to."""
    robot = load_robot("linear_axis")
    model = made(robot, EFFECTS[cause](robot.actuated, robot.force_units), size=1e-3)
    with raises_code("unsupported", f"{cause}", "--steady"):
        build_program(Feedforward(model))
    assert build_program(Feedforward(model.steady())).difference < 1e-10


@pytest.mark.parametrize(
    "cause", ["load_friction", "directional_efficiency", "passive_joint_friction", "gravity_direction"]
)
def test_what_a_mechanism_carries_is_written_out_with_loops_too(cause: str) -> None:
    """Loads of guides, turning of bearings and weights under another gravity are Pinocchio's, loops' forces included."""
    robot = load_robot("gantry_tau", arms="complete")
    model = Model.of(robot, [EFFECTS[cause](robot.actuated, robot.force_units)])
    model = model.with_values({name: 0.1 + 0.1 * k for k, name in enumerate(model.effect_parameters.names)})
    assert build_program(Feedforward(model)).difference < 1e-9


class _Branching(JointwiseEffect):
    """A law that decides by an `if`, which a trace follows on one side only."""

    name = "branching"
    equation = "none"
    quantities = (("branch", "F"),)

    def per_joint(self, joint):
        """Return one thing or another."""
        return [joint.v if joint.q[0] > 0.1 else -joint.v]


def test_a_trace_that_does_not_hold_everywhere_is_not_exported() -> None:
    """The graph is compared with Python over random states before a line is written."""
    robot = load_robot("linear_axis")
    with raises_code("unsupported"):
        build_program(Feedforward(made(robot, _Branching(robot.actuated, robot.force_units))))


def test_the_file_says_what_it_is(write) -> None:
    """Units, order of joints, provenance and every parameter stand in the header; a comment cannot be broken out of."""
    plain = built("linear_axis", write)
    model = Model(plain.robot, plain.effects, plain.effect_parameters, {"log": "a */ log.csv"})
    source, header = write_c_source(build_program(Feedforward(model)), "axis_ff")
    for said in (
        "[0] axis: m, m/s, m/s^2, N",
        "carriage_link.mass = 95",
        "axis.coulomb_pos",
        "a * / log.csv",
        "int axis_ff(",
    ):
        assert said in header
    assert "malloc" not in source and source.count("#include") == 2


def test_the_command_writes_source_and_header(tmp_path, write, capsys) -> None:
    """One command from model file to C; a recording's delay is left out and named, what needs a history asks for an option."""
    robot = load_robot("linear_axis")
    effects = {cause: EFFECTS[cause](robot.actuated, robot.force_units) for cause in ("delay", "hysteresis")}
    made(robot, effects["delay"], size=1e-3).save(tmp_path / "late.yaml")
    made(robot, *effects.values(), size=1e-3).save(tmp_path / "both.yaml")
    out, result = tmp_path / "ff.c", tmp_path / "r.json"
    written = ["--to", "c", "--out", str(out), "--json", str(result)]
    assert main(["feedforward", "export", str(tmp_path / "both.yaml"), *written]) == 2
    assert not out.exists() and not result.exists()
    for name, more, left_out in (("late", [], ["delay"]), ("both", ["--steady"], ["delay", "hysteresis"])):
        assert main(["feedforward", "export", str(tmp_path / f"{name}.yaml"), *written, *more]) == 0
        assert '#include "ff.h"' in out.read_text() and (tmp_path / "ff.h").exists()
        found = json.loads(result.read_text())
        assert found["left_out"] == left_out and found["difference"] < 1e-10 and found["joints"] == ["axis"]
        assert "warning: the feedforward leaves out delay, which distorts the recorded force" in capsys.readouterr().err


def test_a_robot_stands_for_its_rigid_body(tmp_path) -> None:
    """A short name is enough where there is no model file yet."""
    out = tmp_path / "ff.py"
    assert main(["feedforward", "export", "linear_axis", "--to", "python", "--out", str(out)]) == 0
    assert "def tau_ff" in out.read_text()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--to", "c", "--out", "x.py"], "ends in .c"),
        (["--to", "python", "--out", "x.c"], "ends in .py"),
        (["--to", "c", "--out", "x.c", "--name", "a-b"], "cannot name a function in C"),
        (["--to", "python", "--out", "x.py", "--name", "class"], "cannot name a function in Python"),
        (["--to", "python", "--out", "x.py", "--name", "np"], "cannot name a function in Python"),
        (["--to", "python", "--out", "x.py", "--name", "zip"], "cannot name a function in Python"),
        (["--to", "c", "--out", "x.c", "--name", "sqrt"], "cannot name a function in C"),
        (["--to", "c", "--out", "x.c", "--name", "INFINITY"], "cannot name a function in C"),
        (["--to", "c", "--out", "x.c", "--name", "newton"], "cannot name a function in C"),
        (["--to", "c", "--out", "x.c", "--width", "0.1", "0.2"], "must be a number or"),
        (["--to", "fortran", "--out", "x.f"], "there is no --to"),
    ],
)
def test_bad_requests_end_in_a_sentence(more, said, tmp_path, monkeypatch, capsys, write) -> None:
    """Status 2, one line, no file."""
    monkeypatch.chdir(tmp_path)
    built("linear_axis", write).save(tmp_path / "m.yaml")
    assert main(["feedforward", "export", "m.yaml", *more]) == 2
    assert said in capsys.readouterr().err and {p.name for p in tmp_path.iterdir()} == {"m.yaml"}
