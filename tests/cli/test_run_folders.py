"""A run folder holds all that a run needs to be understood and repeated, and two of them can be compared."""

from __future__ import annotations

import hashlib
import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from tau_dyn.cli import COMMANDS, execute, main, parse
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.run_folder import RunFolder
from tau_dyn.exceptions import CannotAnswer, InputError

FK = ["fk", "linear_axis", "--q", "0.1", "--quiet"]


def run(*argv: object) -> int:
    return main([str(a) for a in argv])


@pytest.fixture
def made(tmp_path) -> Path:
    """Return the run folder of a forward kinematics."""
    assert run(*FK, "--out", tmp_path / "one") == 0
    return tmp_path / "one"


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_run_leaves_result_page_own_file_and_where_they_came_from(made):
    """What went in, all options with their defaults, versions, seed, time and hashes stand beside the result."""
    assert set(tree(made)) == {"run.json", "result.json", "report.html", "poses.csv"}
    said = json.loads((made / "run.json").read_text())
    assert said["command"] == "fk" and said["exit_status"] == 0 and said["duration_s"] >= 0
    assert said["configuration"]["q"] == [0.1] and said["configuration"]["poses"] is None and said["seed"] == 0
    assert "quiet" not in said["configuration"] and "out" not in said["configuration"]
    assert {"tau_dyn", "python", "numpy", "scipy", "platform"} <= set(said["versions"])
    (robot,) = said["inputs"]
    assert robot["sha256"] == hashlib.sha256(Path(robot["path"]).read_bytes()).hexdigest()
    for name, sha256 in said["files"].items():
        assert hashlib.sha256((made / name).read_bytes()).hexdigest() == sha256
    result = json.loads((made / "result.json").read_text())
    assert result["status"] == "ok" and result["inputs"] == said["inputs"]


def test_nothing_else_is_left_beside_it(made):
    """The folder was staged under another name, which is gone."""
    assert [p.name for p in made.parent.iterdir()] == ["one"]


def test_a_file_is_still_a_file(tmp_path, monkeypatch):
    """`--out FILE.csv` writes that file and nothing else, as it always did."""
    monkeypatch.chdir(tmp_path)
    assert run(*FK, "--out", "table.csv") == 0
    assert [p.name for p in tmp_path.iterdir()] == ["table.csv"]


@pytest.mark.parametrize(
    ("text", "folder"),
    [
        ("model.yaml", False),
        ("model.yaml/", True),
        ("monday", True),
        ("there.d", True),
        ("bare", False),
        ("a/b", True),
        (".", True),
    ],
)
def test_what_is_a_run_folder(tmp_path, monkeypatch, text, folder):
    """A slash at the end, no suffix, or an existing folder; a file that exists without suffix stays a file."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.d").mkdir()
    (tmp_path / "bare").write_text("")
    values = parse(["identify", "linear_axis", "log.csv", "--out", text]).values()
    assert isinstance(values["out"], RunFolder) is folder


def test_every_command_takes_one(capsys):
    """`--out` is there for all, with the command's own file or without."""
    for name in COMMANDS:
        assert run(*name.split(), "--help") == 0
        assert "--out" in capsys.readouterr().out, name


def test_a_command_without_a_file_of_its_own_refuses_a_file(tmp_path, capsys):
    """`check --out result.json` is a slip for `--json`, not a folder of that name."""
    assert run("check", "log.csv", "--out", tmp_path / "result.json") == 2
    assert "names a file; a folder is written here" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_the_same_command_again_brings_the_folder_up_to_date(made):
    """A rerun replaces its own files and only then; the first run's time is gone, its result is the same."""
    before = tree(made)
    assert run(*FK, "--out", made) == 0
    after = tree(made)
    assert after["result.json"] == before["result.json"] and set(after) == set(before)
    assert [p.name for p in made.parent.iterdir()] == ["one"]


@pytest.mark.parametrize(
    ("spoil", "argv", "says"),
    [
        (lambda d: None, ["fk", "linear_axis", "--q", "0.2"], "with other options (q)"),
        (lambda d: None, ["ik", "linear_axis", "--position", "0", "0", "0"], "holds a run of tau-dyn fk"),
        (lambda d: (d / "notes.txt").write_text("mine"), FK, "holds notes.txt, which its run did not write"),
        (lambda d: (d / "poses.csv").write_text("mine"), FK, "holds poses.csv, which was changed since its run"),
        (lambda d: (d / "run.json").unlink(), FK, "is no run folder"),
        (lambda d: (d / "run.json").write_text("[" * 99999), FK, "run.json"),
        (lambda d: (d / "run.json").write_text('{"run_format": 1}'), FK, "an entry is missing"),
    ],
)
def test_nothing_that_is_not_of_the_same_run_is_overwritten(made, capsys, spoil, argv, says):
    """Another command, other options, foreign or edited files: refused in one line, every byte as it was."""
    spoil(made)
    before = tree(made)
    assert run(*argv, "--out", made) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1 and tree(made) == before


