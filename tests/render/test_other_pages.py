"""The pages of check, simulate and excite: self-contained, escaped, and saying what the terminal says."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import re

import numpy as np
import pytest
from rich.console import Console

from tau_dyn.log import Log, check_log
from tau_dyn.render import ExcitingMotion, SimulatedLog, build_page, print_result
from tau_dyn.render.kinds.identification import describe_headline, describe_verdict
from tau_dyn.render.kinds.recording import resample_evenly
from tau_dyn.simulate import Sensors, Trajectory

COMMAND = "tau-dyn check 'a & <b>.csv'"


def _log(name: str) -> Log:
    t = np.arange(0, 8, 0.004)
    q = 0.2 * np.sin(2.3 * t), 0.3 * np.sin(3.1 * t)
    noise = 1e-6 * np.random.default_rng(3).normal(size=(2, len(t)))
    channels = {"q_slide": q[0] + noise[0], "q_lift": q[1] + noise[1], "q_ref_slide": q[0], "q_ref_lift": q[1]}
    return Log(t, channels | {"tau_slide": 50 * np.cos(2.3 * t), "tau_lift": 9 * np.cos(3.1 * t)}, name)


@pytest.fixture(scope="module")
def fine(hostile) -> Log:
    return _log(hostile)


@pytest.fixture(scope="module")
def poor(fine) -> Log:
    """A gap, lost samples, a jittery clock and a clipped force."""
    rng = np.random.default_rng(4)
    keep = np.ones(fine.n_samples, bool)
    keep[700:900] = keep[rng.integers(1000, 1900, 9)] = False
    channels = {k: np.array(v)[keep] for k, v in fine.channels.items()}
    channels["tau_lift"] = np.clip(channels["tau_lift"], -4, 4)
    return Log((fine.t + 3e-4 * rng.uniform(-1, 1, fine.n_samples))[keep], channels, fine.name)


@pytest.fixture(scope="module")
def motion(robot, hostile) -> Trajectory:
    t = np.arange(0, 4, 0.01)
    w = np.array([2.3, 3.1])
    q, v, a = 0.8 * np.sin(np.outer(t, w)), 0.8 * w * np.cos(np.outer(t, w)), -0.8 * w**2 * np.sin(np.outer(t, w))
    return Trajectory(robot.actuated, t, q, v, a, hostile, (f"scaled because of {hostile}",))


@pytest.fixture(scope="module")
def pages(fine, poor, motion, robot, plant) -> dict[str, str]:
    return {
        "fine": build_page(check_log(fine, robot), log=fine, robot=robot, command_line=COMMAND),
        "poor": build_page(check_log(poor), log=poor, command_line=COMMAND),
        "simulation": build_page(
            SimulatedLog(fine.with_warnings(fine.name), plant, Sensors(force_noise=2.0), {"motion": "<i>"}),
            command_line=COMMAND,
        ),
        "excitation": build_page(ExcitingMotion(motion, plant, 42.0, made={"trials": "3"}), command_line=COMMAND),
    }


def _markup(page: str) -> str:
    return re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.DOTALL)


def _text(page: str) -> str:
    return html.unescape(re.sub(r"<[^>]+>", " ", _markup(page))).replace("\u00a0", " ")


@pytest.mark.parametrize("which", ["fine", "poor", "simulation", "excitation"])
def test_self_contained_and_escaped(pages, which, hostile):
    """No network, only the scripts named by hash, and names with tags stay text."""
    page = pages[which]
    assert not re.search(r"""(src|href|srcset|action)\s*=\s*["']?\s*(https?:)?//""", page)
    assert "url(" not in page and "<link" not in page
    scripts = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    digests = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    assert re.findall(r"'sha256-([^']+)'", page) == digests and len(digests) == 2
    markup = _markup(page)
    assert "<script" not in markup and "<img" not in markup and "<i>" not in markup
    assert html.escape(hostile).replace("&#x27;", "&#39;") in markup
    assert "a &amp; &lt;b&gt;.csv" in markup
    assert len(page) < 600_000


@pytest.mark.parametrize("which", ["fine", "poor", "simulation", "excitation"])
def test_time_view_has_every_joint(pages, which, robot):
    """The data are strict JSON, on the panels' own clock, with strips of equal length."""
    data = re.search(r'<script type="application/json" id="panels">(.*?)</script>', pages[which], flags=re.DOTALL)
    assert data and "<" not in data[1]
    panels = json.loads(data[1], parse_constant=lambda c: pytest.fail(f"{c} is not JSON"))
    assert {p["joint"] for p in panels} == set(robot.actuated)
    for panel in panels:
        for curve in (c for s in panel["strips"] for c in s["curves"]):
            assert len(base64.b64decode(curve["data"])) == 2 * panel["n"]


