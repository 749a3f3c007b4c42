"""Resonances in sentences: the headline, the verdict, numbers with their standard errors."""

from __future__ import annotations

from functools import partial

import numpy as np

from tau_dyn import results as r
from tau_dyn.modes import Mode, Modes, OperationalModes
from tau_dyn.render.kinds.modes_figures import select_known_resonances

GOOD_FIT, FAIR_FIT = 90.0, 70.0
MAX_NAMED_MODES = 5
"""Modes that the headline names."""
MAX_DECIMALS = 5  # of a frequency; more decimals would be below the accuracy of clocks
BADGES = {"good": "Use it", "care": "Use with care", "poor": "Do not rely on it"}
"""Verdicts in a few words."""


def format_frequency(mode: Mode) -> str:
    """Return a mode's frequency [Hz] with its standard error, such as `7.402 ± 0.003`."""
    return _plain(mode.frequency_hz, mode.frequency_stderr)


def format_damping(mode: Mode) -> str:
    """Return a mode's damping in percent of critical damping, with its standard error."""
    return _plain(100 * mode.damping_ratio, 100 * mode.damping_stderr)


def format_mode_interval(value: float, stderr: float) -> str:
    """Return a 95 % interval; empty if it is not known."""
    if not np.isfinite(stderr) or stderr <= 0:
        return ""
    digits = min(max(r.choose_decimals(stderr), 0), MAX_DECIMALS)
    low, high = (f"{value + side * r.Z95 * stderr:.{digits}f}".replace("-", "−") for side in (-1, 1))
    return f"{low} … {high}"


def format_short_frequency(mode: Mode) -> str:
    """Return a frequency with its certain digits, at most three decimals."""
    if not np.isfinite(mode.frequency_stderr):
        return r.format_number(mode.frequency_hz, 3)
    return r.round_to_stderr(mode.frequency_hz, max(mode.frequency_stderr, 2e-3 * mode.frequency_hz))


def describe_headline(found: Modes | OperationalModes) -> str:
    """Return the headline."""
    ringing = select_known_resonances(found)
    if not ringing:
        what = "No resonance found"
    else:
        names = r.format_list([format_short_frequency(m) for m in ringing[:MAX_NAMED_MODES]], MAX_NAMED_MODES)
        more = f" and {len(ringing) - MAX_NAMED_MODES} frequencies more" if len(ringing) > MAX_NAMED_MODES else ""
        what = f"Resonances: {names} Hz{more}"
    if isinstance(found, OperationalModes):
        return f"{what}; from responses alone."
    fit = found.judged.mean
    if found.holdout is not None:
        return f"{what}; fit of the simulated held-out data: {format_fit(fit)}."
    return f"{what}; fit of the simulated training data: {format_fit(fit)}; there are no held-out data."


def format_fit(fit: float) -> str:
    """Return a fit as text."""
    if not np.isfinite(fit):
        return "no fit"
    return f"{fit:.1f} %".replace("-", "−")


def describe_verdict(found: Modes | OperationalModes) -> r.Verdict:
    """Return the verdict on the use of the model."""
    if isinstance(found, OperationalModes):
        return _judge(
            "care", "Use frequencies, damping and shapes; the forces were not measured, so shapes have no scale."
        )
    responding = [k for k, name in enumerate(found.outputs) if name not in found.silent_outputs]
    fit, failed = float(np.mean(found.judged.percent[responding])), [t for t in found.independence if not t.passed]
    if fit > 0 and fit < FAIR_FIT and not failed and select_known_resonances(found):
        return _judge(
            "care", "Disturbances excite the outputs more than the inputs do; the resonance frequencies remain valid."
        )
    if not fit >= FAIR_FIT:
        return _judge("poor", "Use only the resonance frequencies: the fit is too poor for design.")
    if found.holdout is None:
        return _judge("care", "Evaluate it on another recording before use: this is the fit of the training data.")
    vague = [m for m in select_known_resonances(found) if not m.damping_stderr <= 0.3 * m.damping_ratio]
    if failed:
        return _judge(
            "care" if fit < 99 else "good",
            f"Usable for the resonances below; the residual is correlated with the input in {len(failed)} of "
            f"{r.count(len(found.independence), 'pair')} of input and output.",
        )
    if fit < GOOD_FIT:
        return _judge(
            "care", "The residual is not correlated with the inputs: noise and disturbances, not a model error."
        )
    if vague:
        return _judge(
            "good",
            f"Usable for simulation and design; the damping of {r.count(len(vague), 'mode')} is poorly determined.",
        )
    return _judge("good", "Usable for simulation and design: the residual is not correlated with the inputs.")


