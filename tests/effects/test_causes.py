"""What every cause has in common: contract names, complete words, linearity, model files, dissipation, admissible settings."""

from __future__ import annotations

import json
from typing import Any, cast

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.effects import EFFECTS, NO_EXPERIMENT, CartShift, Effect, Motion, Scene, describe_ranges
from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters

CONTRACT = """
coulomb_asymmetry viscous_asymmetry stribeck load_friction position_friction thermal_drift passive_joint_friction quadratic_drag
torque_offset drive_gain cyclic_ripple delay backlash hysteresis transmission_error reducer_coupling pinion_scale
payload link_mass gravity_direction structural_compliance joint_compliance guideway_nonparallel guideway_not_straight
guideway_compliance cart_tilt rod_length joint_placement tool_frame gravity_sag clock_offset resolver_error outliers
timestamp_jitter friction_change
armature drive_lag viscous_curvature force_scale
directional_efficiency lugre static_friction torque_speed_limit cogging
back_emf inductance winding_heat supply_sag
joint_zero torque_saturation torque_crosstalk
""".split()
CAUSES = [name for name, cls in EFFECTS.items() if cls.cause]
JOINTS, UNITS, N = ("j1", "j2", "j3"), ("N", "N", "N m"), 400


@pytest.fixture
def motion(rng) -> Motion:
    """A smooth random motion of three joints with every signal that an effect may feel."""
    t = np.arange(N) * 1e-3
    f, phase = rng.uniform(0.5, 3, 3), rng.uniform(0, 6, 3)
    q, v, a = (
        0.3 * (2 * np.pi * f) ** k * np.sin(2 * np.pi * f * t[:, None] + phase + k * np.pi / 2) for k in range(3)
    )
    root = rng.standard_normal((N, 3, 3))
    signals = {
        "load": rng.standard_normal((N, 3)),
        "reducer_torque": rng.standard_normal((N, 3)),
        "passive": rng.standard_normal((N, 4, 3, 3)),
        "inertia": root @ root.transpose(0, 2, 1) + np.eye(3),
        "damping": rng.uniform(1, 3, (N, 3)),
        "weight_gradient": rng.standard_normal((N, 3, 3)),
        "rigid_force": np.cumsum(rng.standard_normal((N, 3)), axis=0),
        "force": np.cumsum(rng.standard_normal((N, 3)), axis=0),
        "temperature": 20 + np.cumsum(rng.uniform(0, 0.1, (N, 3)), axis=0),
        "reversal": np.abs(q),
        "cart_sensitivity": rng.standard_normal((N, 3, 3, 3)),
        "side_force": rng.standard_normal((N, 3, 3)),
        "guide_across": rng.standard_normal((N, 3, 2, 3)),
        "gravity_turn": rng.standard_normal((N, 3, 2)),
        "shifted_force": rng.standard_normal((N, 3, 3, 4)),
        "delivered_force": np.cumsum(rng.standard_normal((N, 3)), axis=0),
        "campaign": np.repeat((0.0, 1.0), N // 2),
        "reported_force": np.cumsum(rng.standard_normal((N, 3)), axis=0),
        "voltage": np.cumsum(rng.standard_normal((N, 3)), axis=0),
        "pwm": np.cumsum(rng.standard_normal((N, 3)), axis=0),
    }
    return Motion.of(JOINTS, q, v, a, t=t, signals=signals)


def scene(motion: Motion, *more: str, campaigns: int = 2) -> Scene:
    """Return what the motion offers."""
    q, v = motion.q, np.abs(motion.v)
    signals = frozenset((*motion.signals, *more))
    return Scene(
        JOINTS,
        UNITS,
        q.min(0),
        q.max(0),
        np.full(3, 0.01),
        v.max(0),
        60.0,
        100.0,
        signals,
        campaigns,
        coupled=((JOINTS[0], JOINTS[1]),),
        scales={joint: {"force": 1.0} for joint in JOINTS},
        ratios=dict.fromkeys(JOINTS, 15.0),
        limits=dict.fromkeys(JOINTS, (1.0, 2.0)),
    )


def instance(name: str, motion: Motion) -> Effect:
    """Return a cause on its first group of joints, with the middle one of its settings."""
    cls, about = EFFECTS[name], scene(motion)
    group = cls.groups(about)[0]
    grid = cls.grid(about, group)
    return cls(group, [UNITS[JOINTS.index(j)] for j in group], **cast("Any", grid[len(grid) // 2]))


def valued(effect: Effect, rng) -> Parameters:
    """Return random admissible values, with standard errors."""
    values = rng.uniform(1, 5, len(effect.parameters))
    return Parameters(
        effect.parameters.with_values(values).update({n: {"stderr": 0.1} for n in effect.parameters.names})
    )


@pytest.mark.parametrize("name", CAUSES)
def test_a_cause_says_all_that_a_person_needs(name: str) -> None:
    """Its name and the names of its doubles are the contract's; equation, source, revealing motion and range are there."""
    cls = EFFECTS[name]
    assert name in CONTRACT and name == cls.name
    assert cls.mistaken_for and set(cls.mistaken_for) <= set(CONTRACT) - {name}
    assert set(cls.equivalent) <= set(cls.mistaken_for)
    for words in (cls.equation, cls.reference, cls.reveals, describe_ranges(cls.plausible)):
        assert words and "\n" not in words
    assert set(cls.setting_units) <= set(cls.defaults)
    assert {*cls.positive, *cls.whole, *cls.refined} <= set(cls.defaults)


@pytest.mark.parametrize("name", CAUSES)
def test_columns_times_values_are_the_force(name: str, motion: Motion, rng) -> None:
    """A cause is linear in its amplitudes, each of its columns is its force at one, and other joints stay untouched."""
    effect = instance(name, motion)
    values, columns = valued(effect, rng), effect.columns(motion)
    assert columns.shape == (N, 3, len(values)) and np.all(np.isfinite(columns))
    assert_allclose(effect.force(motion, values), columns @ values.values)
    if isinstance(effect, CartShift):
        columns = effect.tool_columns(motion, np.zeros((N, 3, 3)))
    assert columns.any(axis=(0, 1)).all()


@pytest.mark.parametrize("name", CAUSES)
def test_a_cause_survives_its_model_file(name: str, make, tmp_path) -> None:
    """Settings, label and values come back from the file as they went in."""
    robot, cls = make.pair(), EFFECTS[name]
    settings = {
        key: 2 if key in cls.whole else 0.7 * x + 0.1
        for key, x in cls.defaults.items()
        if key not in ("displaced", "friction")
    }
    effect = cls(robot.actuated, robot.force_units, label="_b", **settings)
    model = Model.of(robot, [effect])
    model = model.with_values({p: 0.5 + k for k, p in enumerate(effect.parameters.names)})
    model.save(tmp_path / "m.yaml")
    again = Model.load(tmp_path / "m.yaml")
    assert again.effects[0].settings == effect.settings and again.effects[0].label == "_b"
    assert again.effect_parameters.names == effect.parameters.names
    assert all(p.endswith("_b") for p in effect.parameters.names)
    assert_allclose(again.effect_parameters.values, model.effect_parameters.values)


@pytest.mark.parametrize("name", CAUSES)
def test_its_words_carry_numbers_and_units(name: str, motion: Motion, rng) -> None:
    """`describe` gives one line with a number, and with a standard error where one is known."""
    effect = instance(name, motion)
    said = effect.describe(valued(effect, rng))
    assert "\n" not in said and any(c.isdigit() for c in said)
    assert "±" in said or name in ("position_friction", "cart_tilt")
    assert len(said) < 60 + 60 * len(effect.parameters)


@pytest.mark.parametrize(
    "name",
    [
        "stribeck",
        "load_friction",
        "quadratic_drag",
        "viscous_curvature",
        "passive_joint_friction",
        "reducer_coupling",
        "directional_efficiency",
        "static_friction",
    ],
)
def test_friction_never_drives(name: str, motion: Motion, rng) -> None:
    """With admissible amplitudes the actuators give power at every sample: friction takes energy and gives none."""
    effect = instance(name, motion)
    assert all(p.lower == 0 for p in effect.parameters)
    values = valued(effect, rng)
    if name == "reducer_coupling":  # its inertia stores energy
        values = values.with_values({values.names[0]: 0.0})
    power = np.sum(effect.force(motion, values) * motion.v, axis=1)
    assert power.min() >= 0 < power.max()


@pytest.mark.parametrize("name", CAUSES)
def test_settings_worth_trying_are_admissible_and_finite(name: str, motion: Motion) -> None:
    """Each point of the grid makes an effect; on a joint that stands still nothing is tried that needs a way."""
    cls, about = EFFECTS[name], scene(motion)
    for group in cls.groups(about):
        grid = cls.grid(about, group)
        assert 1 <= len(grid) <= 3000
        assert len({json.dumps(s, sort_keys=True) for s in grid}) == len(grid)
        for settings in grid[:: max(1, len(grid) // 5)]:
            effect = cls(group, [UNITS[JOINTS.index(j)] for j in group], **cast("Any", settings))
            assert np.all(np.isfinite(effect.columns(motion)))


@pytest.mark.parametrize("name", CAUSES)
def test_what_a_cause_needs_is_asked_for(name: str, motion: Motion) -> None:
    """Without one of its signals a cause says why and which experiment would help, none where the part is missing."""
    cls = EFFECTS[name]
    if cls.untestable(scene(motion)) is not None and name != "back_emf":  # forces alone never show it
        assert cls.untestable(scene(motion, "tool")) is None
    spared = {"side_force", "guide_across"}  # a mechanism that gives the one gives the other
    if name == "joint_compliance":
        spared.add("rigid_force")  # of one of its two settings
    for need in set(cls.needs) - spared:
        poor = Motion.of(JOINTS, motion.q, motion.v, motion.a, t=motion.t,
                         signals={k: x for k, x in motion.signals.items() if k != need})  # fmt: skip
        why = cls.untestable(scene(poor, campaigns=1))
        assert why is not None and why[1] == (NO_EXPERIMENT if need == "passive" else cls.reveals)


def test_settings_that_cannot_be_are_refused() -> None:
    """Unknown ones, zero lengths, half harmonics, a delay about nothing: one sentence each."""
    for name, settings, words in (
        ("stribeck", {"speed": 0.0}, "setting speed of effect stribeck must be above zero"),
        ("cyclic_ripple", {"harmonics": 1.5}, "whole number"),
        ("position_friction", {"degree": 0}, "whole number"),
        ("position_friction", {"width": 1.0}, "has no setting 'width'; it has middle, half, degree"),
        ("thermal_drift", {"lag": float("nan")}, "must be a finite number"),
        ("delay", {"about": 0.0}, "must not be zero"),
    ):
        with pytest.raises(InputError, match=words):
            EFFECTS[name](["j1"], ["N"], **cast("Any", settings))
    with raises_code("invalid_value", "0", "1"):
        _ = EFFECTS["hysteresis"](["j1"], ["N"], displaced=2).parameters
