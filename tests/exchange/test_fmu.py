"""An exported FMU moves as the simulator does, in another program, and refuses in a sentence what it cannot do."""

from __future__ import annotations

import shutil
import subprocess
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.cli import main
from tau_dyn.codegen import build_equations, write_fmu_source
from tau_dyn.codegen.fmu_writer import build_base_units
from tau_dyn.effects import EFFECTS, JointwiseEffect, SymmetricFriction, build_friction_model
from tau_dyn.exchange import build_fmu
from tau_dyn.model import Model
from tau_dyn.robot import load_robot, load_robot_from_urdf
from tau_dyn.simulate.plant import Plant

fmpy = pytest.importorskip("fmpy")
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler here")
DT = 1e-3


def made(robot, *causes: str, size: float = 1.0) -> Model:
    """Return a model with asymmetric friction and causes, of amplitudes about one size."""
    effects = [EFFECTS[cause](robot.actuated, robot.force_units) for cause in causes]
    model = Model.of(robot, [*build_friction_model("asymmetric", robot.actuated, robot.force_units), *effects])
    return model.with_values({n: size * (1 + 0.1 * k) for k, n in enumerate(model.effect_parameters.names)})


MODELS = {
    "axis": lambda write: made(load_robot("linear_axis"), "stribeck", "cyclic_ripple", size=20.0),
    "gantry": lambda write: made(
        load_robot("gantry_tau"), "stribeck", "load_friction", "passive_joint_friction", "drive_gain", size=0.1
    ),
    "arm": lambda write: made(load_robot_from_urdf(write.two_link(), "two_link"), "load_friction", size=0.05),
    "four_bar": lambda write: made(load_robot_from_urdf(write.four_bar(), "four_bar"), size=0.3),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("fmu")


@pytest.fixture(scope="module", params=MODELS)
def exported(request, write, folder) -> tuple[Model, Path]:
    """A model and its FMU."""
    return written(MODELS[request.param](write), folder / f"{request.param}.fmu")


@pytest.fixture(scope="module")
def axis(folder) -> tuple[Model, Path]:
    """An axis without friction, and its FMU."""
    return written(Model.of(load_robot("linear_axis")), folder / "smooth.fmu")


def written(model: Model, path: Path) -> tuple[Model, Path]:
    """Write a model's FMU."""
    path.write_bytes(build_fmu(model).content)
    return model, path


def forces(model: Model, n: int) -> np.ndarray:
    """Return forces (n, na) that carry the weight at home and push to and fro, now and then too weakly to move."""
    M, h = model.mechanism.mass_and_bias(model.robot.home, np.zeros(model.robot.na))
    t = np.arange(n)[:, None] * DT
    strong = np.where(np.sin(2 * np.pi * 1.1 * t) > 0, 1.0, 0.1)
    return h + (4 * np.diag(M) + 20) * np.sin(2 * np.pi * 2 * t * (1 + 0.3 * np.arange(model.robot.na))) * strong


def simulated(model: Model, path: Path, tau: np.ndarray, step: float = DT, **start: float) -> dict[str, np.ndarray]:
    """Return what FMPy makes of the FMU under forces (n, na) held from sample to sample."""
    n, joints = len(tau), model.robot.actuated
    rows = [(k * step, *tau[k]) for k in range(n)]
    given = np.array(rows, dtype=[("time", float), *((f"tau_{j}", float) for j in joints)])
    end = (n - 1) * step
    found = fmpy.simulate_fmu(
        str(path), stop_time=end, step_size=step, output_interval=step, input=given, start_values=start
    )
    out = {s: np.column_stack([found[f"{s}_{j}"] for j in joints]) for s in ("q", "v")}
    if "x_tool" in found.dtype.names:
        out["tool"] = np.column_stack([found[f"{x}_tool"] for x in "xyz"])
    return out


def plant_run(model: Model, tau: np.ndarray, q0: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the simulator's positions (n, na) under the same forces, and how often each joint stood still (na,)."""
    plant = Plant(model, model.robot.home if q0 is None else q0, np.zeros(model.robot.na), DT)
    q, stuck = np.empty_like(tau), np.zeros(model.robot.na)
    for k, force in enumerate(tau):
        q[k] = plant.q
        stuck += plant.step(force)[2]
    return q, stuck


@needs_compiler
def test_it_is_valid_and_moves_as_the_simulator_does_to_rounding(exported):
    """Same equations, same step: 0.6 s of reversing, slipping and sticking agree to 1e-11 of the stroke."""
    from fmpy.validation import validate_fmu

    model, path = exported
    assert validate_fmu(str(path)) == []
    tau = forces(model, 601)
    found, (q, stuck) = simulated(model, path, tau), plant_run(model, tau)
    assert np.all(np.ptp(q, axis=0) > 1e-3) and stuck.sum() > 0
    assert_allclose(found["q"], q, rtol=0, atol=1e-11 * float(np.ptp(q)))
    if "tool" in found:
        assert_allclose(found["tool"], model.mechanism.tool_position(q), atol=1e-9)


@needs_compiler
def test_energy_is_kept_without_friction(write, folder):
    """Two rods that swing freely for 2 s keep kinetic and potential energy to 1e-4 of what they exchange."""
    model, path = written(Model.of(load_robot_from_urdf(write.two_link(), "two_link")), folder / "swing.fmu")
    found = simulated(model, path, np.zeros((2001, 2)), q0_shoulder=0.4, q0_elbow=-0.3)
    carried = model.robot.model_with(model.robot.parameters)
    data = carried.createData()
    pairs = zip(found["q"][::20], found["v"][::20], strict=True)
    energies = [(0.5 * v @ model.mechanism.mass_and_bias(q, v)[0] @ v, pin.computePotentialEnergy(carried, data, q))
                for q, v in pairs]  # fmt: skip
    kinetic, potential = np.array(energies).T
    assert kinetic.max() > 5
    assert np.ptp(kinetic + potential) < 1e-4 * np.ptp(kinetic)


@needs_compiler
def test_parameters_are_those_of_the_model(axis):
    """A mass changed in the FMU moves it as the model with that mass."""
    model, path = axis
    tau = np.full((201, 1), 30.0)
    name = next(n for n in model.robot.parameters.names if n.endswith(".mass"))
    heavy = model.with_values({name: 3 * model.parameters[name].value})
    assert_allclose(
        simulated(model, path, tau, **{name: heavy.parameters[name].value})["q"], plant_run(heavy, tau)[0], atol=1e-13
    )


@needs_compiler
def test_a_long_communication_step_is_cut_into_steps_of_the_plant(axis):
    """Forces held for 5 ms move the robot as five equal samples of the simulator do."""
    model, path = axis
    coarse = forces(model, 41)
    q, _ = plant_run(model, np.repeat(coarse, 5, axis=0))
    assert_allclose(simulated(model, path, coarse, step=5 * DT)["q"], q[::5], atol=1e-13)


@contextmanager
def instance(path: Path, said: list[str], **start: float) -> Iterator[tuple[Any, dict[str, int]]]:
    """Give an initialized instance of an FMU, whose log goes to `said`, and the value references of its variables."""
    from fmpy import fmi2

    about, unzipped = fmpy.read_model_description(str(path)), fmpy.extract(str(path))
    place = {v.name: v.valueReference for v in about.modelVariables}
    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(lambda *given: said.append(given[4].decode()))
    fmu = fmi2.FMU2Slave(
        guid=about.guid, unzipDirectory=unzipped, modelIdentifier=about.coSimulation.modelIdentifier, instanceName="one"
    )
    try:
        fmu.instantiate(callbacks=callbacks)
        fmu.setupExperiment()
        fmu.enterInitializationMode()
        fmu.setReal([place[name] for name in start], list(start.values()))
        fmu.exitInitializationMode()
        yield fmu, place
        fmu.terminate()
    finally:
        fmu.freeInstance()
        shutil.rmtree(unzipped, ignore_errors=True)


@needs_compiler
def test_a_state_is_kept_and_restored(axis):
    """From a state that was stored as bytes, the same forces give the same motion again."""
    with instance(axis[1], []) as (fmu, place):
        fmu.setReal([place["tau_axis"]], [25.0])
        fmu.doStep(0.0, 0.1)
        kept = fmu.serializeFMUstate(fmu.getFMUstate())
        fmu.doStep(0.1, 0.1)
        (first,) = fmu.getReal([place["q_axis"]])
        fmu.setFMUstate(fmu.deSerializeFMUstate(kept, None))
        fmu.doStep(0.1, 0.1)
        assert fmu.getReal([place["q_axis"]]) == [first] and first > 0


@needs_compiler
def test_out_of_reach_is_an_error_of_the_fmu_and_no_crash(folder):
    """A start or a step that no loop closes at is an error with a sentence; the step leaves the robot where it was."""
    model, path = written(Model.of(load_robot("gantry_tau")), folder / "plain.fmu")
    said: list[str] = []
    with pytest.raises(fmpy.fmi1.FMICallException), instance(path, said, q0_cart1=9.0) as (fmu, place):
        fmu.doStep(0.0, DT)
    assert any("cannot reach" in sentence for sentence in said)
    with instance(path, said) as (fmu, place):
        where = [place[f"q_{joint}"] for joint in model.robot.actuated]
        fmu.setReal([place["tau_cart1"]], [1e4])
        fmu.doStep(0.0, 0.01)
        before = fmu.getReal(where)
        with pytest.raises(fmpy.fmi1.FMICallException):
            fmu.doStep(0.01, 5.0)
        assert fmu.getReal(where) == before
        fmu.setReal([place["tau_cart1"]], [0.0])
        fmu.doStep(0.01, 0.01)
        assert fmu.getReal(where) != before


@needs_compiler
def test_the_source_stands_alone_and_warns_of_nothing(write, folder):
    """The source in the archive compiles with all warnings as errors and asks for no header but the C library's."""
    _, path = written(MODELS["four_bar"](write), folder / "source.fmu")
    with zipfile.ZipFile(path) as archive:
        source = archive.read("sources/fmu.c").decode()
    included = {line for line in source.splitlines() if line.startswith("#include")}
    assert included == {f"#include <{name}.h>" for name in ("math", "stddef", "stdlib", "string")}
    (folder / "fmu.c").write_text(source)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O0", "-DFMI2_FUNCTION_PREFIX=robot_"]
    subprocess.run(["cc", *flags, "-c", str(folder / "fmu.c"), "-o", str(folder / "fmu.o")], check=True)


def test_what_a_state_does_not_determine_is_left_out_and_said(monkeypatch):
    """Friction that follows a temperature needs a history, a late recording is no force; with no compiler the source is left."""
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    found = build_fmu(made(load_robot("linear_axis"), "thermal_drift", "delay"))
    said = " ".join(found.left_out)
    assert "thermal_drift is left out: it feels temperature" in said
    assert "delay is left out: it distorts the recording" in said
    assert "no C compiler" in said


class _Table(JointwiseEffect):
    """A law that is looked up in a table."""

    name, equation, quantities = "table", "none", (("table", "F"),)

    def per_joint(self, joint):
        """Return a value between two rows."""
        return [np.interp(np.asarray(joint.q, float), [0.0, 1.0], [0.0, 2.0])]


def test_what_cannot_be_traced_is_refused_in_a_sentence():
    """A table is no expression of the state."""
    robot = load_robot("linear_axis")
    with raises_code("unsupported", "table"):
        build_equations(Model.of(robot, [_Table(robot.actuated, robot.force_units)]))


def test_numbers_are_written_to_the_last_digit():
    """A parameter's value reads back from the source as the very same number."""
    model = Model.of(load_robot("linear_axis")).with_values({"carriage_link.mass": 0.1 + 0.2})
    assert repr(0.1 + 0.2) in write_fmu_source(build_equations(model), "{}", "")


def test_units_are_made_of_base_units():
    """`N s/m` is kg/s; a unit that is not known here keeps its name alone."""
    assert {k: x for k, x in (build_base_units("N s/m") or {}).items() if x} == {"kg": 1, "s": -1}
    assert {k: x for k, x in (build_base_units("N m s/rad") or {}).items() if x} == {
        "kg": 1,
        "m": 2,
        "s": -1,
        "rad": -1,
    }
    assert build_base_units("pieces") is None


@pytest.mark.parametrize(
    ("unit", "powers"),
    [
        ("N/(m/s)", {"kg": 1, "s": -1}),
        ("N m/(rad/s)", {"kg": 1, "m": 2, "s": -1, "rad": -1}),
        ("N/(m/s)^2", {"kg": 1, "m": -1}),
        ("N/(m/s K)", {"kg": 1, "s": -1, "K": -1}),
        ("N s^2/m", {"kg": 1}),
        ("rad/(N m)", {"rad": 1, "kg": -1, "m": -2, "s": 2}),
    ],
)
def test_a_quotient_in_brackets_is_divided_by_as_a_whole(unit, powers):
    """A force per speed is a damping, kg/s: what stands below the bar within a bracket comes up again."""
    assert {k: x for k, x in (build_base_units(unit) or {}).items() if x} == powers


@pytest.mark.parametrize("unit", ["N/(m/s", "N)/m", "(((", "N//m^x", "^2"])
def test_a_unit_that_is_none_has_no_base_units(unit):
    """Brackets that do not close and powers that are no numbers give no answer instead of a wrong one."""
    assert build_base_units(unit) is None


def test_a_joint_cannot_end_the_comment_of_an_fmu():
    """The source is compiled where the FMU is written: a joint's name stays within the comment that lists it."""
    robot = load_robot_from_urdf(load_robot("linear_axis").urdf.replace('"axis"', '"x*/int evil;/*"'), "named")
    source = write_fmu_source(build_equations(Model.of(robot)), "{}", "")
    line = next(x for x in source.splitlines() if "Parameters:" in x)
    assert line.count("*/") == 1 and line.endswith("*/") and line.count("/*") == 1


@needs_compiler
def test_the_command_writes_the_same_file_twice(tmp_path, capsys):
    """`export --to fmu` is the model's own content: no date, no path, no chance."""
    robot = load_robot("linear_axis")
    Model.of(robot, [SymmetricFriction(robot.actuated, robot.force_units)]).save(tmp_path / "m.yaml")
    for name in ("a.fmu", "b.fmu"):
        assert main(["export", str(tmp_path / "m.yaml"), "--to", "fmu", "--out", str(tmp_path / name)]) == 0
    assert (tmp_path / "a.fmu").read_bytes() == (tmp_path / "b.fmu").read_bytes()
    assert main(["export", str(tmp_path / "m.yaml"), "--to", "fmu", "--out", str(tmp_path / "c.zip")]) == 2
    assert "ends in .fmu" in capsys.readouterr().err
