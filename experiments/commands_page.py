"""Which commands are there, and what does each option do? Writes `docs/reference/commands.md` from the parsers.

    python experiments/commands_page.py

A test compares the page with the parsers, so the two cannot drift apart.
"""

from __future__ import annotations

import argparse
import re
import textwrap
from collections import Counter
from pathlib import Path

from tau_dyn.cli import build_parser
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
_SHARED = "output"
_HIDDEN = (argparse._HelpAction, argparse._VersionAction)


def page() -> str:
    """Return the page."""
    commands = _subparsers(build_parser())
    parsers = [p for parser, _ in commands.values() for p, _ in (_subparsers(parser) or {"": (parser, "")}).values()]
    lines = [_entry(a) for parser in parsers for _, rows in _groups(parser, without=_SHARED) for a in rows]
    common = {line for line, n in Counter(lines).items() if n >= MIN_COMMANDS}
    parts = [f"| command | |\n|---|---|\n{_index(commands)}"]
    parts += [_section(name, parser, common) for name, (parser, _) in commands.items()]
    shared = "\n".join(line for line in dict.fromkeys(lines) if line in common)
    parts.append(f"## Options of several commands\n\n```text\n{shared}\n```")
    first = next(iter(commands.values()))[0]
    parts.append("## Options of every command\n\n" + _block("", _groups(first, only=_SHARED)))
    return INTRODUCTION + "\n\n".join(parts) + "\n"


def _index(commands: dict[str, tuple[argparse.ArgumentParser, str]]) -> str:
    return "\n".join(f"| [`{name}`](#{name}) | {_cell(text)} |" for name, (_, text) in commands.items())


def _subparsers(parser: argparse.ArgumentParser) -> dict[str, tuple[argparse.ArgumentParser, str]]:
    """Return a parser's commands with their one-line helps."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            helps = {choice.dest: choice.help or "" for choice in action._choices_actions}
            return {name: (sub, helps.get(name, "")) for name, sub in action.choices.items()}
    return {}


def _section(name: str, parser: argparse.ArgumentParser, common: set[str]) -> str:
    inner = _subparsers(parser)
    texts = [f"## {name}", _prose(parser.description or "")]
    for sub, (within, _) in (inner or {"": (parser, "")}).items():
        full = f"{name} {sub}".strip()
        texts.append(_block(_usage(full, within), _groups(within, without=_SHARED), common))
    return "\n\n".join(texts)


def _usage(name: str, parser: argparse.ArgumentParser) -> str:
    """Return what a call needs at least."""
    needed = [a for a in parser._actions if a.required or (not a.option_strings and a.nargs != "?")]
    options = [f"{a.option_strings[-1]} {_value(a)}".strip() for a in needed if a.option_strings]
    places = [_value(a) for a in parser._actions if not a.option_strings and not isinstance(a, _HIDDEN)]
    return " ".join(["tau-dyn", name, *places, *options, "[options]"])


def _groups(
    parser: argparse.ArgumentParser, only: str = "", without: str = ""
) -> list[tuple[str, list[argparse.Action]]]:
    """Return the argument groups that hold anything, with their titles."""
    found = []
    for group in parser._action_groups:
        rows = [a for a in group._group_actions if not isinstance(a, _HIDDEN) and a.help != argparse.SUPPRESS]
        title = group.title or ""
        if rows and (not only or title == only) and title != (without or None):
            found.append(("" if title in ("options", "positional arguments", _SHARED) else title, rows))
    return found


def _block(
    usage: str, groups: list[tuple[str, list[argparse.Action]]], common: set[str] | frozenset[str] = frozenset()
) -> str:
    """Return usage and arguments as a block; of those in `common` only the names."""
    parts, elsewhere = [usage] if usage else [], []
    for title, actions in groups:
        lines = [line for a in actions if (line := _entry(a)) not in common]
        elsewhere += [a.option_strings[-1] for a in actions if a.option_strings and _entry(a) in common]
        if lines:
            parts.append("\n".join([f"{title}:"] * bool(title) + lines))
    if elsewhere:
        parts.append(f"and, as several commands: {' '.join(elsewhere)}")
    return "```text\n" + "\n\n".join(parts) + "\n```"


def _entry(action: argparse.Action) -> str:
    """Return an argument with its help, wrapped."""
    name = " ".join([*action.option_strings[-1:], _value(action)]).strip()
    help_lines = textwrap.wrap(" ".join(_help(action).split()), WIDTH - NAME_WIDTH - 2, break_long_words=False)
    indent = "\n" + " " * (NAME_WIDTH + 2)
    first = f"  {name:{NAME_WIDTH - 1}} " if len(name) < NAME_WIDTH else f"  {name}{indent}"
    return (first + indent.join(help_lines)).rstrip()


def _value(action: argparse.Action) -> str:
    """Return the placeholder for what an argument takes."""
    if action.nargs == 0:
        return ""
    word = action.metavar if isinstance(action.metavar, str) else None
    one = word or ("|".join(map(str, action.choices)) if action.choices else action.dest.upper())
    if action.nargs in ("+", "*"):
        return f"{one} ..." if action.nargs == "+" else f"[{one} ...]"
    if action.nargs == "?":
        return f"[{one}]"
    return " ".join([one] * action.nargs) if isinstance(action.nargs, int) else one


def _help(action: argparse.Action) -> str:
    shown = vars(action) | {"prog": "tau-dyn"}
    return (action.help or "") % {k: v for k, v in shown.items() if v is not None and v is not argparse.SUPPRESS}


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
