"""Names that are markup, scripts, formulas or terminal codes: on no page do they run, in no table do they count."""

from __future__ import annotations

import csv
import json
import shutil
import sys
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from pages import taken_apart

from tau_dyn.cli import main
from tau_dyn.exceptions import InputError, format_one_line
from tau_dyn.render.page import list_scripts
from tau_dyn.vision.measure import escape_formula

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(1)>\" onload=\"x' onclick='y{{7*7}}"
"""A name of a joint, a link, a robot, a column."""

FILE = "log <img src=x onerror=alert(1)>&lt;.csv"
COMMANDS = {
    "check": ["check", FILE, "r.urdf"],
    "identify": ["identify", "r.urdf", FILE, "--json", "identify.json"],
    "compare": ["compare", "identify.json", "identify.json"],
    "simulate": ["simulate", "r.urdf", "--motion", "slow", "--duration", "5", "--out", "sim.csv"],
    "fk": ["fk", "r.urdf", "--q", "0.1"],
    "ik": ["ik", "r.urdf", "--position", "0.1", "0", "0"],
    "workspace": ["workspace", "r.urdf", "--obstacles", "around.yaml"],
    "calibrate": ["calibrate", "r.urdf", "poses.csv"],
}  # fmt: skip
LONG = {
    "plan-motion": ["plan-motion", "r.urdf", "--from-joints=-0.1", "--to-joints", "0.1", "--out", "motion.csv"],
    "modes": ["modes", FILE, "--inputs", f"tau_{EVIL}", "--outputs", f"q_{EVIL}", "--method", "arx", "--order", "2"],
    "accuracy": ["accuracy", "r.urdf", "--actuator-error", "0.0001"],
    "excite": ["excite", "r.urdf", "--duration", "4", "--out", "exc.csv"],
    "diagnose": ["diagnose", "r.urdf", FILE],
}


def evil_robot() -> str:
    """Return one sliding axis whose every name is hostile."""
    joint, link, name = quoteattr(EVIL), quoteattr(f"L{EVIL}"), quoteattr(f"R{EVIL}")
    return f"""<robot name={name} xmlns:tau_dyn="urn:tau_dyn"><link name="base_link"/>
<link name={link}><inertial><origin xyz="0 0 0"/><mass value="5"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>
</inertial></link><joint name={joint} type="prismatic"><parent link="base_link"/><child link={link}/><axis xyz="1 0 0"/>
<limit lower="-0.5" upper="0.5" velocity="1" effort="500"/></joint><link name="tool"/><joint name="hand" type="fixed">
<parent link={link}/><child link="tool"/></joint><transmission name="d"><joint name={joint}/><actuator name="a"/></transmission>
<tau_dyn:assumed what={joint}/></robot>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a robot, a log, poses and obstacles, all of hostile names."""
    folder = tmp_path_factory.mktemp("evil")
    (folder / "r.urdf").write_text(evil_robot())
    t = np.arange(0, 8, 0.01)
    q = 0.1 * np.sin(np.pi * t) + 0.03 * np.sin(2.6 * np.pi * t)
    v = np.gradient(q, t)
    tau = 5 * np.gradient(v, t) + 20 * np.sign(v) + 200 * v + np.random.default_rng(0).normal(0, 1, len(t))
    write(folder / FILE, ["t", f"q_{EVIL}", f"tau_{EVIL}", f"other {EVIL}"], np.column_stack([t, q, tau, q]))
    x = np.linspace(-0.4, 0.4, 30)
    seen = np.column_stack([x, 1.001 * x + np.random.default_rng(1).normal(0, 1e-5, 30), 0 * x, 0 * x])
    write(folder / "poses.csv", [f"q_{EVIL}", "x_tool", "y_tool", "z_tool"], seen)
    evil = EVIL.replace("'", "''")
    (folder / "around.yaml").write_text(
        f"obstacles: [{{name: '{evil}', sphere: {{centre: [3, 0, 0], radius: 0.1}}}}]\n"
    )
    return folder


def write(path: Path, header: list[str], rows: np.ndarray) -> None:
    """Write a table."""
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(header)
        out.writerows([[f"{x:.7f}" for x in row] for row in rows])


