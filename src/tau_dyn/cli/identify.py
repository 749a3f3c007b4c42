"""`tau-dyn identify`."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError

if TYPE_CHECKING:
    from tau_dyn.identify import Identification

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
    samples: Annotated[args.Whole, Parameter(metavar="N")] = 0,
    out: Annotated[
        Path | None,
        args.build_destination("MODEL.yaml", "Write the identified model here, or samples as .parquet or .csv"),
    ] = None,
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
        model: Friction model: rigid (no friction), symmetric (.coulomb .viscous .offset), asymmetric (.._pos .._neg); or a
            model file, which gives start values and effects
        per_log: Estimate a value for each log, all other parameters shared, and test whether the logs differ
        samples: Draw N physically consistent parameter sets that agree with the logs and the robot file; with MODEL.yaml they
            are written to MODEL_samples.parquet
        controller: The servo's law, for logs of commands and positions without torque (cmd_J, q_J); without it, its gains are
            estimated, and masses only up to a common scale
        estimator: wls: weighted least squares of filtered signals; ml: maximum likelihood at the full rate with encoder
            noise; iv: ml with instrumental variables from q_ref_J, for encoder noise that the controller feeds back;
            robust: ml with outlier weights; auto: iv or ml if the residual is consistent with noise, else wls
        jobs: Threads (default: one per core)
        cluster: A Dask scheduler whose workers see the same files; 'local' starts one here with N processes
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.identify import BlockExecutor, identify as identify_robot
        from tau_dyn.scale import count_cores
        from tau_dyn.servo import LoopIdentification, identify_loop, is_loop_log
        from tau_dyn.simulate import read_servo_law

        machine = robot_options.load(robot, may_float=True)
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
        files, drawn = _list_files(out, found, samples, output.seed, step)
    command = partial(_write_diagnosis, robot, logs, holdout, robot_options, fitting)
    if isinstance(found, LoopIdentification):
        again = ["the search for the effect that the simulation lacks:", command(controller=controller)]
        lines = ["estimator: output error through the closed loop", *(again if found.poor_fits else [])]
    else:
        lines = [f"estimator: {found.estimator}", *_suggest_diagnosis(found, command)]

    return Outcome(
        result=found.to_dict() | ({} if drawn is None else {"samples": drawn.to_dict()}),
        warnings=[*found.warnings, *(() if drawn is None else drawn.warnings)],
        inputs=[
            *robot_options.list_files(robot),
            *fitting.list_inputs(model, [*logs, *holdout], [*trained, *held]),
            controller,
        ],
        lines=lines,
        files=files,
        named={"samples" if _is_table(path) else "model": path for path in files},
        found=found,
    )


def _write_diagnosis(
    robot: str, logs: Sequence[str], holdout: Sequence[str], *options: object, controller: Path | None = None
) -> str:
    """Return the command that searches for causes in the same logs."""
    words = ["tau-dyn", "diagnose", robot, *logs]
    words += ["--holdout", *holdout] if holdout else []
    words += ["--controller", str(controller)] if controller else []
    words += [word for some in options for word in args.list_words(some)]
    return shlex.join(words)


def _suggest_diagnosis(found: Identification, command: Callable[[], str]) -> list[str]:
    """Return a line with the command that searches for causes; empty if the residual is noise, or nearly."""
    from tau_dyn.evidence import MIN_STRUCTURED_SHARE, find_poor_fits

    fits = find_poor_fits(found.estimate.regression, found.estimate.residuals(), MIN_STRUCTURED_SHARE)
    if not fits:
        return []
    listed = ", ".join(f"{fit.joint} ({100 * fit.missed_share:.2g} % of its force)" for fit in fits)
    return [f"the residual is more than noise at {listed}; the search for its cause:", command()]


def _is_table(path: Path | None) -> bool:
    return path is not None and path.suffix in (".parquet", ".csv")


def _list_files(
    out: Path | None, found: Any, samples: int, seed: int, step: Callable[[str], None]
) -> tuple[dict[Path | None, Callable[[Path], None]], Any]:
    """Return the files to write and the samples: the model with its samples, or only the samples if `--out` names a table."""
    if not samples:
        if _is_table(out):
            raise InputError("bad_option", f"--out {out} names a table of samples; give their number with --samples N")
        return {out: found.model.save}, None
    from tau_dyn.identify import Identification

    if not isinstance(found, Identification):
        raise InputError(
            "unsupported", "--samples needs logs with torque; logs of commands and positions give no samples"
        )
    step("samples")
    drawn = found.sample(samples, seed=seed)
    if out is None or _is_table(out):
        return {out: partial(drawn.save, ending=out.suffix if out else ".csv")}, drawn
    beside = out.with_name(f"{out.stem}_samples.parquet")
    return {out: found.model.save, beside: partial(drawn.save, ending=".parquet")}, drawn
