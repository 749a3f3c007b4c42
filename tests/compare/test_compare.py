"""What changed between two results is named, and what did not is not."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.cli import main
from tau_dyn.compare import ComparedSide, compare, read_side
from tau_dyn.compare.read import MeasuredQuantity
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import load_robot


def side(quantities, name="a", **more):
    """Return a side with these `name: (value, stderr, unit)`."""
    found = {n: MeasuredQuantity(*q) for n, q in quantities.items()}
    given = {"errors": {}, "findings": {}, "logs": frozenset()} | more
    return ComparedSide(Path(name), name, "identify", found, **given)


def test_two_estimates_of_one_robot_name_a_change_once_in_twenty(rng):
    """Holm's test over 12 values: of 400 pairs drawn from one truth at most 32 name any change (5 % and three deviations)."""
    false = 0
    for _ in range(400):
        stderr = rng.uniform(0.1, 2, 12)
        a, b = ({f"p{k}": (10 + s * rng.standard_normal(), s, "kg") for k, s in enumerate(stderr)} for _ in range(2))
        false += bool(compare(side(a), side(b, "b")).changed)
    assert 5 <= false <= 32


def test_a_heavier_plate_is_named_with_its_interval():
    """9.13 +- 0.05 against 9.63 +- 0.05 kg: 0.5 kg, seven standard errors, with 0.36 to 0.64 as its interval."""
    a, b = (
        side({"plate": (9.13, 0.05, "kg"), "cart": (13.6, 0.2, "kg")}),
        side({"plate": (9.63, 0.05, "kg"), "cart": (13.5, 0.2, "kg")}, "b"),
    )
    found = compare(a, b)
    assert [c.name for c in found.changed] == ["plate"]
    assert_allclose(found.changed[0].ci95, (0.5 - 1.96 * 0.0707, 0.5 + 1.96 * 0.0707), atol=1e-3)


def test_a_value_that_no_data_determined_is_not_judged():
    """Nominal values differ without being changes."""
    found = compare(side({"m": (1.0, None, "kg")}), side({"m": (2.0, 0.1, "kg")}, "b"))
    assert found.changes[0].changed is None and found.changed == ()


def test_resonances_are_matched_by_frequency():
    """A log that misses the first resonance does not shift the others."""
    a = {"mode 1 frequency": (7.4, 0.01, "Hz"), "mode 2 frequency": (11.5, 0.02, "Hz")}
    b = {"mode 1 frequency": (11.52, 0.02, "Hz"), "mode 2 frequency": (20.0, 0.1, "Hz")}
    found = compare(side(a), side(b, "b"))
    assert [(c.name, c.a, c.b) for c in found.changes] == [("mode 2 frequency", 11.5, 11.52)]
    assert found.only_a == ("mode 1 frequency",) and found.only_b == ("mode 3 frequency",)


def test_causes_that_came_and_went_are_listed():
    """A cause found in one result only stands with its status beside `None`."""
    key = ("stribeck", ("cart1",))
    found = compare(
        side({}, findings={key: "confirmed"}), side({}, "b", findings={("backlash", ("cart2",)): "suspected"})
    )
    assert {(f.cause, f.a, f.b) for f in found.findings} == {
        ("stribeck", "confirmed", None),
        ("backlash", None, "suspected"),
    }


@pytest.mark.parametrize("name", ["l.csv", "l.mat", "l.bag", "l.db3", "l.pq", "logs", "L.MCAP"])
def test_whatever_holds_a_recording_counts_as_one(tmp_path, name):
    """Logs come in many kinds of files and in folders; robot files and maps are no data."""
    inputs = [(name, "1"), ("r.urdf.xacro", "2"), ("map.yaml", "3"), ("r.urdf", "4")]
    content = {"command": "identify", "inputs": [{"path": p, "sha256": h} for p, h in inputs]}
    (tmp_path / "r.json").write_text(json.dumps(content))
    assert read_side(tmp_path / "r.json").logs == {"1"}


def test_results_from_the_same_recording_say_so():
    """Two analyses of one log are not independent."""
    one, two = (
        side({"m": (1.0, 0.1, "kg")}, logs=frozenset("x")),
        side({"m": (1.1, 0.1, "kg")}, "b", logs=frozenset("x")),
    )
    assert "same recordings" in compare(one, two).warnings[0]


def test_other_units_are_refused():
    """A value in N against one in N m is no comparison."""
    with raises_code("mismatch"):
        compare(side({"x": (1.0, 0.1, "N")}), side({"x": (1.0, 0.1, "N m")}, "b"))


def saved(tmp_path, name, mass, stderr):
    model = Model.of(load_robot("linear_axis"))
    (p,) = [p for p in model.parameters if p.name == "carriage_link.mass"]
    model = model.with_parameters(
        Parameters([replace(q, value=mass, stderr=stderr) if q is p else q for q in model.parameters])
    )
    model.save(tmp_path / name)
    return tmp_path / name


