"""Public measured logs: what the list says is true of the files, and a folder gets the published files or nothing."""

from __future__ import annotations

import builtins
import hashlib
import json
import os
import shlex
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest
from raising import raises_code

import tau_dyn as td
from tau_dyn.cli import main
from tau_dyn.log import ColumnMap
from tau_dyn.measured_data import fetch, fetch_data, find_set, list_sets
from tau_dyn.robot import load_robot

NAMES = [one.name for one in list_sets()]


@pytest.fixture
def data_folder(tmp_path, monkeypatch) -> Path:
    """A folder of measured data, empty at first."""
    folder = tmp_path / "measured"
    folder.mkdir()
    monkeypatch.setenv("TAU_DYN_DATA", str(folder))
    monkeypatch.chdir(tmp_path)
    return folder


@pytest.fixture
def published(monkeypatch) -> dict[str, bytes]:
    """What addresses answer, by address, in place of the network; another address does not answer."""
    answers: dict[str, bytes] = {}

    def answer(address: str, folder: Path) -> Path:
        path = folder / hashlib.sha256(address.encode()).hexdigest()
        path.write_bytes(answers[address])
        return path

    monkeypatch.setattr(fetch, "download_file", answer)
    return answers


@pytest.mark.parametrize("name", NAMES)
def test_every_set_has_source_licence_size_and_checksums(name):
    """Each published file has an https address and 64 digits; maps, robots and servo laws come with the package."""
    one = find_set(name)
    assert one.licence and one.source.startswith("https://") and one.question and one.next
    for file in one.files:
        assert file.n_bytes > 0 and bool(file.address) == bool(file.sha256)
        if file.address:
            assert file.address.startswith("https://") and len(bytes.fromhex(file.sha256)) == 32
    ColumnMap.load(fetch.find_shared_file("columns", one.columns))
    for robot in one.robots:
        assert load_robot(fetch.find_shared_file("robots", robot) if robot.endswith(".urdf") else robot).na >= 1
    assert not one.controller or fetch.find_shared_file("controllers", one.controller).is_file()


@pytest.mark.parametrize("name", ["tx40", "kr300", "simple_pendulum", "so101", "xl330", "vibration"])
def test_listed_checksums_and_sizes_are_those_of_the_measured_files(name, measured):
    """Where the data folder holds the listed files under their names, their bytes are those of the list."""
    for file in find_set(name).files:
        content = measured(f"{name}/{file.name}").read_bytes()
        assert len(content) == file.n_bytes, file.name
        assert file.sha256 in ("", hashlib.sha256(content).hexdigest()), file.name


def test_the_list_names_every_set_with_its_licence(capsys, tmp_path):
    """A person reads name, question and licence; a program the addresses and checksums."""
    assert main(["data", "--json", str(tmp_path / "list.json")]) == 0
    shown = capsys.readouterr().out
    rows = {row["name"]: row for row in json.loads((tmp_path / "list.json").read_text())["data"]}
    assert set(rows) == set(NAMES) and all(name in shown for name in NAMES)
    assert "Apache-2.0" in shown and rows["kr300"]["downloadable"] is False
    assert rows["emps"]["downloadable"] and len(rows["emps"]["files"][0]["sha256"]) == 64


def test_the_printed_command_identifies_the_emps_drive(measured, tmp_path, monkeypatch, capsys):
    """Copied from the data folder, the printed line gives the published mass of 95.15 kg within its interval."""
    monkeypatch.setenv("TAU_DYN_DATA", str(measured("emps/DATA_EMPS.csv").parents[1]))
    monkeypatch.chdir(tmp_path)
    assert main(["data", "emps"]) == 0
    said = capsys.readouterr()
    assert "no checksum was compared" in said.err
    line = next(line for line in said.out.splitlines() if line.startswith("  tau-dyn identify"))
    assert main([*shlex.split(line)[1:], "--json", "found.json", "--quiet"]) == 0
    rows = {row["name"]: row for row in json.loads(Path("found.json").read_text())["parameters"]}
    low, high = rows["carriage_link.mass"]["ci95"]
    assert low < 95.154 < high
    assert rows["axis.viscous_neg"]["value"] > 1.3 * rows["axis.viscous_pos"]["value"]


def test_a_published_file_is_downloaded_and_compared(data_folder, published, monkeypatch):
    """Without a copy in the data folder the address is asked; the printed command names the published file."""
    content = b"a log"
    one = find_set("emps")
    _publish(monkeypatch, "emps", hashlib.sha256(content).hexdigest())
    published[one.files[0].address] = content
    found = td.fetch_data("emps", data_folder.parent / "drive")
    assert (found.folder / "DATA_EMPS.mat").read_bytes() == content
    assert "drive/DATA_EMPS.mat" in found.next[0] and not found.warnings
    assert load_robot(found.folder / "linear_axis.urdf").actuated == ("axis",)
    assert one.licence in (found.folder / "SOURCE.txt").read_text()


