"""`lead-through --out`: from a stiffness and a settings file to a controller in C."""

from __future__ import annotations

import json

import pytest

from tau_dyn.cli import main

SETTINGS = "task: surface\nnormal_hz: null\nfilter_hz: 30\ntool_sensor: {mass: 0.8, largest_force: 60}\n"


def test_settings_reach_the_code(tmp_path) -> None:
    """The C file holds half of the limit as gain, the weight on the sensor, and the loop with the filter of the settings."""
    (tmp_path / "s.yaml").write_text(SETTINGS)
    out, result = tmp_path / "lead.c", tmp_path / "r.json"
    command = ["lead-through", "--stiffness", "5e4", "--settings", str(tmp_path / "s.yaml"), "--json", str(result)]
    assert main([*command, "--out", str(out)]) == 0
    source, header = out.read_text(), (tmp_path / "lead.h").read_text()
    rows = {row["name"]: row["value"] for row in json.loads(result.read_text())["settings"]}
    assert rows["force_gain"] == pytest.approx(0.5 * rows["force_gain_limit"])
    assert repr(rows["force_gain"]) in source and repr(-0.8 * 9.81) in source
    assert "CALM = 0" in source and "int lead_step(" in header and "force_gain_limit: " in header
    plain = ["lead-through", "--stiffness", "5e4", "--json", str(result)]
    assert main(plain) == 0
    unfiltered = {row["name"]: row["value"] for row in json.loads(result.read_text())["settings"]}
    assert rows["force_gain_limit"] < 0.8 * unfiltered["force_gain_limit"]


@pytest.mark.parametrize(
    ("text", "out", "said"),
    [
        ("pres: 2.0\n", "lead.c", "did you mean press"),
        ("press: [1]\n", "lead.c", "press"),
        ("tool_sensor: {largest_force: 8}\n", "lead.c", "saturates at 8 N"),
        ("tool_sensor: {weight: 8}\n", "lead.c", "wrong kind"),
        ("force_gain: 1\n", "lead.c", "no setting of lead-through"),
        ("- 1\n", "lead.c", "a map"),
        ("press: 2.0\n", "lead.py", "ends in .c"),
        ("press: 2.0\n", "a-b.c", "cannot name a function in C"),
    ],
)
def test_bad_settings_end_in_a_sentence(text, out, said, tmp_path, capsys) -> None:
    """Status 2, one line that names the setting, no file."""
    (tmp_path / "s.yaml").write_text(text)
    command = ["lead-through", "--stiffness", "5e4", "--settings", str(tmp_path / "s.yaml")]
    assert main([*command, "--out", str(tmp_path / out)]) == 2
    assert said in capsys.readouterr().err
    assert {p.name for p in tmp_path.iterdir()} == {"s.yaml"}
