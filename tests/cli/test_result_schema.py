"""The published schema of results: it names every command, holds for what they say, and refuses what is broken."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from tau_dyn.cli import COMMANDS, main
from tau_dyn.model import Model
from tau_dyn.robot import load_robot


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """A log of the linear axis, the same with a payload, a model of it, and motions."""
    folder = tmp_path_factory.mktemp("files")
    t = np.arange(0, 30, 0.004)
    w = 2 * np.pi * np.array([0.5, 1.3])
    q = 0.1 * np.sin(w[0] * t) + 0.03 * np.sin(w[1] * t)
    v = 0.1 * w[0] * np.cos(w[0] * t) + 0.03 * w[1] * np.cos(w[1] * t)
    a = -0.1 * w[0] ** 2 * np.sin(w[0] * t) - 0.03 * w[1] ** 2 * np.sin(w[1] * t)
    for seed, (name, mass) in enumerate((("empty", 95.0), ("loaded", 103.0), ("later", 95.0))):
        tau = mass * a + 20 * np.sign(v) + 200 * v + np.random.default_rng(seed).normal(0, 1, len(t))
        rows = np.column_stack([t, q, tau])
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header="t,q_axis,tau_axis", comments="", fmt="%.9g")
    Model.of(load_robot("linear_axis")).save(folder / "model.yaml")
    (folder / "poses.csv").write_text("q_axis\n0.1\n0.2\n")
    return folder


CALLS = {
    "robots": ["robots"],
    "robot": ["robots", "linear_axis"],
    "causes": ["causes"],
    "data": ["data"],
    "check": ["check", "empty.csv", "linear_axis"],
    "columns": ["columns", "empty.csv", "linear_axis"],
    "fk": ["fk", "linear_axis", "--q", "0.1"],
    "ik": ["ik", "linear_axis", "--position", "0.1", "0", "0"],
    "identify": ["identify", "linear_axis", "empty.csv", "--holdout", "later.csv"],
    "identify without held-out logs": ["identify", "linear_axis", "empty.csv", "--model", "symmetric"],
    "diagnose": ["diagnose", "linear_axis", "empty.csv"],
    "payload": ["payload", "linear_axis", "empty.csv", "--loaded", "loaded.csv"],
    "watch": ["watch", "model.yaml", "empty.csv", "loaded.csv"],
    "fleet": ["fleet", "linear_axis", "one=empty.csv", "two=loaded.csv", "three=later.csv", "--out", "fleet.yaml"],
    "compare": ["compare", "model.yaml", "model.yaml"],
    "excite": [
        "excite",
        "linear_axis",
        "--out",
        "motion.csv",
        "--method",
        "random",
        "--duration",
        "6",
        "--trials",
        "1",
    ],
    "simulate": ["simulate", "linear_axis", "--motion", "slow", "--duration", "4", "--out", "made.csv"],
    "export": ["export", "model.yaml", "--to", "urdf", "--out", "made.urdf"],
    "feedforward": ["feedforward", "export", "model.yaml", "--to", "python", "--out", "made.py"],
    "modes without a resonance": ["modes", "empty.csv", "--inputs", "tau_axis", "--outputs", "q_axis"],
}


def test_the_schema_is_one_and_names_every_command(schema) -> None:
    """It agrees with the rules for schemas; each command stands in it with a part of its own, and no other does."""
    Draft202012Validator.check_schema(schema.schema)
    commands = {words.split()[0] for words in COMMANDS}
    assert set(schema.schema["properties"]["command"]["enum"]) == commands
    assert commands <= set(schema.schema["$defs"]) and schema.schema["$id"] == "urn:tau_dyn:result:1"


@pytest.mark.parametrize("name", CALLS)
def test_results_hold_what_the_schema_says(name, files, monkeypatch, tmp_path, schema) -> None:
    """Status 0 or 3, and the file agrees; with `--json` nothing else decides what is written."""
    monkeypatch.chdir(files)
    assert main([*CALLS[name], "--json", str(tmp_path / "r.json"), "--quiet"]) in (0, 3)
    found = json.loads((tmp_path / "r.json").read_text())
    assert found["command"] == CALLS[name][0] and not list(schema.iter_errors(found))


@pytest.fixture(scope="module")
def identified(files, tmp_path_factory) -> dict:
    """One result of `identify`."""
    path = tmp_path_factory.mktemp("result") / "r.json"
    assert main(["identify", "linear_axis", str(files / "empty.csv"), "--json", str(path), "--quiet"]) == 0
    return json.loads(path.read_text())


def _without(*path):
    def change(result):
        for key in path[:-1]:
            result = result[key]
        del result[path[-1]]

    return change


def _with(value, *path):
    def change(result):
        for key in path[:-1]:
            result = result[key]
        result[path[-1]] = value

    return change


@pytest.mark.parametrize(
    "change",
    [
        _without("tool_version"),
        _without("warning_codes"),
        _without("parameters"),
        _without("parameters", 0, "stderr"),
        _without("train", "per_joint"),
        _with("fine", "status"),
        _with("identify_all", "command"),
        _with("7 kg", "parameters", 0, "value"),
        _with(-1.0, "parameters", 0, "stderr"),
        _with([1.0], "parameters", 0, "ci95"),
        _with([{"path": "x.csv", "sha256": "none"}], "inputs"),
        _with("cannot_answer", "status"),
    ],
)
def test_a_broken_result_is_refused(identified, schema, change) -> None:
    """A key that is gone, a word for a number, half an interval, a refusal without its experiment."""
    assert not list(schema.iter_errors(identified))
    broken = copy.deepcopy(identified)
    change(broken)
    assert list(schema.iter_errors(broken))
