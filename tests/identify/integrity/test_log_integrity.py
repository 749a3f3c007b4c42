"""A log that is not what it claims to be: wiring and time of the forces, judged against the robot file."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from tau_dyn.identify import build_model, check_integrity, identify, is_diagnosis_invalid
from tau_dyn.identify.integrity.force_timing import ForceDelay, _believed
from tau_dyn.identify.integrity.reading_fit import count_independent
from tau_dyn.log import Log, lowpass, read_log
from tau_dyn.message_codes import get_code
from tau_dyn.robot import load_robot, load_robot_from_urdf
from tau_dyn.simulate import build_named_motion

HERE = Path(__file__).resolve().parents[3]
DATA = Path(os.environ.get("TAU_DYN_DATA", HERE.parent / "shared" / "data"))


def codes(robot, log: Log) -> set[str]:
    """Return the codes of a log against a robot file."""
    return {get_code(warning) for warning in check_integrity(robot, [log])}


def scaled(log: Log, **factors: float) -> Log:
    """Return a log with channels multiplied."""
    return log.with_channels(**{name: factor * log.channels[name] for name, factor in factors.items()})


def exchanged(log: Log, one: str, other: str) -> Log:
    """Return a log with two channels exchanged."""
    return log.with_channels(**{one: log.channels[other], other: log.channels[one]})


def test_a_sound_log_of_another_mass_is_not_doubted(l1, monday) -> None:
    """L1 as it really is, up to 10 % off its file: nothing is said."""
    assert check_integrity(l1, [monday]) == []


@pytest.mark.parametrize(
    ("spoil", "code", "mend"),
    [
        (lambda log: scaled(log, tau_cart2=-1.0), "sign_reversed", "tau_cart2: {column: tau_cart2, scale: -1}"),
        (
            lambda log: scaled(log, q_cart1=-1.0, tau_cart1=-1.0),
            "sign_reversed",
            "q_cart1: {column: q_cart1, scale: -1}",
        ),
        (lambda log: exchanged(log, "tau_cart1", "tau_cart3"), "joints_exchanged", "tau_cart1: tau_cart3"),
        (
            lambda log: exchanged(exchanged(log, "tau_cart1", "tau_cart3"), "q_cart1", "q_cart3"),
            "joints_exchanged",
            "q_cart1: q_cart3",
        ),
        (lambda log: scaled(log, tau_cart3=0.01), "scale_wrong", "tau_cart3: {column: tau_cart3, scale: "),
        (lambda log: scaled(log, tau_cart1=10.0), "scale_wrong", "tau_cart1: {column: tau_cart1, scale: "),
    ],
)
def test_each_wrong_wiring_is_named_with_its_mend(l1, monday, spoil, code: str, mend: str) -> None:
    """One column turned, exchanged or scaled contradicts the other joints; the sentence writes the line that mends it."""
    warnings = check_integrity(l1, [spoil(monday)])
    assert code in {get_code(w) for w in warnings} and mend in " ".join(warnings)
    assert is_diagnosis_invalid(warnings)


def test_a_lone_axis_that_turns_round_is_the_same_axis(axis, axis_log) -> None:
    """With q and tau both reversed a lone axis is the same axis; with the force alone friction would push."""
    assert codes(axis, scaled(axis_log, q_axis=-1.0, tau_axis=-1.0)) == set()
    turned = scaled(axis_log, tau_axis=-1.0)
    assert codes(axis, turned) == {"sign_reversed"}
    assert (
        "of tau_axis, " in (said := str(check_integrity(axis, [turned]))) and "% less." in said and "nats" not in said
    )


@pytest.mark.parametrize("down", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, -1.0), (1.0, 0.0, -1.0)])
def test_a_robot_on_a_wall_or_a_slope_is_named_with_its_direction_of_gravity(two_link, make, down) -> None:
    """Forces of an arm that hangs elsewhere fit its file once gravity acts along that side of its base."""
    down = np.array(down) / np.linalg.norm(down)
    turned = two_link.model.copy()
    turned.gravity.linear = np.linalg.norm(turned.gravity.linear) * down
    truth = build_model(replace(two_link, model=turned), "symmetric")
    truth = truth.with_values(dict.fromkeys(truth.effect_parameters.names, 0.5))
    log = make.recorded(truth, build_named_motion("fourier", truth, 20.0, 1), force_noise=0.02, encoder_noise=1e-6)
    (warning,) = check_integrity(two_link, [log])
    shown = ", ".join(f"{x:.2g}" for x in down + 0.0)
    assert get_code(warning) == "gravity_direction" and f"gravity acts along ({shown})" in warning


def test_a_joint_with_a_small_force_does_not_unmake_the_direction_of_gravity(make, write, rng) -> None:
    """A wrist of 0.06 kg whose force is a third noise of its cable: the arm's other forces name the wall without a doubt."""
    wrist = write.joint("wrist", "revolute", "lower_link", "hand_link", "0 1 0", "0.3 0 0") + write.drive("wrist")
    text = write.two_link().replace("</robot>", f"{write.rod('hand_link', 0.06, 0.15)}{wrist}</robot>")
    robot = load_robot_from_urdf(text, "arm")
    turned = robot.model.copy()
    turned.gravity.linear = np.array([9.81, 0.0, 0.0])
    truth = build_model(replace(robot, model=turned), "symmetric")
    log = make.recorded(truth, build_named_motion("fourier", truth, 20.0, 1), force_noise=0.002, encoder_noise=1e-6)
    tau = log.channels["tau_wrist"]
    cable = lowpass(rng.standard_normal(len(tau)), 0.5, log.rate_hz)
    log = log.with_channels(tau_wrist=tau + 0.35 * np.std(tau) * cable / np.std(cable))
    (warning,) = check_integrity(robot, [log])
    assert get_code(warning) == "gravity_direction" and "gravity acts along (1, 0, 0)" in warning
    assert "no reading of them agrees" not in warning and "Check units" not in warning


