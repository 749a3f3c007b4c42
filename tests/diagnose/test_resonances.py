"""Resonances in a residual: found by a black-box fit, named, worth their place in the model, and none where nothing rings."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
import structural_resonances as study

from tau_dyn.diagnose import diagnose
from tau_dyn.diagnose.force_baseline import fit_baseline
from tau_dyn.diagnose.force_channel import ForceChannel
from tau_dyn.diagnose.resonances import add_band_note, add_resonances, propose_resonances
from tau_dyn.effects import Motion, Scene, StructuralCompliance
from tau_dyn.evidence import Diagnosis
from tau_dyn.evidence.null_model import fit_noise_models
from tau_dyn.identify import build_model
from tau_dyn.log import lowpass
from tau_dyn.parameters import Parameter

TRUTH = study.PENDULUMS


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    """A sledge with two pendulums on it, diagnosed with another log held out."""
    (model, log), (_, other) = (study.axis_log(n, duration=40.0) for n in (3, 1003))
    return diagnose(model.robot, log, holdout=other, model="symmetric")


def channel_of(seed: int, pendulums: tuple = TRUTH) -> ForceChannel:
    """Return the force channel of one such log."""
    model, log = study.axis_log(seed, pendulums=pendulums, duration=30.0)
    case = fit_baseline(build_model(model.robot, "symmetric"), [log], [], None, (), lambda step: None)
    return case.channel


def test_both_resonances_are_named_with_frequency_and_damping(found) -> None:
    """7.4 and 11.5 Hz: within 1 % and four standard errors, damping within four, and most of the held-out error gone."""
    first = found.findings[0]
    assert found.verdict == "named" and first.cause == "structural_compliance" and first.status == "confirmed"
    values = {p.name.removeprefix("axis."): p for p in first.parameters}
    for end, (f, z, _) in zip(("", "_2"), TRUTH, strict=True):
        ends = sorted(("", "_2"), key=lambda e: abs(values[f"frequency{e}"].value - f))
        for key, true in ((f"frequency{ends[0]}", f), (f"damping{ends[0]}", z)):
            assert abs(values[key].value - true) < 4 * (values[key].stderr or 0), (end, key)
        assert values[f"frequency{ends[0]}"].value == pytest.approx(f, rel=0.01)
    assert first.gain is not None and first.gain.reduction_percent > 70
    assert "7.4" in first.sentence and "11.5" in first.sentence


def test_the_extended_model_predicts_what_swings(found) -> None:
    """A third log: the extended model leaves less than a third of what the refitted one does."""
    _, log = study.axis_log(5, duration=20.0)
    read = np.column_stack([log.channels["q_axis"]])
    v = np.gradient(read, log.dt, axis=0)
    a = np.gradient(v, log.dt, axis=0)
    q, v, a = (lowpass(x, 40.0, log.rate_hz) for x in (read, v, a))
    left = []
    for model in (found.model, found.extended_model):
        force = model.torque(q, v, a, t=log.t)
        left.append(np.std(lowpass(log.channels["tau_axis"][:, None] - force, 20.0, log.rate_hz)[500:-500]))
    assert left[1] < left[0] / 3


def test_proposals_are_near_the_truth_and_absent_from_a_rigid_axis() -> None:
    """The black-box fit alone: both modes within 1 % and 20 % of damping; without pendulums nothing is proposed."""
    got = sorted(propose_resonances(channel_of(1)))
    assert len(got) == 2
    for (f, z), (true, damping, _) in zip(got, TRUTH, strict=True):
        assert f == pytest.approx(true, rel=0.01) and z == pytest.approx(damping, rel=0.2)
    assert propose_resonances(channel_of(2, ())) == ()


def test_a_proposed_resonance_does_not_count_as_noise() -> None:
    """The noise model of a ringing axis is that of the rigid one within a few percent once the modes are proposed."""
    channel = channel_of(1)
    ringing, known = (fit_noise_models(c, (0,))[0] for c in (channel, add_resonances(channel)))
    rigid = fit_noise_models(channel_of(1, ()), (0,))[0]
    assert known.variance == pytest.approx(rigid.variance, rel=0.2)
    assert ringing.variance > 1.5 * known.variance


def test_what_lies_above_the_encoders_band_says_which_data_would_tell(found) -> None:
    """Above the band in which encoders show the motion a sentence and an experiment are added; below, nothing."""
    first = found.findings[0]
    assert add_band_note(first, 15.0) is first
    said = add_band_note(first, 9.0)
    assert "above the 9 Hz" in said.sentence and "accelerometer at the tool" in said.experiment
    values = {p.name.removeprefix("axis."): p for p in said.parameters}
    for end in ("", "_2"):
        guessed = values[f"frequency{end}"].value > 9.0
        assert all((values[key + end].stderr is None) == guessed for key in ("frequency", "damping"))
    assert {values["frequency"].value > 9.0, values["frequency_2"].value > 9.0} == {True, False}
    assert add_band_note(replace(first, cause="delay"), 9.0).cause == "delay"
    vague = replace(first, parameters=(Parameter("axis.frequency", 20.0, "Hz", stderr=10.0),))
    assert add_band_note(vague, 9.0) is vague


def motion(n: int = 400) -> Motion:
    """Return two joints at 100 Hz under forces that change."""
    t = np.arange(n) / 100
    F = np.column_stack([np.sin(9 * t), np.cos(14 * t)])
    M = np.broadcast_to(np.array([[3.0, 1.0], [1.0, 2.0]]), (n, 2, 2))
    zero = np.zeros((n, 2))
    signals = {"rigid_force": F, "inertia": M, "damping": zero + 5, "weight_gradient": np.zeros((n, 2, 2))}
    return Motion.of(("a", "b"), zero, zero, zero, t=t, signals=signals)


def test_a_structures_matrix_is_reciprocal() -> None:
    """Its load of b gives way to the force of a as that of a to b; three numbers a mode, four where the tool is measured."""
    effect = StructuralCompliance(("a", "b"), ("N", "N m"), coupled=1, modes=2, rest=1)
    names = effect.parameters.names
    assert names[:3] == ("a.structural_compliance", "a+b.structural_compliance", "b.structural_compliance")
    assert names[-1] == "b.structural_compliance_rest" and len(names) == 9
    assert [p.unit for p in effect.parameters][:3] == ["m/N", "m/(N m)", "rad/(N m)"]
    d = effect.displacement(motion())
    alone = StructuralCompliance(("a",), ("N",)).displacement(motion())
    assert_allclose(d[:, 1, 1], alone[:, 0, 0])  # force of a moves b
    assert_allclose(d[:, 0, 6], motion().signals["rigid_force"][:, 0])  # what modes above the band do at once
    full = StructuralCompliance(("a", "b"), ("N", "N m"), coupled=1, reciprocal=0)
    assert len(full.parameters) == 4 and np.count_nonzero(full.displacement(motion())[:, :, 1].any(axis=0)) == 1
    assert effect.refined == ("frequency", "damping", "frequency_2", "damping_2")
    with raises_code("invalid_value", "modes"):
        StructuralCompliance(("a",), ("N",), modes=4)


def test_a_structures_friction_stays_on_the_drives_side() -> None:
    """The matrix' force is the loads' inertia alone; a drive's compliance moves its joint's friction along."""
    still = replace(motion(), signals={**motion().signals, "damping": np.zeros((400, 2))})
    for coupled, same in ((1, True), (0, False)):
        effect = StructuralCompliance(("a", "b"), ("N", "N"), coupled=coupled)
        assert np.allclose(effect.columns(motion()), effect.columns(still)) is same


def test_a_mode_in_the_clear_band_feels_the_whole_force() -> None:
    """Below the frequency up to which motion is clear, a mode answers to the force as it is; above, to its clear part."""
    seen = motion()
    more = {"wide_force": 2 * seen.signals["rigid_force"], "clear_hz": np.full(400, 8.0)}
    both = replace(seen, signals={**seen.signals, **more})
    for f, factor in ((7.0, 2.0), (9.0, 1.0)):
        effect = StructuralCompliance(("a",), ("N",), frequency=f)
        assert_allclose(effect.displacement(both), factor * effect.displacement(seen))


def test_the_grid_follows_the_proposals() -> None:
    """A structure is tried at proposed resonances only, each alone and the surest together; then no joint is tried alone."""
    one = np.ones(2)
    bare = Scene(("a", "b"), ("N", "N"), -one, one, 0.1 * one, one, 30.0, 60.0)
    assert bare.joints not in StructuralCompliance.groups(bare)
    scene = replace(bare, resonances=((7.4, 0.01), (11.5, 0.02)), structure=True)
    assert StructuralCompliance.groups(scene) == [scene.joints]
    grid = StructuralCompliance.grid(scene, scene.joints)
    assert sorted({s["modes"] for s in grid}) == [1, 2] and all(s["coupled"] for s in grid)
    proposal = StructuralCompliance.proposal(scene, scene.joints)
    assert proposal in grid and (proposal["frequency"], proposal["frequency_2"]) == (7.4, 11.5)
    assert max(s.get("modes", 1) for s in StructuralCompliance.grid(scene, ("a",))) == 2