@pytest.mark.parametrize("used", ["trained_on", "held_out"])
def test_models_from_the_same_recording_say_so(tmp_path, used):
    """A model file holds the hashes of the logs that it was fitted to and judged on."""
    for name, mass in (("a.yaml", 95.0), ("b.yaml", 95.2)):
        model = Model.load(saved(tmp_path, name, mass, 0.2))
        replace(model, provenance={used: [{"path": "monday.csv", "sha256": "0" * 64}]}).save(tmp_path / name)
    found = compare(read_side(tmp_path / "a.yaml"), read_side(tmp_path / "b.yaml"))
    assert any("same recordings" in w for w in found.warnings)


def test_a_standard_error_of_zero_is_none(tmp_path):
    """Two values without a scatter cannot be judged; they do not end in a division by zero."""
    sides = [read_side(saved(tmp_path, f"{mass}.yaml", mass, 0.0)) for mass in (95.0, 96.0)]
    assert [c.changed for c in compare(*sides).changes if c.name == "carriage_link.mass"] == [None]


def test_the_command_compares_models(tmp_path, capsys):
    """Two model files: the sentence names the mass, the JSON carries it, the page escapes the paths."""
    a, b = saved(tmp_path, "<b>a.yaml", 95.0, 0.1), saved(tmp_path, "b.yaml", 97.0, 0.1)
    status = main(["compare", str(a), str(b), "--json", str(tmp_path / "r.json"), "--report", str(tmp_path / "r.html")])
    assert status == 0
    assert "carriage_link.mass" in capsys.readouterr().out
    result = json.loads((tmp_path / "r.json").read_text())
    row = next(c for c in result["changes"] if c["name"] == "carriage_link.mass")
    assert row["changed"] and row["difference"] == pytest.approx(2.0)
    page = (tmp_path / "r.html").read_text()
    assert "<b>a.yaml" not in page and "&lt;b&gt;a.yaml" in page


def test_half_a_character_in_a_result_becomes_a_question_mark(tmp_path):
    """JSON may hold one half of a pair, which no file can: found by fuzzing, where the page was not written."""
    row = {"name": "m\ud800", "value": 1.0, "stderr": 0.1, "unit": "kg", "identifiable": True}
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"command": "identify", "status": "ok", "parameters": [row]}))
    argv = ["compare", str(path), str(path), "--json", str(tmp_path / "r.json"), "--report", str(tmp_path / "r.html")]
    assert main(argv) == 0
    assert "m?" in (tmp_path / "r.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "neither a model file"),
        ("[1]", "not a result of ours"),
        ('{"command": "identify", "status": "cannot_answer"}', "no values to compare"),
        ('{"command": "identify", "parameters": [{"name": "m"}]}', "wrong kind"),
        ('{"command": "identify", "parameters": [{"name": "m", "value": "x"}]}', "wrong kind"),
    ],
)
def test_what_is_no_result_is_one_sentence(tmp_path, capsys, content, says):
    """A broken result ends with status 2 and one line; nothing is written."""
    bad, good = tmp_path / "bad.json", tmp_path / "good.json"
    bad.write_text(content)
    good.write_text('{"command": "identify", "parameters": [{"name": "m", "value": 1, "stderr": 0.1, "unit": "kg"}]}')
    assert main(["compare", str(good), str(bad), "--json", str(tmp_path / "out.json")]) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1 and not (tmp_path / "out.json").exists()


def test_reading_a_result_of_identify(tmp_path):
    """Parameters, errors and data hashes are read from the contract's entries."""
    path = tmp_path / "r.json"
    row = {"name": "cart1.viscous_pos", "value": 60.0, "stderr": 2.0, "unit": "N/(m/s)"}
    files = [{"path": "l.csv", "sha256": "s"}, {"path": "robot.urdf", "sha256": "r"}]
    held_out = {"relative_error_percent": 3.5}
    path.write_text(json.dumps({"command": "identify", "parameters": [row], "inputs": files, "holdout": held_out}))
    read = read_side(path)
    assert read.quantities["cart1.viscous_pos"] == MeasuredQuantity(60.0, 2.0, "N/(m/s)")
    assert read.errors == {"holdout error": (3.5, "%")} and read.logs == {"s"}
    assert np.isclose(compare(read, side({"cart1.viscous_pos": (61.0, 2.0, "N/(m/s)")}, "b")).changes[0].stderr, 8**0.5)


def folder(path, command="identify", *, mass=1.0, log="s", options=None, versions=None, **more):
    """Write a run folder by hand, as the command line leaves them."""
    path.mkdir()
    row = {"name": "m", "value": mass, "stderr": 0.1, "unit": "kg"}
    inputs = [{"path": "monday.csv", "sha256": log}, {"path": "robot.xacro", "sha256": "r"}]
    result = {"command": command, "inputs": inputs, "parameters": [row], **more}
    (path / "result.json").write_text(json.dumps(result))
    run = {
        "run_format": 1, "command": command, "command_line": "tau-dyn", "configuration": options or {"model": "rigid"},
        "inputs": inputs, "versions": versions or {"numpy": "2.0"}, "seed": 0, "started": "2026-11-21T22:00:00+00:00",
        "duration_s": 1.0, "exit_status": 0, "files": {},
    }  # fmt: skip
    (path / "run.json").write_text(json.dumps(run))
    return path


