"""`tau-dyn identify`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError

_BLOCKS = Group("Large recordings, which are read block by block")


def identify(
    robot: args.RobotName,
    logs: args.Logs,
    /,
    *,
    holdout: Annotated[args.Strings, Parameter(metavar="LOG")] = (),
    model: Annotated[str, Parameter(metavar="MODEL")] = "asymmetric",
    fitting: args.FittingOptions = args.FittingOptions(),
    per_log: Annotated[args.Strings, Parameter(group=args.CHOICES, metavar="NAME")] = (),
    out: Annotated[Path | None, args.build_destination("MODEL.yaml", "Write the identified model here")] = None,
    controller: Annotated[Path | None, Parameter(metavar="LAW.yaml")] = None,
    estimator: Literal["auto", "wls", "ml", "iv", "robust"] = "auto",
    jobs: Annotated[args.Whole, Parameter(group=_BLOCKS, metavar="N")] = 0,
    cluster: Annotated[str | None, Parameter(group=_BLOCKS, metavar="tcp://HOST:PORT")] = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.Output = args.Output(),
) -> Outcome:
    """Masses and friction from torque logs, with standard errors; evaluated on data that the fit did not use.

    Args:
        holdout: Held-out logs, for evaluation only
        model: Friction model: rigid (none), symmetric (.coulomb .viscous .offset), asymmetric (.._pos .._neg); or a model
            file, which gives start values and effects
        per_log: Estimate a value for each log, everything else shared, and test whether the logs differ
        controller: The servo's law, for logs of commands and positions without torque (cmd_J, q_J); without it its gains are
            estimated, and masses are known up to their scale
        estimator: wls: weighted least squares of filtered signals; ml: maximum likelihood at the full rate with encoder
            noise; iv: ml with instrumental variables from q_ref_J, for encoder noise that the controller feeds back;
            robust: ml with outlier weights; auto: iv or ml if the residual is consistent with noise, else wls
        jobs: Threads (default: one a core)
        cluster: A Dask scheduler whose workers see the same files; 'local' starts one here with N processes
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.identify import BlockExecutor, identify as identify_robot
        from tau_dyn.scale import count_cores
        from tau_dyn.servo import LoopIdentification, identify_loop, is_loop_log
        from tau_dyn.simulate import read_servo_law

        machine = robot_options.load(robot)
        trained, held = fitting.open_logs(logs), fitting.open_logs(holdout)
        machine = robot_options.hold_silent_joints(machine, robot, trained)
        if is_loop_log(trained[0], machine):
            law = None if controller is None else read_servo_law(controller, machine)
            found = identify_loop(
                machine, trained, law=law, holdout=held, progress=step, **fitting.collect(model, output.seed)
            )
        else:
            if controller is not None:
                raise InputError(
                    "bad_option", f"--controller goes with logs of commands without torque; {trained[0].name} is none"
                )
            found = identify_robot(
                machine,
                trained,
                holdout=held,
                progress=step,
                engine=BlockExecutor(jobs or count_cores(), cluster),
                per_log=per_log,
                estimator=estimator,
                **fitting.collect(model, output.seed),
            )
    told = "output error through the closed loop" if isinstance(found, LoopIdentification) else found.estimator

    return Outcome(
        result=found.to_dict(),
        warnings=found.warnings,
        inputs=[
            *robot_options.list_files(robot),
            *fitting.list_inputs(model, [*logs, *holdout], [*trained, *held]),
            controller,
        ],
        lines=[f"estimator: {told}"],
        files={out: found.model.save},
        named={"model": out},
        found=found,
    )
