"""Tries counted: what the best of many settings, joints and groups is worth under noise alone."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from tau_dyn.effects import Delay, PositionFriction, QuadraticDrag, ReducerCoupling, Stribeck, ThermalDrift
from tau_dyn.evidence.candidate_scan import (
    N_NULL_DRAWS,
    GroupTest,
    combine_group_tests,
    fit_group,
    list_joint_groups,
    scan_causes,
)
from tau_dyn.evidence.measurements import TRAIN, VALIDATION

CLEAN = 300


@pytest.fixture(scope="module")
def one(make):
    """A joint's null_model on a clean log, and clean residuals (R, CLEAN) on the same motion."""
    rng = np.random.default_rng(11)
    null_model = make.null_model(make.bench(rng, n=3000))
    return null_model, null_model.draw_null_residuals(CLEAN, rng)


def clean_fits(one, cls, rng):
    """Return the fit of a cause on each clean residual, each with its own noise draws."""
    null_model, clean = one
    found = []
    for e in clean.T:
        again = replace(null_model, e=e)
        found.append(fit_group(again, again.draw_null_residuals(N_NULL_DRAWS, rng), cls, ("x",)))
    return found


@pytest.mark.parametrize("kind", ["OneBump", "Bump", "ManyBumps"])
def test_p_values_of_clean_residuals_are_uniform(make, one, rng, kind):
    """The best of 1, 8 or 40 places in noise: its p-value is uniform, whatever the number of settings.

    Inflation is never below 1, so p may be a little too large, never too small.
    """
    p = [fit.p_value for fit in clean_fits(one, getattr(make, kind), rng)]
    assert stats.kstest(p, "uniform", alternative="greater").pvalue > 0.01
    assert stats.kstest(p, "uniform").statistic < 0.14
    assert np.mean(np.array(p) < 0.05) < 0.05 + 2.5 * np.sqrt(0.05 * 0.95 / CLEAN)


@pytest.mark.parametrize("cls", [Stribeck, QuadraticDrag])
def test_small_p_values_of_a_one_sided_cause_are_as_rare_as_they_say(one, rng, cls):
    """A peak and a drag have one sign: of clean residuals 5 % have p < 0.05 and 20 % p < 0.2, each within 2.6 sigma."""
    p = np.array([fit.p_value for fit in clean_fits(one, cls, rng)])
    for level in (0.05, 0.2):
        assert abs(np.mean(p < level) - level) < 2.6 * np.sqrt(level * (1 - level) / CLEAN)


def test_forms_with_few_and_many_columns_share_one_level(one, rng):
    """Friction of the place, parabola or fifth degree: the better of both is paid for, so p errs to the safe side."""
    p = np.array([fit.p_value for fit in clean_fits(one, PositionFriction, rng)])
    for level in (0.05, 0.2):
        assert level / 4 < np.mean(p < level) < level + 2 * np.sqrt(level * (1 - level) / CLEAN)


def test_multiplicity_grows_with_the_grid(make, one, rng):
    """One place is one try; 8 and 40 places that do not overlap are about as many; a smooth grid is far fewer."""
    null_model, _ = one
    draws = null_model.draw_null_residuals(600, rng)
    single, some, many = (
        fit_group(null_model, draws, cls, ("x",)).n_effective_tests for cls in (make.OneBump, make.Bump, make.ManyBumps)
    )
    drag = fit_group(null_model, draws, QuadraticDrag, ("x",)).n_effective_tests
    assert_allclose([single, drag], 1.0, atol=0.15)
    assert_allclose(some, 8, rtol=0.15)
    assert_allclose(many, 40, rtol=0.2)
    smooth = fit_group(null_model, draws, Stribeck, ("x",))
    assert 1.0 <= smooth.n_effective_tests < 0.8 * len(Stribeck.grid(null_model.channel.scene, ("x",)))


def test_the_best_setting_is_the_hidden_one(make, rng):
    """Of 40 places the one with a force is taken, T is exact there, and its neighbours in the grid are named."""
    place = make.ManyBumps.grid(make.bench(np.random.default_rng(5)).scene, ("x",))[11]
    effect = make.ManyBumps(("x",), ("N",), **place)
    channel = make.bench(np.random.default_rng(5), lambda m: 4 * effect.columns(m)[:, :, 0])
    null_model = make.null_model(channel)
    fit = fit_group(null_model, null_model.draw_null_residuals(N_NULL_DRAWS, rng), make.ManyBumps, ("x",))
    assert fit.effect.settings == effect.settings
    C = null_model.whiten_columns(channel.columns(effect))
    assert_allclose(fit.statistic, (C[:, 0] @ null_model.e) ** 2 / null_model.gram(C)[0, 0], rtol=1e-9)
    assert fit.p_value < 1e-6
    grid = make.ManyBumps.grid(channel.scene, ("x",))
    assert fit.neighbours == (grid[10], grid[12])


