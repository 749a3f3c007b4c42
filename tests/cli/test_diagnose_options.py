"""`diagnose --propose` and `--controller` on the command line; engine and proposal stand in by hand."""

from __future__ import annotations

import json
from importlib import import_module

import numpy as np
import pytest

from tau_dyn import by_measurement
from tau_dyn.cli import main
from tau_dyn.evidence import Diagnosis, OutputErrors, Step
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify import build_model
from tau_dyn.log import Log
from tau_dyn.simulate import Trajectory

FACE = import_module("tau_dyn.diagnose")  # `tau_dyn.diagnose` itself is the function

LAW = "position_gain: 20\nvelocity_gain: 240\n"


def _answer(robot) -> Diagnosis:
    model = build_model(robot, "asymmetric")
    errors = OutputErrors(robot.actuated, np.array([2.0]), np.array([[1.9, 2.2]]), 5.0)
    steps = tuple(Step(name, errors) for name in ("nominal", "refitted", "noise_floor"))
    return Diagnosis(
        verdict="nothing_found", sentence="An answer.", channel="force", outputs=robot.actuated, units=robot.force_units,
        baseline=errors, extended=errors, noise_floor=errors, waterfall=steps, findings=(), unexplained=(), limits=(),
        untestable=(), model=model, extended_model=model, traces=(), n_parts=(6.0, 2.0, 2.0), how="in blocks",
        warnings=(), seed=0,
    )  # fmt: skip


@pytest.fixture(autouse=True)
def asked(monkeypatch):
    """Stand in for the engine and the proposal; return what they were asked."""
    seen = {}

    def propose_motion(found, logs, *, seed, progress):
        seen.update(seed=seed, logs=logs)
        t = np.linspace(0, 1, 101)[:, None]
        return Trajectory(found.outputs, t[:, 0], t**2, 2 * t, 2 + 0 * t, notes=("lambda = 40",))

    monkeypatch.setattr(
        by_measurement, "diagnose_forces", lambda robot, logs, **options: seen.update(run=True) or _answer(robot)
    )
    monkeypatch.setattr(FACE, "propose_motion", propose_motion)
    return seen


@pytest.fixture
def log(tmp_path) -> str:
    """A log without references."""
    t = np.arange(0, 2, 0.01)
    Log(t, {"q_axis": np.sin(t), "tau_axis": np.cos(t)}, "bare").to_csv(tmp_path / "bare.csv")
    return str(tmp_path / "bare.csv")


@pytest.fixture
def law(tmp_path) -> str:
    """A controller file."""
    (tmp_path / "law.yaml").write_text(LAW)
    return str(tmp_path / "law.yaml")


def test_a_motion_is_written(tmp_path, log, asked, capsys):
    """The file can be read as a motion, and the result tells where it is and what to expect."""
    motion, result = tmp_path / "m.csv", tmp_path / "r.json"
    assert main(["diagnose", "linear_axis", log, "--propose", str(motion), "--json", str(result), "--seed", "7"]) == 0
    assert Trajectory.from_csv(motion, ["axis"]).duration == pytest.approx(1)
    said = json.loads(result.read_text())
    assert said["proposal"]["notes"] == ["lambda = 40"] and said["proposal"]["out"] == str(motion)
    assert asked["seed"] == 7 and len(asked["logs"]) == 1 and "lambda = 40" in capsys.readouterr().out


def test_where_no_motion_tells_the_status_is_3(tmp_path, log, monkeypatch, capsys):
    """The diagnosis is still written; the result and a warning name the experiment that would tell."""

    def refuse(*args, **options):
        raise CannotAnswer("no_solution", "no motion tells a payload from a gain", "weigh the plate")

    monkeypatch.setattr(FACE, "propose_motion", refuse)
    motion, result = tmp_path / "m.csv", tmp_path / "r.json"
    assert main(["diagnose", "linear_axis", log, "--propose", str(motion), "--json", str(result)]) == 3
    said = json.loads(result.read_text())
    assert said["status"] == "cannot_answer" and said["verdict"] == "nothing_found" and not motion.exists()
    assert said["proposal"]["experiment"] == "weigh the plate"
    captured = capsys.readouterr()
    assert "warning: no motion is proposed" in captured.err and "An answer." in captured.out


@pytest.mark.parametrize("name", ["m.txt", "bare.csv", "law.csv"])
def test_a_motion_overwrites_no_input(tmp_path, log, asked, name, capsys):
    """What is written must be a CSV and none of the inputs, the controller file included."""
    (tmp_path / "law.csv").write_text(LAW)
    argv = ["diagnose", "linear_axis", log, "--controller", str(tmp_path / "law.csv")]
    assert main([*argv, "--propose", str(tmp_path / name)]) == 2 and "run" not in asked
    wrong = "must end in .csv" if name == "m.txt" else "is an input of this command"
    assert wrong in capsys.readouterr().err


def test_two_outputs_need_two_files(tmp_path, log, asked, capsys):
    """The motion and the model cannot be one file."""
    same = str(tmp_path / "m.csv")
    assert main(["diagnose", "linear_axis", log, "--propose", same, "--out", same]) == 2
    assert "each its own" in capsys.readouterr().err and "run" not in asked


def test_a_controller_needs_references_before_the_work_starts(log, law, asked, capsys):
    """Without references in any log the closed loop cannot be simulated, which is said at once."""
    assert main(["diagnose", "linear_axis", log, "--controller", law]) == 2
    assert "q_ref" in capsys.readouterr().err and "run" not in asked


def test_the_controller_is_an_input_and_its_simulation_a_result(tmp_path, law, monkeypatch):
    """The file is listed with its hash, and what the simulation found stands in the result."""
    from dataclasses import replace

    t = np.arange(0, 2, 0.01)
    columns = {"q_axis": np.sin(t), "tau_axis": np.cos(t), "q_ref_axis": np.sin(t)}
    Log(t, columns, "full").to_csv(tmp_path / "full.csv")
    gains = []

    def with_simulation(found, logs, law, progress):
        gains.append(float(law.velocity_gain[0]))
        return replace(found, simulation={"before": {"error": 2.0}, "after": {"error": 1.0}})

    monkeypatch.setattr(FACE, "add_simulation", with_simulation)
    result = tmp_path / "r.json"
    assert (
        main(["diagnose", "linear_axis", str(tmp_path / "full.csv"), "--controller", law, "--json", str(result)]) == 0
    )
    said = json.loads(result.read_text())
    assert gains == [240.0] and said["simulation"]["after"] == {"error": 1.0}
    assert law in [item["path"] for item in said["inputs"]]
