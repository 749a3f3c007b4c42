"""`tau-dyn workspace`: what it writes, that it repeats itself, and its sentences for faulty input."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tau_dyn.cli import main
from tau_dyn.robot import load_robot

COARSE = ["workspace", "gantry_tau", "--resolution", "0.1"]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One run with all outputs, an obstacle and a section."""
    folder = tmp_path_factory.mktemp("workspace")
    (folder / "lab.yaml").write_text(
        "obstacles:\n  - name: <b>table</b>\n    box: {centre: [1.2, -1.2, 0.1], size: [1.0, 0.6, 0.8]}\n    blocks: tool\n"
    )
    arguments = ["--obstacles", str(folder / "lab.yaml"), "--section", "x=1.75", "--ball-angle", "40", "--quiet"]
    outputs = ["--json", str(folder / "w.json"), "--report", str(folder / "w.html"), "--out", str(folder / "w.csv")]
    assert main([*COARSE, *arguments, *outputs]) == 0
    return folder


def test_json_holds_volume_reasons_and_maps(written: Path) -> None:
    """The result has the volume within its bound, shares that add up to the box, and ordered statistics."""
    result = json.loads((written / "w.json").read_text())
    low, high = result["volume_bound_m3"]
    assert low < result["volume_m3"] < high
    outside = sum(row["points"] for row in result["excluded"])
    assert outside + result["points"]["inside"] == result["points"]["lattice"]
    assert "<b>table</b>" in next(r for r in result["excluded"] if r["reason"] == "safety zone")["culprits"]
    assert {row["map"] for row in result["maps"]} == {
        "condition", "manipulability", "singularity", "stiffness", "speed", "force",
    }  # fmt: skip
    known = [row for row in result["maps"] if row["map"] != "stiffness"]
    assert all(row["min"] <= row["median"] <= row["max"] for row in known)
    assert result["sections"][0]["across"] == "x = 1.75 m"
    stiffness = next(row for row in result["maps"] if row["map"] == "stiffness")
    assert [stiffness[key] for key in ("min", "median", "max", "home")] == [None] * 4
    assert "stiffness_unknown" in result["warning_codes"]


def test_points_say_why_not(written: Path) -> None:
    """A point belongs and has figures, or has a reason and none; its cart positions are within their travel."""
    table = pd.read_csv(written / "w.csv")
    inside = table["inside"] == 1
    assert table.loc[inside, "reason"].isna().all() and table.loc[~inside, "reason"].notna().all()
    assert table.loc[inside, "condition"].ge(1).all() and table.loc[~inside, "condition"].isna().all()
    spread = np.ptp(table.loc[inside, ["q_cart1", "q_cart2", "q_cart3"]].to_numpy(), axis=0)
    assert (spread <= 2.0 + 1e-9).all() and (spread > 1.0).all()


def test_page_is_whole_and_escapes_names(written: Path) -> None:
    """The page stands alone: no address outside, the obstacle's name as text, charts and picture within."""
    page = (written / "w.html").read_text()
    assert "<b>table</b>" not in page and "&lt;b&gt;table" in page
    assert "http-equiv" in page and 'src="http' not in page
    assert page.count("<svg") > 8 and "data:image/png;base64" in page
    assert not re.search(r"\bnan\b", page.split("</style>")[-1].split("<script")[0])


