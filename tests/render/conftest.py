"""Identified robots to report on: one axis with a clean answer, one that leaves questions, both with hostile names."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.compare import ComparedSide, compare
from tau_dyn.compare.read import MeasuredQuantity
from tau_dyn.effects import Stribeck, build_friction_model
from tau_dyn.evidence import (
    Diagnosis,
    Finding,
    Gain,
    Limit,
    OutputErrors,
    Signature,
    Step,
    TimeTrace,
    Unexplained,
    Untestable,
)
from tau_dyn.identify import Identification, identify
from tau_dyn.kinematics import build_forward_table
from tau_dyn.kinematics.accuracy import AccuracyResult, Measured
from tau_dyn.kinematics.workspace import study_workspace
from tau_dyn.log import Log, check_log
from tau_dyn.model import Model
from tau_dyn.modes import find_modes
from tau_dyn.parameters import Parameter
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

sys.path.insert(0, str(Path(__file__).parents[1] / "calibrate"))
from calibration_rigs import measured, rods_of  # noqa: E402  # pyright: ignore[reportMissingImports]

HOSTILE = "<script>alert('log')</script>\x1b[31m.csv"
TRUTH = {
    "one_link.mass": 12.0,
    "two_link.mass": 3.0,
    "slide.coulomb_pos": 30.0,
    "slide.coulomb_neg": 25.0,
    "slide.viscous_pos": 80.0,
    "slide.viscous_neg": 60.0,
    "lift.coulomb_pos": 9.0,
    "lift.coulomb_neg": 9.0,
    "lift.viscous_pos": 20.0,
    "lift.viscous_neg": 20.0,
}


@pytest.fixture(scope="session")
def hostile() -> str:
    """A file name that tries to be markup and a terminal command."""
    return HOSTILE


@pytest.fixture(scope="session")
def truth() -> dict[str, float]:
    """The true values of the simulated robot."""
    return TRUTH


def _link(name: str, mass: float) -> str:
    inertia = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial><mass value="{mass}"/>{inertia}</inertial></link>'


def _joint(name: str, parent: str, child: str, axis: str) -> str:
    limit = '<limit lower="-1" upper="1" velocity="3" effort="1000"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    drive = f'<transmission name="{name}_drive"><joint name="{name}"/></transmission>'
    return f'<joint name="{name}" type="prismatic">{ends}<axis xyz="{axis}"/>{limit}</joint>{drive}'


@pytest.fixture(scope="session")
def robot() -> Robot:
    """A cross slide: one axis along x carries another along y; each link's mass is its only inertial parameter."""
    links = '<link name="base_link"/>' + _link("one_link", 10) + _link("two_link", 3)
    joints = _joint("slide", "base_link", "one_link", "1 0 0") + _joint("lift", "one_link", "two_link", "0 1 0")
    ties = '<t:link name="one_link" parameters="mass"/><t:link name="two_link" parameters="mass"/>'
    name = "&lt;img src=x onerror=alert(1)&gt;"
    return load_robot_from_urdf(
        f'<robot name="{name}" xmlns:t="urn:tau_dyn">{links}{joints}{ties}</robot>', "slide.urdf"
    )


def _log(model: Model, amplitude: tuple[float, float], name: str, rng: np.random.Generator) -> Log:
    t = np.arange(0, 20, 0.004)
    shape = [(1.1, 2.3, 5.0), (1.4, 2.9, 4.3)]
    q, v, a = np.zeros((3, len(t), 2))
    for j, (size, frequencies) in enumerate(zip(amplitude, shape, strict=True)):
        for k, w in enumerate(frequencies):
            q[:, j] += size * np.sin(w * t + k) / w
            v[:, j] += size * np.cos(w * t + k)
            a[:, j] -= size * np.sin(w * t + k) * w
    tau = np.einsum("nij,j->ni", model.regressor(q, v, a), model.parameters.values) + 2 * rng.normal(size=q.shape)
    q = q + 1e-6 * rng.normal(size=q.shape)
    return Log(t, {"q_slide": q[:, 0], "q_lift": q[:, 1], "tau_slide": tau[:, 0], "tau_lift": tau[:, 1]}, name)


@pytest.fixture(scope="session")
def plant(robot) -> Model:
    return Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units)).with_values(TRUTH)


@pytest.fixture(scope="session")
def found(robot, plant) -> Identification:
    """A rich motion, judged on a log of its own; every parameter is determined."""
    rng = np.random.default_rng(7)
    return identify(robot, _log(plant, (0.3, 0.25), HOSTILE, rng), holdout=_log(plant, (0.25, 0.3), "other.csv", rng))


@pytest.fixture(scope="session")
def doubtful(robot, plant) -> Identification:
    """The second joint stands still, so its friction and its share of the mass stay unknown."""
    return identify(robot, _log(plant, (0.3, 0.0), "still.csv", np.random.default_rng(8)))


def signature(output: str, x: np.ndarray, effect: np.ndarray, x_label: str, rng: np.random.Generator) -> Signature:
    """Return samples of an effect in noise of 2 N."""
    y = effect + 2.0 * rng.normal(size=x.shape)
    return Signature(output, x_label, "residual [N]", x, y, effect)


