"""`tau-dyn plan-poses`: what it writes, that a plan is taken up again, and its sentences for faulty input."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tau_dyn.calibrate.poses import placement, read_camera, read_progress
from tau_dyn.cli import main
from tau_dyn.kinematics.workspace import build_machine
from tau_dyn.robot import load_robot
from tau_dyn.vision import Pattern

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from camera_parts.photographs import render

CAMERA = """
camera: {position: [5.5, -0.6, 0.7], look_at: [1.75, -0.6, 0.7], image: [1280, 960], focal: 1400}
pattern: {position: [0.1, 0, 0], normal: [1, 0, 0]}
"""
SMALL = ["plan-poses", "gantry_tau", "--candidates", "150", "--no-collisions"]
JOINTS = ("cart1", "cart2", "cart3")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One run with all outputs."""
    folder = tmp_path_factory.mktemp("plan")
    (folder / "camera.yaml").write_text(CAMERA)
    outputs = ["--out", str(folder / "p.csv"), "--rapid", str(folder / "p.mod"), "--json", str(folder / "p.json")]
    given = ["--n", "12", "--camera", str(folder / "camera.yaml"), "--resume", str(folder / "progress.json")]
    assert main([*SMALL, *given, *outputs]) == 0
    return folder


def test_files_agree(written: Path) -> None:
    """The table, the RAPID module, the progress file and the result hold the same twelve poses in the same order."""
    result = json.loads((written / "p.json").read_text())
    table = pd.read_csv(written / "p.csv")
    told = read_progress(written / "progress.json", JOINTS)
    assert result["chosen"] == 12 and sorted(table.loc[table["pose"] > 0, "pose"]) == list(range(1, 13))
    assert np.allclose(table[[f"q_{j}" for j in JOINTS]], told.q, atol=1e-8)
    assert np.allclose([[row[f"q_{j}"] for j in JOINTS] for row in result["poses"]], told.q)
    assert f"n_places := {len(table)}" in (written / "p.mod").read_text()
    assert result["predicted"]["position"]["rms"] < result["rehearsal"]["position_rms"]["nominal"]


