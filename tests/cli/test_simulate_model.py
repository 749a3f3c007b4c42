"""A model file as the robot to simulate: it moves as its effects say, and what contradicts it is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tau_dyn.cli import main
from tau_dyn.effects import EFFECTS, build_friction_model
from tau_dyn.log import read_log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

QUIET = ["--duration", "5", "--force-noise", "0", "--encoder-noise", "0", "--log-rate", "250", "--quiet"]


@pytest.fixture(scope="module", params=["linear_axis", "gantry_tau"])
def file(request, tmp_path_factory):
    """A model extended by a ripple with a label and by a late recording, on another mass than nominal."""
    robot = load_robot(request.param)
    first = robot.actuated[:1], robot.force_units[:1]
    ripple = EFFECTS["cyclic_ripple"](*first, label="_tooth", period=0.05)
    effects = [*build_friction_model("symmetric", robot.actuated, robot.force_units), ripple, EFFECTS["delay"](*first)]
    mass = next(p for p in robot.parameters if p.name.endswith(".mass"))
    values = {f"{first[0][0]}.ripple_sin_tooth": 12.0, f"{first[0][0]}.delay": 0.002, mass.name: 1.2 * mass.value}
    path = tmp_path_factory.mktemp("model") / "m.yaml"
    Model.of(robot, effects).with_values(values).save(path)
    return path


def test_a_model_file_is_a_robot(file, tmp_path) -> None:
    """`simulate MODEL.yaml` is the same log as its own robot with `--model MODEL.yaml`, and not the nominal robot's."""
    source, logs = Model.load(file).robot.source, {}
    for name, robot in (("own", [str(file)]), ("put", [source, "--model", str(file)]), ("nominal", [source])):
        out = tmp_path / f"{name}.csv"
        argv = [
            "simulate",
            *robot,
            "--motion",
            "fourier",
            *QUIET,
            "--out",
            str(out),
            "--json",
            str(tmp_path / "r.json"),
        ]
        assert main(argv) == 0
        logs[name] = read_log(out)
        if name == "own":
            assert [i["path"] for i in json.loads((tmp_path / "r.json").read_text())["inputs"]] == [str(file)]
    tau = next(key for key in logs["own"].channels if key.startswith("tau_"))
    assert np.array_equal(logs["own"].channels[tau], logs["put"].channels[tau])
    short = min(x.n_samples for x in logs.values())
    assert np.std(logs["own"].channels[tau][:short] - logs["nominal"].channels[tau][:short]) > 5


@pytest.mark.parametrize(
    "more", [["--set", "a=1"], ["--actuated", "axis"], ["--effects", "m.yaml"], ["--model", "m.yaml"]]
)
def test_a_model_file_stands_alone(file, tmp_path, more, capsys) -> None:
    """What would change the file's own robot, effects or values is refused in one line with exit status 2."""
    argv = ["simulate", str(file), *more, "--out", str(tmp_path / "s.csv")]
    assert main(argv) == 2
    said = capsys.readouterr().err
    assert f"leave {more[0]} out" in said and said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_log_without_the_column_that_an_effect_needs_exits_2(tmp_path, capsys) -> None:
    """`identify --model` with a thermal drift and a log without temperature says which column is missing."""
    robot = load_robot("linear_axis")
    Model.of(robot, [EFFECTS["thermal_drift"](robot.actuated, robot.force_units)]).save(tmp_path / "m.yaml")
    log = tmp_path / "log.csv"
    assert main(["simulate", "linear_axis", *QUIET, "--out", str(log)]) == 0
    assert main(["identify", "linear_axis", str(log), "--model", str(tmp_path / "m.yaml"), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert "has no column temp_room or temp_axis, which effect thermal_drift" in said
