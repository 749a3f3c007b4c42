"""The window: open to this computer only, follows the sliders where the loops close, plays, and lights what it is told."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("viser")

from tau_dyn.log import Log
from tau_dyn.robot import load_robot
from tau_dyn.view import Viewer, build_playback
from tau_dyn.view.results import Cloud, ErrorVectors, Findings, Uncertainty, ViewedFinding
from tau_dyn.view.shapes import NAMED, escape_html, format_keys, format_legend


@pytest.fixture(scope="module")
def open_window():
    """A window on the complete Gantry-Tau, closed after all tests."""
    made = Viewer(load_robot("gantry_tau", arms="complete"), port=18080)
    yield made
    made.close()


@pytest.fixture
def viewer(open_window):
    """The same window with the robot back at home, nothing lit."""
    open_window.show(open_window.robot.home)
    open_window.light(())
    return open_window


def test_sliders_move_the_plate_and_say_where_it_cannot_be(viewer):
    """Within reach the robot follows; beyond it stays where it was and the reason stands under the sliders."""
    robot, before = viewer.robot, viewer.q.copy()
    there = robot.home + np.array([0.05, -0.03, 0.02])
    assert viewer.show(there) and viewer.message == ""
    assert_allclose(viewer.q, there)
    assert not viewer.show(robot.home + np.array([6.0, 0.0, 0.0]))
    assert "out of reach" in viewer.message and "robot waits" in viewer._note.content
    assert_allclose(viewer.q, there)
    assert not np.allclose(before, there)


def test_a_hand_on_a_slider_moves_the_robot(viewer):
    """A slider's new value is where its joint goes, the others stay; showing positions is no hand on the sliders."""
    slider = viewer._sliders[1]
    slider.value = slider.value + 0.05
    _settle(lambda: abs(viewer.q[1] - slider.value) < 1e-12)
    assert_allclose(viewer.q, viewer.robot.home + [0, 0.05, 0], atol=1e-12)
    there = viewer.robot.home + 0.0123456789
    viewer.show(there)
    time.sleep(0.2)
    assert_allclose(viewer.q, there, atol=0)


def test_turning_joints_are_shown_in_degrees():
    """A Delta's arm at home, -0.35 rad, stands at -20.05 degrees on its slider and goes where the slider says."""
    made = Viewer(load_robot("delta"), port=18085)
    try:
        assert_allclose(made._sliders[0].value, np.rad2deg(-0.35))
        made._sliders[0].value = -10.0
        _settle(lambda: abs(made.q[0] + np.deg2rad(10.0)) < 1e-9)
    finally:
        made.close()


def test_joint_frames_follow_the_joints_when_asked_for():
    """Hidden at first; shown, each stands where its joint is, and joints in one place share a label."""
    made = Viewer(load_robot("scara_tau"), port=18090)
    try:
        frames = made._frames
        assert not any(h.visible for h in (*frames.handles, *frames.labels))
        frames.seen(True)
        assert all(h.visible for h in (*frames.handles, *frames.labels))
        made.show(made.robot.home + 0.02)
        for joint, handle in zip(made.robot.actuated, frames.handles, strict=True):
            assert_allclose(handle.position, made.placer.at(joint), atol=1e-12)
        named = [name for label in frames.labels for name in label.text.split(", ")]
        assert sorted(named) == sorted(made.robot.actuated)
    finally:
        made.close()


def test_a_narrow_window_has_the_robot_in_sight(viewer):
    """A telephone's camera stands further away than a screen's and looks below the robot; a screen's is left alone."""
    phone, screen = _Client(0.5), _Client(1.6)
    viewer._fit(phone)
    viewer._fit(screen)
    assert screen.camera.position is None
    low, high = viewer._sight.min(axis=0), viewer._sight.max(axis=0)
    away = np.linalg.norm(phone.camera.position - phone.camera.look_at)
    half_width = 0.5 * np.tan(0.75 / 2) * away  # of what is in sight, to either side
    assert half_width > 0.5 * np.linalg.norm((high - low)[:2]) and phone.camera.look_at[2] < low[2]


def test_missing_meshes_are_named(write, tmp_path):
    """The window opens without them and its warnings say which."""
    path = tmp_path / "robot.urdf"
    look = '</inertial><visual><geometry><mesh filename="gone.stl"/></geometry></visual></link>'
    path.write_text(write.two_link().replace("</inertial></link>", look, 1))
    made = Viewer(load_robot(path), port=18095)
    try:
        assert any("gone.stl" in sentence for sentence in made.warnings)
    finally:
        made.close()


class _Client:
    """A page that has just opened, this wide for its height."""

    def __init__(self, aspect):
        self.camera = SimpleNamespace(aspect=aspect, position=None, look_at=None)


def test_the_window_is_open_to_this_computer_only(viewer):
    """The server listens on the loopback address, and viser's relay to the internet does not answer."""
    assert viewer.url.startswith("http://127.0.0.1:")
    assert viewer.server.get_host() == "127.0.0.1"
    assert viewer.server.request_share_url() is None


def test_a_log_plays_at_the_rate_of_the_eye():
    """500 Hz become about 30 pictures a second, with the references as ghost where the log has them."""
    robot, t = load_robot("linear_axis"), np.arange(1000) / 500
    log = Log(t, {"q_axis": np.sin(t), "q_ref_axis": np.cos(t)})
    made = build_playback(log, robot)
    assert 25 < len(made.t) / made.t[-1] < 35
    assert made.ghost is not None and made.ghost.shape == made.q.shape == (len(made.t), 1)
    assert made.ghost_is == "commanded"


