"""The command line's application: the commands, the parsing of words into a call, and messages about wrong usage.

Each command is a function whose signature is its command line (cyclopts). Wrong usage ends in one sentence with the correct
usage and status 2, like every other wrong input.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn, get_type_hints

from cyclopts import (
    App,
    CoercionError,
    CycloptsError,
    MissingArgumentError,
    Parameter,
    UnknownOptionError,
    ValidationError,
)
from cyclopts.argument import Argument
from cyclopts.exceptions import ConsumeMultipleError, UnknownCommandError, UnusedCliTokensError
from cyclopts.help import DefaultFormatter
from rich.text import Text

from tau_dyn.cli import (
    accuracy,
    calibrate,
    control,
    demo,
    diagnose,
    excite,
    export,
    identify,
    kinematics,
    lead_through,
    listings,
    logs,
    modes,
    monitor,
    plan,
    view,
)
from tau_dyn.cli.arguments import Kind
from tau_dyn.cli.execute import Call, Outcome
from tau_dyn.cli.run_folder import RunFolder
from tau_dyn.exceptions import InputError, suggest_nearest
from tau_dyn.version import __version__

COMMANDS: dict[str, Callable[..., Outcome]] = {
    "demo": demo.demo,
    "check": logs.check,
    "columns": logs.columns,
    "simulate": logs.simulate,
    "excite": excite.excite,
    "identify": identify.identify,
    "diagnose": diagnose.diagnose,
    "modes": modes.modes,
    "see": view.see,
    "calibrate": calibrate.calibrate,
    "plan-poses": plan.plan_poses,
    "plan-motion": plan.plan_motion,
    "feedforward export": export.export_feedforward,
    "feedforward share": control.compute_shared_forces,
    "export": export.export,
    "actuators": control.actuators,
    "learn": control.learn,
    "observe": control.observe,
    "lead-through": lead_through.lead_through,
    "payload": monitor.payload,
    "watch": monitor.watch,
    "fleet": monitor.fleet,
    "compare": listings.compare,
    "view": view.view,
    "fk": kinematics.fk,
    "ik": kinematics.ik,
    "accuracy": accuracy.accuracy,
    "workspace": kinematics.workspace,
    "robots": listings.robots,
    "causes": listings.causes,
    "data": listings.data,
}
"""Words of a command -> its function."""

_OWN_FILES = {"export": export.name_export, "feedforward export": export.name_feedforward}
"""Commands whose own file in a run folder is named after their arguments."""

_SHELLS = ("bash", "zsh", "fish")


def name_own_file(call: Call) -> str:
    """Return the usual name of the command's own file in a run folder; empty if it has no own file."""
    words = next((words for words, function in COMMANDS.items() if function is call.function), "")
    if words in _OWN_FILES:
        return _OWN_FILES[words](call.values())
    hint = get_type_hints(call.function, include_extras=True).get("out")
    named = [m.metavar for m in getattr(hint, "__metadata__", ()) if isinstance(m, Parameter) and m.metavar]
    return named[0].lower() if named and Path(named[0]).suffix else ""


class _HelpFormatter(DefaultFormatter):
    """Help whose descriptions are wrapped to the screen's width, regardless of line breaks in docstrings."""

    def __call__(self, console: Any, options: Any, panel: Any) -> None:
        """Show a panel of help."""
        for entry in panel.entries:
            text = getattr(entry.description, "primary_renderable", None)
            if isinstance(text, Text):
                entry.description.primary_renderable = Text(" ".join(text.plain.split()))
        super().__call__(console, options, panel)


def build_app(first: str = "") -> App:
    """Return the application with all commands, or only with those that begin with a word, if there are any."""
    named = {words for words in COMMANDS if words.split(" ")[0] == first} or set(COMMANDS)
    app = App(
        name="tau-dyn",
        help="Identify robot dynamics from torque logs, closed loops included.",
        version=f"tau-dyn {__version__}",
        default_parameter=Parameter(negative="", show_default=_describe_default, allow_repeating=True),
        help_format="plaintext",
        help_formatter=_HelpFormatter(),
        result_action="return_value",
    )
    feedforward = App(
        name="feedforward",
        help="Forces for a controller: tau_ff(q, v, a) as code; shares of double motors along a motion",
        sort_key=list(COMMANDS).index("feedforward export"),
    )
    app.command(feedforward)
    for words, function in ((words, COMMANDS[words]) for words in COMMANDS if words in named):
        group, _, last = words.partition(" ")
        owner, name = (feedforward, last) if group == "feedforward" else (app, words)
        owner.command(function, name=name, sort_key=list(COMMANDS).index(words))
    app.command(print_completion, name="completion")
    return app


def print_completion(shell: str, /) -> str:
    """Print a shell completion script for this program: `tau-dyn completion bash > FILE`, then source it.

    Args:
        shell: bash, zsh or fish.
    """
    if shell not in _SHELLS:
        raise InputError("bad_option", f"there is no completion for {shell}; there are {', '.join(_SHELLS)}")
    return build_app().generate_completion(shell=shell)  # pyright: ignore[reportArgumentType]


def _describe_default(default: Any) -> Any:
    """Return the text of a default in the help, or None if it is not shown."""
    if isinstance(default, RunFolder):
        return default.path
    return None if default in (None, (), "", False) else default


