"""What would have been seen, and what could not: detection limits held against draws, and absorbed causes said to be so."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from tau_dyn.effects import (
    CoulombAsymmetry,
    FrictionChange,
    PinionScale,
    QuadraticDrag,
    Stribeck,
    ThermalDrift,
    ViscousAsymmetry,
)
from tau_dyn.evidence.candidate_scan import FAMILY_LEVEL, N_NULL_DRAWS, scan_causes
from tau_dyn.evidence.detection_limits import compute_detection_limits, select_median_setting, solve_noncentrality
from tau_dyn.evidence.stepwise_selection import StepwiseSelection, adjust_p_value_bonferroni


def searched(make, channel, rng) -> StepwiseSelection:
    """Return a search that found nothing."""
    null_model = make.null_model(channel)
    last = tuple(scan_causes(null_model, null_model.draw_null_residuals(N_NULL_DRAWS, rng), channel.causes, set()))
    return StepwiseSelection((), null_model, last)


@pytest.mark.parametrize("dof", [1, 2, 5])
def test_at_the_noncentrality_the_power_is_what_was_asked_for(rng, dof):
    """Of chi-square draws with it 95 % exceed the critical value of the level; with none of it, the level's share."""
    level = 1e-3
    strength = solve_noncentrality(level, dof)
    critical = stats.chi2.isf(level, dof)
    draws = rng.noncentral_chisquare(dof, strength, 20000)
    assert_allclose(np.mean(draws > critical), 0.95, atol=4 * np.sqrt(0.05 * 0.95 / 20000))
    assert solve_noncentrality(level, dof, 0.99) > strength > solve_noncentrality(level, dof, 0.5)
    assert solve_noncentrality(level / 100, dof) > strength


@pytest.mark.parametrize("name", ["viscous_asymmetry", "quadratic_drag", "stribeck", "bump"])
def test_an_effect_at_its_limit_is_found_in_95_of_100_draws(make, rng, name):
    """Put at the limit's amplitude into noise on the same rows, a cause passes the family-wise level 95 times in 100.

    Inflation costs some, a neighbouring setting that fits by chance adds some: 88 to 99 of 100 are taken.
    """
    causes = (ViscousAsymmetry, QuadraticDrag, Stribeck, make.Bump)
    channel = make.bench(rng, causes=causes)
    search = searched(make, channel, rng)
    limits, untestable = compute_detection_limits(search, ())
    assert untestable == () and [x.cause for x in limits] == [cls.name for cls in causes]
    limit = next(x for x in limits if x.cause == name)
    cls = next(cls for cls in causes if cls.name == name)
    effect = select_median_setting(channel, cls(("x",), ("N",)))
    force = search.null_model.project_out(search.null_model.whiten_columns(channel.columns(effect)))[:, 0]
    found = []
    for noise in search.null_model.draw_null_residuals(120, rng).T:
        null_model = replace(search.null_model, e=noise + limit.amplitude * force)
        (candidate,) = scan_causes(null_model, null_model.draw_null_residuals(N_NULL_DRAWS, rng), [cls], set())
        found.append(adjust_p_value_bonferroni(candidate, search.last) < FAMILY_LEVEL)
    assert 0.88 < np.mean(found) < 0.995


def test_half_the_noise_halves_the_limit(make):
    """A limit is in the cause's unit: with half the noise, half as much is seen."""
    amplitudes = []
    for noise in (1.0, 0.5):
        rng = np.random.default_rng(4)
        channel = make.bench(rng, noise=noise, causes=(ViscousAsymmetry,))
        (limit,), _ = compute_detection_limits(searched(make, channel, rng), ())
        amplitudes.append(limit.amplitude)
    assert_allclose(amplitudes[1], amplitudes[0] / 2, rtol=0.05)
    assert limit.unit == "N/(m/s)" and "viscous asymmetry of" in limit.phrase and "at x" in limit.phrase


def test_blocks_that_scatter_raise_the_limit(make, rng):
    """Where blocks scatter nine times as much as the noise model says, three times the amplitude is needed to be seen."""
    channel = make.bench(rng, causes=(ViscousAsymmetry,))
    search = searched(make, channel, rng)
    (candidate,) = search.last
    fits = tuple(replace(fit, overdispersion=9.0) for fit in candidate.tested)
    loud = replace(search, last=(replace(candidate, fits=fits, tested=fits),))
    (plain,), (limit,) = (compute_detection_limits(x, ())[0] for x in (search, loud))
    assert_allclose(limit.amplitude, 3 * plain.amplitude, rtol=1e-6)


