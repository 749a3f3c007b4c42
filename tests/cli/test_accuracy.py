"""`tau-dyn accuracy`: the map of a parallel robot, a serial arm's poses, measured guideways, and faults as one sentence."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tau_dyn.cli import main

SERIAL = """<robot name="arm">
<link name="base_link"/><link name="a_link"/><link name="b_link"/><link name="tool"/>
<joint name="slide" type="prismatic"><parent link="base_link"/><child link="a_link"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="turn" type="revolute"><parent link="a_link"/><child link="b_link"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="tool_fixed" type="fixed"><origin xyz="0.5 0 0"/><parent link="b_link"/><child link="tool"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def mapped(tmp_path_factory) -> tuple[dict, str]:
    """Return result and page of a small map of the D1 with measured guideways."""
    folder = tmp_path_factory.mktemp("accuracy")
    rng, q = np.random.default_rng(1), np.linspace(-0.5, 0.5, 25)
    points = np.column_stack([q, 60e-6 * q**2 * 4, 0 * q]) + 5e-6 * rng.standard_normal((25, 3))
    pd.DataFrame({"q_cart1": q} | {f"{a}_tool": points[:, k] for k, a in enumerate("xyz")}).to_csv(
        folder / "c1.csv", index=False
    )
    status = main([
        "accuracy", "gantry_tau", "--set", "prototype=d1", "--actuator-error", "cart2=77e-6", "cart3=58e-6:38e-6", "--grid", "9",
        "--samples", "40", "--measured", str(folder / "c1.csv"), "--json", str(folder / "r.json"), "--report", str(folder /
        "r.html"), "--quiet",
    ])  # fmt: skip
    assert status == 0
    return json.loads((folder / "r.json").read_text()), (folder / "r.html").read_text()


def test_result_orders_the_methods(mapped) -> None:
    """Random errors stay below the exact worst case and that below the proved bound, at every point of the map."""
    result, _ = mapped
    map_ = {m: np.array(result["map"][m], float) for m in result["methods"]}
    reached = np.isfinite(map_["exact"])
    assert reached.sum() == result["n_poses"] > 10
    assert np.all(map_["montecarlo"][reached] <= map_["exact"][reached])
    assert np.all(map_["exact"][reached] <= map_["certified"][reached])
    assert result["methods"]["exact"]["max"] == pytest.approx(np.nanmax(map_["exact"]))
    assert result["linear_fails"]["linear"]["least"] < -0.1 < result["linear_fails"]["parallelepiped"]["least"]


def test_errors_of_a_measured_guideway_are_taken(mapped) -> None:
    """The cart without a stated error gets what 95 % of its measured points stay below, and its bow is reported."""
    result, _ = mapped
    line = result["measured"]["guideways"][0]
    assert result["errors_from_measured"] and result["errors"]["actuators"]["cart1"] == line["within_95_percent"]
    assert abs(line["bow"]["size"] - 60e-6) < 15e-6 and "bow 68 +- 2 um" in result["verdicts"][0]


def test_page_says_and_draws_it(mapped) -> None:
    """The page is one file with the map, the table of methods, the error bodies and the guideway."""
    _, page = mapped
    for words in (
        "Over the section x = 0 m",
        "Every method on the same errors",
        "Where the tool may be",
        "cart1, across",
        "bow 68",
    ):
        assert words in page
    drawings = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert page.count('class="chart map"') >= 3 and not any("nan" in drawing for drawing in drawings)


def test_serial_arm_errs_by_its_lever(tmp_path: Path) -> None:
    """A slide off by 1 mm and a turn off by 2 mrad at 0.5 m add up to sqrt(2) mm when both act at right angles."""
    robot, poses = tmp_path / "arm.urdf", tmp_path / "poses.csv"
    robot.write_text(SERIAL)
    pd.DataFrame({"q_slide": [0.1, 0.2], "q_turn": [0.0, np.pi / 2]}).to_csv(poses, index=False)
    assert main(["accuracy", str(robot), "--actuator-error", "slide=1e-3", "turn=2e-3", "--poses", str(poses), "--samples", "50",
                 "--quiet", "--json", str(tmp_path / "r.json"), "--report", str(tmp_path / "r.html")]) == 0  # fmt: skip
    result = json.loads((tmp_path / "r.json").read_text())
    exact = result["methods"]["exact"]
    assert exact["min"] == pytest.approx(np.sqrt(2) * 1e-3, rel=1e-2) and exact["max"] == pytest.approx(2e-3, rel=1e-5)
    assert set(result["left_out"]) == {"ellipsoid", "certified"}
    assert result["orientation"]["exact"]["max"] == pytest.approx(2e-3)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "no error is given"),
        (["--actuator-error", "cart1=-5e-6"], "zero or a positive number"),
        (["--actuator-error", "nan"], "zero or a positive number"),
        (["--actuator-error", "cart7=1e-6"], "no actuated joint named 'cart7'"),
        (["--actuator-error", "0"], "all errors are zero"),
        (["--actuator-error", "5e-5", "--section", "x=99"], "reaches no point of the section x = 99 m"),
        (["--actuator-error", "5e-5", "--section", "x"], "write an axis and where to cut it"),
        (["--actuator-error", "5e-5", "--method", "guess"], "no method named 'guess'"),
        (["--actuator-error", "5e-5", "--grid", "1"], "from 2 to 201"),
        (["--actuator-error", "5e-5", "--range", "y=0:1"], "needs a range of y and one of z"),
        (["--measured", "nowhere.csv"], "nowhere.csv"),
        (["--errors", "nowhere.yaml"], "nowhere.yaml"),
        (["--actuator-error", "5e-5", "--poses", "nowhere.csv"], "nowhere.csv"),
    ],
)
def test_faults_are_one_sentence(words: list[str], said: str, capsys, tmp_path: Path) -> None:
    """Status 2, one line that names the culprit, and no file."""
    out = tmp_path / "r.json"
    assert main(["accuracy", "gantry_tau", "--quiet", "--json", str(out), *words]) == 2
    line = capsys.readouterr().err.strip()
    assert said in line and line.startswith("error: ") and "\n" not in line and not out.exists()


def test_measured_files_must_say_whose_cart(tmp_path: Path, capsys) -> None:
    """A file with several actuators and no orientation, and one without positions, are refused."""
    path = tmp_path / "m.csv"
    pd.DataFrame({"q_cart1": range(9), "q_cart2": range(9), "x_tool": 0, "y_tool": 0, "z_tool": 0}).to_csv(
        path, index=False
    )
    assert main(["accuracy", "gantry_tau", "--measured", str(path)]) == 2
    assert "cart1=m.csv" in capsys.readouterr().err
    pd.DataFrame({"q_cart1": range(9)}).to_csv(path, index=False)
    assert main(["accuracy", "gantry_tau", "--measured", str(path)]) == 2
    assert "lacks x_tool" in capsys.readouterr().err
