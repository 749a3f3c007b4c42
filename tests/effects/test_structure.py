"""A structure that yields as a whole: its matrices' names and units, whose force moves whose load, and what it costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.effects import EFFECTS, Motion, Scene, StructuralCompliance

JOINTS, UNITS, N, DT = ("a", "b"), ("N", "N m"), 600, 1e-3
M = np.array([[3.0, 1.0], [1.0, 2.0]])
D = np.array([5.0, 7.0])


@pytest.fixture
def motion() -> Motion:
    """Two joints at 1 kHz under forces that change, with a mass matrix that couples them."""
    t = DT * np.arange(N)
    F = np.column_stack([np.sin(9 * t), np.cos(14 * t)])
    signals = {"rigid_force": F, "inertia": np.broadcast_to(M, (N, 2, 2)), "damping": np.tile(D, (N, 1)),
               "weight_gradient": np.zeros((N, 2, 2))}  # fmt: skip
    return Motion.of(JOINTS, *np.zeros((3, N, 2)), t=t, signals=signals)


def structure(joints: tuple[str, ...] = JOINTS, **settings: float) -> StructuralCompliance:
    """Return the effect on all joints, coupled unless said otherwise."""
    units = [dict(zip(JOINTS, UNITS, strict=True))[joint] for joint in joints]
    return StructuralCompliance(joints, units, **{"coupled": 1, **settings})  # type: ignore[arg-type]


def test_entries_are_named_after_the_load_that_moves_and_the_force_that_moves_it() -> None:
    """On the diagonal a joint alone; beside it load+force, with the length or angle of the one per force of the other."""
    names = structure(reciprocal=0).parameters.names
    assert names == tuple(f"{owner}.structural_compliance" for owner in ("a", "a+b", "b+a", "b"))
    assert [p.unit for p in structure(reciprocal=0).parameters] == ["m/N", "m/(N m)", "rad/N", "rad/(N m)"]
    assert structure().parameters.names == tuple(f"{owner}.structural_compliance" for owner in ("a", "a+b", "b"))
    ends = [name.rsplit("compliance", 1)[1] for name in structure(modes=2, rest=1).parameters.names]
    assert ends == [""] * 3 + ["_2"] * 3 + ["_rest"] * 3
    assert all(p.lower == -np.inf for p in structure().parameters)  # bounded as a whole, or not


def test_a_structure_of_one_joint_is_that_joints_spring(motion) -> None:
    """Nothing to couple: the plain effect, whatever the setting says; several joints uncoupled are so many springs."""
    one = structure(("a",))
    assert one.parameters.names == ("a.structural_compliance",) and one.parameters["a.structural_compliance"].lower == 0
    assert_allclose(one.columns(motion), structure(("a",), coupled=0).columns(motion))
    both = structure(coupled=0)
    assert both.parameters.names == ("a.structural_compliance", "b.structural_compliance")
    assert_allclose(both.columns(motion)[:, :, 0], one.columns(motion)[:, :, 0])


def test_a_force_moves_the_loads_that_its_entries_name(motion) -> None:
    """`encoder - load = C d`: with C of four entries, each column is one force's answer at one load."""
    alone = structure(coupled=0).displacement(motion)
    answers = [alone[:, k, k] for k in range(2)]
    full = structure(reciprocal=0).displacement(motion)
    C = np.array([1.0, 2.0, 3.0, 4.0])
    expected = np.column_stack(answers) @ C.reshape(2, 2).T
    assert_allclose(full @ C, expected, rtol=1e-12)
    assert_allclose(structure().displacement(motion) @ [1.0, 2.0, 4.0], np.column_stack(answers) @ [[1, 2], [2, 4]])


def test_a_structures_force_is_its_loads_inertia_without_their_friction(motion) -> None:
    """`tau = -M d''`, d'' by differences: guideways rub before what yields; a drive's spring takes its friction along."""
    effect = structure()
    d = effect.displacement(motion)
    second = (d[2:] - 2 * d[1:-1] + d[:-2]) / DT**2
    expected = -np.einsum("ij,njp->nip", M, second)
    found = effect.columns(motion)[1:-1]
    assert_allclose(found[10:-10], expected[10:-10], atol=0.01 * np.abs(expected).max())
    still = replace(motion, signals={**motion.signals, "damping": np.zeros((N, 2))})
    assert_allclose(effect.columns(motion), effect.columns(still))
    springs = structure(coupled=0)
    speed = np.gradient(springs.displacement(motion), DT, axis=0)
    rubbed = springs.columns(motion) - springs.columns(still)
    assert_allclose(rubbed[10:-10], (-D[:, None] * speed)[10:-10], atol=0.01 * np.abs(rubbed).max())


def test_what_modes_above_the_band_do_they_do_at_once(motion) -> None:
    """The rest's columns are the forces themselves, after those of the modes."""
    F = motion.signals["rigid_force"]
    d = structure(rest=1).displacement(motion)
    assert d.shape == (N, 2, 6)
    assert_allclose(d[:, :, 3:] @ [1.0, 2.0, 4.0], F @ [[1, 2], [2, 4]], rtol=1e-12)


