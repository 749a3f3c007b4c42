"""Which commands are there, and what does each option do? Writes `docs/reference/commands.md` from the parsers.

    python experiments/commands_page.py

A test compares the page with the parsers, so the two cannot drift apart.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from tau_dyn.cli import build_parser
from tau_dyn.files import write_whole

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "commands.md"

INTRODUCTION = """# Commands

`tau-dyn COMMAND --help` says the same in the terminal. Every command takes `--json`, `--report`, `--seed` and `--quiet`, listed
once at the end. Exit status: 0 the answer stands; 2 the input is at fault (one sentence, no file written); 3 the data cannot
answer (and which experiment would); 1 a defect of ours.

This page is written by `experiments/commands_page.py`.

"""
_SHARED = "output"
_HIDDEN = (argparse._HelpAction, argparse._VersionAction)


def page() -> str:
    """Return the page."""
    commands = _subparsers(build_parser())
    parts = [f"| command | |\n|---|---|\n{_index(commands)}"]
    parts += [_section(name, parser) for name, (parser, _) in commands.items()]
    first = next(iter(commands.values()))[0]
    parts.append("## Options of every command\n\n" + _tables(_groups(first, only=_SHARED)))
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


def _section(name: str, parser: argparse.ArgumentParser) -> str:
    inner = _subparsers(parser)
    texts = [f"## {name}", _prose(parser.description or "")]
    for sub, (within, _) in (inner or {"": (parser, "")}).items():
        full = f"{name} {sub}".strip()
        texts += [f"```\n{_usage(full, within)}\n```", _tables(_groups(within, without=_SHARED))]
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


def _tables(groups: list[tuple[str, list[argparse.Action]]]) -> str:
    texts = []
    for title, actions in groups:
        rows = "\n".join(f"| {_name(a)} | {_cell(_help(a))} |" for a in actions)
        texts.append((f"*{title[:1].upper()}{title[1:]}*\n\n" if title else "") + f"| | |\n|---|---|\n{rows}")
    return "\n\n".join(texts)


def _name(action: argparse.Action) -> str:
    text = " ".join([*action.option_strings[-1:], _value(action)]).strip()
    return "`" + text.replace("|", "\\|") + "`"


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