def test_held_out_logs_are_not_looked_at_while_causes_are_tried(make, rng, monkeypatch):
    """Columns of the second log, which holds no training sample, are made for none of 40 places; asked for, they are there."""
    motions = [make.moving(rng, ("x",), n) for n in (4000, 2000)]
    channel = make.bench(rng, motions=motions, parts=lambda n: np.full(n, TRAIN if n == 4000 else VALIDATION))
    plain, made = type(channel).run_columns, []
    monkeypatch.setattr(
        type(channel), "run_columns", lambda self, effect, run: made.append(run) or plain(self, effect, run)
    )
    null_model = make.null_model(channel)
    fit = fit_group(null_model, null_model.draw_null_residuals(N_NULL_DRAWS, rng), make.ManyBumps, ("x",))
    assert set(made) == {0} and len(made) == 40
    assert [len(c) for c in null_model.library.columns(fit.effect)] == [4000, 2000]
    assert made.count(1) == 1


def test_scatter_that_the_noise_model_misses_inflates(make, rng):
    """An effect that comes and goes block by block is worth less than its T: inflation above 1.5; with white noise about 1."""
    channel = make.bench(rng, n=8000)
    null_model = make.null_model(channel)
    drag = QuadraticDrag
    steady = null_model.project_out(null_model.whiten_columns(channel.columns(drag(("x",), ("N",)))))[:, 0]
    blocks = len(np.unique(null_model.whiten.block))
    fickle = rng.standard_normal(null_model.whiten.block.max() + 1)[null_model.whiten.block] * steady
    fickle *= 2 * np.sqrt(blocks) / np.linalg.norm(steady)
    found = []
    for extra in (0.0, fickle):
        e = null_model.draw_null_residuals(1, rng)[:, 0] + 8 * steady / np.linalg.norm(steady) + extra
        fit = fit_group(replace(null_model, e=e), null_model.draw_null_residuals(N_NULL_DRAWS, rng), drag, ("x",))
        found.append(fit)
    assert found[0].overdispersion < 1.3 and found[1].overdispersion > 1.5
    assert found[1].p_value > stats.chi2.sf(found[1].statistic, 1)


def three(make, rng, size):
    """Return three joints' null_model, each with a bump of this size at the third of eight places."""
    joints = ("x", "y", "z")
    plain = make.bench(np.random.default_rng(2), joints=joints, n=2000)
    force = 0.0
    for j in joints:
        effect = make.Bump((j,), ("N",), **make.Bump.grid(plain.scene, (j,))[2])
        force = force + size * effect.columns(plain.motions[0])[:, :, 0]
    return make.null_model(make.bench(rng, lambda m: force, motions=plain.motions))


def test_joints_together_show_what_none_shows_alone(make, rng):
    """The same weak effect in three joints: p of all together is mostly below a tenth of the best one's alone."""
    ratio = []
    for _ in range(8):
        null_model = three(make, rng, 1.8)
        (found,) = scan_causes(null_model, null_model.draw_null_residuals(N_NULL_DRAWS, rng), [make.Bump], set())
        ratio.append(min(1.0, 3 * min(f.p_value for f in found.tested)) / found.p_value)
    assert np.median(ratio) > 10


def test_together_or_alone_stays_at_its_level(make, rng):
    """Of clean residuals on three joints 5 % and 2.5 sigma at most have p < 0.05: the better of two is paid for."""
    null_model = three(make, rng, 0.0)
    p = []
    for e in null_model.draw_null_residuals(120, rng).T:
        again = replace(null_model, e=e)
        p.append(scan_causes(again, again.draw_null_residuals(N_NULL_DRAWS, rng), [make.Bump], set())[0].p_value)
    assert np.mean(np.array(p) < 0.5) > 0.15
    assert np.mean(np.array(p) < 0.05) < 0.05 + 2.5 * np.sqrt(0.05 * 0.95 / 120)


def test_a_weak_joint_waits_for_the_next_round(make, rng):
    """A joint with a twentieth of the strongest one's evidence does not join at once; strong ones do, strongest first."""
    null_model = three(make, rng, 12.0)
    (found,) = scan_causes(null_model, null_model.draw_null_residuals(N_NULL_DRAWS, rng), [make.Bump], set())
    assert len(found.fits) == 3
    assert [f.penalised_statistic for f in found.fits] == sorted(
        (f.penalised_statistic for f in found.fits), reverse=True
    )
    strong, *others = found.fits
    weak = replace(others[0], statistic=0.05 * strong.statistic)
    assert weak.statistic > weak.threshold  # strong enough to be seen, were it alone
    assert [f.effect.joints for f in combine_group_tests("bump", [strong, weak]).fits] == [strong.effect.joints]


