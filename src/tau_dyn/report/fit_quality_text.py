"""Quality of a fit in sentences: the data used and left out, the conditioning, the residual's whiteness."""

from __future__ import annotations

import numpy as np
from scipy.stats import binom

from tau_dyn.identify import Identification
from tau_dyn.report.formatting import (
    count,
    format_expression,
    format_list,
    format_number,
    format_percent,
    format_unit,
    format_with_uncertainty,
)
from tau_dyn.report.parameter_rows import ParameterRow
from tau_dyn.report.residuals import ResidualSummary

WELL, FAIR = 30.0, 200.0
_BIASED_LEVEL = 0.01  # chance at which so few estimates of an unbiased fit lie within 2 standard errors
MIN_REPORTED_CORRELATION = 0.9  # between two parameters; less leaves both readable


def describe_preparation(found: Identification) -> list[str]:
    """Return how logs became a regression, one sentence a step."""
    regression = found.estimate.regression
    p, robot = regression.preparation, found.model.robot
    rate = 1 / float(np.median(np.diff(regression.runs[0].t)))
    slowest = [
        f"{_speed(float(v), unit)} ({joint})"
        for joint, v, unit in zip(regression.outputs, p.speed_threshold, robot.position_units, strict=True)
    ]
    sentences = [
        f"Positions pass a zero-phase low-pass of {format_number(p.position_cutoff_hz, 3)} Hz before they are differentiated; "
        f"forces and every column of the regression pass the same one of {format_number(p.force_cutoff_hz, 3)} Hz.",
        f"Both are then decimated to {format_number(rate, 3)} Hz.",
        f"Samples within {format_number(1000 * p.window_s, 2)} ms of a reversal and of speeds below {format_list(slowest)} "
        f"are left out: the sign "
        "of friction is uncertain there. The ends of each log and saturated forces are left out, too.",
    ]
    if p.exclude:
        sentences.append(f"Samples flagged by {format_list(p.exclude)} are left out.")
    return sentences


def _speed(v: float, unit: str) -> str:
    return f"{format_number(1000 * v, 2)} mm/s" if unit == "m" and v < 0.1 else f"{format_number(v, 2)} {unit}/s"


def describe_used_data(found: Identification) -> str:
    """Return how much of the data the fit uses, and what the rest looks like."""
    train, n = found.train, found.estimate.regression.n_samples
    text = f"The fit uses {format_percent(100 * train.used_share)} of the samples: {f'{n:,}'.replace(',', ' ')} force values."
    if train.all_samples is not None:
        text += f" Training error: {format_percent(train.relative_error_percent)} of the used samples, "
        text += f"{format_percent(train.all_samples.relative_error_percent)} of all."
    return text


def describe_conditioning(cond: float) -> str:
    """Return how well a motion separates the parameters, by its condition number."""
    judged = describe_separation(cond)
    return f"Condition number {format_number(cond, 3)} (below {WELL:g} is good, above {FAIR:g} is poor): {judged}."


def describe_separation(cond: float) -> str:
    """Return what a condition number means, as a clause."""
    if cond < WELL:
        return "the parameters are well separated"
    if cond < FAIR:
        return "acceptable; a richer motion would lower the standard errors"
    return "ill-conditioned; single estimates are sensitive to noise, their combinations are not"


def list_correlations(found: Identification, most: int = 8) -> list[tuple[str, str, str]]:
    """Return the strongest correlations above 0.9: both parameters, and the number."""
    base, matrix = found.estimate.base, np.triu(found.estimate.correlation, 1)
    pairs = sorted(np.argwhere(np.abs(matrix) > MIN_REPORTED_CORRELATION), key=lambda ij: -abs(matrix[ij[0], ij[1]]))[
        :most
    ]
    return [
        (base.expression(int(i)), base.expression(int(j)), f"{matrix[i, j]:+.3f}".replace("-", "−")) for i, j in pairs
    ]


def list_combinations(found: Identification) -> list[str]:
    """Return what the data do see of parameters that they cannot see alone, with values; best known (relative error) first."""
    together = [row for row in found.base_rows() if row["expression"] != row["name"]]
    together.sort(key=lambda row: row["stderr"] / max(abs(row["value"]), 1e-300))
    return [
        f"{format_expression(row['expression'])} = {format_with_uncertainty(row['value'], row['stderr'], row['unit'])}"
        for row in together
    ]


def describe_truth_errors(rows: list[ParameterRow]) -> str:
    """Return how the estimates compare with the true values of a simulation, by a binomial test of their coverage."""
    distances = [float(r.distance) for r in rows if r.distance]
    if not distances:
        return ""
    near = sum(d <= 2 for d in distances)
    text = f"{near} of {count(len(distances), 'estimate')} lie within 2 standard errors of the true value; "
    text += "95 % are expected."
    if binom.cdf(near, len(distances), 0.95) < _BIASED_LEVEL:
        text += " The model lacks a force that the simulated robot has; the estimates are biased."
    return text


def describe_whiteness(residuals: list[ResidualSummary]) -> str:
    """Return what the autocorrelation says."""
    left = [f"{r.joint} ({format_number(r.lasts_s, 2)} s)" for r in residuals if not r.white]
    if not left:
        return "Residuals are white within the filter band."
    return (
        f"The residual of {format_list(left)} is correlated for longer than the low-pass filter explains: the model "
        f"lacks a force. "
        "The standard errors include the coloured noise, but not a bias."
    )


def describe_fixed(found: Identification) -> list[str]:
    """Return what was kept at a given value."""
    return [
        f"{p.name} = {format_number(p.value)} {format_unit(p.unit)} ({p.origin})"
        for p in found.parameters
        if not p.free
    ]


def describe_inputs(found: Identification) -> str:
    """Return what went in, in a line: robot, logs, seconds, rate, how it was judged."""
    runs = found.estimate.regression.runs
    logs = list(dict.fromkeys(run.name for run in runs))
    seconds = sum(float(run.t[-1] - run.t[0]) for run in runs)
    named = format_list(logs, 3) if len(logs) <= 3 else count(len(logs), "log")
    return f"{named}, {format_number(seconds, 3)} s; evaluated on {found.holdout_how}"
