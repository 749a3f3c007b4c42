"""A good log is called fit; each spoilt one is told what spoils it, and nothing else is."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from tau_dyn.log import Log, check_log, differentiate, list_unit_warnings, lowpass
from tau_dyn.log.check_motion import compute_motion_cutoff


def topics(check, severity: str | None = None) -> set[str]:
    """Return the topics of the findings that are not fine, or of those of one severity."""
    return {f.topic for f in check.findings if (f.severity != "ok" if severity is None else f.severity == severity)}


def robot(kind="prismatic", lower=-1.0, upper=1.0):
    """Return what a check asks of a robot with one joint `axis`."""
    return SimpleNamespace(actuated=("axis",), joint_kinds=(kind,), lower=np.array([lower]), upper=np.array([upper]))


def test_a_good_log_is_fit_for_use(axis_log):
    """No warning, and numbers that are those it was made with."""
    check = check_log(axis_log, robot())
    assert check.fit_for_use and check.warnings == ()
    axis = check.numbers["joints"]["axis"]
    assert check.numbers["rate_hz"] == pytest.approx(1000)
    assert axis["encoder_noise"] == pytest.approx(5e-6, rel=0.05)
    assert axis["lag"] == pytest.approx(0.005, abs=2e-4)
    assert axis["range"] == pytest.approx([-0.40, 0.41], abs=0.02)
    assert 0.4 < axis["forward_share"] < 0.6
    assert json.loads(json.dumps(check.to_dict()))["fit_for_use"] is True
    assert any("was not tested" in f.sentence for f in check.findings)


def test_a_position_that_freezes_is_a_fault(axis_log):
    """The encoder stands for 0.3 s while the reference moves on."""
    q = axis_log.channels["q_axis"].copy()
    q[5000:5300] = q[5000]
    check = check_log(axis_log.with_channels(q_axis=q))
    assert not check.fit_for_use and "frozen" in topics(check, "fault")
    assert any("q_axis stays at" in s and "from 5 to 5.299 s" in s for s in check.warnings)


def test_a_joint_that_rests_before_it_moves_is_not_frozen_under_an_uneven_clock(motion):
    """A controller's log begins at rest; its positions are rounded, and all its steps except the first are 10 or 12 ms."""
    rng = np.random.default_rng(0)
    steps = np.append(0.002, rng.choice([0.010, 0.012], 2000, p=[0.75, 0.25]))
    t = np.cumsum(np.append(0.0, steps))
    begun = np.maximum(t - 0.5, 0.0)
    q = motion(np.where(begun < 2.0, 0.25 * begun**2, begun - 1.0))
    v = np.gradient(q, t)
    tau = 10 * np.gradient(v, t) + 20 * np.tanh(v / 0.01) + rng.standard_normal(t.size)
    log = Log(t, {"q_axis": np.round(q, 4), "q_ref_axis": q, "tau_axis": tau})
    assert "frozen" not in topics(check_log(log))
    stuck = np.where((t > 10.0) & (t < 10.4), np.interp(10.0, t, q), q)
    assert "frozen" in topics(check_log(log.with_channels(q_axis=np.round(stuck, 4))))


def test_a_force_below_the_drives_resolution_is_not_frozen(axis_log):
    """A drive gives forces below its threshold as zero, for 0.3 s at a time, while the joint moves."""
    tau = np.where(np.abs(axis_log.t % 4.0 - 2.0) < 0.15, 0.0, axis_log.channels["tau_axis"])
    assert "frozen" not in topics(check_log(axis_log.with_channels(tau_axis=tau)))


def test_a_clipped_force_is_found(axis_log):
    """A drive that saturates at 40 N shows plateaus; so much of it is a fault."""
    tau = axis_log.channels["tau_axis"]
    mild = check_log(axis_log.with_channels(tau_axis=np.clip(tau, -np.quantile(tau, 0.99), np.quantile(tau, 0.99))))
    hard = check_log(axis_log.with_channels(tau_axis=np.clip(tau, -20, 20)))
    assert topics(mild) == {"clipping"} and mild.fit_for_use
    assert topics(hard, "fault") == {"clipping"}
    assert check_log(axis_log).numbers["clipped"]["tau_axis"] == 0.0


