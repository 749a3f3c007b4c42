"""Whatever stands on the command line, it is parsed or refused in one sentence; nothing else leaves."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from fuzz_parts.hostile import NUMBERS, WORDS

from tau_dyn.cli import COMMANDS, build_app, parse
from tau_dyn.cli.app import list_options
from tau_dyn.exceptions import InputError

APP = build_app()
LEAVING = {"-h", "--help", "--version"}
WORD = st.sampled_from([*NUMBERS, *WORDS, "linear_axis", "-", "--", "--json", "a=b", "a=1:2"]) | st.text(max_size=6)


@pytest.mark.parametrize("command", COMMANDS)
def test_any_words_are_parsed_or_refused(command: str) -> None:
    """Any option of the command with any words after it, and any words where files stand."""
    options = ["--quiet", *(w for w in list_options(APP, command) if w.startswith("-"))]

    @settings(derandomize=True, database=None, deadline=None, max_examples=20, suppress_health_check=list(HealthCheck))
    @given(st.lists(st.sampled_from(options) | WORD, max_size=8).filter(lambda words: not LEAVING & set(words)))
    def case(words: list[str]) -> None:
        if any(w.startswith("-") and any(o.startswith(w.partition("=")[0]) for o in LEAVING) for w in words):
            return
        try:
            parse([*command.split(), *words], APP)
        except InputError as fault:
            assert 0 < len(str(fault)) <= 1000

    case()


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["fk", "linear_axis", "--q", "nan"], "--q"),
        (["fk", "linear_axis", "--q", "1e999"], "--q"),
        (["ik", "linear_axis", "--position", "inf", "0", "0"], "--position"),
        (["simulate", "linear_axis", "--out", "x.csv", "--rate", "1e308"], "--rate"),
        (["simulate", "linear_axis", "--out", "x.csv", "--duration", "nan"], "--duration"),
        (["simulate", "linear_axis", "--out", "x.csv", "--seed", "9" * 5000], "--seed"),
        (["simulate", "linear_axis", "--out", "x.csv", "--set", "mass=nan"], "mass"),
        (["simulate", "linear_axis", "--out", "x.csv", "--set", "mass=${1/0}"], ""),
        (["simulate", "linear_axis", "--out", "x.csv", "--set", "mass=-1"], "mass"),
        (["simulate", "linear_axis", "--out", "x.csv", "--set", "xacro=1"], "--no-xacro"),
        (["check", "log.csv", "../../../etc/passwd"], "passwd"),
        (["check", "log.csv", "a" * 5000 + ".urdf"], "too long"),
        (["check", "a" * 5000 + ".csv"], "too long"),
        (["identify", "linear_axis", "log.csv", "--fix", "*=nan"], "nan"),
        (["identify", "linear_axis", "log.csv", "--bound", "*=nan:nan"], "nan"),
        (["identify", "linear_axis", "log.csv", "--json", "/dev/full/x"], "/dev/full"),
        (["compare", "log.csv", "log.csv"], "log.csv"),
    ],
)
def test_values_at_the_edge_are_refused_by_their_option(tmp_path: Path, refused, argv: list[str], said: str) -> None:
    """Numbers without end or no numbers, names longer than any file's, code where a value is due."""
    t = np.arange(50) * 0.01
    rows = (f"{a:.3f},{0.1 * np.sin(a):.6f},{np.cos(a):.6f}" for a in t)
    (tmp_path / "log.csv").write_text("t,q_axis,tau_axis\n" + "\n".join(rows) + "\n")
    assert said in refused(*argv)