def test_a_resonance_is_told_by_the_joint_that_yields_most() -> None:
    """Of each mode's diagonal the largest, whatever its sign; what does not swing is not spoken of."""
    effect = structure(modes=2, rest=1, frequency=7.4, damping=0.01, frequency_2=11.5, damping_2=0.02)
    values = [1e-7, 9e-6, 3e-7, -5e-7, 9e-6, 2e-7, 9e-6, 9e-6, 9e-6]
    said = effect.describe(effect.parameters.with_values(dict(zip(effect.parameters.names, values, strict=True))))
    assert said == (
        "the structure yields and rings, all of it together: a resonance at 7.4 Hz, damping 1 %; b by 300 nrad/(N m); a "
        "resonance at 11.5 Hz, damping 2 %; a by -500 nm/N"
    )


@pytest.mark.parametrize("coupled", [0, 1])
def test_a_mode_within_the_clear_band_answers_to_the_whole_force(motion, coupled: int) -> None:
    """Up to the frequency where motion is clear, the force as it is; from there on only its clear part."""
    wide = {"wide_force": 2 * motion.signals["rigid_force"], "clear_hz": np.full(N, 8.0)}
    both = replace(motion, signals={**motion.signals, **wide})
    for frequency, factor in ((7.9, 2.0), (8.0, 1.0), (9.0, 1.0)):
        effect = structure(coupled=coupled, frequency=frequency)
        assert_allclose(effect.displacement(both), factor * effect.displacement(motion))


def test_at_most_three_modes_and_each_is_refined() -> None:
    """Frequency and damping of those that count; a fourth mode is refused."""
    assert structure().refined == ("frequency", "damping")
    assert structure(modes=3).refined[-2:] == ("frequency_3", "damping_3") and len(structure(modes=3).refined) == 6
    with raises_code("invalid_value", "structural_compliance", "3", "4"):
        structure(modes=4)


def scene(cutoff_hz: float, *resonances: tuple[float, float], signals: frozenset[str] = frozenset()) -> Scene:
    """Return what two moving joints offer."""
    one = np.ones(2)
    return Scene(
        JOINTS, UNITS, -one, one, 0.1 * one, one, cutoff_hz, 60.0, signals, resonances=resonances, structure=True
    )


def test_frequencies_are_tried_in_steps_that_a_refinement_bridges() -> None:
    """From 3 Hz to 2.5 times what is seen, at most 15 % apart, with little and with much damping; none for still poses."""
    grid = StructuralCompliance.grid(scene(20.0), ("a",))
    for damping in (0.03, 0.1):
        f = np.array([s["frequency"] for s in grid if s["damping"] == damping])
        assert_allclose([f[0], f[-1]], [3.0, 50.0])
        assert np.all(f[1:] / f[:-1] < 1.17) and len(f) < 30
    assert len(grid) == 2 * len(f)
    assert StructuralCompliance.grid(scene(1.0), ("a",)) == [] == StructuralCompliance.grid(scene(np.inf), ("a",))


def test_a_structure_is_tried_at_what_is_proposed_and_a_little_beside() -> None:
    """Each mode alone and the first two together, 3 % lower, as proposed, 3 % higher; at most three modes of four."""
    modes = ((7.4, 0.01), (11.5, 0.02), (19.0, 0.03), (23.0, 0.04))
    grid = StructuralCompliance.grid(scene(30.0, *modes), JOINTS)
    alone = [s for s in grid if s["modes"] == 1]
    expected = [share * f for f, _ in modes[:3] for share in (0.97, 1.0, 1.03)]
    assert_allclose([s["frequency"] for s in alone], expected)
    assert [s["damping"] for s in alone[::3]] == [0.01, 0.02, 0.03]
    three = [s for s in grid if s["modes"] == 3]
    assert_allclose([three[2][f"frequency{end}"] for end in ("", "_2", "_3")], [1.03 * f for f, _ in modes[:3]])
    assert {s["modes"] for s in grid} == {1, 2, 3} and len(grid) == 15
    assert all((s["coupled"], s["rest"], s["reciprocal"]) == (1, 1, 1) for s in grid)
    tool = scene(30.0, *modes, signals=frozenset({"tool"}))
    assert all(s["reciprocal"] == 0 for s in StructuralCompliance.grid(tool, JOINTS))
    assert StructuralCompliance.proposal(scene(30.0, *modes), JOINTS) == three[1]
    assert StructuralCompliance.proposal(scene(30.0, *modes[:1]), ("a",)) == {
        "modes": 1,
        "frequency": 7.4,
        "damping": 0.01,
    }


def test_joints_are_tried_alone_unless_modes_are_the_structures() -> None:
    """One group of all joints where no single one explains them, else each joint by itself."""
    whole = scene(30.0, (7.4, 0.01))
    assert StructuralCompliance.groups(whole) == [JOINTS]
    assert StructuralCompliance.groups(replace(whole, structure=False)) == [("a",), ("b",)]
    assert EFFECTS["structural_compliance"] is StructuralCompliance