def test_another_clock_makes_another_mass(axis, axis_log) -> None:
    """At ten times the speed the inertial force would be 100 times as large."""
    log = Log(axis_log.t * 10, axis_log.channels, axis_log.name)
    assert codes(axis, log) & {"scale_wrong"}


@pytest.mark.parametrize("factor", [0.1, 2.0])
def test_another_clock_is_told_beside_gravity(l1, monday, factor: float) -> None:
    """Speeds scale with the clock, accelerations with its square, and weights not at all."""
    (warning,) = check_integrity(l1, [Log(monday.t * factor, monday.channels, monday.name)])
    assert get_code(warning) == "scale_wrong"
    assert float(warning.split("`t: {column: t, scale: ")[1].split("}")[0]) == pytest.approx(1 / factor, rel=0.05)


def test_neighbours_that_are_alike_count_less(rng) -> None:
    """Of n residuals that follow each other by 0.8, n (1 - 0.8) / (1 + 0.8) are independent; of white ones all."""
    white = rng.standard_normal(20000)
    assert count_independent(white) == pytest.approx(20000, rel=0.1)
    assert count_independent(lfilter([1], [1, -0.8], white)) == pytest.approx(20000 / 9, rel=0.25)


def test_joints_that_agree_on_a_delay_are_believed_together() -> None:
    """A delay that no joint shows alone weighs by inverse variances: one joint that is known ten times as well decides."""
    share, judged = np.full(3, 0.3), np.ones(3, bool)
    found = ForceDelay(np.array([0.010, 0.010, 0.010]), np.full(3, 1e-4), share, np.ones(3), judged)
    assert _believed(found, 0.004).all()
    apart = np.array([0.010, 0.0101, 0.004])  # the third is within three of its own standard errors of the first two
    assert _believed(found._replace(delay_s=apart, stderr_s=np.array([1e-4, 1e-4, 2.1e-3])), 0.004).all()
    assert not _believed(found._replace(delay_s=apart), 0.004).any()


@pytest.mark.parametrize("delay_s", [-0.02, 0.01, 0.04])
def test_a_late_force_is_named_with_its_delay(l1, monday, delay_s: float) -> None:
    """The jerk of a force that lags has no other source in a rigid robot."""
    late = {f"tau_{j}": np.interp(monday.t - delay_s, monday.t, monday.channels[f"tau_{j}"]) for j in l1.actuated}
    (warning,) = check_integrity(l1, [monday.with_channels(**late)])
    assert get_code(warning) == "force_late" and ("early" in warning) is (delay_s < 0)
    stated = float(warning.split(" by ")[1].split(" ms")[0])
    assert stated == pytest.approx(1e3 * abs(delay_s), abs=1.5)
    assert not is_diagnosis_invalid([warning])


def test_a_strong_lag_of_the_drive_is_told_from_a_delay(l1, monday) -> None:
    """A first-order lag of 50 ms turns phases less than a delay at high frequencies, and damps them."""
    pole = np.exp(-monday.dt / 0.05)
    passed = {
        f"tau_{j}": lfilter([1 - pole], [1, -pole], x, zi=[pole * x[0]])[0]
        for j in l1.actuated
        for x in [monday.channels[f"tau_{j}"]]
    }
    assert codes(l1, monday.with_channels(**passed)) == {"force_lowpassed"}


def test_identify_says_it_first_and_mends_few_lost_samples(l1, truth, monday) -> None:
    """With 0.2 % of the samples lost, the mended clock brings the masses back within their errors' reach."""
    keep = np.flatnonzero(np.random.default_rng(1).random(monday.n_samples) > 0.002)
    lost = Log(monday.t[: len(keep)], {k: x[keep] for k, x in monday.channels.items()}, "lost.csv")
    found = identify(l1, lost)
    assert get_code(found.warnings[0]) == "lost_samples"
    plate = found.parameters["plate_link.mass"]
    assert plate.value == pytest.approx(truth.parameters["plate_link.mass"].value, rel=0.1)


