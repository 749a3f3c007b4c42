"""Friction and other effects: laws on paper, exact equivalences, columns against forces, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.effects import EFFECTS, LazySignals, Motion, build_friction_model

JOINTS, UNITS = ("j1", "j2", "j3"), ("N", "N m", "N m")


@pytest.fixture
def motion(rng) -> Motion:
    """A random motion of three joints that also stands still once."""
    q, v, a = rng.standard_normal((3, 40, 3))
    v[7, 1] = 0.0
    return Motion.of(JOINTS, q, v, a)


def effect(name: str, joints: tuple[str, ...] = JOINTS):
    return EFFECTS[name](joints, [UNITS[JOINTS.index(j)] for j in joints])


def valued(name: str, rng, joints: tuple[str, ...] = JOINTS):
    """Return an effect and random positive values of its parameters."""
    one = effect(name, joints)
    return one, one.parameters.with_values(rng.uniform(1, 5, len(one.parameters)))


@pytest.mark.parametrize("name", ["symmetric_friction", "asymmetric_friction", "torque_offset", "reducer_coupling"])
def test_columns_times_parameters_are_the_force(motion, rng, name: str) -> None:
    """An effect is linear: its force is the sum of its columns, and one parameter's column is its force at one."""
    joints = JOINTS[:2] if name == "reducer_coupling" else JOINTS
    one, values = valued(name, rng, joints)
    columns = one.columns(motion)
    assert columns.shape == (40, 3, len(values))
    assert_allclose(one.force(motion, values), columns @ values.values)
    for k, parameter in enumerate(values):
        alone = one.parameters.with_values({parameter.name: 1.0})
        assert_allclose(one.force(motion, alone), columns[:, :, k], err_msg=parameter.name)


def test_friction_laws_on_paper(motion, rng) -> None:
    """`Fc sign(v) + Fv v`; with coefficients of its own in each direction, as contract 1 writes them."""
    one, values = valued("symmetric_friction", rng)
    fc, fv = (np.array([values[f"{j}.{k}"].value for j in JOINTS]) for k in ("coulomb", "viscous"))
    assert_allclose(one.force(motion, values), fc * np.sign(motion.v) + fv * motion.v)
    two, values = valued("asymmetric_friction", rng)
    cp, cn, vp, vn = (np.array([values[f"{j}.{k}"].value for j in JOINTS])
                      for k in ("coulomb_pos", "coulomb_neg", "viscous_pos", "viscous_neg"))  # fmt: skip
    v = motion.v
    expected = np.where(v > 0, cp + vp * v, -cn + vn * v)
    assert_allclose(two.force(motion, values)[v != 0], expected[v != 0])
    assert two.force(motion, values)[7, 1] == pytest.approx((cp[1] - cn[1]) / 2)  # between the two at standstill


def test_friction_opposes_motion(motion, rng) -> None:
    """With positive coefficients the actuator must give power: `tau_friction v > 0`."""
    for name in ("symmetric_friction", "asymmetric_friction"):
        one, values = valued(name, rng)
        power = one.force(motion, values) * motion.v
        assert np.all(power[motion.v != 0] > 0)


def test_asymmetric_friction_with_equal_coefficients_is_symmetric(motion) -> None:
    """The same numbers in both directions make the symmetric law exactly."""
    one, two = effect("symmetric_friction"), effect("asymmetric_friction")
    values = {j: (k + 1.0, 2 * k + 3.0) for k, j in enumerate(JOINTS)}
    named = {f"{j}.{n}": values[j][m] for j in JOINTS for m, n in enumerate(("coulomb", "viscous"))}
    symmetric = one.parameters.with_values(named)
    both = {f"{name}_{side}": x for name, x in named.items() for side in ("pos", "neg")}
    assert_allclose(two.force(motion, two.parameters.with_values(both)), one.force(motion, symmetric), rtol=1e-14)


def test_asymmetric_coulomb_friction_is_an_offset_exactly(motion) -> None:
    """`Fc_pos = Fc + offset`, `Fc_neg = Fc - offset`: the same forces, so no data tell them apart; columns as well."""
    symmetric, offset, asymmetric = effect("symmetric_friction"), effect("torque_offset"), effect("asymmetric_friction")
    fc, fo = 7.0, 2.5
    a = symmetric.parameters.with_values({f"{j}.coulomb": fc for j in JOINTS})
    b = offset.parameters.with_values({f"{j}.offset": fo for j in JOINTS})
    sides = {f"{j}.coulomb_pos": fc + fo for j in JOINTS} | {f"{j}.coulomb_neg": fc - fo for j in JOINTS}
    c = asymmetric.parameters.with_values(sides)
    assert_allclose(asymmetric.force(motion, c), symmetric.force(motion, a) + offset.force(motion, b), rtol=1e-14)
    smooth = Motion.of(JOINTS, motion.q, motion.v, motion.a, np.tanh(motion.v / 0.3))
    assert_allclose(asymmetric.force(smooth, c), symmetric.force(smooth, a) + offset.force(smooth, b), rtol=1e-13)
    stacked = np.concatenate([x.columns(motion) for x in (symmetric, offset, asymmetric)], axis=2).reshape(120, -1)
    assert np.linalg.matrix_rank(stacked) == 4 * len(JOINTS)  # of 7 columns a joint


