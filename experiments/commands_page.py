"""Which commands are there, and what does each option do? Writes `docs/reference/commands.md` from their signatures.

    python experiments/commands_page.py

A test compares the page with the signatures, so the two cannot drift apart.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cyclopts import App
from cyclopts.argument import Argument

from tau_dyn.cli import COMMANDS, build_app
from tau_dyn.cli.app import list_options
from tau_dyn.files import write_whole

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "commands.md"

INTRODUCTION = """# Commands

Each block is what `tau-dyn COMMAND --help` says. Options of [every command](#options-of-every-command) and of
[several commands](#options-of-several-commands) stand once, at the end. [Exit status](files.md#exit-status).

This page is written by `experiments/commands_page.py`.

"""
MIN_COMMANDS = 5  # an argument of so many commands, with the same help, stands once
WIDTH = 112  # characters of a line, as wide as the site shows without scrolling
NAME_WIDTH = 28  # of the column of names
_SHARED = "Output"


def page() -> str:
    """Return the page."""
    app = build_app()
    groups = {words: list_groups(app, words) for words in COMMANDS}
    lines = [
        format_entry(*row) for of in groups.values() for title, rows in of.items() if title != _SHARED for row in rows
    ]
    common = {line for line, n in Counter(lines).items() if n >= MIN_COMMANDS}
    parts = [f"| command | |\n|---|---|\n{format_index()}"]
    parts += [format_section(words, groups[words], common) for words in COMMANDS]
    shared = "\n".join(line for line in dict.fromkeys(lines) if line in common)
    parts.append(f"## Options of several commands\n\n```text\n{shared}\n```")
    first = next(iter(groups.values()))
    parts.append("## Options of every command\n\n" + format_block("", {"": first[_SHARED]}))
    return INTRODUCTION + "\n\n".join(parts) + "\n"


def list_groups(app: App, words: str) -> dict[str, list[tuple[str, Argument]]]:
    """Return a command's arguments with their labels by the title of their group, files and options last."""
    found: dict[str, list[tuple[str, Argument]]] = {"": []}
    for label, argument in list_options(app, words).items():
        title = next((g.name for g in argument.parameter.group or () if g.name not in ("Parameters", "Arguments")), "")
        found.setdefault(title if title == _SHARED or not argument.required else "", []).append((label, argument))
    found[_SHARED] = [row for row in found.get(_SHARED, []) if row[0] != "--out"]
    return found


def format_index() -> str:
    """Return the table of commands."""
    return "\n".join(
        f"| [`{words.split()[0]}`](#{words.split()[0]}) | {_cell(_summary(f))} |" for words, f in COMMANDS.items()
    )


def _summary(function: Callable[..., Any]) -> str:
    return (function.__doc__ or "").split("\n\n")[0].rstrip(".")


def format_section(words: str, groups: dict[str, list[tuple[str, Argument]]], common: set[str]) -> str:
    """Return what a command does, its usage and its arguments."""
    text = inspect.cleandoc(COMMANDS[words].__doc__ or "").split("\n\nArgs:")[0]
    within = {title: rows for title, rows in groups.items() if title != _SHARED}
    return "\n\n".join([f"## {words.split()[0]}", _prose(text), format_block(_usage(words, within), within, common)])


def _usage(words: str, groups: dict[str, list[tuple[str, Argument]]]) -> str:
    """Return what a call needs at least."""
    rows = [row for of in groups.values() for row in of]
    places = [_place(label, a) for label, a in rows if not label.startswith("-")]
    options = [f"{label} {_value(a)}".strip() for label, a in rows if label.startswith("-") and a.required]
    return " ".join(["tau-dyn", words, *places, *options, "[options]"])


def format_block(
    usage: str, groups: dict[str, list[tuple[str, Argument]]], common: set[str] | frozenset[str] = frozenset()
) -> str:
    """Return usage and arguments as a block; of those in `common` only the names."""
    parts, elsewhere = [usage] if usage else [], []
    for title, rows in groups.items():
        lines = [line for row in rows if (line := format_entry(*row)) not in common]
        elsewhere += [label for label, a in rows if label.startswith("-") and format_entry(label, a) in common]
        if lines:
            parts.append("\n".join([f"{title}:"] * bool(title) + lines))
    if elsewhere:
        parts.append(f"and, as several commands: {' '.join(elsewhere)}")
    return "```text\n" + "\n\n".join(parts) + "\n```"


def format_entry(label: str, argument: Argument) -> str:
    """Return an argument with its help, wrapped."""
    name = f"{label} {_value(argument)}".strip() if label.startswith("-") else _place(label, argument)
    text = argument.parameter.help or ""
    default = argument.field_info.default
    if (
        argument.show_default
        and isinstance(default, str | int | float)
        and not isinstance(default, bool)
        and default != ""
    ):
        text += f" (default {default:g})" if isinstance(default, float) else f" (default {default})"
    help_lines = textwrap.wrap(" ".join(text.split()), WIDTH - NAME_WIDTH - 2, break_long_words=False)
    indent = "\n" + " " * (NAME_WIDTH + 2)
    first = f"  {name:{NAME_WIDTH - 1}} " if len(name) < NAME_WIDTH else f"  {name}{indent}"
    return (first + indent.join(help_lines)).rstrip()


def _place(label: str, argument: Argument) -> str:
    several = " ..." if argument.token_count()[1] else ""
    return f"{label}{several}" if argument.required else f"[{label}{several}]"


def _value(argument: Argument) -> str:
    """Return the placeholder for what an option takes."""
    if argument.hint is bool:
        return ""
    choices = argument.get_choices()
    word = argument.parameter.metavar or ("|".join(choices) if choices else argument.name.lstrip("-").upper())
    several = argument.token_count()[1] and argument.parameter.consume_multiple
    return f"{word} ..." if several else word


def _prose(text: str) -> str:
    return re.sub(r"(?<!`)(--[a-z][a-z-]*)", r"`\1`", text.strip()) if "`" not in text else text.strip()


def _cell(text: str) -> str:
    """Return text as a cell: what angle brackets and pipes would do is undone."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


def main(path: Path = PAGE) -> None:
    """Write the page."""
    write_whole(path, page())


if __name__ == "__main__":
    main()
