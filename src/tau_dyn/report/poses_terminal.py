"""What the terminal shows of a planned calibration: accuracy, number of poses, what no pose can tell."""

from __future__ import annotations

from collections.abc import Mapping
from math import isnan

from rich.console import Console
from rich.table import Table

from tau_dyn.calibrate.poses import CalibrationCampaign, compute_doubling_gain, compute_min_poses
from tau_dyn.report.calibration_words import format_angle, format_length
from tau_dyn.report.formatting import format_list
from tau_dyn.report.terminal import build_bare_table, escape_control_characters, put, say, say_written

_ROWS = 8  # rows printed at most


def print_pose_plan(console: Console, plan: CalibrationCampaign, written: Mapping[str, str] | None = None) -> None:
    """Print a plan for a person.

    Args:
        console: Where to.
        plan: The result.
        written: What was written, such as `{"places": "poses.csv"}`, for the last line.
    """
    say(console, describe_inputs(plan), "dim")
    say(console, describe_headline(plan), "bold")
    say(console, describe_rehearsal(plan))
    put(console, _curve(plan))
    blind = list(plan.choice.not_identifiable)
    if blind:
        say(console, f"not identifiable, nominal value kept: {format_list(blind, 8)}", "dim")
    say_written(console, written)


def describe_headline(plan: CalibrationCampaign) -> str:
    """Return the answer in one sentence."""
    made = plan.choice.predicted
    turned = "" if isnan(made.turn) else f" and {format_angle(made.turn)}"
    return (
        f"{made.poses} poses: predicted RMS error {format_length(made.rms)}{turned} over the "
        f"workspace, standard deviation {format_length(made.scatter)}; "
        f"as many random poses {format_length(plan.choice.at_random)}"
    )


def describe_inputs(plan: CalibrationCampaign) -> str:
    """Return what was looked at."""
    seen = f"{len(plan.visible.index)} of {plan.reachable.n} poses in reach are seen by the {plan.device.name}"
    why = f" (mostly not: {next(iter(plan.visible.reasons))})" if plan.visible.reasons else ""
    rank, least = plan.choice.design.found.rank, compute_min_poses(plan.choice.design)
    return f"{seen}{why}; {rank} identifiable parameters, at least {least} poses"


def describe_rehearsal(plan: CalibrationCampaign) -> str:
    """Return what the simulated calibrations gave, and the tour."""
    tried, tour = plan.rehearsal, plan.tour
    rows = tried.to_dict()["position_rms"]
    ways = int((tour.pose < 0).sum())
    return (
        f"simulated: {format_length(rows['nominal'])} before, {format_length(tried.achieved)} after "
        f"({len(tried.after)} robots); twice as many poses "
        f"would lower held-out errors by {100 * compute_doubling_gain(plan.choice.predicted):.0f} %; tour of "
        f"{len(tour.q)} places" + (f", {ways} of them on the way" if ways else "")
    )


def _curve(plan: CalibrationCampaign) -> Table:
    table = build_bare_table()
    for title in ("poses", "tool", "held out"):
        table.add_column(title, no_wrap=True, justify="right")
    curve = plan.choice.curve
    step = max(1, -(-len(curve) // _ROWS))
    for row in [*curve[:-1:step], curve[-1]]:
        table.add_row(
            *map(escape_control_characters, [str(row.poses), format_length(row.rms), format_length(row.held_out)])
        )
    return table