def parse(argv: Sequence[str] | None, app: App | None = None) -> Call:
    """Return the call that the command line's words describe.

    Raises:
        InputError: The words do not form a valid call.
    """
    words = _join_stdout(sys.argv[1:] if argv is None else argv)
    app = app or build_app(words[0] if words else "")
    try:
        function, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
    except CycloptsError as fault:
        _refuse(app, fault)
    if function.__name__ == "help_print" and not {"--help", "-h"} & set(words):
        chain = [str(word) for word in bound.arguments.get("tokens", ())]
        known = [name for name in COMMANDS if name.startswith(" ".join(chain))]
        example = known[0].removeprefix(" ".join(chain)).strip() if chain else "demo"
        raise InputError(
            "bad_option", f"{' '.join(['tau-dyn', *chain])}: name a command, such as {example}; see tau-dyn --help"
        )
    command = next((words for words, f in COMMANDS.items() if f is function), "")
    return Call(command.split(" ")[0], function, bound)


def _join_stdout(words: Sequence[str]) -> list[str]:
    """Return the words with `--json -` as one: cyclopts takes a single hyphen for an option without a name."""
    joined: list[str] = []
    for word in words:
        if word == "-" and joined and joined[-1] == "--json":
            joined[-1] = "--json=-"
        else:
            joined.append(word)
    return joined


def _refuse(app: App, fault: CycloptsError) -> NoReturn:
    """Raise an error with the correct usage."""
    chain = list(fault.command_chain or ())
    program = " ".join(["tau-dyn", *chain])
    raise InputError("bad_option", f"{program}: {_describe(app, fault, chain)}; see {program} --help") from None


def _describe(app: App, fault: CycloptsError, chain: list[str]) -> str:
    """Return a sentence about a fault of the command line."""
    argument = fault.argument
    if isinstance(fault, UnknownCommandError):
        word = next(iter(fault.unused_tokens or [""]))
        known = list(
            dict.fromkeys(name.split(" ")[len(chain)] for name in COMMANDS if name.startswith(" ".join(chain)))
        )
        return f"there is no command '{word}'{suggest_nearest(word, known)}; there are {', '.join(known)}"
    if isinstance(fault, UnknownOptionError):
        word = (fault.token.keyword or fault.token.value).partition("=")[0]
        known = [name for item in fault.argument_collection for name in item.names]
        return f"there is no {word} here{suggest_nearest(word, known)}"
    if isinstance(fault, UnusedCliTokensError):
        return f"there is no place for {next(iter(fault.unused_tokens or ['']))!r} here"
    if isinstance(fault, ValidationError) and fault.group is not None:
        return f"{' and '.join(re.findall(r'--[a-z-]+', fault.exception_message))} do not go together; give one of them"
    if argument is None:
        return str(fault)
    name = get_label(argument)
    if isinstance(fault, MissingArgumentError | ConsumeMultipleError):
        return _describe_missing(app, fault, chain, name)
    if isinstance(fault, CoercionError | ValidationError):
        chosen = isinstance(fault, CoercionError) and argument.parameter.converter is None
        choices = argument.get_choices() if chosen else None
        if choices and fault.token is not None:
            near = suggest_nearest(fault.token.value, choices)
            return f"there is no {name} '{fault.token.value}'{near}; there are {', '.join(choices)}"
        return f"{name} {_describe_value(fault, argument)}"
    return str(fault)


def _describe_value(fault: CoercionError | ValidationError, argument: Argument) -> str:
    """Return a sentence about a wrong value, with the expected one."""
    token = fault.token if isinstance(fault, CoercionError) else None
    text = repr(token.value if token else next((t.value for t in argument.tokens), ""))
    if isinstance(fault, ValidationError):
        worst = _find_refused(argument)
        return f"{worst or text}: {fault.exception_message}"
    kind = next(iter(_list_kinds(argument)), None)
    if kind is not None:
        return f"{text}: write {kind.words}"
    if fault.target_type in (int, float):
        return f"{text}: write {'a whole number' if fault.target_type is int else 'a number'}"
    return f"{text}: {fault.msg}" if fault.msg else f"{text}: write another value"


def _list_kinds(argument: Argument) -> list[Kind]:
    validators: Any = argument.parameter.validator
    return [v for v in validators if isinstance(v, Kind)]


def _find_refused(argument: Argument) -> str:
    """Return the first word that the kind of number rejects."""
    for kind in _list_kinds(argument):
        for token in argument.tokens:
            try:
                kind(None, float(token.value))
            except ValueError:
                return repr(token.value)
    return ""


def _describe_missing(app: App, fault: CycloptsError, chain: list[str], name: str) -> str:
    """Return a sentence about an option's missing value, or a command's missing arguments."""
    argument = fault.argument
    assert argument is not None  # checked by the caller
    if argument.tokens or getattr(fault, "keyword", None) or isinstance(fault, ConsumeMultipleError):
        several, _ = argument.token_count()
        needed = "a value" if several == 1 else f"{several} values"
        needed = "one value or more" if isinstance(fault, ConsumeMultipleError) else needed
        return f"{name} needs {needed} after it"
    needed = [get_label(a) for a in _get_command(app, chain).assemble_argument_collection() if a.required and a.show]
    missing = needed[needed.index(name) :] if name in needed else [name]
    return f"{' and '.join(', '.join(missing).rsplit(', ', 1))} {'are' if len(missing) > 1 else 'is'} missing"


def _get_command(app: App, chain: Sequence[str]) -> App:
    for word in chain:
        app = app[word]
    return app


def get_label(argument: Argument) -> str:
    """Return an argument's name on the command line: an option, or a positional argument in capitals."""
    return next((n for n in argument.names if n.startswith("-")), argument.name.upper().lstrip("-"))


def list_options(app: App, command: str) -> dict[str, Argument]:
    """Return a command's arguments by their labels."""
    return {
        get_label(a): a
        for a in _get_command(app, command.split(" ")).assemble_argument_collection(parse_docstring=True)
        if a.show
    }


def is_path(argument: Argument) -> bool:
    """Return whether an argument names files."""
    return "Path" in str(argument.hint) or argument.hint is Path
