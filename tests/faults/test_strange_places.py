"""Odd screens, odd places for outputs, odd addresses: the answer, or status 2 in one sentence; never a traceback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import wraps
from pathlib import Path

import pytest

from tau_dyn.cli import main
from tau_dyn.files import resolve_destination

FK = ["fk", "linear_axis", "--q", "0.1", "--quiet"]
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="/dev, links, closed descriptors")


def refused(capsys: pytest.CaptureFixture[str], argv: list[str]) -> str:
    assert main(argv) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and err.startswith("error: ")
    return err


def shell(folder: Path, words: str) -> subprocess.CompletedProcess[str]:
    command = words.replace("tau-dyn", f"{sys.executable} -m tau_dyn")
    return subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("coding", ["ascii", "cp1252"])
def test_a_screen_of_another_coding_shows_what_it_can(tmp_path: Path, coding: str) -> None:
    """Bars and arrows become question marks; it used to be a traceback after the files were written."""
    ended = shell(tmp_path, f"PYTHONIOENCODING={coding} tau-dyn fk linear_axis --q 0.1 --json r.json")
    assert ended.returncode == 0 and "tool" in ended.stdout and ended.stderr == ""
    assert (tmp_path / "r.json").exists()


def test_closed_and_full_screens_change_no_status(tmp_path: Path) -> None:
    """Without stdout and stderr the file is written; a sentence that nobody takes leaves status 2."""
    ended = shell(tmp_path, "tau-dyn fk linear_axis --q 0.1 --json r.json >&- 2>&-; echo $? > status")
    assert ended.returncode == 0 and (tmp_path / "status").read_text() == "0\n" and (tmp_path / "r.json").exists()
    assert shell(tmp_path, "tau-dyn fk nobody --q 0.1 2> /dev/full").returncode == 2


def test_a_pipe_is_written_to(tmp_path: Path) -> None:
    """`--json /dev/stdout | jq`: links to pipes are followed by the system, not by us."""
    ended = shell(tmp_path, "set -o pipefail; tau-dyn fk linear_axis --q 0.1 --quiet --json /dev/stdout | cat")
    assert ended.returncode == 0 and json.loads(ended.stdout)["command"] == "fk"


def test_links_that_lead_to_themselves_are_named(tmp_path: Path, monkeypatch, capsys) -> None:
    """As a file, as its folder, for the library too."""
    monkeypatch.chdir(tmp_path)
    os.symlink("two", "one")
    os.symlink("one", "two")
    for place in ("one", "one/r.json"):
        assert place in refused(capsys, [*FK, "--json", place])
    assert sorted(os.listdir()) == ["one", "two"] and Path("one").is_symlink()


def test_a_folder_that_is_gone_is_named(tmp_path: Path, monkeypatch, capsys) -> None:
    """Somebody removed the folder in which the command was started."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    try:
        assert "the folder that you are in is gone" in refused(capsys, [*FK, "--json", "r.json"])
        assert main(FK) == 0
    finally:
        os.chdir(tmp_path)


def test_what_comes_along_with_an_output_is_not_overwritten(tmp_path: Path, capsys) -> None:
    """C code brings a header; a result under the header's name, or an input under it, is refused, and nothing is written."""
    out = [str(tmp_path / name) for name in ("law.c", "law.h")]
    export = ["export", "linear_axis", "--to", "c", "--out", out[0], "--quiet"]
    assert "two outputs" in refused(capsys, [*export, "--json", out[1]])
    assert list(tmp_path.iterdir()) == []
    assert main([*export, "--json", str(tmp_path / "law.json")]) == 0


def test_a_folder_taken_meanwhile_is_kept(tmp_path: Path, monkeypatch, capsys) -> None:
    """Two commands into one new folder: the one that ends last finds the other's run there, and leaves it."""
    from tau_dyn.cli import COMMANDS

    fk, folder = COMMANDS["fk"], f"{tmp_path / 'run'}/"

    @wraps(fk)
    def slow(*places, **options):
        assert main(["check", str(log), "linear_axis", "--out", folder, "--quiet"]) == 0
        return fk(*places, **options)

    log = tmp_path / "log.csv"
    assert main(["simulate", "linear_axis", "--duration", "4", "--rate", "200", "--out", str(log), "--quiet"]) == 0
    capsys.readouterr()
    monkeypatch.setitem(COMMANDS, "fk", slow)
    assert "holds a run of tau-dyn check" in refused(capsys, [*FK, "--out", folder])
    assert json.loads((tmp_path / "run" / "run.json").read_text())["command"] == "check"


def test_joints_of_a_loop_that_are_all_named_move_as_one(capsys) -> None:
    """Three drives on the one freedom of a parallelogram: one position places them all, and three are too many."""
    argv = ["fk", "parallelogram", "--actuated", "crank", "plate_turn", "rod2_turn", "--q", "0", "0", "0"]
    assert "--q: one value for each actuated joint (crank), not 3" in refused(capsys, argv)


@pytest.mark.parametrize("host", ["203.0.113.7", "nobody.invalid", "256.1.1.1", "a\nb"])
def test_an_address_of_somebody_else_is_refused(host: str, capsys) -> None:
    """A server waits without a word for an address that it cannot listen at."""
    pytest.importorskip("viser")
    assert "no server can listen at" in refused(capsys, ["view", "linear_axis", "--for", "0.1", "--host", host])


@pytest.mark.parametrize("option", ["--force-colour=nan", "--force-colour=inf", "--log-rate=1e-308"])
def test_numbers_that_are_none_end_in_a_sentence(tmp_path: Path, option: str, capsys) -> None:
    """They reached NumPy's roots and a whole number of samples."""
    argv = ["simulate", "linear_axis", "--duration", "4", "--rate", "200", "--out", str(tmp_path / "log.csv"), option]
    try:
        refused(capsys, argv)
    except SystemExit as left:
        assert left.code == 2
    assert list(tmp_path.iterdir()) == []


def test_where_an_output_lies(tmp_path: Path) -> None:
    """Behind links for files, there or not; as named for devices."""
    (tmp_path / "real").write_text("")
    (tmp_path / "link").symlink_to("real")
    (tmp_path / "ahead").symlink_to("new")
    assert resolve_destination(tmp_path / "link") == (tmp_path / "real").resolve()
    assert resolve_destination(tmp_path / "ahead") == (tmp_path / "new").resolve()
    assert resolve_destination("/dev/null") == Path("/dev/null")
