"""A model's feedforward tau_ff(q, v, a) written out for a controller: dependency-free C, or Python with NumPy alone."""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli.common import Outcome, add_common, show_progress
from tau_dyn.cli.kinds import positive
from tau_dyn.exceptions import InputError

HELP = "tau_ff(q, v, a) for a controller, in C or Python"

_ENDINGS = {"c": ".c", "python": ".py"}


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    kinds = parser.add_subparsers(dest="kind", required=True, metavar="export", parser_class=type(parser))
    export = kinds.add_parser("export", help="write the function", description=__doc__)
    export.add_argument("model", metavar="MODEL.yaml", type=Path, help="a model file of identify or diagnose")
    export.add_argument("--to", choices=tuple(_ENDINGS), required=True, help="language")
    export.add_argument(
        "--out", metavar="FILE", type=Path, required=True, help="FILE.c (with FILE.h beside it) or FILE.py"
    )
    export.add_argument("--name", metavar="NAME", default="tau_ff", help="of the function (default tau_ff)")
    export.add_argument(
        "--width", metavar="V", type=positive, nargs="+", default=[0.01],
        help="speed within which the sign of friction is smoothed, one or one a joint [m/s or rad/s] (default 0.01)",
    )  # fmt: skip
    export.add_argument("--shape", choices=("ramp", "tanh"), default="ramp", help="of the smoothed sign (default ramp)")
    export.add_argument("--steady", action="store_true", help="leave out effects that need a history, and say which")
    export.set_defaults(own_file=lambda args: f"{args.name}{_ENDINGS[args.to]}")
    add_common(export)


def run(args: argparse.Namespace) -> Outcome:
    """Write the function."""
    ending = _ENDINGS[args.to]
    if args.out.suffix != ending:
        raise InputError("cannot_write", f"{args.out}: what --to {args.to} writes ends in {ending}")
    with show_progress(args.quiet) as step:
        step("tracing")
        from tau_dyn.codegen import (
            ARGUMENTS,
            build_program,
            include_header,
            locate_header,
            write_c_source,
            write_python_source,
        )
        from tau_dyn.control import Feedforward
        from tau_dyn.model import Model

        model = Model.load(args.model)
        kept = model.steady(ARGUMENTS) if args.steady else model
        dropped = [effect.name for effect in model.effects if effect not in kept.effects]
        width = args.width[0] if len(args.width) == 1 else args.width
        program = build_program(Feedforward(kept, width=width, shape=args.shape))
        files: dict[Path, str] = {}
        if args.to == "c":
            header = locate_header(args.out)
            source, declared = write_c_source(program, args.name)
            files = {args.out: include_header(source, args.name, header), header: declared}
        else:
            files = {args.out: write_python_source(program, args.name)}
    size = len(program.graph.needed(program.outputs))
    written = " and ".join(str(path) for path in files)
    result = {
        "out": [str(path) for path in files],
        "language": args.to,
        "function": args.name,
        "joints": list(kept.robot.actuated),
        "signals": list(program.signals),
        "expressions": size,
        "difference": program.difference,
        "left_out": dropped,
    }
    return Outcome(
        result=result,
        warnings=[f"the feedforward leaves out {name}, which a single state does not determine" for name in dropped],
        inputs=[args.model],
        show=lambda console: console.print(
            f"{args.name}({', '.join(('q', 'v', 'a', *program.signals))}): {size} expressions, within "
            f"{max(program.difference, 1e-16):.1g} of Python's -> {written}",
            markup=False,
        ),
        files=dict(files),
    )
