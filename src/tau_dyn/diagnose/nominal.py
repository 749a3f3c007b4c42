"""Refitted parameters compared with their trusted nominal values: differences that only correct a number of the robot file.

A payload, a wrong link mass or a drive gain vanish in the baseline's refit, so no residual shows them; they show as masses that
differ from the nominal beyond both uncertainties. A wrong motor constant changes all masses by one factor. If the bodies of a
robot have more than a mass, all base parameters are compared together (`payload.py`): there one payload changes many numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from tau_dyn.diagnose.payload import (
    Explanation,
    compare_with_trusted,
    compute_payload_parameters,
    find_end_link,
    find_explanation,
)
from tau_dyn.effects import PARAMETER_CAUSES, format_quantity
from tau_dyn.estimate import Estimate
from tau_dyn.evidence import DIFFERENCE_LEVEL, MIN_FORCE_SHARE, Finding
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import Robot, compute_nominal_stderr, find_placeholders

MAX_GAIN_RANGE = (0.5, 2.0)
"""Factor of a logged force: a torque constant is wrong by 30 % at most, a wrong pulley or winding by a factor of two; a larger
factor is a wrong unit."""
MIN_GAIN_ERROR = 5e-3
"""Deviation of a logged force's factor from one that is below the calibration error of torque sensors and torque constants."""
MAX_MASS_SHARE = 2.0
"""Payload or mass over the mass of all bodies; no robot carries more than twice its own mass."""


def find_parameter_changes(
    model: Model, nominal: Parameters, fitted: Parameters, estimate: Estimate | None = None
) -> list[Finding]:
    """Return a finding for each mass that differs from its nominal value, or one finding that explains all differences.

    Args:
        model: The model, for names of links and units.
        nominal: Values before the fit.
        fitted: Values of the final model, with standard errors.
        estimate: The fit behind them, whose base parameters are compared; None to compare masses alone.
    """
    found = _find_deviations(model, nominal, fitted, estimate) if _states_bodies(model.robot, nominal) else []
    return [_suspect_implausible(finding, model.robot, nominal) for finding in found]


MIN_DIFFERENCE_SHARE = 0.01
"""Least difference between the bodies' forces and the file's that is reported, as a share of the measured force; a torque is
measured to about one per cent."""


def describe_body_difference(model: Model, nominal: Parameters, estimate: Estimate | None) -> str:
    """Return that the bodies differ from their trusted values and no single cause explains it; empty if that is not so.

    Args:
        model: The model, for names of links.
        nominal: Trusted values.
        estimate: The fit whose base parameters are compared.
    """
    if (
        estimate is None
        or not any(len(link.own) > 1 for link in model.robot.links)
        or not _states_bodies(model.robot, nominal)
    ):
        return ""
    difference = compare_with_trusted(model.robot, nominal, estimate)
    n = len(difference.d)
    explanation = find_explanation(model.robot, difference) if n else None
    if not n or (explanation is not None and not explanation.places):
        return ""
    share = difference.force_share
    if stats.chi2.sf(difference.misfit, n) >= DIFFERENCE_LEVEL or share < MIN_DIFFERENCE_SHARE:
        return ""
    return (
        f"The bodies differ from the file: their force changes by {100 * share:.2g} % of the measured force, and no single "
        "body, load or gain explains it."
    )


def _find_deviations(model: Model, nominal: Parameters, fitted: Parameters, estimate: Estimate | None) -> list[Finding]:
    if estimate is not None and any(len(link.own) > 1 for link in model.robot.links):
        difference = compare_with_trusted(model.robot, nominal, estimate)
        explanation = find_explanation(model.robot, difference)
        if explanation is not None:
            finding = _build_finding(model, explanation, difference.misfit - explanation.left)
            return [_suspect_small(_suspect_place(finding, explanation.places), difference.force_share)]
    rows = [(p, nominal[p.name]) for p in fitted if _is_known(p, nominal)]
    if not rows:
        return []
    sigma = np.array([_combined_stderr(p, n) for p, n in rows])
    z = np.array([p.value - n.value for p, n in rows]) / sigma
    p_values = np.minimum(1.0, 2 * stats.norm.sf(np.abs(z)) * len(rows))
    off = np.flatnonzero(p_values < DIFFERENCE_LEVEL)
    ratio = np.array([p.value / n.value for p, n in rows])
    sigma = sigma / [n.value for _, n in rows]
    if len(off) > 1 and _is_common_factor(ratio, sigma):
        return [_build_gain_finding(ratio, sigma, float(p_values.min()))]
    return [_build_mass_finding(model, *rows[k], float(z[k]), float(p_values[k]), len(rows) == 1) for k in off]


