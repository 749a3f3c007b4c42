"""The diagnosis' page and terminal: the answer first, every number the result's own, and no name becomes markup."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from tau_dyn.effects import NO_EXPERIMENT
from tau_dyn.evidence import Finding, Gain, Unexplained, Untestable
from tau_dyn.parameters import Parameter
from tau_dyn.render import build_page, print_result, write_report
from tau_dyn.render.chart import draw_figure
from tau_dyn.render.kinds.diagnosis_words import (
    build_signature_figures,
    describe_confirmation,
    describe_gain,
    describe_unexplained,
    format_value,
    list_untestable,
    recommend_model,
)
from tau_dyn.render.kinds.waterfall import (
    build_output_series,
    build_total_series,
    find_step_finding,
    format_finding,
    format_shares,
)
from tau_dyn.results import format_estimate, format_p_value, format_quantity


@pytest.fixture(scope="module")
def page(diagnosed) -> str:
    return build_page(diagnosed, command_line="tau-dyn diagnose 'a & <b>.csv'")


def _markup(page: str) -> str:
    return re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.DOTALL)


def _text(page: str) -> str:
    plain = html.unescape(re.sub(r"<[^>]+>", " ", _markup(page))).replace("\u00a0", " ")
    return re.sub(r"\s+", " ", plain)


def _printed(diagnosis, width: int, written=None, **options) -> str:
    stream = io.StringIO()
    print_result(Console(file=stream, width=width, highlight=False, **options), diagnosis, written)
    return stream.getvalue()


def test_self_contained_and_escaped(page, hostile):
    """No network, only the scripts named by hash, and names with tags stay text."""
    assert not re.search(r"""(src|href|srcset|action)\s*=\s*["']?\s*(https?:)?//""", page)
    assert "url(" not in page and "<link" not in page and "@import" not in page
    scripts = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    digests = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    assert re.findall(r"'sha256-([^']+)'", page) == digests and len(digests) == 2
    markup = _markup(page)
    assert "<script" not in markup and "<img" not in markup and "<b>one" not in markup and "<i>off" not in markup
    assert html.escape(hostile).replace("&#x27;", "&#39;") in markup and "a &amp; &lt;b&gt;.csv" in markup
    assert len(page) < 700_000


def test_the_answer_stands_first(page, diagnosed):
    """Sentence, verdict, waterfall, cards, what is unexplained, time, limits: in this order."""
    marks = ["<h1", 'class="verdict good"', 'id="waterfall"', 'id="finding-1"', 'id="finding-2"', 'id="unexplained-1"',
             'id="time"', 'id="limits"', 'id="parameters"', 'id="trust"', 'id="provenance"']  # fmt: skip
    places = [page.index(mark) for mark in marks]
    assert places == sorted(places)
    assert diagnosed.sentence in _text(page) and "2 causes named" in _text(page)


def test_every_step_shows_its_error_and_leads_to_its_card(page, diagnosed):
    """The waterfall's percentages are the result's, and a cause's bar links to the card that explains it."""
    whole = build_total_series(diagnosed)
    assert [r.left for r in whole.rungs] == [s.errors.relative_error_percent for s in diagnosed.waterfall]
    table = page[page.index('id="waterfall"') : page.index('class="multiples"')]
    assert re.findall(r'strong">([\d.]+) %', table) == ["31", "7.4", "5.3", "2.5", "2.3"]
    for number, finding in enumerate(diagnosed.findings[:2], 1):
        assert f'<a href="#finding-{number}">+ {finding.cause}</a>' in table
        card = page[page.index(f'id="finding-{number}"') :].split("</section>")[0]
        assert finding.cause.replace("_", " ").capitalize() in card and card.count("<svg") == 2


def test_interval_over_all_joints_is_that_of_one_joint_alone(diagnosed):
    """With one output the joined interval is the output's own; with equal ones it is narrower by their number's root."""
    one = replace(diagnosed.waterfall[1].errors, outputs=("a",), rms=np.array([2.0]), ci95=np.array([[1.6, 2.6]]))
    step = replace(diagnosed.waterfall[1], errors=one)
    single = replace(diagnosed, outputs=("a",), units=("N",), waterfall=(step,), traces=(), findings=())
    rung = build_total_series(single).rungs[0]
    np.testing.assert_allclose([rung.low / rung.left, rung.high / rung.left], [0.8, 1.3])
    four = replace(one, outputs=tuple("abcd"), rms=np.full(4, 2.0), ci95=np.tile([1.6, 2.6], (4, 1)))
    joined = replace(single, outputs=tuple("abcd"), units=("N",) * 4, waterfall=(replace(step, errors=four),))
    rung = build_total_series(joined).rungs[0]
    np.testing.assert_allclose((rung.high / rung.left) ** 2 - 1, (1.3**2 - 1) / 2)


