"""Numbers are rounded to what their uncertainty leaves, and sentences say what a colleague would."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tau_dyn.render.chart import Chart, choose_power, label
from tau_dyn.render.kinds.fit_quality import build_friction_curves, compute_residuals
from tau_dyn.render.kinds.identification import describe_headline, describe_verdict, name_mass_group
from tau_dyn.render.kinds.parameter_rows import ParameterRow, group_rows
from tau_dyn.render.sketch import draw_robot
from tau_dyn.render.time_view import decimate_min_max, encode_int16, find_gaps
from tau_dyn.results import (
    RobotPicture,
    format_list,
    format_number,
    format_p_value,
    format_percent,
    format_quantity,
    format_with_uncertainty,
)
from tau_dyn.robot import load_robot_from_urdf


@pytest.mark.parametrize(
    ("value", "stderr", "text"),
    [
        (95.136, 0.1963, "95.14 ± 0.20 kg"),
        (12.0, 0.0997, "12.00 ± 0.10 kg"),
        (-166.77, 12.6, "−167 ± 13 kg"),
        (1234.0, 456.0, "1230 ± 460 kg"),
        (2e-9, 14.6, "0 ± 15 kg"),
        (-0.0019, 9.7e-5, "−0.001900 ± 0.000097 kg"),
        (3.0, None, "3 kg"),
    ],
)
def test_value_and_error_share_their_last_digit(value, stderr, text):
    """Two digits of the standard error, the value to the same decimal."""
    assert format_with_uncertainty(value, stderr, "kg") == text


def test_rounding_errors_of_zero_are_zero():
    """4.441e-21 kg m² is the rounding of a product; a nanometre and a p-value are not."""
    assert format_number(4.441e-21) == "0" and format_quantity(6.9e-17, "m") == "0 m"
    assert format_quantity(-2e-9, "m") == "−0.002 µm" and format_number(3e-9) == "3.000e−09"
    assert format_p_value(1e-30) == "p < 0.000001" and format_p_value(2e-4) == "p = 0.0002"


def test_percentages_have_two_digits():
    assert [format_percent(x) for x in (0.412, 3.014, 9.96, 30.7)] == ["0.41 %", "3.0 %", "10 %", "31 %"]


def test_lists_and_groups_read_like_language():
    assert format_list(["a"]) == "a" and format_list("abc") == "a, b and c"
    assert [name_mass_group(n) for n in ("rod2a_link.mass", "cart1_link.mass", "plate_link.mass")] == [
        "rod",
        "cart",
        "plate",
    ]


def test_headline_names_error_and_masses(found, doubtful):
    """The first sentence tells how well force is predicted and what is known of the masses."""
    said = describe_headline(found)
    used, every = (format_percent(e.relative_error_percent) for e in (found.holdout, found.holdout.all_samples))
    assert said.startswith(f"Held-out prediction error: {used} ({every} of all samples); ")
    assert "one mass 11.999 kg, 95 % interval [" in said and said.endswith(".")
    assert describe_verdict(found).level == "good" and describe_verdict(doubtful).level != "good"


def test_thinning_keeps_every_peak():
    """A single sample's spike is still there after thinning by a hundred, at its place."""
    t = np.arange(100_000) / 1000
    x = np.zeros((len(t), 1))
    x[61_234] = 5.0
    thin_t, thinned = decimate_min_max(t, x, 2000)
    assert len(thin_t) <= 2000 and np.ptp(np.diff(thin_t)) < 1e-9
    assert thinned.max() == 5.0
    assert abs(thin_t[int(thinned[:, 0].argmax())] - 61.234) < 0.1


def test_packing_loses_less_than_a_pixel():
    """16 bits leave a part in 60 000 of the range."""
    import base64

    x = np.random.default_rng(1).normal(size=500)
    packed = encode_int16(x)
    back = packed["middle"] + packed["scale"] * np.frombuffer(base64.b64decode(packed["data"]), "<i2")
    np.testing.assert_allclose(back, x, atol=np.ptp(x) / 60_000)