def _states_bodies(robot: Robot, nominal: Parameters) -> bool:
    """Return whether a mass is given that is no placeholder; without one there is nothing that a fit could differ from."""
    unknown = find_placeholders(robot.model) if all(p.stderr is None for p in nominal) else frozenset()
    stated = (f"{link.link}.mass" for link in robot.links if link.joint_id not in unknown)
    return any(name in nominal and nominal[name].value > 0 for name in stated)


def _suspect_place(finding: Finding, places: Sequence[str]) -> Finding:
    """Return a finding as `suspected` if the same cause at another link or joint explains as much."""
    if not places:
        return finding
    return replace(finding, status="suspected", why_not_confirmed=f"{' or '.join(places)} instead explains as much")


def _suspect_small(finding: Finding, share: float) -> Finding:
    """Return a finding as `suspected` if nominal bodies need the same force, within the errors of filters on exact data."""
    if share >= MIN_FORCE_SHARE:
        return finding
    why = f"nominal bodies need the same force to {100 * share:.1g} %, and no force is measured to that"
    return replace(finding, status="suspected", why_not_confirmed=why)


def _suspect_implausible(finding: Finding, robot: Robot, nominal: Parameters) -> Finding:
    """Return a finding as `suspected`, with the reason, if its first amplitude is implausible, or is a gain too close to one."""
    first = finding.parameters[0]
    total = sum(nominal[f"{link.link}.mass"].value for link in robot.links if f"{link.link}.mass" in nominal)
    ranges = {"drive_gain": MAX_GAIN_RANGE, "force_scale": MAX_GAIN_RANGE}
    if first.unit == "kg" and total > 0:
        ranges |= {"payload": (0.0, MAX_MASS_SHARE * total), "link_mass": (-total, MAX_MASS_SHARE * total)}
    low, high = ranges.get(finding.cause, (-np.inf, np.inf))
    why = ""
    if not low <= first.value <= high:
        value = format_quantity(first.value, first.unit)
        why = f"{first.name} = {value} is outside of its plausible range ({low:.3g} to {high:.3g})"
    elif ranges.get(finding.cause) is MAX_GAIN_RANGE and abs(first.value - 1) < MIN_GAIN_ERROR:
        why = f"{first.name} is within {100 * MIN_GAIN_ERROR:g} % of one, and no force is calibrated to that"
    return replace(finding, status="suspected", why_not_confirmed=why) if why else finding


def _is_known(p: Parameter, nominal: Parameters) -> bool:
    """Return whether a fitted parameter is a mass with a nominal value and is known well enough for a comparison."""
    if not p.free or p.stderr is None or not p.name.endswith(".mass") or p.name not in nominal:
        return False
    return nominal[p.name].value > 0 and p.stderr < 0.3 * abs(p.value)


def _combined_stderr(p: Parameter, n: Parameter) -> float:
    of_model = n.stderr if n.prior_stderr is None else None  # of an identified model
    trusted = of_model if of_model is not None else compute_nominal_stderr(n)
    return float(np.hypot(p.stderr or 0.0, trusted or 0.0))


def _is_common_factor(ratio: np.ndarray, sigma: np.ndarray) -> bool:
    """Return whether one factor, far from one, explains all masses, of which these are ratios to the nominal ones (n,)."""
    weight = 1 / sigma**2
    mean = float(ratio @ weight / weight.sum())
    scatter = float(np.sum(((ratio - mean) / sigma) ** 2))
    far = abs(mean - 1) * float(np.sqrt(weight.sum()))
    return float(stats.chi2.sf(scatter, len(ratio) - 1)) > 0.05 and far > 4