def test_each_joint_in_percent_of_its_own_force(diagnosed):
    """A joint's share is its rms over the measured force of the samples that served nothing but the gain."""
    parts = build_output_series(diagnosed)
    assert [p.output for p in parts] == list(diagnosed.outputs)
    judged = [np.concatenate([t.measured[t.usable[:, k] & (t.part == 2), k] for t in diagnosed.traces]) for k in (0, 1)]
    expected = [100 * diagnosed.baseline.rms[k] / np.sqrt(np.mean(judged[k] ** 2)) for k in (0, 1)]
    np.testing.assert_allclose([p.rungs[1].left for p in parts], expected)


def test_a_step_of_two_alike_is_not_guessed(diagnosed):
    """Two findings of one cause are told apart by their joints, or no card is linked."""
    ripple = diagnosed.findings[0]
    twin = replace(ripple, joints=("other",))
    assert find_step_finding("cyclic_ripple other", (ripple, twin)) is twin
    assert find_step_finding("cyclic_ripple", (ripple, twin)) is None
    assert find_step_finding("cyclic_ripple", (ripple,)) is ripple


def test_a_cause_that_raises_the_error_is_said_to_leave_more():
    """A reduction of -10 % with the interval -27 to 6 % is 10 % more, -6 to 27 %."""
    gain = Gain(2.0, 2.2, -10.0, (-27.0, 6.0))
    assert describe_gain(gain).startswith("10 % more residual, 95 % interval [\u22126, 27] %")


@pytest.mark.parametrize(("after", "said"), [(6.43, True), (4.0, False)])
def test_a_small_fall_of_all_errors_names_the_output_that_gains(diagnosed, after, said):
    """6.44 to 6.43 % over all joints says nothing; the joint whose error falls by 15 % is named. From 4 % on it is not needed."""
    names = diagnosed.baseline.outputs
    one, other = np.ones(len(names)), np.ones(len(names))
    other[-1] = 0.85
    case = replace(
        diagnosed,
        recommendation="extended",
        baseline=replace(diagnosed.baseline, rms=one, relative_error_percent=6.44),
        extended=replace(diagnosed.extended, rms=other, relative_error_percent=after),
    )
    text = recommend_model(case).sentence
    unit = diagnosed.units[-1]
    assert (f"most at {names[-1]}, 0.85 {unit} instead of 1 {unit}" in text) is said


def test_cards_say_all_there_is_to_a_finding(page, diagnosed):
    """Equation, parameters with intervals, gain, confirmation, odds, twins and the experiment that separates them."""
    said = _text(page)
    for finding in diagnosed.findings:
        assert finding.equation in said and all(format_estimate(p) in said for p in finding.parameters)
    for text in (
        "29 % less residual, 95 % interval [24, 33] %",
        "97 ± 5 % of the effect predicted from the training data",
        "p = 0.0002, corrected for the number of tests",
        "Indistinguishable from hysteresis",
        diagnosed.findings[1].experiment,
        "23 % of the residual",
        diagnosed.unexplained[0].suggested_formula,
        "not applicable: the refit absorbs the effect",
    ):
        assert text in said, text


def test_what_was_not_found_reads_as_a_limit(page):
    """Detection limits, what could not be tested and the experiment for it stand on the page."""
    said = _text(page)
    limits = said[said.index("Not detected; detection limit") :]
    assert "delay of 0.2 ms" in limits and "backlash of 9 µm" in limits and "quadratic drag 3 N s²/m²" in limits
    assert "the logs give no temperature" in limits and "log a temperature" in limits
    assert "family wise error" in limits and "null: sets" in limits


