"""Motions: inside all limits, at rest at their ends, consistent, and good at what they are for."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.model import Model
from tau_dyn.simulate import (
    MOTIONS,
    build_exciting_motion,
    build_fourier_motion,
    build_multisine_on_stroke,
    build_named_motion,
    build_stroke_motion,
    compute_base_condition,
    compute_condition_bound,
    describe_exceeded_limit,
    move,
)

NAMES = sorted(MOTIONS)


@pytest.fixture(params=["gantry", "block"])
def model(request) -> Model:
    """Three coupled carts, and one drive whose force is short."""
    return request.getfixturevalue(request.param)


@pytest.mark.parametrize("name", NAMES)
def test_motion_stays_within_every_limit(model, name):
    """At every sample: range, speed, conditioning of the loops, and force with friction."""
    motion, robot = build_named_motion(name, model, 12.0, seed=5), model.robot
    assert np.all((motion.q >= robot.lower) & (motion.q <= robot.upper))
    assert np.all(np.abs(motion.v) <= robot.velocity_limit)
    assert np.max(model.mechanism.condition(motion.q)) < compute_condition_bound(model)
    assert np.all(np.abs(model.torque(motion.q, motion.v, motion.a)) <= robot.effort_limit)


@pytest.mark.parametrize("name", NAMES)
def test_motion_is_consistent_and_rests_at_its_ends(model, name):
    """Speeds are derivatives of positions, accelerations of speeds, to the finite difference's error; it ends at rest."""
    motion = build_named_motion(name, model, 12.0, seed=2)
    assert_allclose(np.diff(motion.q, axis=0) * 1000, (motion.v[1:] + motion.v[:-1]) / 2, atol=5e-5)
    # strokes and binary speeds have ramps whose slope of acceleration jumps
    assert_allclose(np.diff(motion.v, axis=0) * 1000, (motion.a[1:] + motion.a[:-1]) / 2, atol=5e-2)
    assert_allclose(motion.v[[0, -1]], 0.0, atol=1e-12)
    assert_allclose(motion.q[0], model.robot.home, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_motion_reverses_often(gantry, name):
    """Friction of both directions is seen many times by every joint."""
    motion = build_named_motion(name, gantry, 20.0)
    moving = [v[np.abs(v) > 1e-3] for v in motion.v.T]
    assert min(np.sum(np.diff(np.sign(v)) != 0) for v in moving) >= 6


@pytest.mark.parametrize("name", ["fourier", "exciting", "strokes", "prbs"])
def test_motion_is_fast_enough_for_masses(gantry, name):
    """The carts come near 1 m/s, at several m/s^2."""
    motion = build_named_motion(name, gantry, 20.0)
    assert np.all(np.max(np.abs(motion.v), axis=0) > 0.75) and np.all(np.max(np.abs(motion.a), axis=0) > 4.0)


def test_seed_decides_the_motion(gantry):
    """The same seed repeats a motion, another does not."""
    for name in NAMES:
        one, same, other = (build_named_motion(name, gantry, 8.0, seed) for seed in (1, 1, 2))
        assert np.array_equal(one.q, same.q) and not np.array_equal(one.q, other.q)


def test_search_improves_the_conditioning(gantry):
    """The best of several is better conditioned than most, and says so; a slow motion is far worse."""
    best = build_exciting_motion(gantry, 8.0, seed=0, trials=12)
    others = [compute_base_condition(gantry, build_fourier_motion(gantry, 8.0, seed)) for seed in range(12)]
    assert compute_base_condition(gantry, best) < 0.8 * np.median(others)
    assert "best of 12" in best.notes[-1]
    assert compute_base_condition(gantry, build_named_motion("slow", gantry, 8.0)) > 20 * np.median(others)


def test_joints_do_not_repeat_each_other(gantry):
    """Fourier motions of different joints are no copies."""
    correlation = np.corrcoef(build_fourier_motion(gantry, 20.0).q.T)
    assert np.max(np.abs(correlation - np.eye(3))) < 0.8


def test_strokes_hold_the_speeds_asked_for(block):
    """Both directions of each speed, constant for a good part of the time."""
    motion = build_stroke_motion(block, 30.0, speeds=(0.05, 0.1, 0.3))
    for speed in (0.05, 0.1, 0.3):
        for sign in (1, -1):
            assert np.sum(np.abs(motion.v[:, 0] - sign * speed) < 1e-9) > 300


def test_multisine_rides_without_reversing_the_stroke(gantry):
    """Between the stroke's own reversals the ripple never stops the carts, and its power lies between 2 and 14 Hz."""
    motion = build_multisine_on_stroke(gantry, 20.0)
    spectrum = np.abs(np.fft.rfft(motion.a[:, 0] * np.hanning(motion.n_samples))) ** 2
    f = np.fft.rfftfreq(motion.n_samples, 1e-3)
    assert spectrum[(f > 1.9) & (f < 14.1)].sum() > 0.8 * spectrum.sum()
    assert np.mean(np.abs(motion.v[:, 0]) > 0.05) > 0.75


def test_scaling_is_noted_with_its_reason(make):
    """A drive too weak for the full motion gets a smaller one that says which joint needed what."""
    weak = make.friction(make.block(95.0, effort=150.0), 20.0, 200.0)
    motion = build_fourier_motion(weak, 8.0)
    assert "reduced" in motion.notes[0] and "axis needs" in motion.notes[0] and "150 N" in motion.notes[0]
    hopeless = make.friction(make.block(95.0, effort=15.0), 20.0, 200.0)
    with raises_code("unreachable"):
        build_fourier_motion(hopeless, 8.0)


def test_unreachable_and_singular_places_are_named(make):
    """On guideways longer than the rods, loops that cannot close, or close badly, are broken limits too."""
    long = make.friction(make.gantry(travel=3.0), 80.0, 120.0)
    away = np.array([1.5, -1.5, 1.5])
    assert "loops cannot be closed" in str(
        describe_exceeded_limit(long, move(long.robot.actuated, np.zeros(3), away, 5.0))
    )
    near = move(long.robot.actuated, np.zeros(3), 0.1 * away, 5.0)
    assert describe_exceeded_limit(long, near) is None
    assert "near a singularity" in str(describe_exceeded_limit(long, near, condition=1.5))


def test_motions_shrink_until_the_loops_close_well(make):
    """Limits that allow too much are no licence: the motion is scaled to where the mechanism is well conditioned."""
    long = make.friction(make.gantry(travel=3.0), 80.0, 120.0)
    motion = build_named_motion("prbs", long, 30.0)
    assert "loops" in motion.notes[0]
    assert np.max(long.mechanism.condition(motion.q)) < compute_condition_bound(long)


def test_joints_without_limits_are_within_them(make):
    """A drive that may turn for ever, without speed or force limit: no motion breaks a limit, and no warning is raised."""
    free = Model.of(make.pendulum(limited=False))
    assert np.isinf(free.robot.upper).all() and np.isinf(free.robot.effort_limit).all()
    for name in NAMES:
        motion = build_named_motion(name, free, 8.0)
        assert motion.n_samples > 1 and not any("scaled" in note for note in motion.notes)
    assert describe_exceeded_limit(free, motion) is None


def test_unknown_motion_lists_those_there_are(gantry):
    """A wrong name gets the right ones; a motion too short for its windows is refused."""
    with raises_code("unknown_name"):
        build_named_motion("chirp", gantry)
    with raises_code("invalid_value", "4"):
        build_named_motion("fourier", gantry, 1.0)
