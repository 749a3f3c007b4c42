"""What a stranger gets wrong in the first hour: each slip ends with status 2 and one sentence that says what to do."""

import numpy as np
import pytest

from tau_dyn.cli import main
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.robot import load_robot

T = np.arange(0, 4, 0.004)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ("identify log.csv linear_axis", "were robot and log exchanged?"),
        ("view log.csv", "were robot and log exchanged?"),
        ("identify absent.urdf log.csv", "or a short name such as gantry_tau"),
        (
            "simulate linear_axis --motion m.csv --duration 5 --out s.csv",
            "--duration is the length of a named motion; m.csv has its own, so leave it out",
        ),
        ("check log.csv linearaxis", "no robot named 'linearaxis' (did you mean linear_axis?)"),
        ("identify linear_axis log.csv --fix carriage.mass=90", "(did you mean carriage_link.mass?)"),
        (
            "identify gantry_tau log.csv --set prototype=x9",
            "cannot expand it: prototype is l1, l2, d1 or t1, not x9 [file_format]\n",
        ),
        ("identify linear_axis log.csv --report", "--report needs a value after it"),
        ("identify linear_axis log.csv --model notes.txt", "as identify --out and diagnose --out write it"),
        ("identify gantry_tau log.csv", "name its column in a column map"),
        ("export linear_axes --to mjcf", "linear_axis"),
        ("compare notes.json log.csv", "nor a run folder of ours"),
        ("ik gantry_tau --position 1750 -600 750", "positions are in m (are they in mm?)"),
        ("ik gantry_tau --position 1.75 -0.6", "--position needs 3 values after it"),
        ("modes log.csv --inputs Q_AXIS --outputs tau_axis", "has no column Q_AXIS (did you mean q_axis?)"),
        ("simulate gantry_tau --rate 10 --duration 10 --out s.csv", "too high for this robot and control rate (10 Hz)"),
    ],
)
def test_a_slip_says_what_to_do(tmp_path, monkeypatch, capsys, argv, words):
    """Arguments in each other's place, names nearly right, millimetres, a robot for a model: told apart, and nothing written."""
    monkeypatch.chdir(tmp_path)
    rows = [f"{t:.3f},{0.1 * np.sin(3 * t):.6f},1" for t in T]
    (tmp_path / "log.csv").write_text("\n".join(["t,q_axis,tau_axis", *rows]) + "\n")
    (tmp_path / "notes.txt").write_text("effects: []\n")
    (tmp_path / "notes.json").write_text('{"command": "identify"}\n')
    before = sorted(p.name for p in tmp_path.iterdir())
    assert main(argv.split()) == 2
    said = capsys.readouterr().err
    (line,) = [x for x in said.splitlines() if x.startswith("error:")]
    assert words in f"{line}\n"
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def test_poses_with_exchanged_columns_are_reread(tmp_path, monkeypatch, capsys):
    """Positions of cart 1 under the name of cart 2: a warning names both columns; correct columns give none."""
    monkeypatch.chdir(tmp_path)
    robot, rng = load_robot("gantry_tau"), np.random.default_rng(1)
    q = robot.home + 0.4 * (2 * rng.random((30, 3)) - 1)
    place = forward_kinematics(robot, q).poses.position
    head = "q_cart1,q_cart2,q_cart3,x_tool,y_tool,z_tool"
    for name, columns in (("good.csv", q), ("swapped.csv", q[:, [1, 0, 2]])):
        np.savetxt(name, np.column_stack([columns, place]), delimiter=",", header=head, comments="")
        assert main(["calibrate", "gantry_tau", name, "--model", "frames", "--quiet"]) == 0
        reread = [x for x in capsys.readouterr().err.splitlines() if "[poses_reread]" in x]
        assert len(reread) == (name == "swapped.csv")
        assert all("the columns of cart1 and cart2 are exchanged" in x for x in reread)
