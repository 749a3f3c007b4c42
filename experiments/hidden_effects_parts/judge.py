"""One answer against the truth, as one row of the study's table."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from hidden_effects_parts.oracle import gain_ratio
from hidden_effects_parts.recording import Recording
from hidden_effects_parts.sets import Hidden, HiddenSet, hidden_force
from tau_dyn.diagnose import diagnose
from tau_dyn.evidence import Diagnosis, Finding


def row_of(one: HiddenSet) -> dict[str, Any]:
    """Diagnose a set and return its row."""
    start = time.perf_counter()
    found = diagnose(one.rig.nominal, one.logs, holdout=one.held, model=one.model, seed=one.number)
    seconds = time.perf_counter() - start
    return {**about(one), **answer(found), **judgement(one, found), "seconds": round(seconds, 2)}


def about(one: HiddenSet) -> dict[str, Any]:
    """Return what the set is."""
    joints = one.rig.joints

    def each(say) -> str:
        return "; ".join(str(say(hidden)) for hidden in one.hidden)

    return {
        "what": one.what,
        "number": one.number,
        "robot": one.rig.name,
        "base": one.rig.base,
        "nominal": one.nominal,
        "known_model": one.known is not None,
        "rate_hz": one.sensing.rate_hz,
        "position_sd": one.sensing.position_sd,
        "colour": one.sensing.colour,
        "motions": "; ".join(run.motion.name for run in (*one.runs, *one.held_runs)),
        "held_out": bool(one.held),
        "thermometers": any(log.has("temp", joints) for log in one.logs),
        "form": each(lambda h: type(h.form).__name__),
        "names": each(lambda h: "/".join(h.form.names)),
        "joints": each(lambda h: "+".join(joints[j] for j in h.form.joints)),
        "variables": each(lambda h: "+".join(sorted(named(v, joints) for v in h.form.variables))),
        "amplitude": each(lambda h: f"{h.amplitude:.6g}"),
        "lambda": each(lambda h: f"{h.strength:.4g}"),
        "lambda_in_force": each(lambda h: f"{h.strength_in_force:.4g}"),
    }


def answer(found: Diagnosis) -> dict[str, Any]:
    """Return what was said."""
    confirmed = [f for f in found.findings if f.status == "confirmed"]
    unexplained = [u for u in found.unexplained if u.status == "confirmed"]
    first = confirmed[0] if confirmed else None
    return {
        "verdict": found.verdict,
        "claims": len(confirmed) + len(unexplained),
        "first": first.cause if first else "",
        "first_joints": "+".join(first.joints) if first else "",
        "twins": "/".join(first.indistinguishable_from) if first else "",
        "score": first.score if first else np.nan,
        "p_value": first.p_value if first else min((u.p_value for u in unexplained), default=np.nan),
        "all": "; ".join(f"{f.cause}@{'+'.join(f.joints)}:{f.status}" for f in found.findings),
        "unexplained": "; ".join(f"{u.joint}({'+'.join(u.depends_on)}):{u.status}" for u in found.unexplained),
        "family_level": found.settings.get("family_level", np.nan),
        "causes_tried": found.settings.get("causes_tried", np.nan),
    }


def judgement(one: HiddenSet, found: Diagnosis) -> dict[str, Any]:
    """Return what of it is right; of pairs, about both."""
    confirmed = [f for f in found.findings if f.status == "confirmed"]
    parameters = [f for f in found.findings if f.status == "parameter"]
    unexplained = [u for u in found.unexplained if u.status == "confirmed"]
    by_refit = bool(one.hidden) and not one.hidden[0].form.refit
    pool = parameters if by_refit else confirmed
    detected = bool(pool or (unexplained and not by_refit))
    rows: dict[str, Any] = {
        "false_parameter": one.bodies_known and not by_refit and bool(parameters),
        "detected": detected,
        "first_right": bool(one.hidden) and bool(pool) and any(right(h, pool[0], one) for h in one.hidden),
        "twin_right": bool(one.hidden) and bool(pool) and any(right(h, pool[0], one, twins=True) for h in one.hidden),
        "found": sum(any(right(h, f, one, twins=True) for f in pool) for h in one.hidden),
        "spurious": sum(not any(right(h, f, one, twins=True) for h in one.hidden) for f in confirmed),
    }
    if one.hidden and not one.hidden[0].form.names:
        truth, joints = one.hidden[0].form, one.rig.joints
        wanted = {named(v, joints) for v in truth.variables}
        near = [u for u in unexplained if u.joint == joints[truth.joints[0]]]
        rows["joint_right"] = bool(near)
        rows["variables_right"] = any(wanted == set(u.depends_on) for u in near)
        rows["variables_among"] = any(wanted in map(set, (u.depends_on, *u.indistinguishable_from)) for u in near)
    if one.hidden and one.runs and confirmed:
        runs = (*one.runs, *one.held_runs)
        shapes = [np.stack([h for h in shapes_of(one, run)], axis=2) for run in runs]
        rows["gain_ratio"] = gain_ratio(found, (*one.logs, *one.held), runs, shapes)
    if len(one.hidden) == 1 and rows["first_right"]:
        rows |= parameter_error(one.hidden[0], pool[0])
    return rows


def right(hidden: Hidden, finding: Finding, one: HiddenSet, *, twins: bool = False) -> bool:
    """Tell whether a finding names a hidden thing, on one of its joints; `twins` lets it name it as a twin."""
    said = {finding.cause, *(finding.indistinguishable_from if twins else ())}
    joints = {one.rig.joints[j] for j in hidden.form.joints}
    passive = finding.cause == "passive_joint_friction"  # its joints are the passive ones, or those of the drives
    return bool(said & set(hidden.form.names)) and (passive or bool(joints & set(finding.joints)))


def shapes_of(one: HiddenSet, run: Recording) -> list[np.ndarray]:
    """Return the hidden forces (N, na) of a run in which they all act already, each as it was alone."""
    plain = Recording.of(run.rig, run.motion, one.sensing.rate_hz, run.number)
    return [hidden_force(plain, h.form.act(plain, h.amplitude)) for h in one.hidden]


def parameter_error(hidden: Hidden, finding: Finding) -> dict[str, float]:
    """Return the relative error of the first parameter that form and finding share, and the error in standard errors.

    Both are nan where there is none that data can tell. The size of a wave is that of its sine and cosine together.
    """
    found = {p.name.split(".")[-1]: (p.value, p.stderr) for p in finding.parameters if p.stderr is not None}
    for key, value in hidden.form.truth(hidden.amplitude).items():
        near = [x for name, x in found.items() if name == key or name.startswith(f"{key}_")]
        waves = [x for name, x in found.items() if name in (f"{key}_sin", f"{key}_cos")]
        if waves:
            size = float(np.hypot.reduce([x for x, _ in waves]))
            near = [(size, float(np.hypot.reduce([x * sd for x, sd in waves])) / size)]
        if near:
            estimate, sd = near[0]
            return {
                "parameter_error": abs(estimate - value) / abs(value),
                "parameter_z": (estimate - value) / sd if sd else np.nan,
            }
    return {}


def named(variable: str, joints: tuple[str, ...]) -> str:
    """Return `v1` as `v_cart2`; time has no joint."""
    return variable if variable == "t" else f"{variable[0]}_{joints[int(variable[1:])]}"