def _build_gain_finding(ratio: np.ndarray, sigma: np.ndarray, p_value: float) -> Finding:
    weight = 1 / sigma**2
    mean, stderr = float(ratio @ weight / weight.sum()), float(1 / np.sqrt(weight.sum()))
    return Finding(
        "drive_gain",
        (),
        "parameter",
        float(((mean - 1) / stderr) ** 2),
        p_value,
        (Parameter("drive.gain", mean, "1", stderr=stderr, origin="masses over nominal masses"),),
        None,
        ("link_mass",),
        "tau_log = gain tau",
        f"All masses come out {100 * (mean - 1):+.1f} % off their nominal values, as with a wrong motor constant.",
        "weigh one moving part and fix it (--fix plate_link.mass=...): then the gain of the drives follows from the forces",
    )


def _build_finding(model: Model, found: Explanation, score: float) -> Finding:
    """Return the finding of one explanation of all differences."""
    robot, stderr = model.robot, float(np.sqrt(found.cov[0, 0]))
    if found.cause == "payload":
        link = find_end_link(robot)
        joint = str(robot.model.names[link.joint_id]) if link is not None else ""
        joint = robot.links[0].link if robot.base_coordinates else joint
        parameters = compute_payload_parameters(found, joint)
        mass, *centre = parameters
        sentence = f"The robot carries {format_quantity(mass.value, 'kg', mass.stderr)}"
        if centre:
            values = [f"{round(c.value, 3) + 0.0:.3f}" for c in centre]  # no minus sign before a zero
            errors = ["" if c.stderr is None else f" ± {c.stderr:.3f}" for c in centre]
            place = ", ".join(value + error for value, error in zip(values, errors, strict=True))
            sentence += f" at ({place}) m in the frame of {joint}"
        where = (found.place,)
        experiment = "record the same motion without the payload"
    elif found.cause == "link_mass":
        parameters = (Parameter(f"{found.place}.mass_error", float(found.amplitudes[0]), "kg", stderr=stderr),)
        sentence = f"{found.place} is off its nominal mass by {format_quantity(parameters[0].value, 'kg', stderr)}"
        where = (found.place,)
        experiment = f"weigh {found.place}"
    else:
        owner = found.place or "drive"
        share = float(found.amplitudes[0])
        factor, name = 1 + share, "gain"
        if found.cause == "force_scale":  # its share refers to the logged force
            factor, stderr, name = 1 / (1 - share), stderr / (1 - share) ** 2, "force_scale"
        parameters = (Parameter(f"{owner}.{name}", factor, "1", stderr=stderr, origin="bodies over nominal bodies"),)
        whose = f"logged force of {owner} is" if found.place else "logged forces are"
        sentence = f"The {whose} {format_quantity(factor, '1', stderr)} times the force of the nominal bodies"
        where = (found.place,) if found.place else ()
        experiment = "record the motion without and with a weighed payload, its mass fixed by --fix"
    return Finding(
        found.cause,
        where,
        "parameter",
        score,
        found.p,
        parameters,
        None,
        found.twins,
        PARAMETER_CAUSES.get(found.cause, "tau_log = gain tau"),
        sentence + ".",
        experiment,
    )


def _build_mass_finding(model: Model, p: Parameter, n: Parameter, z: float, p_value: float, only: bool) -> Finding:
    link = p.name.rsplit(".", 1)[0]
    carries = link == model.robot.plate or only
    more = p.value > n.value
    cause, twin = ("payload", "link_mass") if carries and more else ("link_mass", "payload")
    twins = [twin] if carries and more else []
    if only:
        twins += ["drive_gain"]
    error = f"{p.value:.4g} +- {p.stderr:.2g} kg instead of {n.value:.4g} kg"
    return Finding(
        cause,
        (link,),
        "parameter",
        z**2,
        p_value,
        (p,),
        None,
        tuple(twins),
        f"{p.name} differs from its nominal value",
        f"{link} moves like {error}.",
        f"weigh {link.removesuffix('_link')} without and with its load, and fix it (--fix {p.name}=...)",
    )