def test_gaps_are_intervals():
    t = np.arange(10.0)
    usable = np.array([0, 1, 1, 0, 0, 1, 0, 1, 1, 0], bool)
    assert find_gaps(t, usable) == [(0, 0), (3, 4), (6, 6), (9, 9)]
    assert find_gaps(t, usable, 2.5) == [(0, 0), (3, 6), (9, 9)]


def test_friction_samples_scatter_about_the_law(found):
    """With the right model the friction points lie on the identified curve, up to the residual."""
    for k, curve in enumerate(build_friction_curves(found)):
        law = np.interp(curve.v, curve.grid, curve.law)
        assert np.sqrt(np.mean((curve.force - law) ** 2)) == pytest.approx(found.train.rms[k], rel=1e-3)


def test_picture_shows_every_joint(robot):
    """The drawing labels the actuated joints."""
    labels = " ".join(re.findall(r"<text[^>]*>([^<]*)</text>", draw_robot(RobotPicture(robot))))
    assert all(joint in labels for joint in robot.actuated)


def test_an_arm_stands_on_its_foot_whatever_its_other_joints_are(write):
    """The line from the base to a turning root joint is drawn by the joint's own kind, not by that of one before it."""
    two = write.two_link().replace(' name="elbow" type="revolute"', ' name="elbow" type="prismatic"')
    beside = write.joint("turn", "revolute", "base_link", "beside_link", "0 1 0", "0 1 0") + write.drive("turn")
    text = two.replace("</robot>", f"{write.rod('beside_link', 1, 0.3)}{beside}</robot>")
    robot = load_robot_from_urdf(text, "two arms")
    assert robot.actuated == ("shoulder", "elbow", "turn")
    assert draw_robot(RobotPicture(robot)).count('class="rod"') == 2


@pytest.mark.parametrize(
    ("limits", "value", "text", "power"),
    [
        ((-3e-7, 4e-7), 2.5e-7, "250", -9),
        ((0.0, 4e-4), 2.5e-4, "250", -6),
        ((0.0, 0.02), 0.005, "0.005", 0),
        ((-120.0, 80.0), -100.0, "−100", 0),
        ((0.0, 3e5), 2e5, "200", 3),
    ],
)
def test_ticks_are_short_and_say_their_power_of_ten(limits, value, text, power):
    """Numbers too long for their place leave out a power of ten, which the axis then names."""
    assert (label(value, limits), choose_power(limits)) == (text, power)
    drawn = Chart(344, 240, (0.0, 1.0), limits, "a", "b", "y").render()
    assert ("× 10" in drawn) == bool(power)


def test_headings_of_the_parameter_table_stand_once():
    """Lines of one joint stand together however they are ordered; headings keep the order of their first line."""
    rows = [ParameterRow(n, g, "known", "", "", "", "", "", None) for n, g in (("a", "x"), ("b", "y"), ("c", "x"))]
    assert [(name, [r.name for r in members]) for name, members in group_rows(rows)] == [
        ("x", ["a", "c"]),
        ("y", ["b"]),
    ]


@pytest.mark.parametrize(
    ("power", "sine", "noise"), [(0, 0, True), (1, 0, True), (2, 0, True), (0, 1, False), (2, 1, False)]
)
def test_differentiated_noise_of_positions_is_no_missing_force(power, sine, noise):
    """Noise of forces, and of positions differentiated once and twice, is told as noise; a slow sine as large as it is not."""
    n, step, cutoff = 2000, 0.03, 10.0
    f = np.fft.rfftfreq(n, step)
    passed = 1 / (1 + (f / cutoff) ** 8)
    for seed in range(5):
        white = np.random.default_rng(seed).normal(size=n)
        e = np.fft.irfft(np.fft.rfft(white) * passed * f**power, n)
        t = np.arange(n) * step
        e = e / e.std() + sine * np.sqrt(2) * np.sin(2 * np.pi * 0.5 * t)
        run = SimpleNamespace(t=t, usable=np.ones((n, 1), bool))
        preparation = SimpleNamespace(force_cutoff_hz=cutoff)
        regression = SimpleNamespace(runs=[run], outputs=("x",), units=("N",), preparation=preparation)
        found: Any = SimpleNamespace(
            estimate=SimpleNamespace(regression=regression, residuals=lambda e=e: [e[:, None]])
        )
        (row,) = compute_residuals(found)
        assert row.white is noise
