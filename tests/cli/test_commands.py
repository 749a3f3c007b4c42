"""The commands end to end: what they write, what they say, and that it repeats."""

import json

import numpy as np
import pytest

from tau_dyn.cli import main
from tau_dyn.control import Feedforward
from tau_dyn.model import Model
from tau_dyn.robot import list_robot_names


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two simulated logs of the linear axis with friction, as a user would make them."""
    out = tmp_path_factory.mktemp("logs")
    truth = out / "truth.yaml"
    truth.write_text(
        "effects:\n  - effect: asymmetric_friction\n    joints: [axis]\n"
        "    parameters: {coulomb_pos: 20, coulomb_neg: 18, viscous_pos: 170, viscous_neg: 240}\n"
        "parameters: {carriage_link.mass: 91.5}\n"
    )
    for day, motion, seed in (("monday", "fourier", 1), ("tuesday", "prbs", 2)):
        argv = [
            "simulate",
            "linear_axis",
            "--motion",
            motion,
            "--duration",
            "20",
            "--effects",
            str(truth),
            "--seed",
            str(seed),
        ]
        argv += ["--force-noise", "1", "--encoder-noise", "1e-6", "--out", str(out / f"{day}.csv"), "--quiet"]
        assert main(argv) == 0
    return out


@pytest.fixture(scope="module")
def result(folder):
    """The JSON result of identifying Monday, judged on Tuesday."""
    argv = ["identify", "linear_axis", str(folder / "monday.csv"), "--holdout", str(folder / "tuesday.csv")]
    argv += [
        "--json",
        str(folder / "r.json"),
        "--out",
        str(folder / "model.yaml"),
        "--report",
        str(folder / "r.html"),
        "--quiet",
    ]
    assert main(argv) == 0
    return json.loads((folder / "r.json").read_text())


def test_the_command_line_recovers_the_truth(result):
    """Simulated by one command, identified by another, every parameter is within 4.5 standard errors of the truth."""
    truth = {
        "carriage_link.mass": 91.5,
        "axis.coulomb_pos": 20,
        "axis.coulomb_neg": 18,
        "axis.viscous_pos": 170,
        "axis.viscous_neg": 240,
    }
    rows = {row["name"]: row for row in result["parameters"]}
    assert set(rows) == set(truth)
    for name, value in truth.items():
        assert abs(rows[name]["value"] - value) < 4.5 * rows[name]["stderr"]
        assert rows[name]["identifiable"]


def test_a_structured_residual_ends_with_the_search_for_its_cause(folder, capsys):
    """A sine of the position left in the force ends with the command that names it; a residual of noise ends without."""
    (folder / "ripple.yaml").write_text(
        (folder / "truth.yaml").read_text().replace("parameters: {carriage", "  - {effect: cyclic_ripple, joints: [axis], "
        "settings: {period: 0.2}, parameters: {ripple_sin: 12}}\nparameters: {carriage")
    )  # fmt: skip
    made = ["--motion", "fourier", "--duration", "20", "--force-noise", "1", "--encoder-noise", "1e-6", "--quiet"]
    log = str(folder / "a ripple.csv")
    assert main(["simulate", "linear_axis", "--effects", str(folder / "ripple.yaml"), *made, "--out", log]) == 0
    capsys.readouterr()
    assert main(["identify", "linear_axis", log]) == 0
    assert f"tau-dyn diagnose linear_axis '{log}'" in capsys.readouterr().out.replace("\n", " ")
    options = ["--actuated", "axis", "--fitted-inertias", "--fix", "carriage_link.mass=91.5"]
    assert main(["identify", "linear_axis", log, *options]) == 0
    assert f"'{log}' {' '.join(options)}" in capsys.readouterr().out.replace("\n", " ")
    assert main(["identify", "linear_axis", str(folder / "monday.csv")]) == 0
    assert "tau-dyn diagnose" not in capsys.readouterr().out


def test_a_result_says_where_it_came_from(result, folder):
    """Every input stands in the result with its hash, beside version, command, seed and status."""
    assert result["status"] == "ok"
    assert result["command"] == "identify"
    assert {"tool_version", "seed", "warnings"} <= set(result)
    assert str(folder / "monday.csv") in [i["path"] for i in result["inputs"]]
    assert all(len(i["sha256"]) == 64 for i in result["inputs"])


def test_held_out_error_is_close_to_the_training_error(result):
    """A right model predicts a day it never saw about as well as the one it was fitted to."""
    assert result["holdout"]["relative_error_percent"] < 2 * result["train"]["relative_error_percent"] + 0.5
    assert set(result["holdout"]["per_joint"]) == {"axis"}


def test_the_model_file_predicts_what_the_result_says(result, folder):
    """The written model is usable at once: its mass and its feedforward are the result's."""
    model = Model.load(folder / "model.yaml")
    row = next(r for r in result["parameters"] if r["name"] == "carriage_link.mass")
    assert model.parameters["carriage_link.mass"].value == pytest.approx(row["value"])
    tau = Feedforward(model)(np.zeros(1), np.array([0.1]), np.array([2.0]))
    values = {r["name"]: r["value"] for r in result["parameters"]}
    expected = 2 * values["carriage_link.mass"] + values["axis.coulomb_pos"] + 0.1 * values["axis.viscous_pos"]
    assert tau[0] == pytest.approx(expected, rel=1e-9)


