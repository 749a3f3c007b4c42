"""The page of resonances: self-contained, escaped, saying what the terminal says, drawing only what it knows."""

from __future__ import annotations

import html
import io
import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from scipy.signal import lfilter

from tau_dyn.log import Log
from tau_dyn.modes import Modes, find_modes
from tau_dyn.render import build_page, print_result
from tau_dyn.render.chart import Chart, choose_log_ticks
from tau_dyn.render.kinds.modes_words import describe_headline, describe_verdict, format_frequency, format_mode_interval
from tau_dyn.render.pictures import draw_shape
from tau_dyn.results import Ribbon, ShapePicture, find_space_axes


@pytest.fixture(scope="module")
def found(hostile) -> Modes:
    """Two outputs of a resonance at 5 Hz, in a log with a hostile name."""
    rng = np.random.default_rng(0)
    force = np.repeat(rng.choice([-1.0, 1.0], 450), 2)
    pole = np.exp(0.02 * 2 * np.pi * 5.0 * (-0.03 + 1j))
    y = lfilter([0, 1], [1, -2 * pole.real, abs(pole) ** 2], force)
    noise = 0.02 * y.std() * rng.normal(size=(2, 900))
    log = Log(np.arange(900) * 0.02, {"<b>f": force, "x_tool": y + noise[0], "y_tool": 0.4 * y + noise[1]}, hostile)
    return find_modes(log, ["<b>f"], ["x_tool", "y_tool"], order=2, delay=0)


@pytest.fixture(scope="module")
def page(found) -> str:
    """The page of it."""
    return build_page(found, logs=[(found.traces[0].log, "00ff")], command_line="tau-dyn modes '<i>.csv'")


def _markup(page: str) -> str:
    return re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.DOTALL)


def test_self_contained_and_escaped(page, hostile):
    """No network, no markup from names, and small enough to mail."""
    assert not re.search(r"""(src|href|srcset|action)\s*=\s*["']?\s*(https?:)?//""", page)
    assert "url(" not in page and len(page) < 900_000
    markup = _markup(page)
    assert "<script" not in markup and "<i>.csv" not in markup and "<b>f" not in markup
    assert html.escape(hostile).replace("&#x27;", "&#39;") in markup


def test_every_section_is_there(page):
    """Modes, response, time view, pulse, order, poles, tests, mass-damping-stiffness and reasons each have their place."""
    for name in ("modes", "response", "time", "impulse", "order", "poles", "tests", "mechanical", "why", "provenance"):
        assert f'id="{name}"' in page
    assert "nan" not in re.sub(r"<[^>]*>", " ", _markup(page)).lower().split()
    drawn = re.findall(r' d="([^"]*)"', page)
    assert drawn and not any("nan" in d or "inf" in d for d in drawn)


def test_page_and_terminal_say_the_same(found, page):
    """The headline, the verdict and the frequency stand on both."""
    out = io.StringIO()
    print_result(Console(file=out, width=100), found, {"report": "r.html"})
    printed = " ".join(out.getvalue().split())
    text = " ".join(html.unescape(re.sub(r"<[^>]+>", " ", _markup(page))).replace("\u00a0", " ").split())
    for words in (describe_headline(found), describe_verdict(found).sentence, format_frequency(found.modes[0])):
        assert words in printed and words in text
    assert "report → r.html" in printed


def test_words_follow_the_numbers(found):
    """A poor fit that answers to the inputs is not to be relied on, one that is disturbance leaves the resonances standing."""
    poor = replace(found.judged, percent=np.array([20.0, 30.0]))
    bad = tuple(replace(t, p_value=1e-6) for t in found.independence)
    assert describe_verdict(replace(found, holdout=poor, independence=bad)).level == "poor"
    calm = tuple(replace(t, p_value=0.5) for t in found.independence)
    assert describe_verdict(replace(found, holdout=poor, independence=calm)).level == "care"
    assert describe_verdict(replace(found, holdout=None)).level == "care"
    assert "No resonance" in describe_headline(replace(found, modes=()))
    assert format_mode_interval(5.0, 0.01) == "4.980 … 5.020"


def test_tools_move_in_space_and_others_in_bars():
    """Axes of one point are drawn as a path in space, anything else as bars."""
    assert find_space_axes(["x_tool", "y_tool"]) == {"x": 0, "y": 1}
    assert find_space_axes(["ax_tool", "ay_tool", "az_tool"]) == {"x": 0, "y": 1, "z": 2}
    assert find_space_axes(["x_tool", "force"]) == {} and find_space_axes(["place1", "place2"]) == {}
    shape = np.array([1.0, 0.5j])
    assert "animateMotion" in draw_shape(ShapePicture(shape, ("x_tool", "y_tool")))
    assert "bar-now" in draw_shape(ShapePicture(shape, ("place1", "place2")))


def test_logarithmic_axes_are_even_in_ratio():
    """A factor of ten is as wide everywhere, ticks are few enough to read, and areas stay inside."""
    chart = Chart(344, 200, (0.5, 50.0), (0.0, 1.0), "", "f", "y", log_x=True)
    assert chart.x(5.0) - chart.x(0.5) == pytest.approx(chart.x(50.0) - chart.x(5.0))
    for low, high in ((0.5, 50.0), (1e-3, 1e4), (9.0, 11.0)):
        ticks = choose_log_ticks(low, high, 6)
        assert 2 <= sum(named for _, named in ticks) <= 12
        assert all(low * 0.999 <= v <= high * 1.001 for v, _ in ticks)
    assert chart.draw(Ribbon(np.array([1.0, 2.0]), np.array([np.nan, 0.0]), np.array([1.0, 1.0]))) == ""