def check_page(folder: Path, name: str, argv: list[str], monkeypatch, capsys) -> None:
    """Make a page and take it apart: our two scripts, one block of data, the hostile name as text, nothing else."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["tau-dyn", *argv])
    status = main([*argv, "--report", f"{name}.html"])
    said = capsys.readouterr()
    assert status == 0, said.err
    assert "\x1b" not in said.out + said.err
    page = (folder / f"{name}.html").read_text(encoding="utf-8")
    found = taken_apart(page)
    assert found.found == []
    assert [script.strip() for script in found.scripts] == [script.strip() for script in list_scripts()]
    assert len(found.data) == 1 and "alert(1)" in page and "<script>alert" not in page and "49" not in EVIL


@pytest.mark.parametrize("name", COMMANDS)
def test_no_hostile_name_gets_out_of_its_place_on_a_page(folder: Path, name: str, monkeypatch, capsys) -> None:
    """Every command's page, driven with names that would run a script, add an attribute or end a template's quote."""
    if name == "compare" and not (folder / "identify.json").exists():
        monkeypatch.chdir(folder)
        assert main([*COMMANDS["identify"], "--quiet"]) == 0
        capsys.readouterr()
    check_page(folder, name, COMMANDS[name], monkeypatch, capsys)


def test_run_folders_of_hostile_words_are_compared_as_text(folder: Path, monkeypatch, capsys) -> None:
    """Somebody else's run.json and result.json: every word in them is a script, and none of them runs."""
    monkeypatch.chdir(folder)
    assert main([*COMMANDS["fk"], "--quiet", "--out", "run/"]) == 0
    for name, more in (("one", ""), ("two", "2")):
        shutil.copytree("run", name)
        for file in ("run.json", "result.json"):
            held = json.loads((folder / name / file).read_text())
            kept = {"run_format": held.get("run_format"), "command": f"{EVIL}", "status": "ok"}
            (folder / name / file).write_text(json.dumps(_evil(held, more) | {k: v for k, v in kept.items() if v}))
    capsys.readouterr()
    check_page(folder, "compare-runs", ["compare", "one", "two"], monkeypatch, capsys)


def _evil(held: object, more: str) -> Any:
    """Return the same tree with every text, and every name in it that is free, a script."""
    if isinstance(held, dict):
        free = {"configuration", "versions", "files"}
        inside = {k: {f"{EVIL}{n}": x for n, x in v.items()} if k in free and v else v for k, v in held.items()}
        return {k: _evil(v, more) for k, v in inside.items()}
    if isinstance(held, list):
        return [_evil(x, more) for x in held]
    return f"{EVIL}{held}{more}" if isinstance(held, str) else held


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG)
def test_the_same_for_commands_that_take_long(folder: Path, name: str, monkeypatch, capsys) -> None:
    """As above."""
    check_page(folder, name, LONG[name], monkeypatch, capsys)


def test_a_policy_on_every_page_forbids_what_would_still_get_through(folder: Path, monkeypatch, capsys) -> None:
    """Scripts run only by their hash; nothing is loaded from anywhere."""
    monkeypatch.chdir(folder)
    assert main(["fk", "r.urdf", "--q", "0.1", "--report", "policy.html", "--quiet"]) == 0
    page = (folder / "policy.html").read_text(encoding="utf-8")
    policy = page.split('http-equiv="Content-Security-Policy" content="')[1].split('"')[0]
    assert policy.startswith("default-src 'none'") and "'unsafe-inline'" not in policy.split("script-src")[1]


def test_formulas_in_tables_are_text() -> None:
    """A spreadsheet evaluates a cell that begins with = + - @; names from outside get an apostrophe before it."""
    for name in ("=1+1.png", "+x.png", "-x.png", "@SUM(1).png", "\tx.png", "\rx.png"):
        assert escape_formula(name) == f"'{name}"
    for name in ("img_001.png", "a=b.png", "left/-x.png"):
        assert escape_formula(name) == name


def test_headers_we_write_begin_with_a_signal(folder: Path, monkeypatch, capsys) -> None:
    """So a joint called =1+1 is the column q_=1+1, which no spreadsheet takes for a formula; quotes are doubled."""
    monkeypatch.chdir(folder)
    assert main([*COMMANDS["fk"], "--out", "fk.csv", "--quiet"]) == 0
    with (folder / "fk.csv").open(newline="") as file:
        header = next(csv.reader(file))
    assert f"q_{EVIL}" in header and all(name[0].isalpha() for name in header)


def test_messages_are_one_printable_line_of_bounded_length(refused, tmp_path: Path) -> None:
    """Names in a message neither steer the terminal nor fill it."""
    (tmp_path / "log.csv").write_text("t,q_axis,\x1b[31mred\x07,q_axis\n" + "0,0,0,0\n" * 20)
    assert "occurs twice" in refused("check", "log.csv")
    (tmp_path / "wide.csv").write_text("t," + "x" * 50_000 + "," + "x" * 50_000 + "\n0,0,0\n")
    assert "occurs twice" in refused("check", "wide.csv")
    assert (
        "\x1b" not in str(InputError("file_format", "a\x1b[31mb\nc"))
        and len(str(InputError("file_format", "x" * 10**6))) <= 1000
    )
    assert format_one_line("a\n\n b\u202ec") == "a b\N{REPLACEMENT CHARACTER}c"


def test_a_file_name_that_steers_the_terminal_is_shown_plain(tmp_path: Path, capsys, monkeypatch) -> None:
    """Also in warnings and results, not only in refusals."""
    monkeypatch.chdir(tmp_path)
    t = np.arange(200) * 0.01
    write(tmp_path / "a\x1b[2Jb.csv", ["t", "q_axis", "tau_axis"], np.column_stack([t, 1e4 * np.sin(t), t]))
    assert main(["check", "a\x1b[2Jb.csv"]) == 0
    said = capsys.readouterr()
    assert "\x1b" not in said.out + said.err and "b.csv" in said.out + said.err
