"""Which of several laws that explain the same is named, and that a name is not lost to smooth functions that explain no more."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest

from tau_dyn.effects import (
    CyclicRipple,
    Motion,
    PlausibleRange,
    PositionFriction,
    QuadraticDrag,
    Stribeck,
    TransmissionError,
    ViscousAsymmetry,
    ViscousCurvature,
)
from tau_dyn.evidence.candidate_scan import CandidateCause, GroupTest, rescore_group
from tau_dyn.evidence.channel import ColumnCache, build_scene
from tau_dyn.evidence.measurements import TRAIN
from tau_dyn.evidence.null_model import NullModel, fit_noise_models
from tau_dyn.evidence.settings import SEARCH_MARGIN
from tau_dyn.evidence.stepwise_selection import SelectedCause, select_causes


@pytest.mark.parametrize("seed", [1, 6])
def test_laws_that_explain_the_same_are_told_by_their_freedom(make, seed):
    """A drag that varies from block to block scatters more than a Stribeck peak that explains no more: it keeps its name."""
    rng = np.random.default_rng(seed)

    def hidden(motion):
        n = len(motion.t)
        size = np.repeat(1 + 0.6 * rng.standard_normal(n // 100 + 1), 100)[:n]
        return 60 * size[:, None] * motion.v * np.abs(motion.v)

    channel = make.bench(rng, hidden, n=6000, causes=(Stribeck, QuadraticDrag))
    (found,) = select_causes(channel, np.random.default_rng(1), lambda step: None).found
    assert found.candidate.cause == "quadratic_drag"
    assert found.rivals == ("stribeck",)


def causes(found):
    """Return what was found, and on which joints."""
    return {(one.candidate.cause, *effect.joints) for one in found for effect in one.candidate.effects}


@pytest.mark.parametrize("seed", range(3))
def test_each_joint_goes_to_the_law_that_explains_it(make, seed):
    """Drag on one joint beside a Stribeck peak on the other: a wide Stribeck peak would explain both, and is not given both."""
    rng = np.random.default_rng(seed)
    peak = Stribeck(("one",), ("N",), speed=0.08)

    def hidden(motion):
        drag = np.stack([np.zeros(len(motion.t)), 80 * motion.v[:, 1] * np.abs(motion.v[:, 1])], axis=1)
        return 20 * peak.columns(motion)[:, :, 0] + drag

    channel = make.bench(rng, hidden, joints=("one", "two"), n=6000, causes=(Stribeck, QuadraticDrag))
    found = select_causes(channel, np.random.default_rng(1), lambda step: None).found
    assert causes(found) == {("stribeck", "one"), ("quadratic_drag", "two")}


@pytest.mark.parametrize("seed", range(1, 5))
def test_a_twin_on_one_of_two_joints_is_listed(make, seed):
    """Stribeck friction on one joint, and on the other what drag explains as well: one cause takes both, and says so."""
    rng = np.random.default_rng(seed)
    peaks = Stribeck(("one",), ("N",), speed=0.08), Stribeck(("two",), ("N",), speed=0.12)
    channel = make.bench(
        rng,
        lambda m: 20 * peaks[0].columns(m)[:, :, 0] + 10 * peaks[1].columns(m)[:, :, 0],
        joints=("one", "two"),
        n=6000,
        causes=(Stribeck, QuadraticDrag),
    )
    (found,) = select_causes(channel, np.random.default_rng(1), lambda step: None).found
    assert causes([found]) == {("stribeck", "one"), ("stribeck", "two")}
    assert found.rivals == ("quadratic_drag",)


def test_an_artefact_is_passed_over_while_the_search_goes_on(make, rng):
    """What the sieve rejects does not stand beside the true cause, which would be found in what little it leaves."""
    channel = make.bench(rng, lambda m: 80 * m.v * np.abs(m.v), n=6000, causes=(Stribeck, QuadraticDrag))
    asked = []

    def artefact_filter(null_model, candidate, others, n):
        asked.append(candidate.cause)
        return None if candidate.cause == "quadratic_drag" else candidate

    found = select_causes(channel, np.random.default_rng(1), lambda step: None, artefact_filter=artefact_filter).found
    assert asked[0] == "quadratic_drag" and [one.candidate.cause for one in found] == ["stribeck"]


def test_what_stays_is_weighed_again_when_another_cause_is_dropped(make, monkeypatch):
    """A cause that a mimic had left little to explain shows all that it explains once the mimic is dropped."""
    module = importlib.import_module("tau_dyn.evidence.stepwise_selection")
    channel = make.bench(np.random.default_rng(2), lambda m: 80 * m.v * np.abs(m.v), n=6000, causes=(QuadraticDrag,))
    (plain,) = select_causes(channel, np.random.default_rng(1), lambda step: None).found

    def dropped(null_model, found, level):
        (one,) = found
        (fit,) = one.candidate.fits
        return [replace(one, candidate=replace(one.candidate, fits=(replace(fit, statistic=9.0),)))]

    monkeypatch.setattr(module, "_eliminate_backward", dropped)
    (again,) = select_causes(channel, np.random.default_rng(1), lambda step: None).found
    assert (
        again.candidate.statistic == pytest.approx(plain.candidate.statistic, rel=1e-6)
        and plain.candidate.statistic > 100
    )


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_law_that_stands_alone_stays(make, order):
    """A Stribeck peak of the wrong sign explains friction that levels off, and a peak has no wrong sign: the other law stays."""
    module = importlib.import_module("tau_dyn.evidence.stepwise_selection")
    channel = make.bench(
        np.random.default_rng(0),
        lambda m: -40 * np.sign(m.v) * np.exp(-((m.v / 0.17) ** 2)),
        n=6000,
        causes=(Stribeck, ViscousCurvature),
    )
    library, top = ColumnCache(channel), float(channel.scene.fast[0])
    effects = (
        ViscousCurvature(("x",), ("N",), knee=top, power=2.0),
        Stribeck(("x",), ("N",), speed=0.55 * top, power=2.0),
    )
    noise = fit_noise_models(channel, (TRAIN,), [library.columns(effect) for effect in effects])
    null_model, found = NullModel.of(library, (TRAIN,), noise, effects), []
    for k in order:
        fit = rescore_group(GroupTest(effects[k], 0.0, 1.0, 1, True, 1.0, np.zeros(1)), null_model.with_effects([]))
        found.append(SelectedCause(CandidateCause(effects[k].name, (fit,), 0.0, (fit,)), 0.0, ()))
    (kept,) = module._eliminate_backward(null_model, found, 0.05)
    assert kept.candidate.cause == "viscous_curvature"


def test_an_error_of_millimetres_is_no_transmission_error(make):
    """A force along the way that a periodic error would need a millimetre for gets no such name; 50 um keeps it."""

    def implausible(effect, amplitudes):
        return effect.find_implausible(effect.parameters.with_values(np.array(amplitudes)), {}, SEARCH_MARGIN)

    effect = TransmissionError(("x",), ("N",), period=0.1)
    assert not implausible(effect, [3e-5, -4e-5]) and implausible(effect, [1e-3, 0.0])
    turning = TransmissionError(("x",), ("N m",), period=0.1)
    assert not implausible(turning, [1e-3, 1e-3]) and implausible(turning, [0.0, 0.02])
    assert not implausible(CyclicRipple(("x",), ("N",), period=0.1), [1e3, 0.0])


def test_a_law_of_twelve_terms_is_no_name_where_four_explain_as_much(make):
    """Friction that another joint's place makes, which nearly follows the joint's own: friction along the own way is rejected."""
    rng = np.random.default_rng(4)
    m = make.moving(rng, ("one", "two"), 9000)
    q, v, a = (np.array(getattr(m, key)) for key in "qva")
    for x in (q, v, a):
        x[:, 1] = x[:, 0] + 0.2 * x[:, 1]
    motion = Motion.of(m.joints, q, v, a, t=m.t)

    def hidden(m):
        return np.stack([6 * m.sign[:, 0] * np.cos(2 * np.pi * m.q[:, 1] / 0.5), 0 * m.t], axis=1)

    channel = make.bench(rng, hidden, motions=(motion,), causes=(PositionFriction,))
    selection = select_causes(channel, np.random.default_rng(1), lambda step: None)
    assert causes(selection.found) == set()
    (rejected,) = selection.rejected
    assert rejected.selected.candidate.cause == "position_friction" and "smooth functions" in rejected.why


@pytest.mark.parametrize("seed", range(4))
def test_a_law_that_explains_by_fits_and_starts_is_no_name(make, seed):
    """Speed of another joint, faster and slower than the own one in turn: an asymmetry explains two thirds of it, unsteadily."""
    rng = np.random.default_rng(seed)
    m = make.moving(rng, ("one", "two"), 9000)
    faster = 1 + 0.5 * np.sin(2 * np.pi * m.t / 23)
    q, v, a = (np.array(getattr(m, key)) for key in "qva")
    for x in (q, v, a):
        x[:, 1] = faster * x[:, 0]
    motion = Motion.of(m.joints, q, v, a, t=m.t)

    def hidden(m):
        return np.stack([30 * np.abs(m.v[:, 1]), 0 * m.t], axis=1)

    channel = make.bench(rng, hidden, motions=(motion,), causes=(ViscousAsymmetry,))
    found = select_causes(channel, np.random.default_rng(1), lambda step: None).found
    assert ("viscous_asymmetry", "one") not in causes(found)


def test_what_no_drive_has_is_passed_over(make, rng, monkeypatch):
    """A law whose amplitudes could not be that cause is not found, however much it explains."""
    channel = make.bench(rng, lambda m: 80 * m.v * np.abs(m.v), n=6000, causes=(QuadraticDrag,))
    assert causes(select_causes(channel, np.random.default_rng(1), lambda step: None).found) == {
        ("quadratic_drag", "x")
    }
    monkeypatch.setattr(QuadraticDrag, "plausible", (PlausibleRange("quadratic_drag", 0.0, 15.0),))
    assert select_causes(channel, np.random.default_rng(1), lambda step: None).found == ()


@pytest.mark.parametrize(("other", "inflation", "outshone"), [(145, 1, False), (155, 1, True), (155, 2, False)])
def test_a_look_alike_takes_a_name_only_by_far(monkeypatch, other, inflation, outshone):
    """Explaining 12 more in twice the log-likelihood, of rows that scatter as they should, a law without a name is likelier."""
    module = importlib.import_module("tau_dyn.evidence.stepwise_selection")
    fit = GroupTest(PositionFriction(("x",), ("N",)), 143.0, 1.0, 2, False, inflation, np.zeros(1))
    monkeypatch.setattr(module, "rescore_group", lambda fit, null_model: replace(fit, statistic=float(other)))
    assert module._is_outshone(fit, None) is outshone


def test_friction_along_the_way_ends_where_the_training_ends(make):
    """Places that a joint saw in one sample of a hundred, or in held-out data alone, are not part of the polynomials' range."""
    m = make.moving(np.random.default_rng(1), ("x",), 5000)
    trained = np.abs(m.q[:, 0]) < 0.1
    scene = build_scene(
        [m],
        ("x",),
        ("N",),
        slow=np.array([0.01]),
        cutoff_hz=20.0,
        duration=60.0,
        signals=frozenset(),
        trained=[trained],
    )
    low, high = scene.range_of("x")
    assert -0.1 < low < -0.095 and 0.095 < high < 0.1 and scene.high[0] > 0.15
    for setting in PositionFriction.grid(scene, ("x",)):
        assert setting["middle"] + setting["half"] == pytest.approx(high)
