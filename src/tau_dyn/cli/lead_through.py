"""`tau-dyn lead-through`: stability limit, settings, and the controller as C."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter

from tau_dyn.cli.arguments import ColumnMapFile, NotNegative, Output, Positive, Whole, build_destination
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError
from tau_dyn.results import to_plain

_COLUMNS = Group("Columns, by name")
_LOOP = Group("Force loop")
_HANDLE = Group("Handle and hand")


def lead_through(
    log: str | None = None,
    /,
    *,
    stiffness: Annotated[Positive | None, Parameter(metavar="N/m")] = None,
    force: Annotated[str, Parameter(group=_COLUMNS, metavar="COLUMN")] = "force",
    position: Annotated[str, Parameter(group=_COLUMNS, metavar="COLUMN")] = "position",
    columns: ColumnMapFile = None,
    actuators: Annotated[Path | None, Parameter(group=_LOOP, metavar="ACTUATORS.yaml")] = None,
    servo: Annotated[Positive | None, Parameter(group=_LOOP, metavar="HZ")] = None,
    delay: Annotated[Whole | None, Parameter(group=_LOOP, metavar="N")] = None,
    period: Annotated[Positive, Parameter(group=_LOOP, metavar="S")] = 0.004,
    gain: Annotated[Positive | None, Parameter(group=_LOOP, metavar="X")] = None,
    mass: Annotated[Positive, Parameter(group=_HANDLE, metavar="KG")] = 3.0,
    damping: Annotated[NotNegative, Parameter(group=_HANDLE, metavar="X")] = 40.0,
    hand: Annotated[Positive, Parameter(group=_HANDLE, metavar="N/m")] = 1000.0,
    settings: Annotated[Path | None, Parameter(metavar="SETTINGS.yaml")] = None,
    out: Annotated[Path | None, build_destination("LEAD.c", "Write the controller in C and its header here")] = None,
    output: Output = Output(),
) -> Outcome:
    """Largest stable force gain of lead-through, and settings with half of it.

    Args:
        log: One slow contact with the tool's force and position, from which the contact's stiffness is estimated
        stiffness: Stiffness of the stiffest contact, instead of LOG
        force: Force on the tool along the normal [N]
        position: Position of the tool along the normal [m]
        actuators: A file of the actuators command; its slowest servo and longest delay, at the ends of their 95 % intervals
        servo: Bandwidth of the drives (default 69, from the thesis)
        delay: Delay from a force sample to the next command [samples] (default 0)
        period: Sample period of the controller
        gain: Gain to check [m/s per N]
        mass: Mass of the handle
        damping: Damping of the handle [N s/m]
        hand: Stiffness of the stiffest hand
        settings: Other settings of the controller and of its sensors
    """
    import numpy as np

    if (log is None) == (stiffness is None):
        raise InputError("bad_option", "lead-through takes either a LOG of one touch or --stiffness N/m")
    if out is not None and isinstance(out, Path) and out.suffix != ".c":
        raise InputError("cannot_write", f"{out}: the controller is written as C; its name ends in .c")
    with show_progress(output.quiet) as step:
        step("computing")
        from tau_dyn.control.iterative import read_saved_actuators
        from tau_dyn.control.lead_through import (
            ForceLoop,
            LeadThroughOptions,
            advise_lead_through,
            fit_contact_stiffness,
            read_lead_through_options,
        )
        from tau_dyn.log import read_log
        from tau_dyn.results import Z95

        read, stderr, most, warnings = None, None, stiffness, []
        if log is not None:
            read = read_log(log, columns)
            missing = next((name for name in (force, position) if name not in read.channels), None)
            if missing is not None:
                raise InputError(
                    "missing_column", f"{log}: there is no column {missing}; name it with --force or --position"
                )
            value, stderr = fit_contact_stiffness(read.channels[position], read.channels[force])
            most = value + Z95 * stderr
        if actuators is not None:
            drives = read_saved_actuators(actuators)
            servo = drives.slowest.bandwidth_hz if servo is None else servo
            delay = int(np.ceil(drives.slowest.delay / period - 1e-6)) if delay is None else delay
            warnings += drives.warnings
        more = LeadThroughOptions() if settings is None else read_lead_through_options(settings)
        loop = ForceLoop(period, 69.0 if servo is None else servo, delay or 0, more.filter_hz)
        assert most is not None  # one of the two is given
        found = advise_lead_through(
            loop, most, mass=mass, damping=damping, force_gain=gain, hand_stiffness=hand, stderr=stderr, options=more
        )
        files = {} if out is None else found.write_code(out)
    return Outcome(
        result={"settings": to_plain(found.to_rows()), "contact_stiffness_stderr": stderr},
        warnings=[*(read.warnings if read else ()), *warnings, *found.warnings],
        inputs=[*([(log, read.sha256)] if log and read else []), *(p for p in (actuators, columns, settings) if p)],
        files=files,
        named={path.suffix[1:]: path for path in files},
        found=found,
    )
