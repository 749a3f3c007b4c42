"""`tau-dyn diagnose`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import CannotAnswer, InputError


def diagnose(
    robot: args.RobotName,
    logs: args.Logs,
    /,
    *,
    holdout: Annotated[args.Strings, Parameter(metavar="LOG")] = (),
    model: Annotated[str, Parameter(metavar="MODEL")] = "asymmetric",
    fitting: args.FittingOptions = args.FittingOptions(),
    out: Annotated[
        Path | None,
        args.build_destination(
            "MODEL.yaml",
            "Write the model extended by the confirmed causes here; simulate, identify and the feedforward read it",
        ),
    ] = None,
    propose: Annotated[Path | None, Parameter(metavar="MOTION.csv", validator=args.require_csv_name)] = None,
    controller: Annotated[Path | None, Parameter(metavar="LAW.yaml")] = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """Physical causes of the residual between model and logs, and the improvement of the model by each cause.

    The model is fitted first. Causes are selected from its residual, confirmed on a second part of the data, and their gain is
    measured on a third. If the data are inconclusive, the answer names an experiment that would decide, and the exit status is
    3. The status is also 3 if a motion is requested and no motion would decide.

    Args:
        holdout: Logs excluded from the search: one half confirms a cause, the other measures its gain (default: blocks of the
            logs, 60/20/20)
        model: Effects already in the model: rigid, symmetric (.coulomb .viscous .offset), asymmetric (.._pos .._neg), or a
            model file; its parameters are refitted
        propose: Write the motion here (t, q_ref, v_ref, a_ref; a minute, within the robot's limits) that best separates the
            causes that these logs do not separate
        controller: The rig's controller: the first log with q_ref_JOINT is simulated again in closed loop, before and after;
            for logs of commands and positions without torque (cmd_J, q_J) the servo's law
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.by_measurement import diagnose_drives
        from tau_dyn.diagnose import add_simulation
        from tau_dyn.servo import diagnose_loop, is_loop_log
        from tau_dyn.simulate import read_servo_law

        machine = robot_options.load(robot, may_float=True)
        if propose or controller:
            machine.require_fixed_base("diagnose --propose or --controller")
        trained, held = fitting.read_logs(logs), fitting.read_logs(holdout)
        machine = robot_options.hold_silent_joints(machine, robot, trained)
        inputs = [
            *robot_options.list_files(robot),
            *fitting.list_inputs(model, [*logs, *holdout], [*trained, *held]),
            controller,
        ]
        if is_loop_log(trained[0], machine):
            if propose:
                raise InputError("bad_option", "--propose needs logs with torque")
            servo = None if controller is None else read_servo_law(controller, machine)
            loop = diagnose_loop(
                machine, trained, law=servo, holdout=held, progress=step, **fitting.collect(model, output.seed)
            )
            return Outcome(
                result=loop.to_dict(), warnings=loop.warnings, inputs=inputs, files={out: loop.extended_model.save},
                named={"extended model": out}, found=loop, exit_status=loop.exit_status,
            )  # fmt: skip
        law = _read_law(controller, machine, trained)
        found = diagnose_drives(machine, trained, holdout=held, progress=step, **fitting.collect(model, output.seed))
        if law is not None:
            found = add_simulation(found, trained, law, step)
        result, warnings, status = found.to_dict(), list(found.warnings), found.exit_status
        files: dict[Path | None, Any] = {out: found.extended_model.save}
        if propose:
            motion, refusal, answer = _propose(found, trained, propose, output.seed, step)
            result |= answer
            warnings += refusal
            files |= {propose: motion.to_csv} if motion else {}
            status = status if motion else CannotAnswer.exit_status

    return Outcome(
        result=result,
        warnings=warnings,
        inputs=inputs,
        lines=[f"proposed: {note}" for note in result.get("proposal", {}).get("notes", ())],
        files=files,
        named={_name_model(found): out, "motion": propose if propose in files else None},
        found=found,
        exit_status=status,
    )


def _name_model(found: Any) -> str:
    """Return what the written model is: without a confirmed cause it is the refitted one."""
    return "extended model" if any(f.status == "confirmed" for f in found.findings) else "refitted model"


def _read_law(path: Path | None, robot, logs):
    """Return the controller after a check that a log can be simulated with it, or None."""
    if path is None:
        return None
    from tau_dyn.diagnose import log_with_references
    from tau_dyn.simulate import read_law_file

    log_with_references(logs, robot.actuated)
    return read_law_file(path, robot)


def _propose(found, logs, path: Path, seed: int, step):
    """Return the proposed motion or None, warnings, and its part of the result."""
    from tau_dyn.diagnose import propose_motion

    try:
        motion = propose_motion(found, logs, seed=seed, progress=step)
    except CannotAnswer as fault:
        text = f"no motion is proposed: {fault.missing}. The experiment that would: {fault.experiment}"
        answer = {"out": None, "missing": fault.missing, "experiment": fault.experiment}
        return None, [text], {"status": "cannot_answer", "proposal": answer}
    answer = {"out": str(path), "duration_s": motion.duration, "notes": list(motion.notes)}
    return motion, [], {"proposal": answer}