def test_the_same_seed_gives_the_same_result(folder, result):
    """Nothing in a result depends on anything but its inputs and its seed."""
    argv = ["identify", "linear_axis", str(folder / "monday.csv"), "--holdout", str(folder / "tuesday.csv")]
    assert main([*argv, "--json", str(folder / "again.json"), "--quiet"]) == 0
    again = json.loads((folder / "again.json").read_text())
    assert again["parameters"] == result["parameters"]


def test_a_model_file_can_be_identified_again(folder, result):
    """A model file's effects are fitted to a new log."""
    argv = [
        "identify",
        "linear_axis",
        str(folder / "tuesday.csv"),
        "--model",
        str(folder / "model.yaml"),
        "--json",
        str(folder / "m.json"),
    ]
    assert main([*argv, "--quiet"]) == 0
    rows = {r["name"]: r for r in json.loads((folder / "m.json").read_text())["parameters"]}
    assert abs(rows["carriage_link.mass"]["value"] - 91.5) < 4.5 * rows["carriage_link.mass"]["stderr"]


def test_check_finds_a_good_log_fit(folder, capsys):
    """A clean simulated log is fit for use, and the command says so."""
    assert main(["check", str(folder / "monday.csv"), "linear_axis", "--json", str(folder / "c.json")]) == 0
    assert json.loads((folder / "c.json").read_text())["fit_for_use"] is True
    assert capsys.readouterr().out.strip()


def test_check_of_a_log_with_a_fault_exits_with_three(folder, tmp_path, schema):
    """A constant force is a fault: status 3, the fault as what is missing, its remedy, and all fields of the check."""
    rows = [line.split(",") for line in (folder / "monday.csv").read_text().splitlines()]
    k = rows[0].index("tau_axis")
    path, result = tmp_path / "dead.csv", tmp_path / "c.json"
    path.write_text("\n".join([",".join(rows[0]), *(",".join([*r[:k], "3.5", *r[k + 1 :]]) for r in rows[1:])]) + "\n")
    assert main(["check", str(path), "linear_axis", "--json", str(result), "--quiet"]) == 3
    found = json.loads(result.read_text())
    assert found["status"] == "cannot_answer" and found["code"] == "log_not_usable" and found["fit_for_use"] is False
    assert "tau_axis is 3.5" in found["missing"] and "Log the drive's force." in found["experiment"]
    assert not list(schema.iter_errors(found))
    assert list(schema.iter_errors({k: x for k, x in found.items() if k != "numbers"}))


def test_excite_stays_within_limits(folder):
    """An exciting motion is written with positions, speeds and accelerations, inside the robot's travel."""
    out = folder / "motion.csv"
    assert main(["excite", "linear_axis", "--out", str(out), "--duration", "10", "--trials", "3", "--quiet"]) == 0
    header, *rows = out.read_text().splitlines()
    assert {"t", "q_ref_axis"} <= set(header.split(","))
    column = header.split(",").index("q_ref_axis")
    assert max(abs(float(r.split(",")[column])) for r in rows) <= 0.5


@pytest.mark.parametrize(
    "argv",
    [
        ["check", "monday.csv", "linear_axis"],
        ["simulate", "linear_axis", "--duration", "5", "--out", "s.csv"],
        ["excite", "linear_axis", "--duration", "5", "--trials", "1", "--out", "e.csv"],
    ],
)
def test_every_command_has_its_page(folder, monkeypatch, argv):
    """`--report` writes one page that loads nothing from elsewhere."""
    monkeypatch.chdir(folder)
    assert main([*argv, "--report", f"{argv[0]}.html", "--quiet"]) == 0
    page = (folder / f"{argv[0]}.html").read_text()
    assert page.lstrip().lower().startswith("<!doctype html")
    assert 'src="http' not in page and 'href="http' not in page


def test_the_report_is_one_page_that_names_every_parameter(folder, result):
    """The page is self-contained and holds what the JSON holds."""
    page = (folder / "r.html").read_text()
    assert page.lstrip().lower().startswith("<!doctype html")
    for row in result["parameters"]:
        assert row["name"] in page


def test_robots_and_causes_are_listed(tmp_path, capsys):
    """Every robot that a command takes by name and every cause is in the list; a slip is answered with the near one."""
    robots, causes = tmp_path / "robots.json", tmp_path / "causes.json"
    assert main(["robots", "--json", str(robots)]) == 0 and main(["causes", "--json", str(causes)]) == 0
    named = {row["name"]: row for row in json.loads(robots.read_text())["robots"]}
    assert set(list_robot_names()) <= set(named) and named["delta"]["about"].startswith("Delta")
    rows = json.loads(causes.read_text())["causes"]
    assert {"stribeck", "payload", "force_scale", "rod_length"} <= {row["cause"] for row in rows}
    assert all(row["equation"] for row in rows)
    capsys.readouterr()
    assert main(["causes", "stribek"]) == 2 and "did you mean stribeck" in capsys.readouterr().err
