"""The command `see`: photographs in, a table for `calibrate` out, bad input as one sentence."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.cli import main
from tau_dyn.vision import Cameras, Pattern, write_cameras
from tau_dyn.vision.cameras import INTRINSICS

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from camera_parts.photographs import draw_facing_rotation, render

cv2 = pytest.importorskip("cv2")
NUMBERS = np.array([620, 620, 319.5, 239.5, -0.1, 0.0, 0, 0, 0.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    here = tmp_path_factory.mktemp("images")
    rng = np.random.default_rng(0)
    for k in range(2):
        image = render(
            Pattern(5, 4, 0.05),
            draw_facing_rotation(0.4, k, 0.1),
            np.array([0.02 * k, 0.0, 1.0]),
            NUMBERS,
            (640, 480),
            rng,
        )
        cv2.imwrite(str(here / f"at{k}.png"), image)
    (here / "q.csv").write_text("image,q_a\nat0.png,0.1\nat1.png,0.2\n")
    covariance = np.diag(np.where(np.arange(len(INTRINSICS)) < 2, 0.01, 0.0))
    write_cameras(
        here / "cameras.yaml",
        Cameras(NUMBERS[None], np.eye(3)[None], np.zeros((1, 3)), np.array([[640, 480]]), "brown", covariance),
    )
    return here


def see(folder, *more):
    return main(["see", str(folder), "--pattern", "5x4", "--square", "0.05", "--quiet", *map(str, more)])


def test_photographs_become_a_table(folder, tmp_path):
    """Poses with standard errors, robot positions and the result file, in one call."""
    out, result = tmp_path / "poses.csv", tmp_path / "r.json"
    assert (
        see(
            folder,
            "--cameras",
            folder / "cameras.yaml",
            "--positions",
            folder / "q.csv",
            "--out",
            out,
            "--json",
            result,
        )
        == 0
    )
    rows = [line.split(",") for line in out.read_text().splitlines()]
    assert rows[0][:5] == ["image", "q_a", "x_tool", "y_tool", "z_tool"]
    assert [row[:2] for row in rows[1:]] == [["at0.png", "0.1"], ["at1.png", "0.2"]]
    assert abs(float(rows[2][2]) - 0.02) < 2e-3
    held = json.loads(result.read_text())
    assert held["status"] == "ok"
    assert held["n_poses"] == 2
    assert held["poses"][0]["stderr"][2] > 0


@pytest.mark.parametrize(
    ("more", "status", "says"),
    [
        (["--pattern", "nine"], 2, "COLUMNSxROWS"),
        (["--square", "-1"], 2, "--square"),
        (["--lens", "fisheye"], 2, "lens model"),
        (["--positions", "nowhere.csv"], 2, "nowhere.csv"),
        (["--cameras", "nowhere.yaml"], 2, "nowhere.yaml"),
        (["--report", "page.html"], 2, "no report"),
        ([], 3, "cannot answer"),
    ],
)
def test_bad_input_is_one_sentence(folder, tmp_path, capsys, monkeypatch, more, status, says):
    """Status 2 and one line; two images of an unknown camera cannot answer; nothing is written."""
    monkeypatch.chdir(tmp_path)
    if "--report" in more:
        more = [*more, "--cameras", str(folder / "cameras.yaml")]
    assert see(folder, "--out", "poses.csv", *more) == status
    said = capsys.readouterr().err
    assert says in said
    assert "Traceback" not in said
    assert not (tmp_path / "poses.csv").exists()


def test_an_input_is_not_overwritten(folder, capsys):
    """The table of robot positions cannot be the output."""
    assert see(folder, "--positions", folder / "q.csv", "--out", folder / "q.csv") == 2
    assert "overwritten" in capsys.readouterr().err
