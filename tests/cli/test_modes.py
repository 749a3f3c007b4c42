"""`modes` on the command line: what it writes, what it says, and how bad input ends."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from tau_dyn.cli import main
from tau_dyn.modes import load_state_space

HZ, DAMPING, DT = 5.0, 0.03, 0.02


def vibration_log(path: Path, n: int = 900, seed: int = 0, **more: np.ndarray) -> Path:
    """Write a log of one resonance under a random binary force, 40 dB above the noise."""
    rng = np.random.default_rng(seed)
    force = np.repeat(rng.choice([-1.0, 1.0], n // 2 + 1), 2)[:n]
    w = 2 * np.pi * HZ
    pole = np.exp(DT * w * (-DAMPING + 1j * np.sqrt(1 - DAMPING**2)))
    y = lfilter([0, 1, 0.5], [1, -2 * pole.real, abs(pole) ** 2], force)
    columns = {"t": np.arange(n) * DT, "force": force, "place": y + 0.01 * y.std() * rng.normal(size=n), **more}
    rows = [",".join(f"{v:.9g}" for v in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join([",".join(columns), *rows]) + "\n")
    return path


def test_all_outputs_are_written(tmp_path, capsys):
    """One call gives the result, the page and a model that can be loaded, and prints the resonance."""
    log = vibration_log(tmp_path / "bench.csv")
    out = {"--json": tmp_path / "r.json", "--report": tmp_path / "r.html", "--out": tmp_path / "m.yaml"}
    argv = ["modes", str(log), "--inputs", "force", "--outputs", "place", *(str(x) for p in out.items() for x in p)]
    assert main(argv) == 0
    result = json.loads(out["--json"].read_text())
    assert result["command"] == "modes" and result["status"] == "ok" and len(result["inputs"][0]["sha256"]) == 64
    assert result["order"] == 2 and result["delay_samples"] == 0
    mode = result["modes"][0]
    assert abs(mode["frequency_hz"] - HZ) < 4 * mode["frequency_stderr"]
    assert result["fit_percent"]["holdout"] > 98.5
    saved = load_state_space(out["--out"])
    assert saved.inputs == ("force",) and saved.model.order == 2
    assert "Hz" in out["--report"].read_text(encoding="utf-8")
    printed = capsys.readouterr().out
    assert "resonance" in printed.lower() and "fit by output" in printed and "model →" in printed


def test_held_out_logs_and_a_fixed_order(tmp_path, capsys):
    """Logs that are given are judged on, and an order that is asked for is taken."""
    logs = [vibration_log(tmp_path / f"{k}.csv", seed=k) for k in range(2)]
    argv = ["modes", str(logs[0]), "--holdout", str(logs[1]), "--inputs", "force", "--outputs", "place"]
    assert main([*argv, "--order", "3", "--delay", "0", "--json", str(tmp_path / "r.json"), "--quiet"]) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["order"] == 3 and result["held_out"] == "the logs given" and len(result["inputs"]) == 2
    assert result["fit_percent"]["n_samples"] == {"train": 900, "holdout": 900}
    assert capsys.readouterr().out == ""


def test_responses_alone_give_resonances_without_a_scale(tmp_path, capsys):
    """Without --inputs the response to an unknown force gives the resonance, a page, and says what it cannot give."""
    log, page = vibration_log(tmp_path / "bench.csv", n=3000), tmp_path / "r.html"
    out = ["--json", str(tmp_path / "r.json"), "--report", str(page)]
    assert main(["modes", str(log), "--outputs", "place", "--order", "12", *out]) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["kind"] == "operational" and result["mdk"]["status"] == "not_identifiable"
    assert min(abs(mode["frequency_hz"] - HZ) for mode in result["modes"]) < 0.1
    assert "shapes have no scale" in " ".join(capsys.readouterr().out.split()) and "bench.csv" in page.read_text()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--inputs", "torque", "--outputs", "place"], ["torque", "force"]),
        (["--inputs", "force", "--outputs", "still"], ["still", "never changes"]),
        (["--inputs", "force", "--outputs", "force"], ["twice"]),
        (["--inputs", "force", "--outputs", "copy"], ["copy", "force", "again"]),
        (["--inputs", "force", "--outputs", "hole"], ["hole", "t ="]),
        (["--outputs", "place", "--out", "m.yaml"], ["--out", "--inputs"]),
        (["--outputs", "place", "--method", "n4sid"], ["--method n4sid", "--inputs"]),
        (["--outputs", "place", "--order", "1"], ["--order 1"]),
        (["--inputs", "force"], ["--outputs"]),
        (["--inputs", "force", "--outputs", "place", "--order", "0"], ["--order 0"]),
        (["--inputs", "force", "--outputs", "place", "--order", "-2"], ["--order"]),
        (["--inputs", "force", "--outputs", "place", "--order", "180"], ["180"]),
        (["--inputs", "force", "--outputs", "place", "--method", "magic"], ["magic", "n4sid"]),
        (["--inputs", "force", "--outputs", "place", "--reference", "force"], ["force", "reference"]),
        (["--inputs", "force", "--outputs", "place", "--sensor", "nose"], ["nose"]),
    ],
)
def test_faulty_requests_say_what_would_be_right(tmp_path, capsys, options, words):
    """What cannot be met ends with status 2, one line, and no file."""
    hole = np.ones(900) + np.arange(900)
    hole[30] = np.nan
    extra = {"still": np.ones(900), "hole": hole}
    log = vibration_log(tmp_path / "bench.csv", **extra)
    lines = log.read_text().splitlines()
    log.write_text("\n".join([lines[0] + ",copy", *(f"{x},{float(x.split(',')[1]) * 3:g}" for x in lines[1:])]) + "\n")
    before = sorted(p.name for p in tmp_path.iterdir())
    assert main(["modes", str(log), *options, "--json", str(tmp_path / "r.json")]) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    assert len(said) == 1 and said[0].startswith("error:")
    for word in words:
        assert word in said[0]
    assert sorted(p.name for p in tmp_path.iterdir()) == before


@pytest.mark.parametrize(("n", "options"), [(40, []), (900, ["--method", "era"])])
def test_data_that_cannot_answer_leave_with_3(tmp_path, capsys, n, options):
    """Too short a log, and pulses asked of a log that has none, say which experiment would do."""
    log, out = vibration_log(tmp_path / "short.csv", n), tmp_path / "r.json"
    argv = ["modes", str(log), "--inputs", "force", "--outputs", "place", *options, "--json", str(out)]
    assert main(argv) == 3
    assert "experiment that would" in capsys.readouterr().err
    assert json.loads(out.read_text())["status"] == "cannot_answer"


def test_a_jittery_clock_is_a_warning(tmp_path, capsys):
    """Uneven stamps are mended with a warning, and the resonance is still found."""
    log = vibration_log(tmp_path / "bench.csv")
    rng, lines = np.random.default_rng(1), log.read_text().splitlines()
    shaken = [f"{float(x.split(',', 1)[0]) + rng.uniform(0, 8e-4):.6f},{x.split(',', 1)[1]}" for x in lines[1:]]
    log.write_text("\n".join([lines[0], *shaken]) + "\n")
    argv = ["modes", str(log), "--inputs", "force", "--outputs", "place", "--order", "4", "--delay", "0"]
    assert main([*argv, "--json", str(tmp_path / "r.json")]) == 0
    printed = capsys.readouterr()
    assert "steps vary" in printed.err
    hz = [m["frequency_hz"] for m in json.loads((tmp_path / "r.json").read_text())["modes"]]
    assert min(abs(f - HZ) for f in hz) < 0.1


def test_modes_are_drawn_on_a_robot(tmp_path, capsys):
    """With --robot the page has the robot swinging and the result says so; outputs without a place give a warning instead."""
    log = vibration_log(tmp_path / "bench.csv")
    text = log.read_text().replace("t,force,place", "t,force,x_tool", 1)
    named = tmp_path / "named.csv"
    named.write_text(text)
    page, result = tmp_path / "r.html", tmp_path / "r.json"
    more = ["--robot", "gantry_tau", "--report", str(page), "--json", str(result), "--order", "2", "--delay", "0"]
    assert main(["modes", str(named), "--inputs", "force", "--outputs", "x_tool", *more]) == 0
    shape = json.loads(result.read_text())["robot_modes"][0]
    assert shape["model_frequency_hz"] is None and shape["frequency_hz"] == pytest.approx(HZ, rel=0.01)
    assert "<animate " in page.read_text() and "How the robot moves" in page.read_text()
    assert main(["modes", str(log), "--inputs", "force", "--outputs", "place", *more]) == 0
    read = json.loads(result.read_text())
    assert "robot_modes" not in read and any("no mode is drawn on gantry_tau" in w for w in read["warnings"])


def test_loading_a_robot_needs_a_robot(tmp_path, capsys):
    """--set without --robot is refused in one sentence."""
    log = vibration_log(tmp_path / "bench.csv")
    assert main(["modes", str(log), "--inputs", "force", "--outputs", "place", "--set", "arms=complete"]) == 2
    assert "--robot" in capsys.readouterr().err
