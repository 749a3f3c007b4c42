"""A model adds its parts up, and survives a file; hostile files are refused in one sentence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.effects import EFFECTS, Motion, build_friction_model
from tau_dyn.exceptions import InputError, TauDynError
from tau_dyn.files import write_atomically, write_whole
from tau_dyn.model import Model
from tau_dyn.robot import load_robot, load_robot_from_urdf


@pytest.fixture
def model(two_link, rng) -> Model:
    """Two links with untouched rigid values, symmetric friction, an offset, and a shared reducer."""
    effects = [*build_friction_model("symmetric", two_link.actuated, two_link.force_units)]
    effects.append(EFFECTS["reducer_coupling"](two_link.actuated, two_link.force_units))
    model = Model.of(two_link, effects, {"logs": ["monday.csv"], "seed": 1})
    return model.with_values({n: float(rng.uniform(0.1, 3)) for n in model.effect_parameters.names})


@pytest.fixture
def saved(model, tmp_path) -> Path:
    """The model's file."""
    model.save(tmp_path / "m.yaml")
    return tmp_path / "m.yaml"


def test_force_is_regressor_times_parameters(model, rng) -> None:
    """`tau = [Y, columns] theta`, rigid body and effects in the order of `model.parameters`."""
    q, v, a = rng.standard_normal((3, 10, 2))
    tau = model.torque(q, v, a)
    assert_allclose(model.regressor(q, v, a) @ model.parameters.values, tau, atol=1e-12)
    apart = model.mechanism.inverse_dynamics(q, v, a)
    assert np.abs(tau - apart).max() > 0.1


def test_a_gain_feels_the_force_of_what_yields(two_link) -> None:
    """A drive's gain scales all forces, also those of an effect that needs friction's growth with speed to be known."""
    on, units, t = two_link.actuated, two_link.force_units, 1e-3 * np.arange(400)
    q, v, a = (x[:, None] * [1.0, 0.5] for x in (np.sin(9 * t), 9 * np.cos(9 * t), -81 * np.sin(9 * t)))
    yielding = EFFECTS["transmission_error"](on, units, period=0.7)
    friction = build_friction_model("symmetric", on, units)
    plain = Model.of(two_link, [*friction, yielding])
    plain = plain.with_values({name: 0.01 * (1 + k) for k, name in enumerate(plain.effect_parameters.names)})
    scaled = Model.of(two_link, [*friction, yielding, EFFECTS["drive_gain"](on, units)])
    scaled = scaled.with_values(
        {p.name: p.value for p in plain.effect_parameters} | {f"{j}.gain_error": 0.1 for j in on}
    )
    assert_allclose(scaled.torque(q, v, a, t=t), 1.1 * plain.torque(q, v, a, t=t), rtol=1e-12)


def test_values_are_replaced_by_name(model) -> None:
    """A new value reaches the force; an unknown name lists those that exist."""
    q, v, a = np.zeros((1, 2)), np.ones((1, 2)), np.zeros((1, 2))
    more = model.with_values({"elbow.viscous": model.parameters["elbow.viscous"].value + 2.0})
    assert_allclose(more.torque(q, v, a) - model.torque(q, v, a), [[0, 2.0]], atol=1e-12)
    with raises_code("unknown_name", "elbow.viscos"):
        model.with_values({"elbow.viscos": 1.0})


def test_a_model_survives_its_file(model, saved, rng) -> None:
    """Values, effects, bounds and provenance come back; forces are equal."""
    back = Model.load(saved)
    q, v, a = rng.standard_normal((3, 5, 2))
    assert_allclose(back.torque(q, v, a), model.torque(q, v, a), rtol=1e-13)
    assert list(back.parameters) == list(model.parameters)
    assert dict(back.provenance) == {"logs": ["monday.csv"], "seed": 1}
    back.save(saved.with_name("again.yaml"))
    assert saved.with_name("again.yaml").read_text() == saved.read_text()


def test_untied_parameters_and_a_looped_robot_survive_too(rng, tmp_path) -> None:
    """The file carries its own robot: arguments, actuated joints, which inertias were untied, gravity mass."""
    robot = load_robot("gantry_tau", prototype="l2", gravity_mass=20).untied(["plate_link.mx", "rod1_link.izz"])
    model = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    model = model.with_values({"plate_link.mx": 0.3, "cart1.coulomb_pos": 55.0, "rod1_link.izz": 1.7})
    model.save(tmp_path / "m.yaml")
    back = Model.load(tmp_path / "m.yaml")
    assert list(back.parameters) == list(model.parameters)
    assert back.robot.source == "gantry_tau" and dict(back.robot.arguments) == {"prototype": "l2", "gravity_mass": "20"}
    q = robot.home + rng.uniform(-0.1, 0.1, (4, 3))
    v, a = rng.standard_normal((2, 4, 3))
    assert_allclose(back.torque(q, v, a), model.torque(q, v, a), rtol=1e-12)


