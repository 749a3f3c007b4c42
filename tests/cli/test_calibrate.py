"""`tau-dyn calibrate`: JSON as the contract says, a page, a saved robot, and one sentence for every fault."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "calibrate"))
from calibration_rigs import measured, rods_of  # pyright: ignore[reportMissingImports]

from tau_dyn.calibrate import load_calibration
from tau_dyn.calibrate.simulated import format_csv
from tau_dyn.cli import main
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.robot import load_robot


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A folder with poses of an L1 whose guideways are skew, and poses to hold out; and what the command wrote of them."""
    folder = tmp_path_factory.mktemp("campaign")
    rods = rods_of()
    poses, _ = measured(rods, "nonparallel", 120, 5)
    every = np.arange(poses.n)
    (folder / "poses.csv").write_text(format_csv(poses.take(every[::2]), rods.robot.actuated))
    (folder / "held.csv").write_text(format_csv(poses.take(every[1::4]), rods.robot.actuated))
    (folder / "more.csv").write_text(format_csv(poses.take(every[3::4]), rods.robot.actuated))
    held = [str(folder / "held.csv"), str(folder / "more.csv")]
    (folder / "wanted.csv").write_text("q_cart1,q_cart2,q_cart3\n-0.1,0.0,0.2\n0.1,-0.2,0.3\n1.6,1.5,1.55\n")
    status = main(
        ["calibrate", "gantry_tau", str(folder / "poses.csv"), "--holdout", *held, "--quiet"]
        + ["--correct", str(folder / "wanted.csv"), "--corrected", str(folder / "corrected.csv")]
        + ["--json", str(folder / "r.json"), "--report", str(folder / "r.html"), "--out", str(folder / "m.yaml")]
    )
    assert status == 0
    return folder


def test_result_is_as_the_contract_says(campaign):
    """Models with train and held-out errors in m, the chosen one, rank, and what cannot be told and why."""
    result = json.loads((campaign / "r.json").read_text())
    assert {"tool_version", "command", "inputs", "seed", "status", "warnings"} <= set(result)
    assert result["chosen"] == "nonparallel" == result["models"][-1]["name"]
    for model in result["models"]:
        for part in ("train", "holdout"):
            assert set(model[part]["position"]) == {"mean", "rms", "max"}
            assert model[part]["orientation"] is None
    assert (
        result["models"][-1]["holdout"]["position"]["mean"]
        < 2.5e-5
        < result["models"][0]["holdout"]["position"]["mean"]
    )
    assert result["identifiability"]["rank"] == 21
    blind = result["identifiability"]["not_identifiable"]
    assert len(blind) == 6 and all(set(row) == {"parameter", "depends_on"} and row["depends_on"] for row in blind)
    named = [row["path"] for row in result["inputs"]]
    assert any(path.endswith("poses.csv") for path in named) and any(path.endswith("held.csv") for path in named)


def test_not_identifiable_parameters_are_nominal_without_stderr(campaign):
    """What no pose can tell is reported at its nominal value, with no standard error, as in every result."""
    result = json.loads((campaign / "r.json").read_text())
    rows = {row["name"]: row for row in result["models"][-1]["parameters"]}
    for blind in result["identifiability"]["not_identifiable"]:
        row = rows[blind["parameter"]]
        assert (
            row["value"] == row["nominal"] and row["stderr"] is None and row["ci95"] is None and not row["identifiable"]
        )
    sure = rows["arm1.length"]
    assert sure["ci95"][0] < sure["value"] < sure["ci95"][1] and sure["stderr"] < 1e-4


def test_saved_robot_can_be_read(campaign):
    """The calibrated robot predicts the held-out poses that the result speaks of."""
    robot = load_calibration(campaign / "m.yaml")
    table = np.genfromtxt(campaign / "held.csv", delimiter=",", names=True)
    q = np.column_stack([table[f"q_{j}"] for j in robot.robot.actuated])
    seen = np.column_stack([table[f"{a}_tool"] for a in "xyz"])
    assert np.linalg.norm(robot.seen(q).position - seen, axis=1).mean() < 2.5e-5


def test_corrected_positions_put_the_tool_where_the_controller_meant(campaign):
    """The calibrated robot at the corrected positions stands where the robot file's stands at those asked for."""
    wanted, corrected = (pd.read_csv(campaign / name) for name in ("wanted.csv", "corrected.csv"))
    names = [f"q_{joint}" for joint in ("cart1", "cart2", "cart3")]
    assert list(corrected["reason"].fillna("")) == ["", "", "cart1 beyond its limit"]
    assert "not_corrected" in json.loads((campaign / "r.json").read_text())["warning_codes"]
    wanted, corrected = wanted[:2], corrected[:2]
    meant = forward_kinematics(load_robot("gantry_tau"), wanted[names].to_numpy()).poses.position
    reached = load_calibration(campaign / "m.yaml").forward(corrected[names].to_numpy()).poses.position
    np.testing.assert_allclose(reached, meant, atol=1e-9)
    assert np.abs(wanted[names].to_numpy() - corrected[names].to_numpy()).max() > 1e-4


def test_page_is_one_file_and_tells_the_story(campaign):
    """The page loads nothing from elsewhere and shows errors, gain, geometry and what is blind."""
    page = (campaign / "r.html").read_text()
    assert "http://" not in page.replace("http://www.w3.org", "") and "https://" not in page
    for section in ("Error before and after", "Error by model", "Errors in space", "Not identifiable"):
        assert section in page
    assert "equivalent to a change of" in page


def test_every_file_stands_in_the_pages_provenance(campaign):
    """Poses may be held out in several files; the page names each with its hash."""
    page = (campaign / "r.html").read_text()
    inputs = json.loads((campaign / "r.json").read_text())["inputs"]
    assert len(inputs) == 5 and all(row["sha256"] in page for row in inputs)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--model", "perfect"], "no model named 'perfect'"),
        (["--fix", "arm9.length"], "arm9.length"),
        (["--residual", "sideways"], "sideways"),
    ],
)
def test_faults_are_one_sentence_and_write_nothing(campaign, tmp_path, capsys, arguments, sentence):
    """A wrong name leaves with status 2, one line, and no file."""
    out = tmp_path / "r.json"
    assert (
        main(["calibrate", "gantry_tau", str(campaign / "poses.csv"), "--json", str(out), "--quiet", *arguments]) == 2
    )
    said = capsys.readouterr().err
    assert sentence in said and said.count("\n") == 1 and not out.exists()


def test_broken_model_files_are_told(campaign, tmp_path):
    """A file that is no calibrated robot, or lacks a parameter, is refused with a sentence."""
    from tau_dyn.exceptions import InputError

    text = (campaign / "m.yaml").read_text()
    for spoiled, sentence in (
        ("a: 1\n", "not a calibrated robot"),
        (text.replace("name: arm1.length", "name: arm1.depth"), "parameter arm1.length is missing"),
        (text.replace("travel:", "way:"), "missing or of the wrong kind"),
    ):
        (tmp_path / "m.yaml").write_text(spoiled)
        with pytest.raises(InputError, match=sentence):
            load_calibration(tmp_path / "m.yaml")
