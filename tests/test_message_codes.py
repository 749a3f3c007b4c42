"""Errors and warnings carry codes of one table, wherever they travel."""

from __future__ import annotations

import ast
import importlib.util
import pickle
from collections.abc import Iterator
from pathlib import Path

import pytest
from raising import raises_code

import tau_dyn
from tau_dyn.cli import main
from tau_dyn.exceptions import CannotAnswer, InputError, LoopClosureError, TauDynError, UnknownName
from tau_dyn.mechanism import NotRods
from tau_dyn.message_codes import ERROR_CODES, WARNING_CODES, CodedWarning, format_warnings

SOURCE = Path(tau_dyn.__file__).parent
ROOT = Path(__file__).resolve().parents[1]
CODED = {"InputError": ERROR_CODES, "CannotAnswer": ERROR_CODES, "TooShort": ERROR_CODES, "TauDynError": ERROR_CODES,
         "CodedWarning": WARNING_CODES, "RepairedWarning": WARNING_CODES}  # fmt: skip


def list_codes() -> Iterator[tuple[str, str, str]]:
    """Yield (place, class, code) of every coded error and warning that the source builds with a literal code."""
    for path in sorted(SOURCE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in CODED and node.args:
                first = node.args[0]
                place = f"{path.relative_to(SOURCE)}:{node.lineno}"
                if isinstance(first, ast.Constant):
                    yield place, node.func.id, str(first.value)
                else:
                    assert ast.unparse(first).endswith((".code", "CODE")), f"{place}: its first argument is no code"


def test_every_code_is_in_the_table():
    """An error or a warning that a reader cannot look up is none of ours."""
    unknown = [(place, code) for place, kind, code in list_codes() if code not in CODED[kind]]
    assert not unknown


def test_every_code_of_an_error_is_used():
    """A code that no error carries is not listed."""
    own = {"unknown_name", "loop_not_closed"}  # of classes that always carry the same
    assert set(ERROR_CODES) == {code for _, kind, code in list_codes() if not kind.endswith("Warning")} | own


@pytest.mark.skipif(not (ROOT / "experiments").is_dir(), reason="the package alone is tested")
def test_the_page_of_codes_is_what_the_tables_say():
    """Where it differs, run `python experiments/codes_page.py` again."""
    spec = importlib.util.spec_from_file_location("codes_page", ROOT / "experiments" / "codes_page.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.PAGE.read_text(encoding="utf-8") == module.build_page()


@pytest.mark.parametrize(
    "fault",
    [
        InputError("missing_column", "a.csv has no column t"),
        UnknownName("robot", "gantri", ["gantry_tau"]),
        LoopClosureError("out of reach"),
        NotRods("no loops"),
        CannotAnswer("poor_excitation", "nothing moves", "move it"),
        TauDynError("workers_lost", "no worker is left"),
    ],
)
def test_an_error_survives_another_process(fault: TauDynError):
    """A worker's error comes back with its class, code, sentence and exit status."""
    back = pickle.loads(pickle.dumps(fault))
    assert type(back) is type(fault) and str(back) == str(fault) and vars(back) == vars(fault)
    assert back.code in ERROR_CODES


def test_the_command_line_prints_the_code(capsys):
    """An error ends in its code, in brackets."""
    assert main(["identify", "gantri_tau", "log.csv"]) == 2
    assert capsys.readouterr().err.rstrip().endswith("[unknown_name]")


def test_a_refusal_is_told_apart_by_its_code():
    """The same class with another code, or without the culprit's name, is another refusal."""
    with raises_code("missing_column", "q_a"):
        raise InputError("missing_column", "a.csv has no column q_a")
    for code, name in (("bad_sample", "q_a"), ("missing_column", "q_b")):
        with pytest.raises(AssertionError), raises_code(code, name):
            raise InputError("missing_column", "a.csv has no column q_a")


def test_codes_stand_parallel_to_the_sentences():
    """A program reads the code, a person the sentence; what is said twice stands once."""
    lost = CodedWarning("lost_samples", "9 samples are missing")
    assert format_warnings([lost, "something else", lost]) == {
        "warnings": ["9 samples are missing", "something else"],
        "warning_codes": ["lost_samples", "note"],
    }


def test_a_code_survives_another_process():
    """A worker's warning comes back with its code."""
    assert pickle.loads(pickle.dumps(CodedWarning("held_channel", "q_a is held"))).code == "held_channel"
