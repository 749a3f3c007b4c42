"""The page is self-contained, says what the result says, and lets no name become markup."""

from __future__ import annotations

import html
import json
import re

import pytest

from tau_dyn.render import build_page, write_report
from tau_dyn.results import format_number, format_with_uncertainty, round_to_stderr


@pytest.fixture(scope="module")
def page(found, truth) -> str:
    return build_page(found, command_line="tau-dyn identify 'a & <b>.csv'", truth=truth)


def _markup(page: str) -> str:
    """Return the page without its scripts, styles and data."""
    return re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.DOTALL)


def test_nothing_is_loaded_from_elsewhere(page):
    """No element and no style refers to anything outside, and the policy forbids it."""
    assert not re.search(r"""(src|href|srcset|action)\s*=\s*["']?\s*(https?:)?//""", page)
    assert "@import" not in page and "url(" not in page
    assert "<link" not in page and "<iframe" not in page
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)
    assert policy and policy[1].startswith("default-src 'none'") and "http" not in policy[1]


def test_policy_names_exactly_the_scripts_inside(page):
    """A script that somebody slips in would not run: each allowed one is named by its hash."""
    import base64
    import hashlib

    scripts = re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)
    digests = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    assert re.findall(r"'sha256-([^']+)'", page) == digests and len(digests) == 2
    assert "'unsafe-inline'; script" not in page.replace("style-src 'unsafe-inline'; img-src data:; script", "")


def test_hostile_names_stay_text(page, hostile):
    """A robot or log name with tags appears as written and opens no tag."""
    markup = _markup(page)
    assert "<script" not in markup and "<img" not in markup
    assert html.escape(hostile).replace("&#x27;", "&#39;") in markup
    assert "&lt;img src=x onerror=alert(1)&gt;" in markup
    assert "a &amp; &lt;b&gt;.csv" in markup
    data = re.search(r'<script type="application/json" id="panels">(.*?)</script>', page, flags=re.DOTALL)
    assert data and "<" not in data[1]
    assert {p["log"] for p in json.loads(data[1])} == {hostile, "other.csv"}


def test_every_number_is_the_results_own(page, found):
    """Each parameter's line shows the value, error and interval of the JSON result."""
    result = found.to_dict()
    text = html.unescape(re.sub(r"<[^>]+>", " ", _markup(page)))
    for row in result["parameters"]:
        assert row["name"] in text
        assert format_with_uncertainty(row["value"], row["stderr"]) in text
        assert (
            f"{round_to_stderr(row['ci95'][0], row['stderr'])} … {round_to_stderr(row['ci95'][1], row['stderr'])}"
            in text
        )
    assert f"{result['holdout']['relative_error_percent']:.1f} %" in text.replace("\u00a0", " ")
    assert format_number(result["condition_number"], 3) in text


def test_true_values_are_compared(page, found, truth):
    """With the truth at hand the page says how far off each estimate is, in standard errors."""
    row = next(r for r in found.rows() if r["name"] == "one_link.mass")
    distance = abs(row["value"] - truth["one_link.mass"]) / row["stderr"]
    assert f">{distance:.1f}<" in page and "Comparison with the true values" in page


def test_doubts_come_before_the_plots(doubtful):
    """What is not determined is said above, greyed in the table with its reason, and not called known."""
    page = build_page(doubtful)
    assert page.index("<h2>Warnings") < page.index("Measured and predicted force")
    assert 'class="verdict care"' in page or 'class="verdict poor"' in page
    for row in doubtful.rows():
        if row["stderr"] is None:
            owner, part = row["name"].rsplit(".", 1)  # three and more of a link stand in one line
            lines = re.findall(
                rf'<tr class="(?:unseen|fold)"><th[^>]*>{re.escape(owner)}(?:: [^<]*\b{part}\b[^<]*|\.{part})<.*?</tr>',
                page,
            )
            assert len(lines) == 1 and re.search("nominal value|only in combination", lines[0])


def test_light_dark_and_paper(page):
    """The style follows the reader's scheme and has rules for print."""
    assert "prefers-color-scheme: dark" in page and "@media print" in page and "color-scheme: light dark" in page


def test_written_whole(tmp_path, found):
    """The file holds the page, and weighs less than a photograph."""
    path = tmp_path / "r.html"
    write_report(path, found)
    assert path.read_text(encoding="utf-8").startswith("<!doctype html>")
    assert path.stat().st_size < 600_000
