"""Compiled code moves as the plant in Python does, serves all values of the parameters, and is built once for all."""

from __future__ import annotations

import ctypes
import os
import pickle
import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raising import raises_code

from tau_dyn.effects import EFFECTS, JointwiseEffect
from tau_dyn.equations import LibraryCache
from tau_dyn.model import Model
from tau_dyn.robot import load_robot
from tau_dyn.simulate import (
    CascadeController,
    CascadeLaw,
    CompiledPlant,
    Sensors,
    Trajectory,
    compiled_plant,
    concatenate,
    free_motion,
    move,
    replay,
    run_plant,
    simulate,
    simulate_drive,
)
from tau_dyn.simulate.plant import Plant

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler here")
LONG = 10**6
SETTINGS = {"stribeck": {"speed": 0.1}, "position_friction": {"half": 0.3}, "thermal_drift": {"lag": 0.5}}
FRICTION = (
    "stribeck", "position_friction", "thermal_drift", "quadratic_drag", "torque_offset", "drive_gain", "cyclic_ripple",
    "hysteresis", "viscous_curvature", "armature",
)  # fmt: skip
CARRIED = ("load_friction", "passive_joint_friction", "gravity_direction", "reducer_coupling")
READ = ("backlash", "transmission_error", "pinion_scale")
SIZES = {"load_friction": 0.02, "gain_error": 0.05, "tilt_x": 0.02, "tilt_y": -0.03, "thermal_coulomb": -0.1,
         "thermal_viscous": -0.1, "backlash": 4e-5, "error_sin": 1e-5, "error_cos": -2e-5, "pinion_scale": 1e-3}  # fmt: skip
BROKEN_OFF = 1e-9  # of the trajectories; rounding grows to 1e-12 in two seconds


def hiding(model: Model, causes: tuple[str, ...], size: float) -> Model:
    """Return a model in which causes hide besides, of amplitudes near one size."""
    robot = model.robot
    effects = []
    for cause in causes:
        joints = robot.actuated[:2] if cause == "reducer_coupling" else robot.actuated
        units = [robot.force_units[robot.actuated.index(joint)] for joint in joints]
        effects.append(EFFECTS[cause](joints, units, label=f"_{cause}", **SETTINGS.get(cause, {})))
    made = Model.of(robot, [*model.effects, *effects])
    values = {name: model.parameters[name].value for name in model.effect_parameters.names}
    for effect in effects:
        for name in effect.parameters.names:
            quantity = name.split(".", 1)[1].removesuffix(f"_{effect.name}")
            values[name] = SIZES.get(quantity, size)
    return made.with_values(values)


def there_and_back(model: Model, length: float, seconds: float = 0.35) -> Trajectory:
    """Return a motion that starts at rest at home, reverses and rests."""
    joints, home = model.robot.actuated, model.robot.home
    far = length * np.resize([1.0, -0.7, 0.4], model.robot.na)
    ways = [(home, home + far), (home + far, home - far), (home - far, home)]
    return concatenate([move(joints, a, b, seconds) for a, b in ways], rest=0.02)


def both(monkeypatch, run):
    """Return what a run gives as compiled code and in Python; short runs are compiled too."""
    for name in ("MIN_SAMPLES", "MIN_SAMPLES_PER_DRIVE", "MIN_SAMPLES_PER_PASSIVE_JOINT"):
        monkeypatch.setattr(compiled_plant, name, 0)
    steps, step = [], Plant.step
    monkeypatch.setattr(Plant, "step", lambda self, tau: steps.append(1) or step(self, tau))
    monkeypatch.setenv("TAU_DYN_COMPILE", "1")
    compiled = run()
    assert not steps
    monkeypatch.setenv("TAU_DYN_COMPILE", "0")
    plain = run()
    assert steps
    return compiled, plain


def assert_same(compiled, plain) -> None:
    """Check two runs against each other."""
    for name in ("q", "v", "tau"):
        one, other = getattr(compiled, name), getattr(plain, name)
        assert_allclose(one, other, rtol=0, atol=BROKEN_OFF * float(np.abs(other).max()))
    assert_array_equal(compiled.stuck, plain.stuck)
    if plain.q_read is not None:
        assert_allclose(compiled.q_read, plain.q_read, rtol=0, atol=BROKEN_OFF)


