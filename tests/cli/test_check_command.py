"""`check` reports the tests that ran, with units, and joins the files of a folder by a proposed map."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.cli import main

T = np.arange(0.0, 20.0, 0.004)
Q = 0.2 * np.sin(2 * T) + 0.1 * np.sin(5.3 * T)
TAU = 95.0 * (-0.8 * np.sin(2 * T) - 2.809 * np.sin(5.3 * T)) + 20 * np.sign(
    0.4 * np.cos(2 * T) + 0.53 * np.cos(5.3 * T)
)


def write(path: Path, head: str, *columns: np.ndarray) -> str:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=head, comments="", fmt="%.7f")
    return str(path)


@pytest.mark.parametrize("with_force", [True, False])
def test_only_forces_are_compared_with_masses(tmp_path: Path, capsys, with_force: bool) -> None:
    """Wiring and timing of forces cannot be compared with masses where the log has no force."""
    head, columns = ("t,q_axis,tau_axis", (T, Q, TAU)) if with_force else ("t,q_axis", (T, Q))
    assert main(["check", write(tmp_path / "a.csv", head, *columns), "linear_axis"]) == 0
    assert ("compared with the masses" in " ".join(capsys.readouterr().out.split())) is with_force


def test_numbers_of_a_known_joint_have_units(tmp_path: Path, capsys) -> None:
    """A slide's range is in m and its speed in m/s: 0.4 + 0.53 m/s at most."""
    assert main(["check", write(tmp_path / "a.csv", "t,q_axis,tau_axis", T, Q, TAU), "linear_axis"]) == 0
    told = " ".join(capsys.readouterr().out.split())
    low, high, fastest = map(float, re.findall(r"range (\S+) … (\S+) m, up to (\S+) m/s", told)[0])
    assert (low, high) == pytest.approx((Q.min(), Q.max()), rel=0.01)
    assert fastest == pytest.approx(np.max(np.abs(0.4 * np.cos(2 * T) + 0.53 * np.cos(5.3 * T))), rel=0.01)


def test_the_files_of_a_folder_are_checked_by_a_proposed_map(tmp_path: Path, capsys) -> None:
    """Positions in one file and forces in another become one log of the same motion."""
    folder, where = tmp_path / "topics", str(tmp_path / "map.yaml")
    folder.mkdir()
    write(folder / "encoder.csv", "time,pos_axis", T, Q)
    write(folder / "drive.csv", "stamp,force_axis", T[::2] + 0.0011, np.interp(T[::2] + 0.0011, T, TAU))
    assert main(["columns", str(folder), "linear_axis", "--out", where]) == 0
    assert main(["check", str(folder), "linear_axis", "--columns", where]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "compared with the masses" in told and "clock of drive.csv" in told
    assert main(["check", str(folder), "linear_axis"]) == 2
    assert "`tau-dyn columns FOLDER ROBOT` proposes a map" in capsys.readouterr().err


@pytest.mark.parametrize(
    "mass", ["", '<inertial><mass value="95"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>']
)
def test_a_robot_file_without_masses_is_not_compared(tmp_path: Path, capsys, mass: str) -> None:
    """A robot file without masses has nothing to compare forces with."""
    file = tmp_path / "slide.urdf"
    file.write_text(
        f'<robot name="slide"><link name="base"/><link name="cart">{mass}</link><joint name="axis" type="prismatic">'
        '<parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>'
        '<limit lower="-1" upper="1" velocity="2" effort="2000"/></joint></robot>'
    )
    assert main(["check", write(tmp_path / "a.csv", "t,q_axis,tau_axis", T, Q, TAU), str(file)]) == 0
    assert ("compared with the masses" in " ".join(capsys.readouterr().out.split())) is bool(mass)