def test_a_run_file_that_names_other_places_removes_nothing_there(made, tmp_path):
    """A forged list of files cannot make a rerun delete a file outside the folder."""
    (tmp_path / "precious.txt").write_text("mine")
    said = json.loads((made / "run.json").read_text())
    said["files"]["../precious.txt"] = ""
    (made / "run.json").write_text(json.dumps(said))
    assert run(*FK, "--out", made) == 0
    assert (tmp_path / "precious.txt").read_text() == "mine"


def test_an_input_within_the_folder_is_not_replaced(tmp_path, capsys):
    """Poses read from the folder that is to be written would be lost."""
    assert run(*FK, "--out", tmp_path / "one") == 0
    poses = tmp_path / "one" / "poses.csv"
    assert run("fk", "linear_axis", "--poses", poses, "--out", tmp_path / "one") == 2
    assert "is an input of this command" in capsys.readouterr().err


def test_an_existing_empty_folder_is_filled(tmp_path, monkeypatch):
    """The current folder and a mounted one cannot be replaced; they are written to."""
    monkeypatch.chdir(tmp_path)
    assert run(*FK, "--out", ".") == 0
    assert set(tree(tmp_path)) == {"run.json", "result.json", "report.html", "poses.csv"}


def test_other_outputs_go_where_they_are_asked_for_as_well(tmp_path):
    """`--json` beside a run folder writes both."""
    assert run(*FK, "--out", tmp_path / "one", "--json", tmp_path / "r.json") == 0
    assert (tmp_path / "r.json").read_bytes() == (tmp_path / "one" / "result.json").read_bytes()


@pytest.mark.parametrize("other", ["run.json", "report.html", "poses.csv"])
def test_no_output_takes_the_place_of_another_in_the_folder(tmp_path, capsys, other):
    """The names in a run folder are taken."""
    assert run(*FK, "--out", tmp_path / "one", "--json", tmp_path / "one" / other) == 2
    assert "two outputs" in capsys.readouterr().err and not (tmp_path / "one").exists()


def called(tmp_path, work) -> int:
    """Run a command of our own making into a run folder."""
    call = parse(["check", "log.csv", "--out", str(tmp_path / "one"), "--quiet"])
    return execute(replace(call, function=lambda *_, **options: work(options)))


def test_a_fault_while_writing_leaves_nothing(tmp_path):
    """The own file's writer breaks half way: no folder, no stage."""

    def broken(path: Path) -> None:
        path.write_text("half")
        raise RuntimeError("broken")

    with pytest.raises(RuntimeError):
        called(tmp_path, lambda args: Outcome(files={tmp_path / "one" / "own.txt": broken}))
    assert not list(tmp_path.iterdir())


def test_data_that_cannot_answer_leave_a_run_that_says_so(tmp_path, capsys):
    """Status 3 is a result too: what is missing, and the experiment."""

    def refuse(args):
        raise CannotAnswer("poor_excitation", "the axis never moved", "move it")

    assert called(tmp_path, refuse) == 3
    assert set(tree(tmp_path)) == {"one/run.json", "one/result.json"}
    assert json.loads((tmp_path / "one" / "run.json").read_text())["exit_status"] == 3
    said = json.loads((tmp_path / "one" / "result.json").read_text())
    assert said["status"] == "cannot_answer" and said["experiment"] == "move it"
    assert "cannot answer: the axis never moved" in capsys.readouterr().err


def test_the_demo_goes_beside_what_is_there(tmp_path):
    """`demo --out DIR` has always filled the folder that it was given, whatever else that held."""
    (tmp_path / "mine.txt").write_text("mine")
    call = parse(["demo", "--out", str(tmp_path), "--quiet"])
    files = {tmp_path / "monday.csv": "t\n"}
    outcome = Outcome(files=files, report=lambda command_line: "<p>")
    assert execute(replace(call, function=lambda *_, **__: outcome)) == 0
    assert {*tree(tmp_path)} == {"mine.txt", "monday.csv", "report.html", "result.json", "run.json"}
    deeper = tmp_path / "a" / "b.d"
    call = parse(["demo", "--out", str(deeper), "--quiet"])
    assert execute(replace(call, function=lambda *_, **__: Outcome())) == 0 and (deeper / "run.json").is_file()


@pytest.mark.skipif(sys.platform == "win32", reason="the lock is one of Unix")
def test_of_two_runs_that_end_at_once_the_second_waits(tmp_path):
    """While one run writes a folder another one does not touch it; then it replaces the folder of the same call."""
    with ThreadPoolExecutor(1) as pool:
        with RunFolder(tmp_path / "one").locked():
            second = pool.submit(called, tmp_path, lambda args: Outcome())
            time.sleep(0.5)
            waits = not second.done() and not list(tmp_path.iterdir())
        assert waits and second.result() == 0
    assert set(tree(tmp_path)) == {"one/run.json", "one/result.json"}


def test_a_folder_that_another_run_filled_meanwhile_is_kept(tmp_path):
    """The other run has other options: the later one is refused, and every byte stays as it was."""

    def fill(args):
        assert run(*FK, "--out", tmp_path / "one") == 0
        return Outcome()

    with pytest.raises(InputError, match="holds a run of tau-dyn fk"):
        called(tmp_path, fill)
    assert set(tree(tmp_path)) == {"one/run.json", "one/result.json", "one/report.html", "one/poses.csv"}