@pytest.mark.parametrize(
    ("robot", "causes", "size", "length"),
    [
        ("gantry", (), 0.0, 0.05),
        ("gantry", FRICTION, 3.0, 0.05),
        ("gantry", (*CARRIED, *READ), 1.0, 0.05),
        ("arm", FRICTION[:5], 0.2, 0.04),
        ("arm", ("load_friction", *READ), 0.2, 0.04),
        ("complete", ("load_friction", "passive_joint_friction", "thermal_drift"), 1.0, 0.03),
    ],
)
def test_compiled_code_moves_as_python_does(robot, causes, size, length, make, gantry, monkeypatch):
    """Every cause that acts or is read: positions, speeds, forces and sticking are the same to 1e-9, noise in the loop."""
    if robot == "complete":
        model = make.friction(load_robot("gantry_tau", arms="complete"), 80.0, 120.0, 0.15)
    else:
        model = gantry if robot == "gantry" else make.arm("ur5")
    model = hiding(model, causes, size)
    path, sensors = there_and_back(model, length, 0.16), Sensors(encoder_noise=1e-6)
    runs = both(monkeypatch, lambda: simulate_drive(model, path, None, sensors, np.random.default_rng(0)))
    assert_same(*runs)
    assert runs[0].stuck.any() and np.ptp(runs[0].q, axis=0).min() > 0.3 * length


def test_encoders_round_as_in_python(block, monkeypatch):
    """Friction that holds keeps the loop stable below a step of the encoders: every reading is the same."""
    sensors = Sensors(encoder_noise=1e-6, encoder_resolution=2e-6)
    path = there_and_back(block, 0.03)
    runs = both(monkeypatch, lambda: simulate_drive(block, path, None, sensors, np.random.default_rng(0)))
    assert_same(*runs)
    assert_allclose(runs[0].q_read / 2e-6, np.round(runs[0].q_read / 2e-6), atol=1e-6)


def test_a_rod_swings_as_in_python(make, monkeypatch):
    """A pendulum without friction, 3 s from rest at 1 rad."""
    model = Model.of(make.pendulum())
    assert_same(*both(monkeypatch, lambda: free_motion(model, np.array([1.0]), np.zeros(1), 3.0)))


def test_a_recording_is_repeated_as_in_python(block, monkeypatch):
    """Forces held from sample to sample, three periods of the loop a sample, two steps of the plant a period."""
    law = CascadeLaw.of(25.0, 240.0, na=1, integral_rate=8.0, speed_feedforward=0.7, force_per_unit=35.0, limit=10.0)
    log = simulate(block, there_and_back(block, 0.03), CascadeController(law), Sensors(log_rate_hz=250))
    runs = both(monkeypatch, lambda: replay(block, log, law, rate_hz=750.0, substeps=2))
    for signal, values in runs[1].simulated.items():
        assert_allclose(
            runs[0].simulated[signal], values, rtol=0, atol=BROKEN_OFF * max(1.0, float(np.abs(values).max()))
        )


def test_parameters_are_given_when_it_runs(gantry):
    """A plate twice as heavy and cold grease, given to the library as it is, move as the model with these values."""
    heavy = gantry.with_values({"plate_link.mass": 20.0, "cart1.viscous_pos": 300.0, "cart2.coulomb_neg": 10.0})
    plant, home, rest = CompiledPlant.find(gantry, LONG), gantry.robot.home, np.zeros(3)
    assert plant is not None
    push = heavy.mechanism.mass_and_bias(home, rest)[1] + np.array([120.0, -150.0, 90.0])
    moved = plant.apply_forces(home, rest, 1e-3, np.tile(push, (300, 1)), parameters=heavy.parameters.values)
    expected = free_motion(heavy, home, rest, 0.299, tau=push)
    assert moved is not None
    assert_allclose(moved.q, expected.q, rtol=0, atol=BROKEN_OFF)
    assert np.abs(moved.q - plant.apply_forces(home, rest, 1e-3, np.tile(push, (300, 1))).q).max() > 1e-4


def test_the_tool_is_where_the_mechanism_says(gantry):
    """Tool positions of a compiled run, and of one that came from another process, are the mechanism's to 1e-9 m."""
    path = there_and_back(gantry, 0.1, 0.9).resampled(1000.0)
    run = run_plant(gantry, path, CascadeController(CascadeLaw.for_model(gantry), start=gantry))
    assert run.compute_tool is not None
    carried = pickle.loads(pickle.dumps(run))
    assert_allclose(run.tool, carried.tool, rtol=0, atol=1e-9)
    assert_array_equal(carried.tool, gantry.mechanism.tool_position(run.q))


def test_the_same_call_takes_the_same_path(block):
    """A library that is there already does not change what a short run gives: it stays in Python."""
    assert CompiledPlant.find(block, LONG) is not None
    assert CompiledPlant.find(block, 100) is None


class _Table(JointwiseEffect):
    """A law that is looked up in a table."""

    name, equation, quantities = "table", "none", (("table", "F"),)

    def per_joint(self, joint):
        """Return a value between two rows."""
        return [np.interp(np.asarray(joint.q, float), [0.0, 1.0], [0.0, 2.0])]


def test_what_cannot_be_compiled_runs_in_python(make, monkeypatch):
    """A law that is no expression, and a computer without a compiler: the plant in Python moves the robot."""
    model = Model.of(make.block(), [_Table(["axis"], ["N"])])
    assert CompiledPlant.find(model, LONG) is None
    fallen = free_motion(model.with_values({"axis.table": 5.0}), np.array([0.5]), np.zeros(1), 0.6)
    assert_allclose(fallen.a[0], -5.0 / 95.0, rtol=1e-6)
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    assert CompiledPlant.find(Model.of(make.block()), LONG) is None