_judge = partial(r.judge, badges=BADGES)


def describe_inputs(found: Modes | OperationalModes) -> str:
    """Return a summary of the inputs."""
    if isinstance(found, OperationalModes):
        samples = r.format_thousands(found.n_samples)
        return (
            f"{samples} samples at {r.format_number(1 / found.dt, 4)} Hz, no inputs, {r.count(len(found.outputs), 'output')} "
            f"({r.format_list(found.outputs)}); models up to order {found.order}, ssi-cov."
        )
    n = found.train.n_samples + (0 if found.holdout is None else found.holdout.n_samples)
    what = "impulse tests" if found.kind == "impulse" else f"{r.count(len(found.inputs), 'input')}"
    samples = r.format_thousands(n)
    return (
        f"{samples} samples at {r.format_number(1 / found.dt, 4)} Hz, {what} ({r.format_list(found.inputs)}), "
        f"{r.count(len(found.outputs), 'output')} ({r.format_list(found.outputs)}); order {found.order}, delay "
        f"{found.delay}, {found.method}; held out: {found.how_held}."
    )


def describe_mechanical(found: Modes) -> str:
    """Return a sentence about the estimation of mass, damping and stiffness."""
    m = found.mechanical
    if m is None:
        return f"Mass, damping and stiffness are not identifiable: {found.mechanical_why}."
    if m.status == "identified":
        unit = "" if m.unit == 1 else f" in units of {m.unit:.6g} m/s²"
        force = "held over each sample" if m.hold == "held" else "linear between samples"
        taken = f"Outputs are taken as {m.sensor}s{unit}, and inputs as {force}."
        return f"Mass, damping and stiffness are identified: {m.why}. {taken}"
    if m.status == "condensed" and m.valid_hz:
        low, high = (r.format_number(v, 3) for v in m.valid_hz)
        return f"Mass, damping and stiffness are a condensed model, valid from {low} to {high} Hz: {m.why}."
    return f"Mass, damping and stiffness are not identifiable: {m.why}."


def _plain(value: float, stderr: float) -> str:
    """Return a value and its standard error, with the decimals of two digits of the error."""
    if not np.isfinite(stderr) or stderr <= 0:
        return r.format_number(value, 4)
    digits = min(max(r.choose_decimals(stderr), 0), MAX_DECIMALS)
    return f"{value:.{digits}f} ± {max(stderr, 10.0**-digits):.{digits}f}".replace("-", "−")


def describe_tests(found: Modes) -> str:
    """Return the result of the tests in one or two sentences."""
    on = "held-out" if found.tested_on == "holdout" else "training"
    failed = [t for t in found.independence if not t.passed]
    n = len(found.independence)
    said = (
        f"On {on} data, the residual of the simulation is not correlated with the inputs: no linear dynamics are missing."
        if not failed
        else f"On {on} data, in {len(failed)} of {n} pairs the residual is correlated with the input: "
        "linear dynamics are missing, or the structure is nonlinear."
    )
    coloured = [t.output for t in found.whiteness if not t.passed]
    share = r.format_percent(100 * max((t.outside for t in found.whiteness), default=0.0))
    if coloured:
        return (
            f"{said} One-step errors of {', '.join(coloured)} keep some memory ({share} of the lags outside the band)."
        )
    return f"{said} One-step errors are white."


def tabulate_modes(found: Modes | OperationalModes) -> list[dict[str, float]]:
    """Return one row per resonance, lowest frequency first."""
    rows = []
    for m in found.modes:
        row = {n: getattr(m, n) for n in ("frequency_hz", "frequency_stderr", "damping_ratio", "damping_stderr")}
        for quantity, value in (("frequency", "frequency_hz"), ("damping", "damping_ratio")):
            for end, sign in (("low", -1), ("high", 1)):
                row[f"{quantity}_{end}"] = row[value] + sign * r.Z95 * row[f"{quantity}_stderr"]
        rows.append(row)
    return rows


def format_entry(values: np.ndarray, spread: np.ndarray | None, i: int, j: int) -> str:
    """Return an entry of a matrix with its standard error, if that is known."""
    value, sigma = float(values[i, j]), 0.0 if spread is None else float(spread[i, j])
    if not np.isfinite(sigma) or sigma <= 0:
        return r.format_number(value, 4)
    return f"{r.round_to_stderr(value, sigma)} ± {r.round_to_stderr(sigma, sigma)}"