def test_a_coarse_force_is_not_called_clipped(axis_log):
    """Rounding to 1 N repeats values everywhere, at the extremes too, and a quiet wave stays long at its top."""
    wave = 50 * np.sin(np.pi * axis_log.t)
    for tau in (axis_log.channels["tau_axis"], wave):
        assert topics(check_log(axis_log.with_channels(tau_axis=np.round(tau)))) == set()
    assert "clipping" in topics(check_log(axis_log.with_channels(tau_axis=np.round(np.clip(wave, -40, 45)))))


def test_a_force_that_never_changes_is_a_fault(axis_log):
    """Zero throughout is a channel that was not connected."""
    check = check_log(axis_log.with_channels(tau_axis=np.zeros(axis_log.n_samples)))
    assert topics(check, "fault") == {"constant"}


def test_a_force_logged_at_a_lower_rate_is_found(axis_log):
    """A current renewed every 4 ms in a 1 kHz log is 1.5 ms late on average."""
    held = np.repeat(axis_log.channels["tau_axis"][::4], 4)
    check = check_log(axis_log.with_channels(tau_axis=held))
    assert topics(check) == {"held"}
    assert "is updated every 4 samples; it is 0.0015 s late on average" in check.warnings[0]


def test_a_joint_at_rest_is_named(axis_log, rng):
    """A second joint that never moves leaves its parameters unknown; a log in which nothing moves is a fault."""
    still = 0.5 + 5e-6 * rng.standard_normal(axis_log.n_samples)
    force = rng.standard_normal(axis_log.n_samples)
    check = check_log(axis_log.with_channels(q_b=still, tau_b=force))
    assert topics(check) == {"excitation"} and check.fit_for_use and "joint b does not move" in check.warnings[0]
    resting = Log(axis_log.t, {"q_axis": still, "tau_axis": force})
    assert not check_log(resting).fit_for_use


def test_one_way_motion_is_named(axis_log, rng):
    """Forwards only: friction and a torque offset are the same."""
    q = 0.05 * axis_log.t + 0.002 * np.sin(2 * np.pi * axis_log.t) + 5e-6 * rng.standard_normal(axis_log.n_samples)
    check = check_log(Log(axis_log.t, {"q_axis": q, "tau_axis": axis_log.channels["tau_axis"]}))
    assert topics(check) == {"excitation"} and "only forwards" in check.warnings[0]


def test_a_rough_encoder_is_named(axis_log):
    """Steps of 5 mm drown velocities and accelerations."""
    q = np.round(axis_log.channels["q_axis"] / 5e-3) * 5e-3
    assert "encoder" in topics(check_log(axis_log.with_channels(q_axis=q)))
    assert check_log(axis_log.with_channels(q_axis=q)).numbers["joints"]["axis"]["quantisation"] == pytest.approx(5e-3)


def test_a_reference_that_comes_late_is_named(axis_log, motion):
    """A position cannot run 20 ms ahead of its reference."""
    check = check_log(axis_log.with_channels(q_ref_axis=motion(axis_log.t - 0.02)))
    assert topics(check) == {"synchronisation"}
    assert check.numbers["joints"]["axis"]["lag"] == pytest.approx(-0.02, abs=2e-4)


@pytest.mark.parametrize("lag", [2.3e-3, 3.8e-3])
def test_a_lag_is_known_to_a_part_of_a_sample(axis_log, motion, lag):
    """The position follows by 2.3 and 3.8 sample steps: the lag is found to a tenth of a step, by a parabola."""
    t = axis_log.t
    log = Log(t, {"q_axis": motion(t - lag), "q_ref_axis": motion(t), "tau_axis": axis_log.channels["tau_axis"]})
    assert check_log(log).numbers["joints"]["axis"]["lag"] == pytest.approx(lag, abs=1e-4)


def test_gaps_and_lost_samples_are_named(axis_log):
    """A gap of 0.5 s is a warning and the longest part is judged; a lost sample is counted."""
    keep = np.setdiff1d(np.arange(axis_log.n_samples), [*range(4000, 4500), 9000])
    log = Log(axis_log.t[keep], {k: v[keep] for k, v in axis_log.channels.items()}, name="gappy.csv")
    check = check_log(log)
    assert topics(check) == {"gaps"} and check.fit_for_use
    assert check.numbers["n_missing"] == 501
    assert check.numbers["gaps"] == [[pytest.approx(3.999), pytest.approx(4.5)]]