def spoil(log: Log, name: str) -> Log:
    """Return a log with one row in forty repeated, channels interpolated from a fifth of the rate, or a dead encoder."""
    n = log.n_samples
    if name == "repeated":
        rows = np.arange(n)
        rows[1:] -= np.random.default_rng(2).random(n - 1) < 0.025
        return Log(log.t, {k: x[rows] for k, x in log.channels.items()}, log.name)
    if name == "interpolated":
        at = np.arange(0, n, 5)
        return Log(log.t, {k: np.interp(np.arange(n), at, x[at]) for k, x in log.channels.items()}, log.name)
    q = log.channels["q_cart1"].copy()
    q[n // 2 :] = q[n // 2]
    return log.with_channels(q_cart1=q)


@pytest.mark.parametrize(
    ("name", "code"),
    [("repeated", "repeated_samples"), ("interpolated", "updated_less_often"), ("dead", "held_channel")],
)
def test_a_fault_that_is_left_out_blocks_and_biases_nothing(l1, truth, monday, name: str, code: str) -> None:
    """The fit without the faulty samples is within four of its standard errors of the truth, and causes may be confirmed."""
    log = spoil(monday, name)
    warnings = check_integrity(l1, [log])
    assert {get_code(w) for w in warnings} == {code} and not is_diagnosis_invalid(warnings)
    found = identify(l1, log)
    for body in ("plate_link", "cart1_link", "cart3_link"):
        mass = found.parameters[f"{body}.mass"]
        assert abs(mass.value - truth.parameters[f"{body}.mass"].value) < 4 * mass.stderr


def test_a_fault_that_remains_blocks(l1, monday) -> None:
    """One sample in twenty is lost under a counted clock: what is behind is at another time, and nothing is confirmed."""
    keep = np.flatnonzero(np.random.default_rng(1).random(monday.n_samples) > 0.05)
    lost = Log(monday.t[: len(keep)], {k: x[keep] for k, x in monday.channels.items()}, "lost.csv")
    assert is_diagnosis_invalid(check_integrity(l1, [lost]))


def test_a_clean_fit_carries_no_coded_warning(found) -> None:
    """What comes with every log says nothing."""
    assert {get_code(w) for w in found.warnings} <= {"note"}


@pytest.mark.parametrize(("place", "columns", "robot"), [
    ("emps/DATA_EMPS.csv", "emps", "linear_axis"),
    ("tx40", "tx40", "tx40/tx40.urdf"),
])  # fmt: skip
def test_real_sound_logs_are_not_doubted(place: str, columns: str, robot: str) -> None:
    """A linear drive and a geared arm whose file lacks drive inertia and wrist coupling are wired as their files say."""
    if not (DATA / place).exists():
        pytest.skip("the real logs are not here (TAU_DYN_DATA)")
    log = read_log(DATA / place, HERE / "identification" / "columns" / f"{columns}.yaml")
    assert check_integrity(load_robot(DATA / robot if "/" in robot else robot), [log]) == []


@pytest.mark.parametrize(("share", "told"), [(0.3, {"force_at_limit"}), (0.01, set())])
def test_forces_that_swing_between_the_drives_limits_are_told(l1, monday, share: float, told: set[str]) -> None:
    """Samples at the limit all over the log leave no cause to confirm; a hundredth in one stretch does no harm."""
    tau, limit = monday.channels["tau_cart2"].copy(), float(l1.effort_limit[1])
    n = len(tau)
    shut = np.random.default_rng(1).random(n) < share if share > 0.1 else np.arange(n) < share * n
    log = monday.with_channels(tau_cart2=np.where(shut, np.copysign(limit, tau), tau))
    found = [w for w in check_integrity(l1, [log]) if get_code(w) == "force_at_limit"]
    assert {get_code(w) for w in found} == told
    assert all("cart2 is at its limit" in w for w in found)
    assert is_diagnosis_invalid(found) is bool(told)  # what is left is chosen by the force's own noise


def test_forces_beyond_the_drives_limit_are_in_another_unit(l1, monday) -> None:
    """No drive exceeds its limit: the advice is the unit, not a gentler motion."""
    scale = 10 * float(l1.effort_limit[1]) / np.abs(monday.channels["tau_cart2"]).max()
    log = monday.with_channels(tau_cart2=scale * monday.channels["tau_cart2"])
    (said,) = [w for w in check_integrity(l1, [log]) if get_code(w) == "force_at_limit"]
    assert "cart2 is beyond its limit" in said and "up to 10 times" in said and "unit and scale of tau_cart2" in said
    assert "gentler" not in said