def test_a_smoothed_sign_makes_friction_continuous(rng) -> None:
    """Neighbouring speeds around zero feel neighbouring forces; with the sharp sign they jump by both Coulomb forces."""
    one, values = valued("asymmetric_friction", rng)
    v = np.repeat(np.linspace(-1e-3, 1e-3, 401)[:, None], 3, axis=1)
    zero = np.zeros_like(v)
    smooth = one.force(Motion.of(JOINTS, zero, v, zero, np.clip(v / 1e-3, -1, 1)), values)
    sharp = one.force(Motion.of(JOINTS, zero, v, zero), values)
    assert np.abs(np.diff(smooth, axis=0)).max() < 0.06
    jump = [values[f"{j}.coulomb_pos"].value + values[f"{j}.coulomb_neg"].value for j in JOINTS]
    assert_allclose((sharp[201] - sharp[199]), jump, rtol=1e-3)
    assert_allclose(smooth[[0, -1]], sharp[[0, -1]])


def test_reducer_coupling_loads_both_joints_alike(motion, rng) -> None:
    """A shared motor that turns with the sum of two joints puts one force on both, whichever is named first."""
    one, values = valued("reducer_coupling", rng, ("j2", "j3"))
    force = one.force(motion, values)
    assert_allclose(force[:, 1], force[:, 2])
    assert not force[:, 0].any()
    inertia, viscous, coulomb = values.values
    v, a = motion.v[:, 1] + motion.v[:, 2], motion.a[:, 1] + motion.a[:, 2]
    assert_allclose(force[:, 1], inertia * a + viscous * v + coulomb * np.sign(v))
    other = effect("reducer_coupling", ("j3", "j2"))
    assert_allclose(other.force(motion, other.parameters.with_values(values.values)), force)
    ((speed, joints),) = one.other_speeds(motion)
    assert_allclose(speed, v)
    assert joints == [1, 2]


def test_effects_of_some_joints_leave_the_others_alone(motion, rng) -> None:
    """Columns stand with the joint of their name."""
    one, values = valued("symmetric_friction", rng, ("j3", "j1"))
    assert values.names == ("j3.coulomb", "j3.viscous", "j1.coulomb", "j1.viscous")
    force = one.force(motion, values)
    assert not force[:, 1].any()
    coulomb, viscous = values["j1.coulomb"].value, values["j1.viscous"].value
    assert_allclose(force[:, 0], coulomb * np.sign(motion.v[:, 0]) + viscous * motion.v[:, 0])


def test_units_follow_the_joint() -> None:
    """A slide's friction is in N and N/(m/s), a hinge's in N m and N m/(rad/s).

    Viscous friction and the sum of both Coulomb values are not negative.
    """
    p = effect("asymmetric_friction").parameters
    assert [p[f"j1.{k}"].unit for k in ("coulomb_pos", "viscous_neg")] == ["N", "N/(m/s)"]
    assert [p[f"j2.{k}"].unit for k in ("coulomb_pos", "viscous_neg")] == ["N m", "N m/(rad/s)"]
    assert all(x.lower == (-np.inf if "coulomb" in x.name else 0) for x in p)
    assert len(p.friction_sums) == len(JOINTS) and effect("torque_offset").parameters["j1.offset"].lower == -np.inf


def test_what_cannot_be_is_refused(motion) -> None:
    """Unknown models, joints that do not move here, a reducer with three joints: each is named."""
    with raises_code("unknown_name"):
        build_friction_model("stiction", JOINTS, UNITS)
    with raises_code("invalid_value", "j9", "j1", "j2", "j3"):
        EFFECTS["torque_offset"](["j9"], ["N"]).columns(motion)
    with raises_code("invalid_value", "3"):
        effect("reducer_coupling")
    assert build_friction_model("rigid", JOINTS, UNITS) == ()


def test_signals_that_no_effect_feels_are_never_computed(motion) -> None:
    """Load friction feels the load of its own joint; the mass matrix beside it costs nothing, though its name is known."""
    asked = []

    def make(name: str, x: np.ndarray) -> np.ndarray:
        asked.append(name)
        return x

    load = np.full((40, 3), 2.0)
    signals = LazySignals(
        {"load": lambda: make("load", load), "inertia": lambda: make("inertia", np.zeros((40, 3, 3)))}
    )
    lazy = Motion.of(JOINTS, motion.q, motion.v, motion.a, signals=signals)
    assert "inertia" in lazy.signals and not asked
    columns = effect("load_friction", ("j2",)).columns(lazy)
    assert_allclose(columns[:, 1, 0], 2.0 * np.sign(motion.v[:, 1]))
    assert set(asked) == {"load"} and len(asked) == 1