def test_a_robot_that_runs_away_is_refused_as_in_python(gantry):
    """Gains far too high end in the sentence of the simulator, and not in numbers that are none."""
    law = CascadeLaw.of(400.0, 4e5, na=3)
    path = there_and_back(gantry, 0.1, 0.9).resampled(1000.0)
    with raises_code("unstable", "ran away"):
        run_plant(gantry, path, CascadeController(law, start=gantry))


class _Norm(_Table):
    """A law whose code asks the numbers for what expressions have not."""

    name = "norm"

    def per_joint(self, joint):
        """Return the position, by a detour."""
        return [np.array([x.real for x in joint.q])]


def test_a_law_that_fails_on_expressions_runs_in_python(make):
    """Whatever tracing meets in a law of the user's, the simulation is not harmed."""
    model = Model.of(make.block(), [_Norm(["axis"], ["N"])]).with_values({"axis.table": 95.0})
    run = free_motion(model, np.array([0.1]), np.zeros(1), 0.5)
    assert_allclose(run.q[-1], 0.1 * np.cos(0.5), rtol=1e-3)


def test_a_defect_of_ours_while_tracing_shows(make, monkeypatch):
    """What our own effects do not foresee is raised, and not hidden by the slower way; a law of the user's is forgiven."""

    def defect(*_args, **_settings):
        raise AttributeError("a name that is not there")

    monkeypatch.setattr(compiled_plant, "build_equations", defect)
    monkeypatch.setattr(compiled_plant, "_TRACED", compiled_plant._TracedModels())
    with pytest.raises(AttributeError, match="a name that is not there"):
        CompiledPlant.find(make.friction(make.block(), 20.0, 10.0, 0.1), LONG)
    assert CompiledPlant.find(Model.of(make.block(), [_Norm(["axis"], ["N"])]), LONG) is None


SOURCE = 'int answer(void);\n__attribute__((visibility("default"))) int answer(void) { return 42; }\n'


def answer(library: ctypes.CDLL | None) -> int:
    """Return what a library says."""
    assert library is not None
    return library.answer()


def test_a_library_is_built_once(tmp_path, monkeypatch):
    """Another process finds it by the hash of its source and asks no compiler; other source is another library."""
    assert LibraryCache(tmp_path).find(SOURCE) is None
    assert answer(LibraryCache(tmp_path).build(SOURCE)) == 42
    monkeypatch.setattr(subprocess, "run", lambda *a, **k: pytest.fail("a compiler was asked"))
    assert answer(LibraryCache(tmp_path).build(SOURCE)) == 42
    assert LibraryCache(tmp_path).find(SOURCE.replace("42", "43")) is None


def test_processes_may_build_at_once(tmp_path):
    """Four that start together each get a whole library, and nothing half written is left."""
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: answer(LibraryCache(tmp_path).build(SOURCE)), range(4)))
    assert found == [42] * 4
    assert [path.suffix for path in tmp_path.iterdir()] == [".so"]


def test_a_broken_file_is_built_again(tmp_path):
    """What a full disk left is no library."""
    whole, spoiled = tmp_path / "whole", tmp_path / "spoiled"
    LibraryCache(whole).build(SOURCE)
    spoiled.mkdir(mode=0o700)
    (spoiled / next(whole.iterdir()).name).write_bytes(b"no library")
    assert LibraryCache(spoiled).find(SOURCE) is None
    assert answer(LibraryCache(spoiled).build(SOURCE)) == 42


@pytest.mark.skipif(os.name != "posix", reason="permissions are POSIX's")
def test_code_that_others_may_write_is_not_loaded(tmp_path):
    """From a folder open to all nothing is loaded; the library is built beside it."""
    LibraryCache(tmp_path).build(SOURCE)
    tmp_path.chmod(0o777)
    assert LibraryCache(tmp_path).find(SOURCE) is None
    assert answer(LibraryCache(tmp_path).build(SOURCE)) == 42


def test_a_user_without_a_home_has_a_folder_too(tmp_path, monkeypatch):
    """Where there is no home, libraries are kept beside other temporary files."""
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("pathlib.Path.home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert answer(LibraryCache().build(SOURCE)) == 42


def test_a_folder_that_cannot_be_is_no_hindrance(tmp_path):
    """Where the folder is a file, each process builds for itself."""
    (tmp_path / "file").write_text("")
    assert answer(LibraryCache(tmp_path / "file").build(SOURCE)) == 42


def test_old_libraries_leave(tmp_path, monkeypatch):
    """The folder keeps the newest."""
    monkeypatch.setattr("tau_dyn.equations.compiler.MAX_LIBRARIES", 2)
    for k in range(4):
        LibraryCache(tmp_path).build(SOURCE.replace("42", str(k)))
    assert len(list(tmp_path.glob("*.so"))) == 2
