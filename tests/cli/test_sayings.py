"""What the command line says to a slip: one line in words, with what would be right; no argparse, no Python."""

from __future__ import annotations

import runpy
import sys

import pytest

from tau_dyn.cli import main


@pytest.mark.parametrize(
    ("argv", "says"),
    [
        ("", "name a command, such as demo"),
        ("identfy", "there is no command 'identfy' (did you mean identify?); there are demo, check"),
        ("identify", "tau-dyn identify: ROBOT and LOG are missing"),
        ("identify linear_axis log.csv --modle rigid", "there is no --modle here (did you mean --model?)"),
        ("identify linear_axis log.csv --seed -3", "--seed '-3': write a whole number from zero up"),
        ("identify linear_axis log.csv --samples 2.5", "--samples '2.5': write a whole number from zero up"),
        ("identify linear_axis log.csv --estimator foo", "there is no --estimator 'foo'; there are auto, wls"),
        ("simulate linear_axis --rate 0 --out x.csv", "--rate '0': write a number above zero"),
        ("simulate linear_axis --rate abc --out x.csv", "--rate 'abc': write a number above zero"),
        ("fk linear_axis --q abc", "--q 'abc': write a finite number"),
        ("workspace linear_axis --rod-stiffness -1", "--rod-stiffness '-1': write a number above zero or 'rigid'"),
        ("accuracy delta --grid x", "--grid 'x': write a whole number from 2 to 201"),
        ("accuracy delta --samples 0", "--samples '0': write a whole number from 1 to 100000"),
        ("view delta --port 0", "--port '0': write a port between 1 and 65535"),
        ("excite delta --box a 0 0 1 1 1 --out m.csv", "--box 'a': write a number"),
        ("plan-poses linear_axis --n x", "--n 'x': write a whole number above zero, or auto"),
        ("identify linear_axis log.csv --out", "--out needs a value after it"),
    ],
)
def test_a_slip_is_answered_in_words(tmp_path, monkeypatch, capsys, argv, says):
    """Status 2 and one line that names the slip, what would be right, and the help of that very command."""
    monkeypatch.chdir(tmp_path)
    assert main(argv.split()) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert not any(word in error for word in ("invalid", "argument -", "unrecognized", "_value"))
    assert f"see {' '.join(['tau-dyn', *[w for w in argv.split()[:1] if w != 'identfy']])} --help" in error
    assert not list(tmp_path.iterdir())


def test_the_module_is_the_command_line(monkeypatch, capsys):
    """`python -m tau_dyn` says what `tau-dyn` says, and ends as it ends."""
    monkeypatch.setattr(sys, "argv", ["tau_dyn", "identfy"])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_module("tau_dyn", run_name="__main__")
    assert "did you mean identify?" in capsys.readouterr().err
