"""The terminal output fits, stays plain when piped, and no file name can steer the terminal."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from tau_dyn.log import check_log
from tau_dyn.render import print_result
from tau_dyn.render.kinds.parameter_rows import ParameterRow, build_parameter_table, describe_row
from tau_dyn.render.terminal import build_grids, put
from tau_dyn.results import Chapter, Column, On, Presentation, ResultTable, Row, format_with_uncertainty


def _printed(width: int, show, *args) -> str:
    stream = io.StringIO()
    show(Console(file=stream, width=width, highlight=False, soft_wrap=False), *args)
    return stream.getvalue()


@pytest.mark.parametrize("width", [80, 100, 160])
def test_fits_the_terminal(found, doubtful, width):
    """No line is wider than the terminal, or than 100 columns."""
    for result in (found, doubtful):
        text = _printed(width, print_result, result, {"model": "m.yaml", "report": "r.html"})
        assert max(map(len, text.splitlines())) <= min(width, 100)
        assert "\x1b" not in text
        assert "model → m.yaml" in text


def test_table_keeps_its_lines_at_80_columns(found):
    """Each parameter that the data tell alone stands on one line, whole; of the others no value looks like an estimate."""
    lines = _printed(80, print_result, found, {}).splitlines()
    for row in found.rows():
        own = [x for x in lines if x.strip().startswith(row["name"] + " ") and "=" not in x]
        assert len(own) == (row["stderr"] is not None)
        assert all("±" in line and "…" not in line for line in own)


def test_a_value_that_the_data_do_not_determine_is_no_estimate_on_a_terminal():
    """0.07 kg m with a standard error of 15000 is not listed; 0.001 kg m^2 that is known better than from the file is."""
    entry = {"name": "a.mx", "value": 0.07, "stderr": 1.5e4, "ci95": [-3e4, 3e4], "unit": "kg m", "nominal": 2.0,
             "nominal_stderr": 0.6, "determined": False, "identifiable": True, "at_bound": False}  # fmt: skip
    product = entry | {"name": "b.ixy", "value": 0.001, "stderr": 0.0015, "ci95": [-0.002, 0.004], "nominal": 0.0,
                       "nominal_stderr": 0.02}  # fmt: skip
    rows = [describe_row(one, 0.05, "", "") for one in (entry, product)]
    text = _printed(
        80, lambda console: put(console, build_grids(build_parameter_table(rows, "5 %", on=On.ALL)[0], 80)[0])
    )
    assert "b.ixy" in text and "a.mx" not in text


def test_names_of_a_stock_arm_fit_into_80_columns():
    """`shoulder_lift_joint.coulomb_neg`, a standard error of 8e-5 and `N m/(rad/s)` leave room for the nominal value."""
    row = ParameterRow(
        "shoulder_lift_joint.coulomb_neg", "", "known", format_with_uncertainty(-0.0019, 9.7e-5), "a … b", "N m/(rad/s)",
        "0.01714", "", None,
    )  # fmt: skip
    text = _printed(
        80, lambda console: put(console, build_grids(build_parameter_table([row], "5 %", on=On.ALL)[0], 80)[0])
    )
    assert "−0.001900 ± 0.000097" in text and "0.01714" in text and "…" not in text


def test_a_name_breaks_between_its_parts():
    """A name that is too long for its column breaks behind a dot or an underscore, not within a part."""
    row = Row(["shoulder_pan_joint.coulomb_pos", "1.234567890123456789 ± 0.000000012345678901", "9" * 20])
    table = ResultTable([Column("name"), Column("value", "number"), Column("second", "number")], [row], on=On.ALL)
    lines = _printed(80, lambda console: put(console, build_grids(table, 80)[0])).split()
    assert "".join(x for x in lines if x[0] in "sjcp")[-30:] == "shoulder_pan_joint.coulomb_pos"
    assert all(x[-1] in "_." for x in lines if x.startswith("shoulder")) and max(map(len, lines)) <= 80


def test_a_wide_table_keeps_names_and_numbers_whole():
    """A file gets the columns that names and numbers need, and a remark wraps; a terminal keeps its width."""
    cells = [
        "elbow_joint.armature",
        "0.017140 ± 0.000097",
        "1.234567890123456789 ± 0.000000012345678",
        "by the prior of it",
    ]
    columns = [Column("name"), Column("value", "number"), Column("second", "number"), Column("remark")]
    table = ResultTable(columns, [Row(cells)], on=On.ALL)
    shown = Presentation("Test", "me", "t", sections=[Chapter("a", "", lambda: [table], On.ALL)])
    file = _printed(80, lambda console: print_result(console, shown, wide_tables=True)).splitlines()
    assert any(all(cell in line for cell in cells[:3]) for line in file) and 80 < max(map(len, file)) < 100
    assert not any(cells[3] in line for line in file)
    assert max(map(len, _printed(80, print_result, shown).splitlines())) <= 80


def test_colour_only_for_people(found):
    """A terminal gets colour, a pipe does not."""
    stream = io.StringIO()
    print_result(Console(file=stream, width=90, force_terminal=True), found, {})
    assert "\x1b[" in stream.getvalue()


def test_check_says_its_verdict_first(axis_like):
    """The judgement stands above the findings, every finding with its topic."""
    checked = check_log(axis_like)
    text = _printed(80, lambda console: print_result(console, checked, log=axis_like))
    assert "\x1b" not in text and max(map(len, text.splitlines())) <= 80
    assert "sable" in text.splitlines()[3]
    assert all(f.topic in text for f in checked.findings)


@pytest.fixture
def axis_like(hostile):
    import numpy as np

    from tau_dyn.log import Log

    t = np.arange(0, 10, 0.002)
    return Log(t, {"q_a": np.sin(t), "tau_a": np.cos(t)}, hostile)
