"""The command line: a command is a function whose signature is its command line; it returns the results to show and write."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

from tau_dyn.cli.ending import (  # first: Ctrl-C is handled from here on
    INTERRUPTED,
    Ended,
    describe_machine_fault,
    ignore_odd_environment,
    quiet_start,
    replace_unencodable,
    require_address_space,
    say,
    unwind_on_signal,
)

# isort: split
from tau_dyn.cli.app import COMMANDS, build_app, name_own_file, parse
from tau_dyn.cli.execute import execute
from tau_dyn.exceptions import TauDynError, format_one_line

__all__ = ["COMMANDS", "Ended", "build_app", "describe_machine_fault", "execute", "main", "parse", "unwind_on_signal"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    replace_unencodable()
    ignore_odd_environment()
    try:
        with warnings.catch_warnings(action="ignore"), unwind_on_signal():  # doubts are reported by our own messages
            call = parse(argv)
            if call.function not in COMMANDS.values():  # help, the version, completion
                text = call.run()
                if isinstance(text, str):
                    print(text)
                return 0
            require_address_space()
            return execute(call, name_own_file(call))
    except TauDynError as fault:
        say(f"error: {' '.join(str(fault).split())} [{fault.code}]")
        return fault.exit_status
    except KeyboardInterrupt:
        say(INTERRUPTED)
        return 130
    except Ended as told:
        say(f"ended by {told.name}; every output file is as it was, or complete")
        return int(told.code or 0)
    except BrokenPipeError:
        return 0
    except (OSError, MemoryError, ImportError, RuntimeError) as fault:
        if (sentence := describe_machine_fault(fault)) is None:
            raise
        say(f"error: {format_one_line(sentence)}")
        return 2


quiet_start.over()
