"""Any result is presented once and shown in four ways: page, terminal, notebook, JSON."""

from __future__ import annotations

import io
import json
import re
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from rich.console import Console

import tau_dyn as td
from tau_dyn.log import Log
from tau_dyn.render import build_page, present, print_result
from tau_dyn.render.terminal import build_grids, put
from tau_dyn.results import Bar, Chapter, Column, On, Presentation, ResultTable, Row, Text, Verdict, to_plain


def _markup(page: str) -> str:
    return re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.DOTALL)


def _printed(result, width: int = 80) -> str:
    stream = io.StringIO()
    print_result(Console(file=stream, width=width, highlight=False), result, {"report": "r.html"})
    return stream.getvalue()


def test_any_result_has_a_page(results, kind, tmp_path):
    """`write_report` takes any result; the page loads nothing, shows no NaN, and says the headline."""
    path = tmp_path / "r.html"
    td.write_report(path, results[kind])
    page = path.read_text(encoding="utf-8")
    assert page.startswith("<!doctype html") and not re.search(r"""(src|href)\s*=\s*["']?\s*(https?:)?//""", page)
    assert "nan" not in re.sub(r"<[^>]*>", " ", _markup(page)).lower().split()
    said = re.sub(r"<[^>]+>", "", re.search(r"<h1[^>]*>(.*?)</h1>", page, re.DOTALL)[1])
    assert said.strip()


def test_any_result_prints_within_80_columns(results, kind):
    """Plain text, no line too wide, nothing cut, and the last line says what was written."""
    text = _printed(results[kind])
    lines = text.splitlines()
    assert "\x1b" not in text and max(map(len, lines)) <= 80 and lines[-1].strip() == "report → r.html"
    assert not re.search(r"\S…(?= |$)", text), "an ellipsis at the end of a word is a cut cell"


def test_any_result_is_plain_data(results, kind):
    """Strict JSON of its table, one row a thing."""
    table = results[kind].to_pandas()
    rows = to_plain(table.to_dict("records"))
    assert json.loads(json.dumps(rows, allow_nan=False)) == rows
    assert len(rows) == len(table)


def test_page_and_terminal_say_the_same(results):
    """Headline and verdict are written once."""
    for kind in ("identification", "diagnosis", "calibration", "workspace", "modes"):
        shown = present(results[kind])
        printed = " ".join(_printed(results[kind]).split())
        page = " ".join(re.sub(r"<[^>]+>", "", _markup(build_page(results[kind]))).replace("\u00a0", " ").split())
        assert shown.verdict is not None
        for said in (shown.headline, shown.verdict.sentence):
            assert " ".join(said.split()) in printed
        assert shown.verdict.badge in page


def test_a_log_that_nobody_judged(tmp_path):
    """A log shows its channels and its signals, also without a joint, and no verdict that nobody gave."""
    log = Log(np.arange(100) * 0.01, {"temperature": np.linspace(20, 21, 100)}, "warm.csv")
    assert present(log).verdict is None and "temperature" in _printed(log)
    page = build_page(log)
    (panel,) = json.loads(re.search(r'id="panels">(.*?)</script>', page, flags=re.DOTALL)[1])
    assert panel["joint"] == "temperature" and "temperature" in _markup(page)


def test_sections_are_made_when_somebody_looks():
    """A terminal does not pay for a page's figures, and a block stands only where it says."""
    made = []

    def build():
        made.append(1)
        return [Text("everywhere", on=On.ALL), Text("on the page")]

    shown = Presentation(
        "Test", "me", "t", "A sentence.", Verdict("good", "Fine."),
        sections=[Chapter("a", "", build, On.PAGE | On.TERMINAL), Chapter("b", "", lambda: 1 / 0, On.PAGE)],
    )  # fmt: skip
    assert not made
    text = _printed(shown)
    assert made == [1] and "everywhere" in text and "on the page" not in text
    with pytest.raises(ZeroDivisionError):
        build_page(shown)


def test_a_narrow_terminal_keeps_numbers_and_bars_whole():
    """What can be spared goes, what tells a row is repeated, words wrap; no number is broken."""
    rows = [Row(["shoulder_lift_joint", Bar(0.5), "12.345 ± 0.012 N m", "a remark that is long enough to wrap"])]
    columns = [Column("joint"), Column("", "bar"), Column("value", "number"), Column("remark", spare=True)]

    def lines(table: ResultTable, width: int) -> list[str]:
        stream = io.StringIO()
        for grid in build_grids(table, width):
            put(Console(file=stream, width=width, highlight=False), grid)
        return stream.getvalue().splitlines()

    narrow, wide = lines(ResultTable(columns, rows), 52), lines(ResultTable(columns, rows), 100)
    assert "remark" not in "".join(narrow) and "remark" in "".join(wide)
    assert any("shoulder_lift_joint" in x and "█" in x and "12.345 ± 0.012 N m" in x for x in narrow)
    many = ResultTable([Column("row", kept=True), *(Column(f"q{k}", "number") for k in range(9))],
                 [Row(["7", *(f"{k}.123456" for k in range(9))])])  # fmt: skip
    parts = [x for x in lines(many, 40) if x.strip().startswith("7")]
    assert len(parts) > 1 and max(map(len, lines(many, 40))) <= 40
    assert sum(x.count(".123456") for x in parts) == 9


def test_a_robot_is_drawn_in_a_notebook(results):
    """What a robot is, one sees."""
    assert 'class="robot"' in results["robot"]._repr_html_()


def _walk(thing, path: str, depth: int):
    """Yield a result and what hangs from it: dataclasses of ours in its fields, the first of each collection."""
    if isinstance(thing, list | tuple) and not hasattr(thing, "_fields"):
        thing = next(iter(thing), None)
    if not type(thing).__module__.startswith("tau_dyn."):
        return
    yield path, thing
    if is_dataclass(thing) and depth:
        for f in fields(thing):
            yield from _walk(getattr(thing, f.name), f"{path}.{f.name}", depth - 1)


def test_a_repr_is_a_few_short_lines(results, kind):
    """A prompt that echoes a result, or a part of one, shows no robot file, no array and no control character."""
    said = {(path, type(thing).__name__): repr(thing) for path, thing in _walk(results[kind], kind, 3)}
    long = {key: text for key, text in said.items() if len(text.splitlines()) > 12 or len(text) > 1000}
    assert not long.keys()
    assert not [key for key, text in said.items() if "<link" in text or "\x1b" in text]
    assert max(map(len, said[kind, type(results[kind]).__name__].splitlines())) <= 88


def test_a_repr_says_the_headline(results):
    """What a result answers stands in its `repr`: its class, what it is of, the first words of the headline."""
    for result in results.values():
        said = " ".join(repr(result).split())
        assert said.startswith(f"{type(result).__name__}:") or type(result).__name__ == "Parameters"
        assert present(result).headline[:20] in said
