"""`simulate --vibration`: a log from a robot file with springs, and one sentence where that cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.cli import main
from tau_dyn.log import read_log

FLEXIBLE = ["gantry_tau", "--set", "arms=complete", "--set", "flexible=true"]


def test_binary_references_make_a_log(tmp_path: Path) -> None:
    """The log is read like a recorded one; the result names the resonances that are in it."""
    out, result = tmp_path / "v.csv", tmp_path / "r.json"
    wrist = ["--set", "wrist=serial2", "--frame", "gauge_block_link", "--drive-lag", "0.11", "--drive-delay", "0.016"]
    argv = ["simulate", *FLEXIBLE, *wrist, "--vibration", "prbs", "--duration", "8", "--out", str(out), "--quiet"]
    assert main([*argv, "--json", str(result)]) == 0
    log = read_log(out)
    assert log.n_samples == 2000 and {"q_ref_cart1", "q_cart3", "y_tool", "ay_tool"} <= set(log.channels)
    assert json.loads(result.read_text())["natural_frequencies_hz"][0] == pytest.approx(7.4, abs=0.02)


def test_pushes_make_a_log(tmp_path: Path) -> None:
    out = tmp_path / "p.csv"
    argv = ["simulate", *FLEXIBLE, "--vibration", "push-z", "--amplitude", "3", "--duration", "10", "--out", str(out)]
    assert main([*argv, "--quiet"]) == 0
    log = read_log(out)
    assert log.rate_hz == pytest.approx(1000)
    assert np.sum(log.channels["fz_tool"]) * log.dt == pytest.approx(6.0)  # two pushes of 3 N s


@pytest.mark.parametrize(
    ("argv", "complaint"),
    [
        (["gantry_tau", "--vibration", "prbs"], "no <tau_dyn:spring>"),
        ([*FLEXIBLE, "--vibration", "push-x", "--frame", "nowhere"], "no frame named 'nowhere'"),
        ([*FLEXIBLE, "--vibration", "prbs", "--drive-delay", "0.01"], "--drive-lag"),
        ([*FLEXIBLE, "--vibration", "prbs", "--drive-lag", "0.1", "--drive-delay", "0.003"], "whole number of steps"),
        ([*FLEXIBLE, "--vibration", "prbs", "--drive-lag", "0.1", "0.1"], "2 drive(s) for 3"),
        ([*FLEXIBLE, "--vibration", "prbs", "--effects", "e.yaml"], "does not go with"),
    ],
)
def test_what_cannot_vibrate_is_one_sentence(
    argv: list[str], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "v.csv"
    assert main(["simulate", *argv, "--out", str(out), "--quiet"]) == 2
    message = capsys.readouterr().err
    assert complaint in message and message.count("\n") == 1
    assert not out.exists()
