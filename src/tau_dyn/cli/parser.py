"""The parser of the command line: its faults are one sentence that says what would be right, like all others."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any, NoReturn

from tau_dyn.cli.run_folder import build_out_argument
from tau_dyn.exceptions import InputError, suggest_nearest

_NEGATIVE = re.compile(r"^-(\d|\.\d)")
_PLAIN = {"float": "a number", "int": "a whole number"}
"""What Python's own readers take; those of `kinds.py` say it themselves."""


class Parser(argparse.ArgumentParser):
    """A parser whose faults are one sentence, like all others."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Take `-1e-3` for a number: argparse before Python 3.14 takes it for an option."""
        self.writes = False
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = _NEGATIVE

    def add_argument(self, *names: Any, **options: Any) -> argparse.Action:
        """Add an argument; `--out` also takes a run folder, in which the command's own file is called as its metavar."""
        if "--out" in names:
            shown, self.writes = options.get("metavar", "FILE"), True
            options["type"] = build_out_argument(options.get("type", Path), shown)
            if shown not in ("DIR", "FOLDER/"):
                options["help"] = f"{options.get('help', '')}; FOLDER/ takes it with result, report and run.json"
            self.set_defaults(own_file=shown.lower() if Path(shown).suffix else "")
        return super().add_argument(*names, **options)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse what a command does not know itself, so that its own help is named."""
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            near = suggest_nearest(unknown[0], re.findall(r"--[\w-]+", self.format_usage()))
            self.error(f"there is no {unknown[0]} here{near}")
        return known, unknown

    def error(self, message: str) -> NoReturn:
        """Raise instead of printing usage and leaving; in words that say what would be right."""
        raise InputError("bad_option", f"{self.prog}: {_in_words(message)}; see {self.prog} --help")


def _in_words(message: str) -> str:
    """Return argparse's message as a person would say it."""
    if match := re.match(r"argument (.+?): invalid (\w+) value: (.+)$", message):
        return f"{match[1]} {match[3]}: write {_PLAIN.get(match[2], match[2])}"
    if match := re.match(r"argument (.+?): invalid choice: '?(.+?)'? \(choose from (.+)\)$", message):
        known = [word.strip("' ") for word in match[3].split(",")]
        what = match[1].lower() if match[1] == "COMMAND" else match[1]
        return f"there is no {what} '{match[2]}'{suggest_nearest(match[2], known)}; there are {', '.join(known)}"
    if match := re.match(r"the following arguments are required: (.+)$", message):
        if match[1] == "COMMAND":
            return "name a command, such as demo"
        return f"{' and '.join(match[1].rsplit(', ', 1))} {'are' if ',' in match[1] else 'is'} missing"
    if match := re.match(r"argument (\S+): expected (one|at least one|\d+) arguments?$", message):
        needed = {"one": "a value", "at least one": "one value or more"}.get(match[2], f"{match[2]} values")
        return f"{match[1]} needs {needed} after it"
    return re.sub(r"^argument (\S+): ", r"\1 ", message)