def test_a_plan_is_taken_up_again(written: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With a progress file that exists, nothing is chosen anew: what is left comes out, in its old order."""
    now = read_progress(written / "progress.json", JOINTS)
    for k in range(4):
        now = now.with_result(k, (np.zeros(3), None) if now.pose[k] >= 0 else None)
    now.save(written / "half.json")
    outputs = [
        "--out",
        str(written / "rest.csv"),
        "--rapid",
        str(written / "rest.mod"),
        "--json",
        str(written / "r.json"),
    ]
    assert main([*SMALL, "--resume", str(written / "half.json"), *outputs]) == 0
    rest = pd.read_csv(written / "rest.csv")
    assert np.allclose(rest[[f"q_{j}" for j in JOINTS]], now.q[4:], atol=1e-8)
    assert json.loads((written / "r.json").read_text())["left"] == int((rest["pose"] > 0).sum())
    assert "poses measured" in capsys.readouterr().out


def test_same_seed_same_files(written: Path, tmp_path: Path) -> None:
    """Asked twice with one seed, the plan is the same to the letter."""
    given = ["--n", "12", "--camera", str(written / "camera.yaml"), "--out", str(tmp_path / "again.csv"), "--quiet"]
    assert main([*SMALL, *given]) == 0
    assert (tmp_path / "again.csv").read_text() == (written / "p.csv").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--n", "3"], "at least 8"),
        (["--n", "0"], "--n"),
        (["--n", "many"], "--n"),
        (["--n", "5000"], "candidates"),
        (["--model", "banana"], "no model named 'banana'"),
        (["--criterion", "best"], "--criterion"),
        (["--accuracy", "nan"], "--accuracy"),
        (["--camera", "nowhere.yaml"], "nowhere.yaml"),
        (["--obstacles", "nowhere.yaml"], "nowhere.yaml"),
        (["--safety", "-1"], "--safety"),
        (["--safety-angle", "60"], "ball joints"),
        (["--rapid", "no/folder/p.mod"], "does not exist"),
        (["--out", "p.txt"], ".csv"),
        (["--camera", "a.yaml", "--tracker", "b.yaml"], "do not go together"),
    ],
)
def test_faulty_input_is_one_sentence(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Faulty input ends with status 2, one line that names the culprit, and no file."""
    monkeypatch.chdir(tmp_path)
    extra = [] if "--n" in arguments else ["--n", "10"]
    assert main([*SMALL, *extra, *arguments]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert message in said and "Traceback" not in said
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_answered_ends_with_three(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A camera that looks away sees no pose, and an accuracy may be out of reach: status 3, the reason, and what would help."""
    (tmp_path / "away.yaml").write_text(CAMERA.replace("look_at: [1.75", "look_at: [9.75"))
    (tmp_path / "inside.yaml").write_text("obstacles: [{name: rack, sphere: {centre: [5.5, -0.6, 0.7], radius: 0.2}}]")
    (tmp_path / "camera.yaml").write_text(CAMERA)
    result = tmp_path / "r.json"
    assert main([*SMALL, "--camera", str(tmp_path / "away.yaml"), "--json", str(result)]) == 3
    assert json.loads(result.read_text())["status"] == "cannot_answer"
    assert "sees none" in capsys.readouterr().err
    assert main([*SMALL, "--n", "10", "--accuracy", "1e-7"]) == 3
    assert "times as exact" in capsys.readouterr().err
    camera = ["--camera", str(tmp_path / "camera.yaml")]
    assert main([*SMALL, *camera, "--obstacles", str(tmp_path / "inside.yaml")]) == 2
    assert "inside the obstacle 'rack'" in capsys.readouterr().err


CHOOSE = "choose: {position: [[3, 6.5], [-2, 1], [0, 2]]}"


@pytest.fixture
def short_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer places and steps than a user waits for."""
    for name, value in (("_DRAWN_POWER", 4), ("_REFINED", 1), ("_STEPS", 10)):
        monkeypatch.setattr(placement, name, value)


def test_a_camera_is_placed_and_set_up(
    short_search: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The place chosen is written, drawn, and planned with; a photograph taken from it needs no move."""
    cv2 = pytest.importorskip("cv2")
    monkeypatch.chdir(tmp_path)
    Path("camera.yaml").write_text(CAMERA.replace("pattern: {", "pattern: {columns: 9, rows: 6, ") + CHOOSE)
    outputs = ["--save-camera", "new.yaml", "--picture", "wanted.png", "--json", "r.json"]
    assert main([*SMALL, "--n", "12", "--camera", "camera.yaml", *outputs]) == 0
    result, said = json.loads(Path("r.json").read_text()), capsys.readouterr().out
    found = result["placement"]
    assert found["chosen"]["predicted_rms"] < found["given"]["predicted_rms"] and found["poses"] == 12
    assert result["predicted"]["position"]["rms"] == pytest.approx(found["chosen"]["predicted_rms"], rel=0.05)
    new = read_camera("new.yaml")
    assert np.allclose(new.pose.translation, found["position"]) and "poses in view" in said
    at = [str(x) for x in result["picture"]["at"]]
    assert " ".join(f"{x:g}" for x in result["picture"]["at"]) in " ".join(said.split())

    tool = build_machine(load_robot("gantry_tau")).kinematics.forward(np.array([result["picture"]["at"]])).poses
    seen = new.frames.measured(tool, np.zeros(1, int))
    printed, numbers = seen.rotation[0] @ np.diag([1.0, -1, -1]), np.array([1400, 1400, 639.5, 479.5, 0, 0, 0, 0, 0])
    image = render(Pattern(9, 6, 0.04), printed, seen.position[0], numbers, (1280, 960), np.random.default_rng(0))
    cv2.imwrite("photo.png", image)
    given = ["plan-poses", "gantry_tau", "--camera", "new.yaml", "--taken", "photo.png", "--at", *at]
    assert main([*given, "--picture", "over.png", "--json", "c.json"]) == 0
    found = json.loads(Path("c.json").read_text())["correction"]
    assert (np.abs(found["shift"]["value"]) < 4.5 * np.array(found["shift"]["stderr"])).all()
    assert "move the camera" in capsys.readouterr().out and cv2.imread("over.png").shape == (960, 1280, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--picture", "p.png"], "--camera"),
        (["--camera", "camera.yaml", "--picture", "p.jpg"], ".png"),
        (["--camera", "camera.yaml", "--save-camera", "new.yaml"], "choose"),
        (["--camera", "camera.yaml", "--taken", "photo.png"], "--at"),
        (["--camera", "camera.yaml", "--at", "0.5", "0.5", "0.5"], "--picture or --taken"),
        (["--camera", "camera.yaml", "--taken", "photo.png", "--at", "0.5", "nan", "0.5"], "--at"),
        (["--camera", "camera.yaml", "--taken", "photo.png", "--at", "0.5"], "cart1, cart2, cart3"),
        (["--camera", "camera.yaml", "--taken", "photo.png", "--at", "9", "0.5", "0.5"], "do not close"),
        (["--camera", "free.yaml", "--taken", "photo.png", "--at", "0.5", "0.5", "0.5"], "--save-camera"),
        (["--camera", "empty.yaml"], "empty range"),
        (["--camera", "unknown.yaml"], "'where' is not known"),
        (["--camera", "free.yaml", "--n", "3"], "at least 8"),
    ],
)
def test_faulty_set_ups_are_one_sentence(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Options that lack another, and ranges that are none, end with status 2, one line, and no file."""
    monkeypatch.chdir(tmp_path)
    texts = {
        "camera": "", "free": CHOOSE, "empty": CHOOSE.replace("[-2, 1]", "[1, -2]"), "unknown": "choose: {where: 1}",
    }  # fmt: skip
    for name, text in texts.items():
        Path(f"{name}.yaml").write_text(CAMERA + text)
    assert main([*SMALL, *arguments]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert message in said and "Traceback" not in said
    assert len(list(tmp_path.iterdir())) == len(texts)


def test_a_camera_that_sees_nothing_from_anywhere_ends_with_three(
    short_search: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Behind the plate no place sees the pattern: status 3, the reason, and what would help."""
    (tmp_path / "c.yaml").write_text(CAMERA + "choose: {position: [[-6, -4], [-2, 1], [0, 2]]}")
    result = tmp_path / "r.json"
    assert main([*SMALL, "--n", "12", "--camera", str(tmp_path / "c.yaml"), "--json", str(result)]) == 3
    assert json.loads(result.read_text())["code"] == "not_visible"
    assert "from behind" in capsys.readouterr().err