def test_jitter_is_named(axis_log, rng):
    """Steps that vary by 20 % are a warning."""
    t = axis_log.t + 0.0002 * rng.uniform(-0.5, 0.5, axis_log.n_samples)
    assert "jitter" in topics(check_log(Log(t, axis_log.channels)))


def test_a_clock_in_milliseconds_is_a_fault(axis_log):
    """Steps of 1 s are not those of a machine."""
    check = check_log(Log(1000 * axis_log.t, axis_log.channels))
    assert "sampling" in topics(check, "fault")


def test_a_robots_missing_columns_are_named(axis_log):
    """Positions are indispensable, forces are needed to identify."""
    other = robot()
    other.actuated = ("cart1",)
    check = check_log(axis_log, other)
    assert not check.fit_for_use
    assert any("has no q_cart1" in s for s in check.warnings) and any("has no tau_cart1" in s for s in check.warnings)


@pytest.mark.parametrize(
    ("factor", "kind", "limit", "words"),
    [
        (
            1000,
            "prismatic",
            1.0,
            "the unit is probably mm (a gear ratio looks alike): write `q_axis: {column: q_axis, scale: 0.001}`",
        ),
        (1000, "prismatic", np.inf, "the unit is probably mm"),
        (
            180 / np.pi,
            "revolute",
            2.0,
            "the unit is probably degrees (a gear ratio looks alike): write `q_axis: {column: q_axis, scale: 0.0174532925}`",
        ),
        (1e5, "revolute", 2.0, "is it this joint, at its own side of the gear, in rad?"),
    ],
)
def test_positions_in_the_wrong_unit_are_recognised(axis_log, factor, kind, limit, words):
    """Limits tell mm from m and degrees from rad; the scale to give stands in the sentence."""
    log = axis_log.with_channels(q_axis=factor * axis_log.channels["q_axis"])
    (sentence,) = list_unit_warnings(log, robot(kind, -limit, limit))
    assert words in sentence and sentence.startswith("good.csv: q_axis runs from -")
    assert "units" in topics(check_log(log, robot(kind, -limit, limit)))


def test_right_units_raise_no_doubt(axis_log):
    """Within the limits, a little beyond them, and without a robot."""
    assert list_unit_warnings(axis_log, robot()) == ()
    assert list_unit_warnings(axis_log, robot(lower=-0.35, upper=0.35)) == ()
    assert list_unit_warnings(axis_log, robot("revolute", -np.inf, np.inf)) == ()
    assert list_unit_warnings(axis_log) == ()


def test_without_a_robot_only_the_impossible_is_doubted(axis_log):
    """400 mm reads like a wrong unit; 40 may be turns of a motor."""
    thousand = axis_log.with_channels(q_axis=1000 * axis_log.channels["q_axis"])
    assert "in mm or degrees, or through 128 turns" in list_unit_warnings(thousand)[0]
    assert list_unit_warnings(axis_log.with_channels(q_axis=100 * axis_log.channels["q_axis"])) == ()


def test_a_log_of_ten_samples_is_judged_without_a_crash(rng):
    """Too little to filter is still told so."""
    log = Log(np.arange(10) / 100, {"q_axis": rng.standard_normal(10), "tau_axis": rng.standard_normal(10)})
    assert "sampling" in topics(check_log(log))


def test_the_noise_of_a_differentiated_encoder_is_what_is_left_of_it(axis_log, motion):
    """Twice filtered and differentiated, the encoder's 5 um of noise alone make what the check calls acceleration noise."""
    noise = axis_log.channels["q_axis"] - motion(axis_log.t)
    left = lowpass(noise, compute_motion_cutoff(axis_log), axis_log.rate_hz)
    for name in ("velocity_noise", "acceleration_noise"):
        left = differentiate(left, axis_log.dt)
        told = check_log(axis_log).numbers["joints"]["axis"][name]
        assert told == pytest.approx(float(left[500:-500].std()), rel=0.15)