def test_check_judges_first_and_tells_remedies(pages, poor):
    """The verdict is the headline; findings stand worst first, each with its remedy, before the plots."""
    assert 'class="verdict good"' in pages["fine"] and "Problems and fixes" not in pages["fine"]
    page, checked = pages["poor"], check_log(poor)
    said = _text(page)
    bad = [f for f in checked.findings if f.severity != "ok"]
    assert bad and all(f.remedy in said for f in bad)
    assert page.index("Problems and fixes") < page.index("Recorded signals")
    order = re.findall(r'<td class="verdict \w+"><span>(\w+)</span>', page)
    assert order == sorted(order, key=["fault", "warning"].index) and len(order) == len(bad)
    assert "steps differ by up to" in said and "how often" in said
    assert "how often" not in _text(pages["fine"])


def test_check_of_a_log_with_nothing(hostile):
    """A log without any joint still gives a page that says so."""
    bare = Log(np.arange(0, 1, 0.01), {"temperature": np.ones(100)}, hostile)
    page = build_page(check_log(bare), log=bare)
    assert 'class="verdict poor"' in page and "Log joint positions." in page


def test_gaps_break_the_curves(poor):
    """Where nothing was recorded nothing is drawn."""
    t, channels, there = resample_evenly(poor, ["q_slide"])
    hole = (t > poor.t[699] + 1e-9) & (t < poor.t[700] - 1e-9)
    assert np.ptp(np.diff(t)) < 1e-9 and hole.sum() > 150
    assert np.isnan(channels["q_slide"][hole]).all() and np.array_equal(there, np.isfinite(channels["q_slide"]))


def test_simulation_tells_truth_and_notes(pages, truth, hostile):
    """True values, sensors and notes are on the page."""
    said = _text(pages["simulation"])
    assert all(name in said for name in truth) and "force noise" in said
    assert "follows its reference" in said and 'class="warnings"' in pages["simulation"]


def test_saturated_drive_is_named(plant, fine):
    """A force at its limit changes the judgement."""
    force = np.clip(40 * fine.channels["tau_slide"], -1000, 1000)
    page = build_page(SimulatedLog(fine.with_channels(tau_slide=force), plant))
    assert 'class="verdict care"' in page and "The force of slide reached its limit" in page


def test_excitation_compares_with_limits(pages, motion):
    """Condition number first, then travel and speed against their limits."""
    page = pages["excitation"]
    assert "condition number 42" in _text(page) and 'class="verdict care"' in page
    assert f"{np.abs(motion.v).max(axis=0)[0]:#.3g}" in page and "−1 … 1" in page
    panels = json.loads(re.search(r'id="panels">(.*?)</script>', page, flags=re.DOTALL)[1])
    assert any(strip["bounds"] for strip in panels[0]["strips"])


def test_truth_makes_the_headline_honest(found, truth):
    """With the truth at hand the headline gives real errors, and a wrong estimate is not called ready to use."""
    said = describe_headline(found, truth)
    assert "of the true value" in said and "is known to" not in said
    wrong = truth | {"one_link.mass": 2 * truth["one_link.mass"]}
    assert "up to 50 % from the true value, more than 3 standard errors" in describe_headline(found, wrong)
    judged = describe_verdict(found, wrong)
    assert judged.level == "care" and "one_link.mass" in judged.sentence


def test_no_blanks_at_line_ends(found, truth, fine):
    """Terminal lines end where their text ends, in colour and without."""
    for terminal in (False, True):
        stream = io.StringIO()
        console = Console(file=stream, width=90, force_terminal=terminal)
        print_result(console, found, {"model": "m.yaml"}, truth=truth)
        print_result(console, check_log(fine), log=fine)
        plain = re.sub(r"\x1b\[[0-9;]*m", "", stream.getvalue())
        assert not [line for line in plain.splitlines() if line != line.rstrip()]


@pytest.mark.parametrize(("at", "text"), [(-1.688e-16, "y = 0 m"), (-0.25, "y = -0.25 m"), (4.441e-21, "y = 0 m")])
def test_a_section_through_a_rounding_error_is_one_through_zero(at: float, text: str) -> None:
    """A plane that is 1e-16 m away from the origin goes through it."""
    from tau_dyn.kinematics.workspace.study import Section

    none = np.zeros(0)
    assert Section(1, at, 0, 2, none, none, none, 0.0).name == text