def test_the_limit_is_that_of_the_joint_where_it_is_hardest_to_see(make, rng):
    """A joint that moves a third as much shows less of a drag: its limit is the one that is said."""
    motion = make.moving(rng, ("brisk", "lazy"), 4000)
    for array in (motion.q, motion.v, motion.a):
        array[:, 1] /= 3
    channel = make.bench(rng, motions=[motion], causes=(QuadraticDrag,))
    (limit,), _ = compute_detection_limits(searched(make, channel, rng), ())
    assert "at lazy" in limit.phrase


def test_a_cause_with_a_name_has_no_limit(make, rng):
    """What was found is not listed as what would have been."""
    channel = make.bench(rng, causes=(ViscousAsymmetry, QuadraticDrag))
    limits, _ = compute_detection_limits(searched(make, channel, rng), ["viscous_asymmetry"])
    assert [x.cause for x in limits] == ["quadratic_drag"]


class Twin(ViscousAsymmetry):
    """A force that the baseline has already."""

    name = "twin"

    def per_joint(self, joint):
        """Return friction's own sign."""
        return [joint.sign]


class Cousin(ViscousAsymmetry):
    """A force that the baseline takes nearly all of."""

    name = "cousin"

    def per_joint(self, joint):
        """Return friction's own sign, and a little else."""
        return [joint.sign + 0.003 * np.abs(joint.v)]


def test_what_the_baseline_has_under_another_name_is_neither_seen_nor_missed(make, rng):
    """Coulomb friction once more is part of the model: no limit, and nothing to complain about."""
    channel = make.bench(rng, causes=(Twin,))
    assert compute_detection_limits(searched(make, channel, rng), ()) == ((), ())


def test_absorbed_causes_are_untestable_and_say_why(make, rng):
    """What the refit takes up, what needs a thermometer or a second log, and what the motion does not cover: never a limit."""
    causes = (Cousin, ThermalDrift, FrictionChange, PinionScale, Stribeck)
    channel = make.bench(rng, causes=causes)
    channel = replace(channel, scene=replace(channel.scene, fast=channel.scene.slow))
    limits, untestable = compute_detection_limits(searched(make, channel, rng), ())
    assert limits == ()
    why = {u.cause: u.why for u in untestable}
    assert "absorbs" in why["cousin"]
    assert "temperature" in why["thermal_drift"]
    assert "only one training log" in why["friction_change"]
    assert "absorbs" in why["pinion_scale"]
    assert "no setting" in why["stribeck"]
    assert all(u.experiment for u in untestable)


def test_without_reversals_what_the_refit_takes_is_missed(make, rng):
    """Always forward, a constant is Coulomb friction itself: an asymmetry is untestable, not part of the model."""
    motion = make.moving(rng, ("x",), 3000)
    motion.v[:] = 0.5 + 0.1 * motion.v
    motion.sign[:] = 1.0
    channel = make.bench(rng, motions=[motion], causes=(CoulombAsymmetry, ViscousAsymmetry))
    limits, untestable = compute_detection_limits(searched(make, channel, rng), ())
    assert limits == () and [u.cause for u in untestable] == ["coulomb_asymmetry", "viscous_asymmetry"]


def test_a_limit_of_half_of_what_was_measured_is_none(make):
    """A few seconds of data that are mostly noise: what would be seen is as large as all that was measured, so nothing is."""
    for noise, n, known in ((1.0, 1500, True), (300.0, 260, False)):
        rng = np.random.default_rng(6)
        channel = make.bench(rng, n=n, noise=noise, causes=(Stribeck,))
        limits, untestable = compute_detection_limits(searched(make, channel, rng), ())
        assert bool(limits) == known and bool(untestable) != known


def test_a_grid_whose_laws_have_settings_of_their_own_has_a_middle():
    """Plain modes at 5, 7 and 9 Hz before one proposed with a number of modes: the middle is 7 Hz."""

    class Modes:
        refined = ("frequency",)
        joints = ("axis",)

        @classmethod
        def grid(cls, scene, joints):
            return [{"frequency": 5.0}, {"frequency": 7.0}, {"frequency": 9.0}, {"frequency": 6.0, "modes": 2.0}]

        def with_settings(self, **settings):
            return settings

    assert select_median_setting(cast(Any, SimpleNamespace(scene=None)), cast(Any, Modes())) == {"frequency": 7.0}
