"""What pages give to copy holds: Python compiles, the command line takes `tau-dyn` lines, scripts have their options."""

from __future__ import annotations

import ast
import re
import shlex
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from page_blocks import ROOT, all_pages, blocks, commands

from tau_dyn.cli import build_app, parse

PAGES = [str(path.relative_to(ROOT)) for path in all_pages()]
_PLACEHOLDER = re.compile(r"[\[\]|]|\.\.\.|(?<![\w./-])[A-Z]{1,7}(?![\w.])")  # a line that shows a form, not a call
_INDENTED = re.compile(r"^    (tau-dyn (?:.*\\\n)*.*)$", re.M)


def calls(page: str) -> list[str]:
    """Return the `tau-dyn` lines of a page that can be typed as they are."""
    shell = [line for b in blocks(page) if b.language in ("", "bash", "sh") for line in commands(b.text)]
    indented = [line for text in _INDENTED.findall(page) for line in commands(text)]
    lines = (line.split(" && ")[-1].split(" > ")[0] for line in (*shell, *indented))
    return [line for line in lines if re.match(r"tau-dyn [a-z]", line) and not _PLACEHOLDER.search(line)]


@pytest.mark.parametrize("name", PAGES)
def test_python_compiles(name):
    """Every block of Python is Python."""
    for block in blocks((ROOT / name).read_text(encoding="utf-8")):
        if block.language == "python":
            try:
                ast.parse(block.text)
            except SyntaxError as fault:
                pytest.fail(f"{name}:{block.line + (fault.lineno or 0)}: {fault.msg}")


@pytest.mark.parametrize("name", PAGES)
def test_commands_parse(name):
    """Every command that a page gives has arguments that exist."""
    app = build_app()
    for line in calls((ROOT / name).read_text(encoding="utf-8")):
        try:
            parse(shlex.split(line)[1:], app)
        except Exception as fault:
            pytest.fail(f"{name}: {line}\n{fault}")


_SCRIPT = re.compile(r"\bpython ((?:experiments|identification)/\S+\.py)(.*)")


def read_script(path: Path, read: set[Path]) -> str:
    """Return a script's text and that of the modules next to it that it imports."""
    if path in read or not path.exists():
        return ""
    read.add(path)
    text = path.read_text(encoding="utf-8")
    beside = re.findall(r"^\s*(?:from|import) (\w+)", text, re.M)
    return text + "".join(read_script(path.with_name(f"{name}.py"), read) for name in beside)


@pytest.mark.parametrize("name", PAGES)
def test_scripts_have_the_options(name):
    """A study that takes minutes or hours is not executed here; its script is there, with every option that the page gives."""
    shell = [b for b in blocks((ROOT / name).read_text(encoding="utf-8")) if b.language in ("", "bash", "sh")]
    for line in (line for block in shell for line in commands(block.text)):
        if found := _SCRIPT.search(line):
            text = read_script(ROOT / found[1], set())
            options = re.findall(r"(?<=[\s\[])--[\w-]+", found[2])
            assert text and [option for option in options if f'"{option}"' not in text] == [], line


def test_there_are_commands_to_parse():
    """The pages' lines are found: many of them, so that the test above does not pass by seeing none."""
    found = [line for name in PAGES for line in calls((ROOT / name).read_text(encoding="utf-8"))]
    assert len(found) > 60