def test_two_runs_say_what_was_different(tmp_path, capsys):
    """Another log under the same name, another option, another library: all three are named, what is alike is not."""
    a = folder(tmp_path / "a")
    b = folder(tmp_path / "b", mass=3.0, log="t", options={"model": "symmetric"}, versions={"numpy": "2.1"})
    assert main(["compare", str(a), str(b), "--json", str(tmp_path / "r.json")]) == 0
    said, found = capsys.readouterr().out, json.loads((tmp_path / "r.json").read_text())
    assert {i["a"]: i["state"] for i in found["input_changes"]} == {"monday.csv": "changed", "robot.xacro": "same"}
    assert found["configuration_changes"] == [{"name": "model", "a": "rigid", "b": "symmetric"}]
    assert found["version_changes"] == [{"name": "numpy", "a": "2.0", "b": "2.1"}]
    assert found["changes"][0]["changed"]
    for word in ("monday.csv is changed", "model rigid → symmetric", "numpy 2.0 → 2.1"):
        assert word in " ".join(said.split())
    assert "robot.xacro" not in said


def test_files_are_matched_by_path_then_content_then_name():
    """A log that moved is renamed, one that was recorded again is changed, one that is gone is said."""
    from tau_dyn.compare.run import list_input_changes

    found = list_input_changes({"a/m.csv": "1", "a/n.csv": "2", "x": "3"}, {"b/m.csv": "1", "b/n.csv": "4", "y": "5"})
    assert [(i.a, i.b, i.state) for i in found] == [
        ("a/m.csv", "b/m.csv", "renamed"),
        ("a/n.csv", "b/n.csv", "changed"),
        ("x", None, "only in the first"),
        (None, "y", "only in the second"),
    ]


def test_errors_and_findings_come_with_their_intervals(tmp_path):
    """Diagnosed errors have intervals, a cause what it is worth; a cause in one run only appeared or vanished."""
    gain = {"rms_before": 2.0, "rms_after": 1.0, "reduction_percent": 50.0, "ci95": [40.0, 60.0]}
    cause = {"cause": "stribeck", "joints": ["axis"], "status": "confirmed", "parameters": [], "gain": gain}
    one = {"extended": {"relative_error_percent": 1.0, "relative_ci95": [0.9, 1.1]}, "findings": []}
    two = {"extended": {"relative_error_percent": 0.5, "relative_ci95": [0.4, 0.6]}, "findings": [cause]}
    a, b = (read_side(folder(tmp_path / n, "diagnose", **more)) for n, more in (("a", one), ("b", two)))
    found = compare(a, b)
    assert found.to_dict()["errors"][0] == {
        "name": "extended error", "unit": "%", "a": 1.0, "b": 0.5, "ci95_a": [0.9, 1.1], "ci95_b": [0.4, 0.6]
    }  # fmt: skip
    (change,) = found.findings
    assert change.what == "appeared" and change.gain_b == (50.0, 40.0, 60.0) and change.gain_a is None


def test_two_runs_with_nothing_in_common_still_have_circumstances(tmp_path):
    """A check beside a simulation: no quantity to compare, but files, options and versions."""
    a = folder(tmp_path / "a", "check", parameters=None)
    b = folder(tmp_path / "b", "simulate", parameters=None, options={"motion": "prbs"})
    found = compare(read_side(a), read_side(b))
    assert not found.changes and {d.name for d in found.configuration} == {"model", "motion"}


def test_a_run_without_an_answer_says_what_its_data_lacked(tmp_path):
    """Compared with a run that answered, the one that could not is a warning, not a refusal."""
    a = folder(tmp_path / "a")
    b = folder(tmp_path / "b", status="cannot_answer", missing="the axis never moved", parameters=None)
    assert any("the axis never moved" in w for w in compare(read_side(a), read_side(b)).warnings)


def test_a_check_with_faults_is_compared_by_its_findings(tmp_path):
    """A log that is not usable exits with 3, but its faults are an answer: one that vanished after a repair is listed."""
    a, b = tmp_path / "a.json", tmp_path / "b.json"
    faulty = {
        "status": "cannot_answer",
        "fit_for_use": False,
        "missing": "a live channel",
        "experiment": "record again",
    }
    sound = {"status": "ok", "fit_for_use": True}
    for path, more, severity in ((a, faulty, "fault"), (b, sound, "ok")):
        rows = [{"severity": severity, "topic": "frozen", "sentence": "", "remedy": ""}]
        path.write_text(json.dumps({"command": "check", "inputs": [], "findings": rows, "numbers": {}} | more))
    assert compare(read_side(a), read_side(b)).findings


@pytest.mark.parametrize(("name", "says"), [("run.json", "no run folder"), ("result.json", "no such file")])
def test_half_a_run_folder_is_refused(tmp_path, capsys, name, says):
    """A folder without run.json is no run; without a result there is nothing to compare."""
    a = folder(tmp_path / "a")
    (a / name).unlink()
    assert main(["compare", str(a), str(folder(tmp_path / "b"))]) == 2
    assert says in capsys.readouterr().err