def test_overridden_actuated_joints_survive(write, tmp_path) -> None:
    """A robot driven elsewhere than its file says stays so."""
    robot = load_robot_from_urdf(write.four_bar(), "bars", actuated=["rocker"])
    Model.of(robot).save(tmp_path / "m.yaml")
    assert Model.load(tmp_path / "m.yaml").robot.actuated == ("rocker",)


@pytest.mark.parametrize(
    "text",
    ["!!python/object/apply:os.system ['true']", "!!python/object:tau_dyn.model.Model {}", "!!python/name:os.system"],
)
def test_no_code_runs_on_loading(tmp_path, text: str) -> None:
    """YAML tags that build Python objects are refused, wherever they stand."""
    path = tmp_path / "evil.yaml"
    for content in (text, f"tau_dyn_model: 1\nprovenance: {text}\n"):
        path.write_text(content)
        with raises_code("file_format", "evil.yaml", "python/"):
            Model.load(path)


CHANGES = [
    ("tau_dyn_model", 2), ("tau_dyn_model", None), ("robot", []), ("robot", "gantry_tau"), ("robot", {"actuated": 3}),
    ("robot", {"actuated": ["nobody"]}), ("robot", {"arguments": 3}), ("effects", {}), ("effects", [3]),
    ("effects", [{"effect": "magic"}]), ("effects", [{"effect": "torque_offset", "joints": ["nobody"]}]),
    ("effects", [{"effect": "torque_offset", "joints": 3}]), ("effects", [{"effect": "torque_offset", "joints": "elbow"}]),
    ("effects", [{"effect": ["torque_offset"]}]), ("effects", [{"effect": "reducer_coupling", "joints": ["elbow"]}]),
    ("untied", 3), ("untied", ["nobody.mx"]), ("untied", "upper_link.mx"), ("parameters", {}), ("parameters", [1]),
    ("parameters", []), ("urdf", 3), ("urdf", ""), ("urdf", "<robot/>"), ("urdf", "{broken"), ("provenance", 3),
    ("urdf", '<!DOCTYPE r [<!ENTITY a "b">]><robot name="r"><link name="&a;"/></robot>'),
]  # fmt: skip


@pytest.mark.parametrize("value", ["9" * 350, "-0x" + "f" * 300, "1.0e+999", ".nan"])
def test_a_value_beyond_all_floats_is_refused(saved, value: str) -> None:
    """However it is written, a value that no calculation can hold is said, with its parameter."""
    content = yaml.safe_load(saved.read_text())
    content["parameters"][0]["value"] = "HERE"
    saved.write_text(yaml.safe_dump(content).replace("value: HERE", f"value: {value}"))
    with raises_code("invalid_value", f"{content['parameters'][0]['name']}"):
        Model.load(saved)


@pytest.mark.parametrize(("key", "value"), CHANGES)
def test_a_wrong_entry_is_one_sentence(saved, key: str, value: object) -> None:
    """Whatever is edited into a model file, loading answers with a sentence, never with a traceback of ours."""
    content = yaml.safe_load(saved.read_text())
    content[key] = value
    saved.write_text(yaml.safe_dump(content))
    with pytest.raises(TauDynError) as fault:
        Model.load(saved)
    assert fault.value.exit_status == 2 and "\n" not in str(fault.value)


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [({"value": "heavy"}, "must be a number"), ({"value": float("nan")}, "finite number"),
     ({"value": True}, "must be a number"), ({"value": None}, "number"), ({"lower": 9.0, "upper": 1.0}, "above upper"),
     ({"lower": float("nan")}, "lower"), ({"name": "other.mass"}, "does not belong"), ({"name": 3}, "name"),
     ({"colour": "red"}, "only"), ({"free": "maybe"}, "free"), ({"unit": 3}, "unit")],
)  # fmt: skip
def test_a_wrong_parameter_is_one_sentence(saved, entry: dict, sentence: str) -> None:
    """The parameter is named."""
    content = yaml.safe_load(saved.read_text())
    content["parameters"][0].update(entry)
    saved.write_text(yaml.safe_dump(content))
    with pytest.raises(InputError) as fault:
        Model.load(saved)
    assert sentence in str(fault.value) and "\n" not in str(fault.value)


