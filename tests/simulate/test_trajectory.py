"""Trajectories: files, logs, clocks, and pieces joined without jumps."""

import numpy as np
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.log import Log
from tau_dyn.simulate import Trajectory, build_fourier_motion, concatenate, move


def test_motion_survives_its_file(gantry, tmp_path):
    """Written and read, positions, speeds and accelerations agree to 12 digits."""
    motion = build_fourier_motion(gantry, 4.0)
    motion.to_csv(tmp_path / "m.csv")
    back = Trajectory.from_csv(tmp_path / "m.csv", motion.joints)
    for key in ("t", "q", "v", "a"):
        assert_allclose(getattr(back, key), getattr(motion, key), atol=1e-10)


def test_spline_finds_speeds_of_positions_alone(tmp_path):
    """A file of positions at 100 Hz gives the speed of a 1 Hz sine to 1e-5 and its acceleration to 1e-3."""
    t = np.arange(301) / 100
    w = 2 * np.pi
    text = "t,q_ref_axis\n" + "\n".join(f"{x:.6f},{np.sin(w * x):.15g}" for x in t) + "\n"
    (tmp_path / "m.csv").write_text(text)
    motion = Trajectory.from_csv(tmp_path / "m.csv", ["axis"])
    assert_allclose(motion.v[10:-10, 0], w * np.cos(w * t)[10:-10], atol=1e-4)
    fine = motion.resampled(1000.0)
    assert_allclose(fine.q[100:-100, 0], np.sin(w * fine.t)[100:-100], atol=1e-7)
    assert_allclose(fine.a[100:-100, 0], -(w**2) * np.sin(w * fine.t)[100:-100], atol=1e-2)


def test_measured_positions_are_smoothed_before_they_are_a_reference(rng):
    """A log without `q_ref` works, with a note; its encoder noise does not become acceleration."""
    t = np.arange(4000) / 1000
    q = 0.1 * np.sin(2 * np.pi * t)
    log = Log(t, {"q_axis": q + 1e-6 * rng.standard_normal(len(t))}, "monday.csv")
    motion = Trajectory.from_log(log, ["axis"])
    assert "monday.csv has no q_ref columns" in motion.notes[0]
    assert_allclose(motion.a[200:-200, 0], -((2 * np.pi) ** 2) * q[200:-200], atol=0.1)
    with_reference = Trajectory.from_log(log.with_channels(q_ref_axis=q), ["axis"])
    assert with_reference.notes == () and np.array_equal(with_reference.q[:, 0], q)


def test_pieces_join_without_a_jump(gantry):
    """Between pieces a minimum-jerk move: continuous position, speed and acceleration, at most the speed asked for."""
    joints = gantry.robot.actuated
    pieces = [build_fourier_motion(gantry, 4.0), move(joints, np.full(3, 0.3), np.full(3, 0.1), 1.0)]
    whole = concatenate(pieces, rest=0.3, speed=0.2)
    assert_allclose(np.diff(whole.t), 1e-3, rtol=1e-6)
    assert_allclose(np.diff(whole.q, axis=0) * 1000, (whole.v[1:] + whole.v[:-1]) / 2, atol=1e-5)
    assert np.max(np.abs(np.diff(whole.a, axis=0))) < 0.1
    between = (whole.t > 4.0) & (whole.t < whole.t[-1] - 1.0)
    assert_allclose(np.max(np.abs(whole.v[between])), 0.2, rtol=1e-3)
    assert np.all(whole.v[(whole.t > 4.0) & (whole.t < 4.3)] == 0.0)


def test_moving_pieces_and_other_joints_are_refused(gantry, block):
    """Only motions of the same joints that start and end at rest can be joined."""
    whole = build_fourier_motion(gantry, 4.0)
    cut = Trajectory(whole.joints, whole.t[:1500], whole.q[:1500], whole.v[:1500], whole.a[:1500], "cut")
    with raises_code("mismatch"):
        concatenate([cut, whole])
    with raises_code("mismatch"):
        concatenate([whole, build_fourier_motion(block, 4.0)])


def test_faulty_motions_say_what_is_wrong(tmp_path):
    """Shapes, clocks, missing columns."""
    with raises_code("wrong_shape"):
        Trajectory(("axis",), np.arange(3.0), *np.zeros((3, 2, 1)))
    with raises_code("bad_sample"):
        Trajectory(("axis",), np.zeros(3), *np.zeros((3, 3, 1)))
    (tmp_path / "m.csv").write_text("t,q_other\n0,1\n1,2\n2,3\n")
    with raises_code("missing_column", "q_axis"):
        Trajectory.from_csv(tmp_path / "m.csv", ["axis"])