def errors(outputs: tuple[str, ...], rms: tuple[float, ...], percent: float) -> OutputErrors:
    """Return errors with intervals of about 7 %."""
    values = np.array(rms)
    return OutputErrors(outputs, values, np.column_stack([0.93 * values, 1.08 * values]), percent)


def _traces(outputs: tuple[str, ...], names: tuple[str, str], rng: np.random.Generator) -> tuple[TimeTrace, ...]:
    t = np.arange(0, 30, 0.02)
    drawn = []
    for name in names:
        v = np.column_stack([0.3 * np.cos((1.1 + 0.3 * k) * t + k) for k in range(len(outputs))])
        before = 60 * v + 25 * np.sign(v)
        effect = 4.0 * np.sign(v) * np.exp(-np.abs(v) / 0.05)
        noise = rng.normal(size=v.shape)
        part = np.where(t < 18, 0, np.where(t < 24, 1, 2))
        drawn.append(TimeTrace(name, t, before + effect + noise, before, before + effect, np.abs(v) > 0.01, part))
    return tuple(drawn)


def diagnosis_by_hand(model: Model, names: tuple[str, str], verdict: str = "named") -> Diagnosis:
    """Return a diagnosis as the engine would give it: two causes, one finding off nominal, something unexplained."""
    rng, outputs = np.random.default_rng(5), model.robot.actuated
    first, second = outputs[0], outputs[1]
    unit = model.robot.force_units[0]
    x = 0.3 * np.sin(np.linspace(0, 60, 1800))
    place = np.linspace(0, 20.9, 1800)
    mass = next(p for p in model.parameters if p.name.endswith(".mass"))
    fitted = model.with_parameters(
        model.parameters.update(
            {p.name: {"stderr": 0.02 * abs(p.value) + 0.01, "value": 1.02 * p.value} for p in model.parameters}
        )
    )
    stribeck = Stribeck([first], [unit], speed=0.02)
    wider = Model.of(fitted.robot, [*fitted.effects, stribeck])
    known = {p.name: {"value": p.value, "stderr": p.stderr} for p in fitted.parameters}
    extended = wider.with_parameters(
        wider.parameters.update({**known, f"{first}.stribeck": {"value": 4.1, "stderr": 0.2}})
    )
    findings = (
        Finding("cyclic_ripple", (second,), "confirmed", 412.0, 1e-9,
                (Parameter(f"{second}.ripple_cos", 1.61, unit, stderr=0.09),
                 Parameter(f"{second}.ripple_sin", -0.8, unit, stderr=0.1), Parameter("period", 0.0209, "m", stderr=1e-5)),
                Gain(3.1, 2.2, 29.0, (24.0, 33.0)), (), "tau += cos · cos(2 pi q / period) + sin · sin(2 pi q / period)",
                f"{second} carries a force of 1.8 +- 0.1 {unit} that repeats every 20.9 mm, the pinion's tooth",
                signature=signature(second, place, 1.8 * np.cos(2 * np.pi * place / 20.9),
                                    f"position of {second} modulo 20.9 mm [mm]", rng),
                confirmation=(0.97, 0.05)),
        Finding("stribeck", (first,), "confirmed", 150.0, 2e-4,
                (Parameter(f"{first}.stribeck", 4.1, unit, stderr=0.2), Parameter("speed", 0.0201, "m/s", stderr=0.003)),
                Gain(3.6, 3.1, 13.9, (8.0, 19.0)), ("hysteresis",), "tau += stribeck sign(v) exp(-|v| / speed)",
                f"Friction of {first} rises by 4.1 +- 0.2 {unit} when it moves slower than 20 mm/s",
                "strokes that turn around after 1, 2 and 5 mm", (stribeck,),
                signature(first, x, 4.1 * np.sign(x) * np.exp(-np.abs(x) / 0.05), f"speed of {first} [m/s]", rng),
                confirmation=(0.9, 0.08)),
        Finding("link_mass", (), "parameter", 40.0, 1e-5,
                (Parameter(mass.name, 1.04 * mass.value, "kg", stderr=0.01 * mass.value),),
                None, ("payload",), "m <i>off</i> nominal", f"{mass.name} is 4 % heavier than its nominal value", "weigh it"),
    )  # fmt: skip
    left = Unexplained(second, (f"v_{first}", f"q_{second}"), 0.23, f"0.8 v_{first} q_{second}", 3e-4, "confirmed",
                       signature(second, x, 6 * x**2, f"speed of {first} [m/s]", rng))  # fmt: skip
    wave = [(1.0, 31.0), (0.24, 7.4), (0.17, 5.3), (0.08, 2.5), (0.07, 2.3)]
    names_of = ("nominal", "refitted", f"stribeck {first}", f"cyclic_ripple {second}", "noise_floor")
    steps = tuple(
        Step(n, errors(outputs, tuple(f * 14.0 / (1 + 0.3 * k) for k in range(len(outputs))), p))
        for n, (f, p) in zip(names_of, wave, strict=True)
    )
    nothing = verdict in ("nothing_found", "cannot_tell")
    said = {
        "named": "The simulation misses 7.4 % of the measured force; "
        f"a ripple on {second} and Stribeck friction on {first} explain 4.9 % of it.",
        "nothing_found": "The simulation misses 7.4 % of the measured force and nothing systematic is left.",
        "cannot_tell": f"Something acts on {first}, but these logs cannot tell hysteresis from Stribeck friction.",
        "unexplained": f"Something acts on {second} that no cause known here explains.",
    }
    return Diagnosis(
        verdict=verdict, sentence=said[verdict], channel="force", outputs=outputs, units=model.robot.force_units,
        baseline=steps[1].errors, extended=steps[1 if nothing else 3].errors, noise_floor=steps[-1].errors,
        waterfall=(*steps[:2], steps[-1]) if nothing else steps, findings=() if nothing else findings,
        unexplained=() if nothing else (left,),
        limits=(Limit("delay", 2e-4, "s", "delay of 0.2 ms"), Limit("load_friction", 0.05, "", "load friction of μ 0.05"),
                Limit("backlash", 9e-6, "m", "backlash of 9 µm"), Limit("quadratic_drag", 3.0, "N s^2/m^2", "")),
        untestable=(Untestable("thermal_drift", "the logs give no temperature",
                               "log a temperature beside each drive while it warms up"),),
        model=fitted, extended_model=fitted if nothing else extended,
        traces=_traces(outputs, names, rng), n_parts=(36.0, 12.0, 12.0),
        how="each log in blocks of 6 s, 60 / 20 / 20", warnings=("the encoder of <b>one</b> joint is coarse",), seed=3,
        experiment="strokes that turn around after 1, 2 and 5 mm" if verdict == "cannot_tell" else "",
        simulation={"before": {"position": {first: 1.4e-4}}, "after": {"position": {first: 0.9e-4}}},
        settings={"cutoff_hz": 20.0, "null": {"sets": 200, "cached": True}, "family_wise_error": 0.01},
    )  # fmt: skip


