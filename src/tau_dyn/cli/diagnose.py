"""What the simulation gets wrong, which physical cause explains it, and how much better the model is with that cause.

The model is fitted first; what it misses is searched for causes, confirmed on a second part of the data, and the gain is
measured on a third. Where the data cannot tell, the answer says which experiment would, and the exit status is 3; so it is
where a motion is asked for and none would tell.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tau_dyn.cli.common import (
    Outcome,
    add_common,
    add_robot,
    format_command_line,
    list_written_files,
    load_robot_from,
    show_progress,
)
from tau_dyn.cli.fitting import add_fitting, collect_fitting_inputs, collect_fitting_options, read_fitting_logs
from tau_dyn.cli.kinds import read_csv_file_name
from tau_dyn.exceptions import CannotAnswer

HELP = "what the simulation gets wrong, and the cause"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_robot(parser)
    add_fitting(
        parser,
        model="what the simulation has already: rigid, symmetric (.coulomb .viscous .offset), asymmetric (.._pos .._neg; "
        "default), or a model file; its parameters are refitted",
        holdout="logs kept from the search: one half confirms a cause, the other measures its gain (without any, blocks of "
        "the logs do, 60/20/20)",
        out="write the model extended by the confirmed causes here; simulate, identify and the feedforward read it",
    )
    parser.add_argument(
        "--propose",
        metavar="MOTION.csv",
        type=read_csv_file_name,
        help="write the motion here (t, q_ref, v_ref, a_ref; a minute, within the robot's limits) that best tells what these "
        "logs could not",
    )
    parser.add_argument(
        "--controller",
        metavar="LAW.yaml",
        type=Path,
        help="the rig's controller: the first log with q_ref_JOINT is simulated again in closed loop, before and after",
    )
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Diagnose."""
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.diagnose import diagnose

        robot = load_robot_from(args)
        logs, held = read_fitting_logs(args)
        law = _law(args, robot, logs)
        found = diagnose(robot, logs, holdout=held, progress=step, **collect_fitting_options(args))
        if law is not None:
            from tau_dyn.diagnose import add_simulation

            found = add_simulation(found, logs, law, step)
        result, files, warnings, status = found.to_dict(), {}, list(found.warnings), found.exit_status
        if args.propose:
            motion, refusal, answer = _proposed(found, logs, args, step)
            result |= answer
            warnings += refusal
            files |= {args.propose: motion.to_csv} if motion else {}
            status = status if motion else CannotAnswer.exit_status
    if args.out:
        files[args.out] = found.extended_model.save
    return Outcome(
        result=result,
        warnings=warnings,
        inputs=[*collect_fitting_inputs(args, logs, held), *([args.controller] if args.controller else [])],
        show=lambda console: _show(console, found, args, result),
        files=files,
        report=lambda: _page(found),
        exit_status=status,
    )


def _law(args: argparse.Namespace, robot, logs):
    """Return the controller, sure that a log can be simulated with it, or None."""
    if not args.controller:
        return None
    from tau_dyn.diagnose import log_with_references
    from tau_dyn.simulate import read_law_file

    log_with_references(logs, robot.actuated)
    return read_law_file(args.controller, robot)


def _proposed(found, logs, args: argparse.Namespace, step):
    """Return the proposed motion or None, warnings, and what the result says of it."""
    from tau_dyn.diagnose import propose_motion

    try:
        motion = propose_motion(found, logs, seed=args.seed, progress=step)
    except CannotAnswer as fault:
        text = f"no motion is proposed: {fault.missing}. The experiment that would: {fault.experiment}"
        answer = {"out": None, "missing": fault.missing, "experiment": fault.experiment}
        return None, [text], {"status": "cannot_answer", "proposal": answer}
    answer = {"out": str(args.propose), "duration_s": motion.duration, "notes": list(motion.notes)}
    return motion, [], {"proposal": answer}


def _show(console, found, args: argparse.Namespace, result: dict) -> None:
    from tau_dyn.render import print_result

    proposed = result.get("proposal", {})
    print_result(console, found, list_written_files(args, extended_model=args.out, motion=proposed.get("out")))
    for note in proposed.get("notes", ()):
        console.print(f"proposed: {note}", markup=False)


def _page(found) -> str:
    from tau_dyn.render import build_page

    return build_page(found, command_line=format_command_line())