def test_one_delay_for_all_drives_competes_with_one_for_each(make, rng):
    """Overlapping groups never act at once: all together where they agree, each alone where that explains much more."""
    null_model = three(make, rng, 6.0)
    fits = scan_causes(null_model, null_model.draw_null_residuals(N_NULL_DRAWS, rng), [make.Bump], set())[0].tested
    whole = replace(
        fits[0], effect=make.Bump(("x", "y", "z"), ("N",) * 3), statistic=1.05 * sum(f.statistic for f in fits)
    )
    assert [len(f.effect.joints) for f in combine_group_tests("bump", [whole, *fits]).fits] == [3]
    poor = replace(whole, statistic=1.1 * max(f.statistic for f in fits))
    assert sorted(f.effect.joints for f in combine_group_tests("bump", [poor, *fits]).fits) == [("x",), ("y",), ("z",)]


def test_groups_that_are_covered_are_not_tried_again(make, rng):
    """What acts on all joints of a group is not tried there; a pair may share a joint with another pair."""
    channel = make.bench(rng, joints=("x", "y", "z"), n=500)
    pairs = (("x", "y"), ("x", "z"), ("y", "z"))
    channel = replace(channel, scene=replace(channel.scene, signals=frozenset({"force"}), coupled=pairs))
    everyone = ("x", "y", "z")
    assert list_joint_groups(channel, Delay, set()) == [everyone, ("x",), ("y",), ("z",)]
    assert list_joint_groups(channel, Delay, {("delay", everyone)}) == []
    assert list_joint_groups(channel, Delay, {("delay", ("x",))}) == [everyone, ("y",), ("z",)]
    assert list_joint_groups(channel, Delay, {("stribeck", everyone)}) == list_joint_groups(channel, Delay, set())
    assert list_joint_groups(channel, ReducerCoupling, {("reducer_coupling", ("x", "y"))}) == [("x", "z"), ("y", "z")]


def test_what_the_motion_cannot_show_is_not_tried(make, rng):
    """Without a temperature thermal drift has no groups; a joint that never left its slow speeds has no Stribeck grid."""
    channel = make.bench(rng, n=500)
    null_model = make.null_model(channel)
    assert list_joint_groups(channel, ThermalDrift, set()) == []

    still = replace(channel, scene=replace(channel.scene, fast=channel.scene.slow))
    null_model = make.null_model(still)
    assert fit_group(null_model, null_model.draw_null_residuals(4, rng), Stribeck, ("x",)) is None
    assert scan_causes(null_model, null_model.draw_null_residuals(4, rng), [ThermalDrift, Stribeck], set()) == []


def test_joints_that_are_late_alike_have_one_delay(one):
    """One delay that explains what three do is one delay, though chance gives each joint's scatter another inflation."""
    joints, units = ("x", "y", "z"), ("N", "N", "N")
    whole = GroupTest(Delay(joints, units), 505.0, 1.4, 1, False, 1.5, np.ones(N_NULL_DRAWS))
    alone = [
        GroupTest(Delay((j,), ("N",)), T, 1.4, 1, False, inflation, np.ones(N_NULL_DRAWS))
        for j, T, inflation in (("x", 189.0, 1.0), ("y", 87.0, 1.3), ("z", 233.0, 1.2))
    ]
    assert [fit.effect.joints for fit in combine_group_tests("delay", [whole, *alone]).fits] == [joints]
    apart = replace(whole, statistic=440.0)  # 69 less than three delays explain: they are not alike
    assert len(combine_group_tests("delay", [apart, *alone]).fits) == 3


def test_a_cause_on_many_joints_is_tried_on_each_of_them(one, rng):
    """One joint of five stands out at 1e-4, the others show nothing: five tries alone, and their sum as another, make it 1e-3."""
    fit = clean_fits(one, QuadraticDrag, rng)[0]
    (alone,) = (replace(fit, n_effective_tests=1.0, overdispersion=1.0, one_sided=False, dof=1) for _ in range(1))
    strong = replace(alone, statistic=float(stats.chi2.isf(1e-4, 1)))
    weak = replace(alone, statistic=0.0)
    found = combine_group_tests("quadratic_drag", [strong, weak, weak, weak, weak])
    assert found.p_value == pytest.approx(2 * (1 - (1 - 1e-4) ** 5), rel=1e-6)
    assert combine_group_tests("quadratic_drag", [strong]).p_value == pytest.approx(1e-4, rel=1e-6)
