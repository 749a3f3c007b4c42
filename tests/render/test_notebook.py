"""Results show themselves in a notebook: well formed, escaped, quiet towards the page around them; and hand out their tables."""

from __future__ import annotations

import ast
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from raising import raises_code

from tau_dyn.render import render_notebook as render_html, tabulate as build_table
from tau_dyn.render.notebook import DARK

PAGE = Path(__file__).parents[2] / "docs" / "how_to" / "notebooks.md"


def test_a_face_is_well_formed_and_escaped(results, kind, hostile):
    """It parses as XML, holds no script, no link and no name that became markup."""
    face = render_html(results[kind])
    root = ET.fromstring(face)
    assert root.tag == "div" and root.get("class") == "tau-dyn"
    assert {e.tag for e in root.iter()} <= {
        "div", "style", "p", "b", "span", "table", "thead", "tbody", "tr", "th", "td", "details", "summary", "i",
        "svg", "title", "path", "text", "circle", "rect", "g", "line", "polygon", "polyline", "ellipse", "tspan",
    }  # fmt: skip
    assert not any(key.startswith("on") or key in ("href", "src") for e in root.iter() for key in e.keys())
    assert len(face) < 300_000


@pytest.mark.parametrize("kind", ["log", "check", "comparison"])
def test_hostile_names_are_shown_as_they_are(results, kind, hostile):
    """A log called like a script is a text that reads like one."""
    face = render_html(results[kind])
    name = hostile.split("\x1b")[0]
    assert name not in face and name in "".join(ET.fromstring(face).itertext())


def test_the_style_stays_inside(results, kind):
    """Every rule is below the face; the notebook around it looks as before."""
    style = ET.fromstring(render_html(results[kind])).find("style")
    assert style is not None and style.text
    for selectors in re.findall(r"([^{}]+)\{", style.text):
        for one in selectors.split(","):
            assert one.strip().startswith((".tau-dyn", *(f"{dark} .tau-dyn" for dark in DARK))), one
    assert "@" not in style.text and "url(" not in style.text


def test_what_is_drawn_has_a_style(results, kind):
    """Every path of a chart is named in the style, else it would be a black blob."""
    root = ET.fromstring(render_html(results[kind]))
    style = root.find("style")
    assert style is not None
    used = {c for e in root.iter("path") for c in (e.get("class") or "").split()}
    assert {c for c in used if f".{c}" not in (style.text or "")} <= {"triad-name", "data", "pose"}


def test_a_result_shows_itself(results, kind):
    """Jupyter asks `_repr_html_`; nobody has to import the report."""
    found = results[kind]
    if kind == "diagnosis" and not hasattr(found, "_repr_html_"):
        pytest.skip("Diagnosis is no Shown yet")
    assert found._repr_html_() == render_html(found) and isinstance(found.to_pandas(), pd.DataFrame)


def test_tables_are_tidy(results):
    """Units stand in a column, intervals in two, lists as text; the numbers are the result's own."""
    table = build_table(results["identification"])
    assert {"name", "value", "unit", "stderr", "ci95_low", "ci95_high", "nominal"} <= set(table)
    rows = results["identification"].rows()
    np.testing.assert_array_equal(table["value"], [r["value"] for r in rows])
    np.testing.assert_array_equal(table["ci95_low"], [r["ci95"][0] if r["ci95"] else np.nan for r in rows])
    findings = build_table(results["diagnosis"])
    assert list(findings["cause"]) == ["cyclic_ripple", "stribeck", "link_mass"]
    assert findings["gain_percent"].isna().tolist() == [False, False, True]
    modes = build_table(results["modes"])
    assert abs(modes["frequency_hz"][0] - 5.00225) < 4 * modes["frequency_stderr"][0]
    assert (modes["frequency_low"] < modes["frequency_hz"]).all()
    log = results["log"]
    assert list(build_table(log)) == ["t", *log.channels] and len(build_table(log)) == log.n_samples


def test_long_tables_are_folded(plant):
    """What is beyond the first rows does not push the next cell away, and is there."""
    from tau_dyn.parameters import Parameter, Parameters

    face = render_html(Parameters([Parameter(f"p{k}.mass", 1.0, "kg") for k in range(40)]))
    folded = ET.fromstring(face).find("details")
    assert folded is not None and "p39.mass" in "".join(folded.itertext()) and "and 24 more" in face


@pytest.mark.parametrize("asked", [render_html, build_table])
def test_what_has_no_face_says_so(asked):
    """An object of nobody's is no result."""
    with raises_code("invalid_value", "int is no result"):
        asked(3)


def test_the_notebook_of_the_docs_runs(tmp_path, monkeypatch):
    """The cells of docs/how_to/notebooks.md, one after the other as a notebook runs them; what ends a cell shows itself."""
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {}
    shown = []
    for cell in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
        *body, last = ast.parse(cell).body
        ends = isinstance(last, ast.Expr)
        exec(compile(ast.Module(body if ends else [*body, last], []), "cell", "exec"), space)
        if ends:
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), space)
            shown += [value._repr_html_()] if hasattr(value, "_repr_html_") else []
    assert len(shown) == 5 and all(text for text in shown)
    assert "Held-out prediction error" in shown[3] and (tmp_path / "report.html").is_file()