@pytest.fixture(scope="session")
def diagnosed(plant, hostile) -> Diagnosis:
    """Two causes, a mass off its nominal value, something unexplained; names hostile."""
    return diagnosis_by_hand(plant, (hostile, "other.csv"))


@pytest.fixture(scope="session")
def undecided(plant) -> Diagnosis:
    """The data cannot tell."""
    return diagnosis_by_hand(plant, ("a.csv", "b.csv"), "cannot_tell")


def resonance(name: str) -> Log:
    """Return a mass on a spring, 5 Hz, pushed by a binary force."""
    rng, t = np.random.default_rng(0), np.arange(600) * 0.02
    force = np.repeat(rng.choice([-1.0, 1.0], 300), 2)
    pole = np.exp(0.02 * 2 * np.pi * 5.0 * (-0.03 + 1j))
    y = np.zeros(600)
    for k in range(2, 600):
        y[k] = 2 * pole.real * y[k - 1] - abs(pole) ** 2 * y[k - 2] + force[k - 1]
    return Log(t, {"<b>f": force, "x_tool": y + 0.02 * y.std() * rng.normal(size=600)}, name)


def calibrated():
    """Return a calibration of an L1 whose guideways are skew."""
    from tau_dyn.calibrate import calibrate

    rods = rods_of()
    poses, _ = measured(rods, "nonparallel", 60, 5)
    every = np.arange(poses.n)
    return calibrate(rods.robot, poses.take(every[::2]), poses.take(every[1::2]), "nonparallel")


def compared(hostile):
    """Return two results that differ in a mass."""
    sides = [
        ComparedSide(
            Path(f"{hostile}{k}"), str(k), "identify", {"<i>mass": MeasuredQuantity(x, 0.1, "kg")}, {}, {}, frozenset()
        )
        for k, x in enumerate((9.1, 9.9))
    ]
    return compare(*sides)


@pytest.fixture(scope="session")
def results(found, diagnosed, robot, plant, hostile) -> dict[str, object]:
    """One of each, with hostile names where names come from files."""
    log = resonance(hostile)
    axis = load_robot("linear_axis")
    return {
        "robot": robot,
        "model": plant,
        "parameters": plant.parameters,
        "log": log,
        "identification": found,
        "diagnosis": diagnosed,
        "check": check_log(log, robot),
        "modes": find_modes(log, ["<b>f"], ["x_tool"], order=2, delay=0),
        "calibration": calibrated(),
        "workspace": study_workspace(axis, resolution=0.1),
        "accuracy": AccuracyResult(robot, None, None, None, (), Measured()),
        "poses": build_forward_table(axis, np.array([[0.1], [0.2]])),
        "comparison": compared(hostile),
    }


KINDS = "robot model parameters log identification diagnosis check modes calibration workspace accuracy poses comparison".split()


@pytest.fixture(params=KINDS)
def kind(request) -> str:
    """Each kind of result in turn."""
    return request.param
