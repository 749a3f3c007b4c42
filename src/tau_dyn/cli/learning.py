"""`tau-dyn actuators` and `tau-dyn learn`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter

from tau_dyn.cli.arguments import (
    ColumnMapFile,
    NotNegative,
    Output,
    Positive,
    Strings,
    Whole,
    build_destination,
)
from tau_dyn.cli.execute import Outcome, show_progress
from tau_dyn.exceptions import InputError
from tau_dyn.results import to_plain

_COLUMNS = Group("Columns, by name")
_LAW = Group("How an error becomes a correction")


def actuators(
    logs: Annotated[tuple[str, ...], Parameter(name="LOG")],
    /,
    *,
    inputs: Annotated[Strings, Parameter(group=_COLUMNS, metavar="COLUMN")] = (),
    outputs: Annotated[Strings, Parameter(group=_COLUMNS, metavar="COLUMN")] = (),
    columns: ColumnMapFile = None,
    out: Annotated[Path | None, build_destination("ACTUATORS.yaml", "Write the actuators here, for learn")] = None,
    output: Output = Output(),
) -> Outcome:
    """Gain, time constant and delay of each controlled actuator, with uncertainty, from steps or multisines.

    Args:
        logs: CSV, Parquet, MCAP, a ROS bag or .mat with t, references and positions; never joined
        inputs: References (default: every q_ref_J beside which there is a q_J)
        outputs: Positions, in the order of the inputs
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.control.iterative import fit_actuator_models
        from tau_dyn.log import read_log

        read = [read_log(path, columns) for path in logs]
        step("fitting")
        found = fit_actuator_models(read, inputs, outputs)
    return Outcome(
        result={"axes": to_plain(found.to_rows()), "sample_time_s": found.dt},
        warnings=[*(w for log in read for w in log.warnings), *found.warnings],
        inputs=[*((path, log.sha256) for path, log in zip(logs, read, strict=True)), *([columns] if columns else [])],
        files={out: found.save} if out else {},
        named={"actuators": out},
        found=found,
    )


def learn(
    reference: Annotated[Path, Parameter(name="REFERENCE.csv")],
    trial: Annotated[str, Parameter(name="TRIAL")],
    /,
    *,
    actuators: Annotated[Path, Parameter(metavar="ACTUATORS.yaml")],
    correction: Annotated[Path | None, Parameter(metavar="FILE.csv")] = None,
    columns: ColumnMapFile = None,
    gain: Annotated[Positive, Parameter(group=_LAW, metavar="X")] = 0.9,
    shift: Annotated[Whole | None, Parameter(group=_LAW, metavar="N")] = None,
    cutoff: Annotated[Positive | None, Parameter(group=_LAW, metavar="HZ")] = None,
    lead: Annotated[NotNegative | None, Parameter(group=_LAW, metavar="S")] = None,
    not_monotone: Annotated[bool, Parameter(group=_LAW)] = False,
    largest_correction: Annotated[Positive | None, Parameter(group=_LAW, metavar="X")] = None,
    out: Annotated[Path, build_destination("CORRECTION.csv", "Write the next correction here", csv=True)],
    output: Output = Output(),
) -> Outcome:
    """The next correction of a repeated motion from one trial; refused before anything moves if learning would not converge.

    Args:
        reference: The motion without correction, as export --to reference writes it
        trial: A log of the motion with t and q_J, from its first sample on
        actuators: From the actuators command
        correction: The correction that was in force in the trial (none in the first one)
        gain: Part of the error that one iteration takes away
        shift: Of the error forwards in time [samples] (default: delay plus time constant)
        cutoff: Up to which frequency is learnt (default: the highest that converges in every iteration)
        lead: Fading in and out [s] (default: a tenth of the motion each)
        not_monotone: Allow a law that converges, but not in every iteration
        largest_correction: Refuse a larger one [m or rad] (default: the size of the motion)
    """
    with show_progress(output.quiet) as step:
        step("loading")
        import numpy as np

        from tau_dyn.control.interface import (
            Correction,
            compute_digest,
            format_correction_text,
            read_correction,
            require_same_motion,
        )
        from tau_dyn.control.iterative import LearningOptions, compute_learning_step, read_actuators
        from tau_dyn.log import read_log
        from tau_dyn.simulate import Trajectory

        joints = _list_joints(reference)
        motion = Trajectory.from_csv(str(reference), joints)
        dt = motion.duration / (motion.n_samples - 1)
        log = read_log(trial, columns)
        if abs(log.dt / dt - 1) > 1e-3:
            raise InputError(
                "time_stamps",
                f"{trial}: it has a sample every {1e3 * log.dt:.6g} ms, {reference} one every {1e3 * dt:.6g} ms; log the trial "
                "at the controller's period",
            )
        before = None
        if correction is not None:
            given = read_correction(correction, joints, period=dt)
            require_same_motion(motion, given)
            before = given.dq
        step("checking convergence")
        options = LearningOptions(gain, shift, cutoff, lead, not not_monotone)
        position = log.joint("q", joints)[: motion.n_samples]
        found = compute_learning_step(
            read_actuators(actuators, joints), joints, dt, motion.q, position, before, options
        )
        allowed = float(np.ptp(motion.q, axis=0).max()) if largest_correction is None else largest_correction
        size = float(np.abs(found.correction).max())
        if size > allowed:
            raise InputError(
                "invalid_value",
                f"the next correction is up to {size:.3g}, more than the {allowed:.3g} allowed; the robot does not do what its "
                "model says, or --largest-correction is too low",
            )
    text = format_correction_text(Correction(joints, dt, found.correction, compute_digest(motion)))
    facts = {"gain": found.gain, "shift_samples": found.shift, "cutoff_hz": found.cutoff_hz}
    checked = found.convergence
    return Outcome(
        result={
            "joints": to_plain(found.to_rows()),
            "law": facts,
            "convergence": {
                "largest_singular_value": max(checked.singular), "spectral_radius": checked.radius,
                "monotone": checked.monotone, "stable": checked.stable,
            },
            "out": str(out),
        },
        warnings=[*log.warnings, *found.warnings],
        inputs=[reference, (trial, log.sha256), actuators, *(p for p in (correction, columns) if p)],
        files={out: text},
        named={"correction": out},
        found=found,
    )  # fmt: skip


def _list_joints(reference: Path) -> tuple[str, ...]:
    """Return the joints of a reference file, in the order of its columns.

    Raises:
        InputError: It has none.
    """
    from tau_dyn.cli.arguments import read_columns

    joints = tuple(n.removeprefix("q_ref_") for n in read_columns(reference) if n.startswith("q_ref_"))
    if not joints:
        raise InputError(
            "missing_column", f"{reference}: there is no column q_ref_J; export --to reference writes them"
        )
    return joints
