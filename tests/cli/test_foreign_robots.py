"""Other people's robot files on the command line: packages, MJCF, tools, and how what cannot be read ends."""

from __future__ import annotations

import json

import pytest

from tau_dyn.cli import main

MJCF = (
    '<mujoco><worldbody><body name="arm"><joint name="turn" axis="0 1 0" range="-90 90"/>'
    '<geom type="capsule" size=".05" mass="30" fromto="0 0 0 .8 0 0"/>{}</body></worldbody></mujoco>'
)


@pytest.fixture
def answer(tmp_path):
    """Return a function that runs a command and gives its JSON."""

    def run(*words: object) -> dict:
        out = tmp_path / "result.json"
        assert main([*map(str, words), "--json", str(out), "--quiet"]) == 0
        return json.loads(out.read_text())

    return run


def test_fk_of_an_mjcf_and_of_a_package_elsewhere(tmp_path, answer, write, capsys):
    """The site is the tool; `--package` says where `$(find ..)` leads, and its absence is one sentence."""
    arm = tmp_path / "arm.xml"
    arm.write_text(MJCF.format('<site name="attachment_site" pos=".3 0 0"/>'))
    row = answer("fk", arm, "--q", 0)["rows"][0]
    assert row["position"] == pytest.approx([0.3, 0, 0])
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "arm.xacro").write_text(write.two_link())
    asking = tmp_path / "asking.urdf.xacro"
    find = '<xacro:include filename="$(find far_away)/arm.xacro"/>'
    asking.write_text(f'<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">{find}</robot>')
    words = ["fk", str(asking), "--q", "0", "0"]
    assert answer(*words, "--package", f"far_away={tmp_path / 'package'}", "--tool", "lower_link")["status"] == "ok"
    capsys.readouterr()
    assert main(words) == 2 and main([*words, "--package", "far_away"]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 2 and "--package far_away=DIR" in said[0] and "NAME=DIR" in said[1]


def test_an_mjcf_goes_through_simulation_and_identification_into_files(tmp_path, answer):
    """Log, model, URDF and MJCF again; what is read back answers."""
    arm, log, model = tmp_path / "arm.xml", tmp_path / "log.csv", tmp_path / "model.yaml"
    arm.write_text(MJCF.format(""))
    answer("simulate", arm, "--duration", 20, "--out", log)
    answer("identify", arm, log, "--model", "symmetric", "--out", model)
    for kind in ("urdf", "mjcf"):
        out = tmp_path / {"urdf": "again.urdf", "mjcf": "again.xml"}[kind]
        answer("export", model, "--to", kind, "--out", out)
        assert answer("fk", out, "--q", 0.3)["status"] == "ok"


@pytest.mark.parametrize(
    "text", [MJCF.format('<geom mesh="a" type="mesh"/>'), MJCF.format("<composite/>"), "<mujoco/>"]
)
def test_what_cannot_be_read_ends_in_a_sentence(tmp_path, capsys, text):
    """Status 2 and one line on stderr, which names the file."""
    arm = tmp_path / "arm.xml"
    arm.write_text(text)
    assert main(["fk", str(arm), "--q", "0"]) == 2
    (said,) = capsys.readouterr().err.strip().splitlines()
    assert said.startswith("error: ") and "arm.xml" in said