def test_the_simulated_motion_is_the_ghost_at_the_same_times():
    """A simulated log at another rate is read at the measured one's times; after its end there is nothing."""
    robot, t = load_robot("linear_axis"), np.arange(1000) / 500
    measured, s = Log(t + 7.0, {"q_axis": 0.1 * np.sin(t)}), np.arange(1500) / 1000
    made = build_playback(measured, robot, Log(s, {"q_axis": 0.1 * np.sin(s) + 0.01}))
    shared = made.t < 1.49
    assert made.ghost_is == "simulated" and made.ghost is not None
    assert_allclose(made.ghost[shared] - made.q[shared], 0.01, atol=1e-6)
    assert np.isnan(made.ghost[-1]).all()
    assert_allclose(made.apart(), 0.01, atol=1e-6)


def test_playing_goes_forward_and_pausing_stops(viewer):
    """Pressed once it runs through the log with the robot, pressed again it stands."""
    t = np.arange(300) / 100
    q = viewer.robot.home + 0.05 * np.sin(t)[:, None]
    names = viewer.robot.actuated
    log = Log(
        t,
        {f"q_{j}": q[:, k] for k, j in enumerate(names)} | {f"q_ref_{j}": q[:, k] + 1e-4 for k, j in enumerate(names)},
    )
    viewer.play(build_playback(log, viewer.robot))
    viewer.player.seek(1.0)
    assert_allclose(viewer.q, viewer.robot.home + 0.05 * np.sin(1.0), atol=2e-3)
    viewer.player._toggle(None)
    _settle(lambda: viewer.player.t > 1.1)
    viewer.player._toggle(None)
    time.sleep(0.1)
    at = viewer.player.t
    time.sleep(0.15)
    assert viewer.player.t == at
    first = next(k for k, s in enumerate(viewer.placer.shapes) if s.joint)

    def apart():
        return abs(viewer.player._ghost.handles[0].position - viewer.figure.handles[first].position)[0]

    _settle(lambda: abs(apart() - 1e-4) < 1e-6)
    viewer.player._enlarged.value = "1000"
    _settle(lambda: abs(apart() - 0.1) < 1e-3)  # 0.1 mm, enlarged a thousand times


def test_a_finding_lights_what_its_joint_carries(viewer):
    """Cart 2's finding colours cart 2 and its rods; chosen away, all have their own colours again."""
    from tau_dyn.view.panels import FindingsPanel

    own = [tuple(h.color) for h in viewer.figure.handles]
    rows = (
        ViewedFinding("stribeck (confirmed)", "Cart 2 sticks.", ("cart2",)),
        ViewedFinding("rod_length (suspected)", "", ("rod1",)),
    )
    panel = FindingsPanel(viewer, Findings("Two causes.", rows))
    assert _lit(viewer) == {"cart2", "rod2a_pitch", "rod2b_pitch"}
    assert "Cart 2 sticks." in panel._said.content
    panel.choose("2. rod_length (suspected)")
    assert _lit(viewer) == {"rod1_pitch"}
    panel.choose("none")
    assert [tuple(h.color) for h in viewer.figure.handles] == own


def test_text_from_files_is_text(viewer):
    """Names and sentences with tags stay text in every panel that is HTML."""
    from tau_dyn.view.panels import FindingsPanel

    bad = "<img src=x onerror=alert(1)>"
    panel = FindingsPanel(viewer, Findings(bad, (ViewedFinding(bad, bad, (bad,)),)))
    assert "<img" not in panel._said.content and "&lt;img" in panel._said.content
    value = np.array([0.0, 1.0])
    for page in (escape_html(bad), format_legend(bad, value), format_keys({bad: NAMED})):
        assert "<img" not in page and "&lt;img" in page
    points = np.array([[0.0, 0, 0], [0.1, 0.1, 0.1]])
    viewer.add([Cloud(bad, points, {bad: value}, bad), Uncertainty({bad: 0.1, "plate_link": float("nan")})])
    assert "<img" not in viewer.panels[-2]._legend.content


def test_error_arrows_are_long_enough_to_see_and_carry_their_numbers(viewer):
    """Errors of 0.1 mm over a metre are enlarged to about a tenth of it, and the panel says rms and largest in mm."""
    from tau_dyn.view.panels import ErrorsPanel

    points = np.random.default_rng(1).uniform(-0.5, 0.5, (40, 3))
    vectors = np.tile([1e-4, 0, 0], (40, 1))
    panel = ErrorsPanel(viewer, ErrorVectors(points, {"robot file": vectors, "complete": vectors / 10}))
    assert 0.05 < 1e-4 * float(panel._enlarged.value) < 0.2
    assert "rms 0.1 mm" in panel._said.content
    panel._model.value = "complete"
    panel.draw()
    assert "rms 0.01 mm" in panel._said.content


def _lit(viewer):
    lit = [k for k, h in enumerate(viewer.figure.handles) if tuple(h.color) == NAMED]
    return {viewer.robot.model.names[viewer.placer.shapes[k].joint] for k in lit}


def _settle(done, seconds=5.0):
    end = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.02)
