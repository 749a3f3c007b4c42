"""The command line: one thin file a command; each parses, calls the library, and hands back what to print and write."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

from tau_dyn.cli.ending import (  # first: from here on Ctrl-C is answered
    Ended,
    describe_machine_fault,
    quiet_start,
    replace_unencodable,
    say,
    unwind_on_signal,
)

# isort: split
from tau_dyn.cli import (
    accuracy,
    calibrate,
    causes,
    check,
    compare,
    demo,
    diagnose,
    excite,
    export,
    feedforward,
    fk,
    identify,
    ik,
    modes,
    plan_motion,
    plan_poses,
    robots,
    see,
    simulate,
    view,
    workspace,
)
from tau_dyn.cli.execute import execute
from tau_dyn.cli.parser import Parser
from tau_dyn.exceptions import TauDynError, format_one_line
from tau_dyn.version import __version__

COMMANDS = {
    "demo": demo,
    "check": check,
    "simulate": simulate,
    "excite": excite,
    "identify": identify,
    "diagnose": diagnose,
    "modes": modes,
    "see": see,
    "calibrate": calibrate,
    "plan-poses": plan_poses,
    "plan-motion": plan_motion,
    "feedforward": feedforward,
    "export": export,
    "compare": compare,
    "view": view,
    "fk": fk,
    "ik": ik,
    "accuracy": accuracy,
    "workspace": workspace,
    "robots": robots,
    "causes": causes,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    warnings.simplefilter("ignore", RuntimeWarning)  # numbers out of range end in a sentence of ours
    replace_unencodable()
    try:
        with unwind_on_signal():
            args = build_parser().parse_args(argv)
            return execute(args.command, COMMANDS[args.command].run, args)
    except TauDynError as fault:
        say(f"error: {' '.join(str(fault).split())} [{fault.code}]")
        return fault.exit_status
    except KeyboardInterrupt:
        say("interrupted; every output file is as it was, or complete")
        return 130
    except Ended as told:
        say(f"ended by {told.name}; every output file is as it was, or complete")
        return int(told.code or 0)
    except BrokenPipeError:
        return 0
    except (OSError, MemoryError) as fault:
        if (sentence := describe_machine_fault(fault)) is None:
            raise
        say(f"error: {format_one_line(sentence)}")
        return 2


def build_parser() -> Parser:
    """Return the parser of all commands."""
    parser = Parser(prog="tau-dyn", description="Identify robot dynamics from torque logs, closed loops included.")
    parser.add_argument("--version", action="version", version=f"tau-dyn {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    for name, module in COMMANDS.items():
        module.add(commands.add_parser(name, help=module.HELP, description=module.__doc__))
    return parser


quiet_start.over()
