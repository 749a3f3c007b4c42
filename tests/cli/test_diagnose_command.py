"""`diagnose` on the command line: what it writes, what it says, and its exit status. The engine stands in by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tau_dyn import by_measurement
from tau_dyn.cli import main
from tau_dyn.evidence import Diagnosis, OutputErrors, Step
from tau_dyn.identify import build_model
from tau_dyn.log import Log
from tau_dyn.model import Model


def _answer(robot, verdict: str) -> Diagnosis:
    model = build_model(robot, "asymmetric")
    errors = OutputErrors(robot.actuated, np.array([2.0]), np.array([[1.9, 2.2]]), 5.0)
    steps = tuple(Step(name, errors) for name in ("nominal", "refitted", "noise_floor"))
    return Diagnosis(
        verdict=verdict, sentence="An answer.", channel="force", outputs=robot.actuated, units=robot.force_units,
        baseline=errors, extended=errors, noise_floor=errors, waterfall=steps, findings=(), unexplained=(), limits=(),
        untestable=(), model=model, extended_model=model, traces=(), n_parts=(6.0, 2.0, 2.0), how="in blocks",
        warnings=("a doubt",), seed=0, experiment="slow strokes",
    )  # fmt: skip


@pytest.fixture
def logs(tmp_path):
    """Two logs of the linear axis, too short to mean anything."""
    t = np.arange(0, 2, 0.01)
    for name in ("monday", "tuesday"):
        Log(t, {"q_axis": np.sin(t), "tau_axis": np.cos(t)}, name).to_csv(tmp_path / f"{name}.csv")
    return [str(tmp_path / "monday.csv"), "--holdout", str(tmp_path / "tuesday.csv")]


@pytest.fixture
def asked(monkeypatch):
    """Stand in for the engine; return what it was asked, and let a test set the verdict."""
    seen = {"verdict": "nothing_found"}

    def diagnose(robot, logs, **options):
        seen.update(options, logs=logs)
        return _answer(robot, seen["verdict"])

    monkeypatch.setattr(by_measurement, "diagnose_forces", diagnose)
    return seen


def test_all_outputs_are_written(tmp_path, logs, asked, capsys):
    """One call gives the result, the page and a model that can be loaded, and prints the answer."""
    out = {"--json": tmp_path / "r.json", "--report": tmp_path / "r.html", "--out": tmp_path / "m.yaml"}
    argv = ["diagnose", "linear_axis", *logs, *(str(x) for pair in out.items() for x in pair)]
    assert main([*argv, "--fix", "carriage_link.mass", "--exclude", "flag", "--seed", "4", "--model", "rigid"]) == 0
    result = json.loads(out["--json"].read_text())
    assert result["command"] == "diagnose" and result["status"] == "ok" and result["verdict"] == "nothing_found"
    assert [len(i["sha256"]) for i in result["inputs"]] == [64, 64, 64]
    assert Model.load(out["--out"]).effects and "An answer." in out["--report"].read_text(encoding="utf-8")
    printed = capsys.readouterr()
    assert "An answer." in printed.out and "refitted model →" in printed.out and "warning: a doubt" in printed.err
    assert asked["choices"].fix == ("carriage_link.mass",) and asked["exclude"] == ("flag",) and asked["seed"] == 4
    assert asked["model"] == "rigid" and len(asked["logs"]) == len(asked["holdout"]) == 1


def test_data_that_cannot_tell_leave_with_3_and_still_write(tmp_path, logs, asked, capsys):
    """Where the data cannot tell, the status says so, and result, page and model are there to read."""
    asked["verdict"] = "cannot_tell"
    files = [tmp_path / "r.json", tmp_path / "r.html", tmp_path / "m.yaml"]
    argv = [
        "diagnose",
        "linear_axis",
        *logs,
        "--json",
        str(files[0]),
        "--report",
        str(files[1]),
        "--out",
        str(files[2]),
    ]
    assert main(argv) == 3
    result = json.loads(files[0].read_text())
    assert result["status"] == "cannot_answer" and result["experiment"] == "slow strokes"
    assert all(path.is_file() for path in files) and "slow strokes" in capsys.readouterr().out


def test_the_model_must_not_overwrite_a_log(tmp_path, logs, asked, capsys):
    """An output that is also an input is refused before the work starts."""
    assert main(["diagnose", "linear_axis", *logs, "--out", logs[0]]) == 2
    assert "would be overwritten" in capsys.readouterr().err and "logs" not in asked