def test_words_ask_for_maps_of_the_springs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`--what` takes several words: softest and per axis, sag by weight and load, two resonances, in every output."""
    outputs = [
        "--json",
        str(tmp_path / "w.json"),
        "--report",
        str(tmp_path / "w.html"),
        "--out",
        str(tmp_path / "w.csv"),
    ]
    stated = [
        "--rod-stiffness",
        "1e7",
        "--actuator-stiffness",
        "5e6",
        "--actuator-stiffness",
        "cart3=rigid",
        "--load",
        "50",
    ]
    coarse = ["workspace", "gantry_tau", "--resolution", "0.2"]
    assert main([*coarse, *stated, "--what", "stiffness", "sag", "resonance", *outputs]) == 0
    said = capsys.readouterr().out
    result = json.loads((tmp_path / "w.json").read_text())
    rows = {row["map"]: row for row in result["maps"]}
    names = ["stiffness", "stiffness_x", "stiffness_y", "stiffness_z", "sag", "sag_load", "resonance", "resonance_2"]
    for name in names:
        assert 0 < rows[name]["min"] <= rows[name]["median"] <= rows[name]["max"], name
        assert len(rows[name]["min_at"]) == 3
    assert "first resonance" in said and "largest at [m]" in said
    assert rows["resonance"]["max"] < rows["resonance_2"]["max"]
    table = pd.read_csv(tmp_path / "w.csv")
    assert table.loc[table["inside"] == 1, names].notna().any().all() and table.loc[
        table["inside"] == 0, names
    ].isna().all(None)
    assert table["stiffness"].min() == pytest.approx(rows["stiffness"]["min"], rel=1e-6)
    assert "First resonance" in (tmp_path / "w.html").read_text()
    assert not {"stiffness_unknown", "drives_held"} & set(result["warning_codes"])


def test_standard_errors_of_springs_become_intervals(tmp_path: Path) -> None:
    """A robot file whose drive springs have standard errors gets 95 % intervals, and columns of standard errors."""
    text = load_robot("delta").urdf
    springs = "".join(
        f'<tau_dyn:drive_spring xmlns:tau_dyn="urn:tau_dyn" joint="arm{k}" stiffness="2000" stiffness_stderr="40"/>'
        for k in (1, 2, 3)
    )
    (tmp_path / "delta.urdf").write_text(text.replace("</robot>", f"{springs}</robot>"))
    arguments = ["workspace", str(tmp_path / "delta.urdf"), "--resolution", "0.05", "--what", "stiffness", "sag"]
    files = ["--json", str(tmp_path / "w.json"), "--out", str(tmp_path / "w.csv"), "--quiet"]
    assert main([*arguments, "--rod-stiffness", "rigid", *files]) == 0
    row = next(r for r in json.loads((tmp_path / "w.json").read_text())["maps"] if r["map"] == "stiffness")
    low, high = row["home_ci95"]
    assert low < row["home"] < high and high - low < 4 * 0.02 * row["home"]
    assert pd.read_csv(tmp_path / "w.csv")["sag_stderr"].gt(0).any()


def test_same_seed_same_answer(written: Path, tmp_path: Path) -> None:
    """A second run writes the same numbers."""
    arguments = ["--obstacles", str(written / "lab.yaml"), "--section", "x=1.75", "--ball-angle", "40", "--quiet"]
    assert main([*COARSE, *arguments, "--json", str(tmp_path / "again.json")]) == 0
    assert json.loads((tmp_path / "again.json").read_text()) == json.loads((written / "w.json").read_text())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--resolution", "-1"], "--resolution"),
        (["--resolution", "nan"], "--resolution"),
        (["--resolution", "9"], "too coarse"),
        (["--resolution", "0.0001"], "points; take"),
        (["--section", "x=a"], "a section is an axis"),
        (["--section", "x=99"], "misses the searched box"),
        (["--map", "beauty"], "beauty"),
        (["--tool-limit", "x=2:1"], "inverted"),
        (["--tool-limit", "x=90:91"], "tool limit: x"),
        (["--ball-angle", "300"], "between 0 and 180"),
        (["--condition", "0.5"], "must be 1 or more"),
        (["--orientation", "nan", "0", "0"], "write a finite number"),
        (["--actuator-stiffness", "cart9=1e6"], "cart9"),
        (["--actuator-stiffness", "soft"], "JOINT=number"),
        (["--rod-stiffness", "soft"], "a number above zero or 'rigid'"),
        (["--load", "-1"], "--load"),
        (["--what", "sag_load"], "sag_load"),
        (["--obstacles", "nowhere.yaml"], "no such file"),
        (["--tilt", "0", "0", "0"], "does not turn freely"),
    ],
)
def test_faulty_input_is_one_sentence(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Status 2, one line on stderr with the culprit, and no file."""
    out = tmp_path / "w.json"
    assert main([*COARSE, *arguments, "--quiet", "--json", str(out)]) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1 and "Traceback" not in said
    assert not out.exists()