@pytest.mark.parametrize("content", ["", "[]", "3", "a: b", "{", "\x00", "a: &a [*a]", "a: 2026-13-41", "[" * 5000])
def test_other_files_are_not_models(tmp_path, content: str) -> None:
    """The first key says what a model file is."""
    path = tmp_path / "x.yaml"
    path.write_text(content)
    with raises_code("file_format", "x.yaml"):
        Model.load(path)
    with raises_code("file_not_found", "absent.yaml"):
        Model.load(tmp_path / "absent.yaml")


def test_files_appear_whole_or_not_at_all(tmp_path) -> None:
    """A write that fails halfway leaves the old file and no litter; a missing folder is a sentence."""
    path = tmp_path / "m.yaml"
    write_whole(path, "old")
    with pytest.raises(RuntimeError), write_atomically(path) as part:
        part.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with raises_code("cannot_write"):
        write_whole(tmp_path / "nowhere" / "m.yaml", "x")


TWO_ON_ONE_JOINT = (
    ("stribeck", {"speed": 0.031}, ""), ("stribeck", {"speed": 0.4}, "_b"), ("cyclic_ripple", {"period": 0.02}, ""),
    ("position_friction", {}, ""), ("load_friction", {}, ""), ("drive_gain", {}, ""),
)  # fmt: skip


def extended(name: str, *causes: tuple[str, dict[str, float], str], size: float = 0.02) -> Model:
    """Return a robot with causes on its first joint."""
    robot = load_robot(name)
    effects = [EFFECTS[c](robot.actuated[:1], robot.force_units[:1], label=label, **s) for c, s, label in causes]
    model = Model.of(robot, [*build_friction_model("asymmetric", robot.actuated, robot.force_units), *effects])
    return model.with_values({n: size * (k + 1) for k, n in enumerate(model.effect_parameters.names)})


@pytest.mark.parametrize("name", ["gantry_tau", "linear_axis"])
def test_an_extended_model_survives_its_file(name: str, rng, tmp_path) -> None:
    """Settings and labels come back, two instances of one effect stay apart, and forces are equal."""
    model = extended(name, *TWO_ON_ONE_JOINT)
    model.save(tmp_path / "m.yaml")
    back = Model.load(tmp_path / "m.yaml")
    assert [(e.name, e.settings, e.label) for e in back.effects] == [
        (e.name, e.settings, e.label) for e in model.effects
    ]
    assert list(back.parameters) == list(model.parameters)
    q = model.robot.home + rng.uniform(-0.1, 0.1, (6, model.robot.na))
    v, a = rng.standard_normal((2, *q.shape))
    assert_allclose(back.torque(q, v, a), model.torque(q, v, a), rtol=1e-12)


PAIRED = ("reducer_coupling", "torque_crosstalk")


@pytest.mark.parametrize("name", ["gantry_tau", "linear_axis"])
@pytest.mark.parametrize("cause", [name for name, cls in EFFECTS.items() if cls.cause and name not in PAIRED])
def test_forces_at_states_are_given_or_refused_by_name(name: str, cause: str) -> None:
    """A state determines the force, or one sentence names the effect and what is missing; nothing is silently zero."""
    model = extended(name, (cause, {}, ""))
    q = np.tile(model.robot.home, (6, 1))
    v, a = np.full_like(q, 0.2), np.full_like(q, 0.3)
    try:
        assert np.all(np.isfinite(model.torque(q, v, a)))
        assert cause in {e.name for e in model.steady().effects} | {
            "guideway_compliance",
            "guideway_nonparallel",
            "cart_tilt",
        }
    except InputError as fault:
        assert cause not in {e.name for e in model.steady().effects}
        assert str(fault).startswith(f"effect {cause} ") and "\n" not in str(fault)
    signals = {"temperature": q, "reversal": np.ones_like(q), "campaign": np.ones(6), "reported_force": 5.0 * v}
    along = model.torque(q, v, a, t=0.01 * np.arange(6), signals=signals)  # a recording has everything
    assert along.shape == q.shape and np.all(np.isfinite(along))
    assert_allclose(
        model.regressor(q, v, a, t=0.01 * np.arange(6), signals=signals) @ model.parameters.values, along, atol=1e-7
    )


def test_a_missing_signal_names_the_effect_that_feels_it(two_link) -> None:
    """A motion built without the model says which effect it is too poor for."""
    effect = EFFECTS["load_friction"](two_link.actuated, two_link.force_units)
    model = Model.of(two_link, [effect])
    motion = Motion.of(two_link.actuated, *np.ones((3, 2, 2)))
    for ask in (model.effect_force, model.columns):
        with raises_code("unsupported", "load_friction"):
            ask(motion)
