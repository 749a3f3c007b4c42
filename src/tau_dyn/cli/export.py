"""An identified robot back in a file of another program: URDF for Pinocchio, Drake and ROS, MJCF for MuJoCo."""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli.common import Outcome, add_common, progress
from tau_dyn.exceptions import InputError

HELP = "the identified robot as URDF or MJCF"

_ENDINGS = {"urdf": ".urdf", "mjcf": ".xml"}


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("model", metavar="MODEL.yaml", type=Path, help="a model file of identify or diagnose")
    parser.add_argument("--to", choices=tuple(_ENDINGS), required=True, help="format")
    parser.add_argument("--out", metavar="FILE", type=Path, help="FILE.urdf or FILE.xml; by default beside the model")
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Write the file."""
    ending = _ENDINGS[args.to]
    out = args.out or args.model.with_suffix(ending)
    if out.suffix != ending:
        raise InputError(f"{out}: what --to {args.to} writes ends in {ending}")
    with progress(args.quiet) as step:
        step("writing")
        from tau_dyn.exchange import mjcf_of, urdf_of
        from tau_dyn.model import Model

        model = Model.load(args.model)
        made = urdf_of(model) if args.to == "urdf" else mjcf_of(model)
    links = len(model.robot.links)
    said = f"{model.robot.name} with {links} {'link' if links == 1 else 'links'} that carry mass"
    leaning = f"; nominal, since no data determined them: {', '.join(made.nominal)}" if made.nominal else ""
    result = {"out": str(out), "format": args.to, "left_out": list(made.left_out), "nominal": list(made.nominal)}
    return Outcome(
        result=result,
        warnings=made.left_out,
        inputs=[args.model],
        show=lambda console: console.print(f"{said} -> {out}{leaning}", markup=False),
        files={out: made.text},
    )