def test_a_wrong_checksum_is_one_sentence_and_leaves_no_file(data_folder, published, capsys):
    """What the address answers is not what was published: status 2, and nothing is written."""
    published[find_set("emps").files[0].address] = b"something else"
    before = sorted(os.listdir())
    assert main(["data", "emps"]) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and said.err.rstrip().endswith("[wrong_checksum]")
    assert sorted(os.listdir()) == before and not said.out


def test_a_changed_file_in_the_data_folder_is_refused(data_folder):
    """A copy that has the published name has to have the published bytes."""
    (data_folder / "tx40").mkdir()
    (data_folder / "tx40" / "pos_read_data.csv").write_text("Joint_1\n0\n")
    with raises_code("wrong_checksum", "pos_read_data.csv"):
        fetch_data("tx40")


def test_files_of_others_are_not_overwritten(data_folder, capsys):
    """A file of the same name with another content stays as it is, and so does all else; the same content is no obstacle."""
    _copy_of_xl330(data_folder)
    mine = Path("xl330", "columns.yaml")
    mine.parent.mkdir()
    mine.write_text("t: my_clock\n")
    assert main(["data", "xl330"]) == 2
    assert "[cannot_write]" in capsys.readouterr().err
    assert mine.read_text() == "t: my_clock\n" and os.listdir("xl330") == ["columns.yaml"]
    assert main(["data", "xl330", "--out", "servo"]) == 0
    assert main(["data", "xl330", "--out", "servo"]) == 0
    assert "servo/kp100_*.csv" in capsys.readouterr().out


def test_a_set_that_is_not_published_as_it_is_read_needs_the_data_folder(data_folder):
    """No checksum is known of a converted file, so it is not downloaded, and the sentence names the source."""
    with raises_code("file_not_found", "TAU_DYN_DATA"):
        fetch_data("kr300")


def test_without_the_extra_the_sentence_names_it(data_folder, monkeypatch):
    """Pooch is optional; without it a download ends in the line that installs it."""
    real = builtins.__import__

    def refuse(name, *rest, **options):
        if name == "pooch":
            raise ImportError(name)
        return real(name, *rest, **options)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with raises_code("missing_package", "tau_dyn[data]"):
        fetch_data("emps")


def test_without_a_network_the_sentence_names_the_address(data_folder, monkeypatch):
    """An address that nobody answers at is one sentence, and nothing is written."""
    pytest.importorskip("pooch")
    unreachable = _with_address("http://127.0.0.1:9/DATA_EMPS.mat")
    monkeypatch.setattr(fetch, "list_sets", lambda: (unreachable,))
    with raises_code("download_failed", "127.0.0.1"):
        fetch_data("emps")
    assert not Path("emps").exists()


def test_an_unknown_name_lists_the_known_ones():
    """A slip in a name is answered by the names that exist."""
    with raises_code("unknown_name", "did you mean emps"):
        fetch_data("emp")


def test_a_download_from_an_address_arrives_byte_by_byte(data_folder, monkeypatch):
    """Pooch fetches from a server of this machine; the checksum decides whether the bytes are taken."""
    pytest.importorskip("pooch")
    content = bytes(range(256)) * 40
    (data_folder / "DATA_EMPS.mat").write_bytes(content)
    handler = partial(_QuietHandler, directory=str(data_folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/DATA_EMPS.mat"
        served = _with_address(address, hashlib.sha256(content).hexdigest())
        monkeypatch.setattr(fetch, "list_sets", lambda: (served,))
        assert (fetch_data("emps").folder / "DATA_EMPS.mat").read_bytes() == content
        monkeypatch.setattr(
            fetch, "list_sets", lambda: (replace(served, files=(replace(served.files[0], sha256="1" * 64),)),)
        )
        with raises_code("wrong_checksum", address):
            fetch_data("emps", "again")
        server.shutdown()
    assert not Path("again").exists()


class _QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Write nothing."""


def _with_address(address: str, sha256: str = "0" * 64) -> fetch.DataSet:
    one = find_set("emps")
    return replace(one, files=(replace(one.files[0], address=address, sha256=sha256),))


def _publish(monkeypatch, name: str, sha256: str) -> None:
    """Let the list have another checksum of the only file of a set."""
    changed = _with_address(find_set(name).files[0].address, sha256)
    monkeypatch.setattr(fetch, "list_sets", lambda: (changed,))


def _copy_of_xl330(folder: Path) -> None:
    """Put files of the names of a set that is only converted into the data folder."""
    (folder / "xl330").mkdir()
    for file in find_set("xl330").files:
        (folder / "xl330" / file.name).write_text("t,position,goal_position\n0,0,0\n")