def test_signature_shows_the_effect_and_its_absence(diagnosed):
    """Without the cause the binned means follow the fitted line; with it they lie near zero, in an equal frame."""
    ripple = diagnosed.findings[0].signature
    without, with_it = map(str, map(draw_figure, build_signature_figures(ripple)))
    assert 'class="predicted"' in without and 'class="predicted"' not in with_it

    def heights(chart: str) -> np.ndarray:
        drawn = re.search(r'<path d="([^"]*)" class="mean"', chart)
        assert drawn
        return np.array([float(y) for y in re.findall(r"M[\d.]+ ([\d.]+)h0", drawn[1])])

    assert np.ptp(heights(without)) > 2.5 * np.ptp(heights(with_it))
    assert re.findall(r'y="([\d.]+)"', without)[2:] == re.findall(r'y="([\d.]+)"', with_it)[2:]
    step = draw_figure(build_signature_figures(diagnosed.findings[1].signature)[0])
    line = re.search(r'<path d="([^"]*)" class="predicted"', str(step))
    assert line and line[1].count("M") == 2, "a step at zero speed is not bridged"


def test_time_view_shows_both_models_and_what_each_part_served(page, diagnosed):
    """Measured, before and after share the time; the confirming and the judging blocks are shaded, and told apart."""
    data = re.search(r'id="panels">(.*?)</script>', page, flags=re.DOTALL)
    panels = json.loads(data[1], parse_constant=lambda c: pytest.fail(f"{c} is not JSON"))
    assert len(panels) == len(diagnosed.traces) * len(diagnosed.outputs)
    assert [c["name"] for c in panels[0]["strips"][0]["curves"]] == ["measured", "before", "after"]
    assert [(round(a), round(b), ink) for a, b, ink in panels[0]["bands"]] == [(18, 24, "confirm"), (24, 30, "held")]


def test_time_view_opens_at_the_output_with_the_largest_residual(page, diagnosed):
    """The reader first looks at the output that the model misses by the largest share of its force."""
    panels = json.loads(re.search(r'id="panels">(.*?)</script>', page, flags=re.DOTALL)[1])
    left, force = (
        np.sum([np.sum(x**2 * trace.usable, axis=0) for trace, x in pairs], axis=0)
        for pairs in (
            [(t, t.measured - t.after) for t in diagnosed.traces],
            [(t, t.measured) for t in diagnosed.traces],
        )
    )
    shares = dict(zip(diagnosed.outputs, left / force, strict=True))
    assert len(set(shares.values())) > 1
    assert panels[0]["joint"] == max(shares, key=shares.get)


def test_parameters_are_compared_with_the_model_without_the_causes(page, diagnosed):
    """The table shows the extended model's values beside the refitted ones; a cause's own parameter is new."""
    row = re.search(r"<tr class=\"known\"><th>slide.stribeck</th>(.*?)</tr>", page)
    assert row and "4.10 ± 0.20" in row[1] and "new" in row[1]
    mass = re.search(r"<tr class=\"known\"><th>one_link.mass</th>(.*?)</tr>", page)
    assert mass and mass[1].count("±") == 2 and "10<" in mass[1]


def test_the_named_joints_stand_out_in_the_picture(page, undecided):
    """The robot's picture shows the answer's joints in another colour, and none where nothing is named."""
    assert page.count('class="cart named"') == 2
    assert 'class="cart named"' not in build_page(undecided)


def test_cannot_tell_names_the_experiment(undecided):
    """A page that cannot tell says so above everything, with the experiment."""
    page = build_page(undecided)
    assert 'class="verdict care"' in page and "Inconclusive" in page
    assert page.index(undecided.experiment) < page.index('id="waterfall"')
    assert undecided.experiment in re.sub(r"\s+", " ", _printed(undecided, 80))


@pytest.mark.parametrize("width", [48, 60, 80, 120])
def test_terminal_keeps_bars_and_numbers_whole(diagnosed, width):
    """Each step is one line with its bar and percentage, however narrow; nothing is wider than 100 columns."""
    lines = _printed(diagnosed, width, {"report": "r.html"}).splitlines()
    assert max(map(len, lines)) <= min(width, 100)
    for rung, share in zip(
        build_total_series(diagnosed).rungs, ("31 %", "7.4 %", "5.3 %", "2.5 %", "2.3 %"), strict=True
    ):
        line = next(x for x in lines if x.strip().startswith(rung.label))
        assert share in line and re.search("[█▏▎▍▌▋▊▉]", line) and line.count("±") == line.count("± ")
    assert "report → r.html" in lines[-1]


def test_terminal_is_plain_when_piped_and_says_what_is_uncertain(diagnosed):
    """Colour only for people; twins, limits and what could not be tested stand below the bars, in this order."""
    text = _printed(diagnosed, 100)
    assert "\x1b" not in text and "\x1b[" in _printed(diagnosed, 100, force_terminal=True)
    marks = [
        "nominal parameters",
        "noise floor",
        "Confirmed:",
        "Differs from the robot file",
        "Unexplained",
        "These data cannot separate",
        "Not detected; detection limit",
        "Not testable",
    ]
    assert [text.index(m) for m in marks] == sorted(text.index(m) for m in marks)
    assert not [line for line in text.splitlines() if line != line.rstrip()]


def test_the_terminal_gives_the_size_of_each_confirmed_cause(diagnosed):
    """A ripple or a Stribeck peak is told with its force and unit at 80 columns, not by the joint alone."""
    said = " ".join(_printed(diagnosed, 80).split("Confirmed:")[1].split("Differs from")[0].split())
    for finding in (f for f in diagnosed.findings if f.status == "confirmed"):
        assert format_estimate(finding.parameters[0]) in said


def test_bars_that_differ_do_not_read_alike():
    """0.262 and 0.258 % get the digit that tells them apart; 29 % keeps two, and equal bars stay as they are."""
    assert format_shares([28.6, 0.2618, 0.2582, 0.2589]) == ["29 %", "0.262 %", "0.258 %", "0.259 %"]
    assert format_shares([0.5, 0.5, np.nan]) == ["0.5 %", "0.5 %", ""]


def test_written_whole(tmp_path, diagnosed):
    """`write_report` takes a diagnosis as it takes an identification."""
    write_report(tmp_path / "r.html", diagnosed)
    assert (tmp_path / "r.html").read_text(encoding="utf-8").startswith("<!doctype html>")


def test_numbers_in_units_of_their_size():
    """Small lengths, speeds and times take a prefix; forces and large ones do not."""
    assert [format_quantity(x, u) for x, u in ((0.0209, "m"), (9e-6, "m"), (2e-4, "s"), (1.5, "m"), (0.02, "N"))] == [
        "20.9 mm", "9 µm", "0.2 ms", "1.5 m", "0.02 N"
    ]  # fmt: skip


def test_odds_and_shares_in_words():
    """A chance reads as odds, a confirmation that falls short says so."""
    assert [format_p_value(p) for p in (0.0, 2e-4, 0.03, 0.9)] == [
        "p < 0.000001", "p = 0.0002", "p = 0.03", "p = 0.9"
    ]  # fmt: skip
    assert "weaker than predicted" in describe_confirmation((0.3, 0.1)) and "weaker" not in describe_confirmation(
        (0.9, 0.1)
    )
    assert [format_value(v) for v in (True, 3, 0.25, None, [1, 2])] == ["yes", "3", "0.25", "none", "1 and 2"]


def test_sets_of_variables_that_explain_it_as_well_are_listed():
    """What may depend on one pair of variables or as well on another says both."""
    item = Unexplained(
        "b", ("q_a", "v_b"), 0.1, "", 1e-4, "confirmed", indistinguishable_from=(("v_c",), ("q_c", "v_b"))
    )
    assert "depends on q_a and v_b (or equally on v_c; or on q_c and v_b); no known" in describe_unexplained(item)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("arm_link.mass_error", 1.1, "1.100 ± 0.045 kg more than nominal"),
        ("arm_link.mass_error", -1.1, "1.100 ± 0.045 kg less than nominal"),
        ("arm_link.mass", 10.1, "10.100 ± 0.045 kg in all"),
        ("payload.mass", 2.0, "2.000 ± 0.045 kg"),
    ],
)
def test_a_mass_is_told_from_a_difference(name, value, said):
    """What a link is heavier or lighter by reads so, all of its mass reads so, and a payload is what is carried."""
    p = Parameter(name, value, "kg", stderr=0.045)
    finding = Finding("link_mass", ("arm_link",), "parameter", 9.0, 1e-6, (p,), None, (), "", "", "")
    assert format_finding(finding)[-1] == said


def test_causes_of_parts_that_a_robot_lacks_are_not_listed():
    """A serial arm has no guideway: only causes that other logs would test are listed as not testable."""
    lacking = Untestable("guideway_nonparallel", "the robot has no carts", NO_EXPERIMENT)
    cold = Untestable("thermal_drift", "the logs give no temperature", "the same motion repeated from cold to warm")
    assert list_untestable(SimpleNamespace(untestable=(lacking, cold))) == [cold]
