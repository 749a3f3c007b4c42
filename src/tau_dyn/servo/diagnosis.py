"""Errors of a servo loop's simulation and their causes in the loop, tested on positions.

    logs -> baseline -> causes (`cause_search.py`) -> confirmed -> gain -> residual (`residual_structure.py`)

A cause is confirmed if held-out positions show the effect that it predicts, and its gain is measured on test data that serve no
other purpose. Both use the models fitted to the search's data alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Unpack

import numpy as np
from scipy.stats import norm

from tau_dyn.effects import LOOP_CAUSES
from tau_dyn.evidence import (
    MAX_HELD_OUT_RATIO,
    Choice,
    Diagnosis,
    Finding,
    Gain,
    Limit,
    OutputErrors,
    Status,
    Step,
    Untestable,
    decide_verdict,
    describe_foreign_joints,
    describe_split,
)
from tau_dyn.identify import list_provenance
from tau_dyn.log import Log, Recording
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter
from tau_dyn.robot import Robot
from tau_dyn.servo.cause_search import LoopSearch, check_steps, compute_limits, part_twins, search_causes
from tau_dyn.servo.data import BASELINE, LoopData, fit_coupled, fit_from_starts, keep_kinds
from tau_dyn.servo.doubts import list_loop_warnings
from tau_dyn.servo.fit import LoopFit, fit_loop
from tau_dyn.servo.identification import fill_model, list_body_rows, list_joint_rows
from tau_dyn.servo.preparation import LoopOptions, read_loop_logs
from tau_dyn.servo.records import LoopRecord
from tau_dyn.servo.residual_structure import LoopResidual, compute_noise_floor, find_residual_structure
from tau_dyn.servo.saturation import start_saturated
from tau_dyn.servo.unknowns import HIGHEST, LIMITS, LOWEST, LoopUnknowns, get_unit
from tau_dyn.simulate import SERVO_ENTRIES

CONFIRMED = 2.6
"""Score on held-out data from which an effect is confirmed: exceeded by chance in one of 200 cases."""
BLOCK_S = 4.0  # of the split into training, confirmation and gain
DRAWS = 400
"""Bootstrap draws of blocks for the gain's interval."""
MAX_INCREASE = 0.5  # per cent of a joint's rms; a smaller increase is not reported


@dataclass(frozen=True, eq=False)
class _Parts:
    """Records for the search, the confirmation and the gain, and loads along the last two."""

    train: Sequence[LoopRecord]
    confirm: Sequence[LoopRecord]
    gain: Sequence[LoopRecord]
    same_logs: bool


class _Residuals(NamedTuple):
    """Residuals (M, na, S) of a model at the used samples, blocks and samples that are there (M, S)."""

    r: np.ndarray
    blocks: np.ndarray
    used: np.ndarray

    @property
    def rms(self) -> np.ndarray:
        """Root mean square of each joint (na,)."""
        return np.sqrt((self.r**2).sum(axis=(0, 2)) / max(int(self.used.sum()), 1))


def diagnose_loop(
    robot: Robot, logs: Log | Recording | Iterable[Log | Recording], **options: Unpack[LoopOptions]
) -> Diagnosis:
    """Find the errors of servo loops' simulation, from logs of commands and positions.

    Args:
        robot: The robot, with nominal parameters.
        logs: Training logs with `cmd_J` and `q_J` of every actuated joint.
        **options: See `LoopOptions`.

    Raises:
        InputError: A log, the law or a choice is at fault.
        CannotAnswer: The logs hold no motion.
    """
    given = read_loop_logs(robot, logs, options)
    progress, seed = given.progress, given.seed
    parts = _split(given.kept, given.others)
    given, data = start_saturated(given, parts.train, BASELINE)
    law = data.law
    unknowns = keep_kinds(data, (*BASELINE, *law.estimated))
    data = replace(data, unknowns=unknowns, whole=True)
    data, short, base, search = _search(data, progress)
    held = data
    if not parts.same_logs:
        held = replace(
            replace(data, unknowns=search.unknowns, records=parts.confirm).with_exact_motions(search.fit),
            unknowns=unknowns,
        )
    progress("confirmation and gain")
    findings = _confirm(held, search, parts, seed)
    nominal, before, after = (
        _predict(held, u, x, parts.gain)
        for u, x in (
            (_hold_nominal(data), np.zeros(data.space.n_unknowns)), (data.unknowns, base.x), (search.unknowns, search.fit.x)
        )
    )  # fmt: skip
    interval = _compare(before, after, seed)
    foreign = [] if parts.same_logs else _find_foreign(law.joints, search.fit, after.rms)
    choice, why = _recommend(law.joints, findings, (nominal, before, after), interval, foreign, seed)
    floor = np.minimum(compute_noise_floor([*given.kept, *given.others]), after.rms)  # never above the residual
    train, confirm = (
        _predict(one, search.unknowns, search.fit.x, records)
        for one, records in ((data, parts.train), (held, parts.confirm))
    )
    residuals = [
        LoopResidual(records, found.r)
        for records, found in ((parts.train, train), (parts.confirm, confirm), (parts.gain, after))
    ]
    unexplained = find_residual_structure(law.joints, residuals, floor, np.random.default_rng(seed))
    progress("detection limits")
    limits, untestable = _list_limits(short, base, findings)
    warnings = [*given.warnings, *describe_foreign_joints(foreign)]
    held = [] if parts.same_logs else parts.confirm
    warnings += list_loop_warnings(law, parts.train, held, [*given.train, *given.held], data, base)
    provenance = list_provenance(given.train, given.held, seed)
    model, extended = (
        replace(_build_model(replace(data, unknowns=u), fit, seed), provenance=provenance)
        for u, fit in ((data.unknowns, base), (search.unknowns, search.fit))
    )
    size = np.concatenate([record.q[record.used] for record in parts.gain]).std(axis=0)
    names = ("nominal", "refitted", "extended")
    steps = [_measure(law.joints, x, size, seed) for x in (nominal, before, after)]
    bottom = OutputErrors(law.joints, floor, np.column_stack([floor, floor]), _compute_percent(floor, size))
    findings = sorted(findings, key=lambda f: f.rank)
    verdict = decide_verdict(findings, unexplained, _list_aliased(findings))
    return Diagnosis(
        verdict=verdict,
        sentence=_describe(findings, *steps[1:]),
        channel="position",
        outputs=law.joints,
        units=data.model.robot.position_units,
        baseline=steps[1],
        extended=steps[2],
        noise_floor=bottom,
        waterfall=(*map(Step, names, steps), Step("noise_floor", bottom)),
        findings=tuple(findings),
        unexplained=unexplained,
        limits=limits,
        untestable=untestable,
        model=model,
        extended_model=extended,
        traces=(),
        n_parts=_measure_parts(parts),
        how=describe_split(not parts.same_logs, "logs"),
        warnings=tuple(dict.fromkeys(warnings)),
        seed=seed,
        recommendation=choice,
        recommendation_why=why,
        further={
            "measured": "position",
            "gain_percent_ci95": interval,
            "controller": dict(extended.controller),
        },
    )


def _list_aliased(findings: Sequence[Finding]) -> Sequence[Finding]:
    """Return the findings if all are unconfirmed and each has an indistinguishable cause: the data cannot separate them."""
    open_ = all(f.indistinguishable_from and f.status != "confirmed" for f in findings)
    return findings if open_ else ()


def _measure_parts(parts: _Parts) -> tuple[float, float, float]:
    """Return the length of training, validation and test data [s]."""
    train, confirm, gain = (
        sum(float(record.used.sum()) * record.interval for record in records)
        for records in (parts.train, parts.confirm, parts.gain)
    )
    return train, confirm, gain


def _compute_percent(rms: np.ndarray, size: np.ndarray) -> float:
    """Return the norm of errors (na,) divided by that of the motion (na,) [%]."""
    return 100 * float(np.linalg.norm(rms) / max(float(np.linalg.norm(size)), 1e-12))


def _measure(joints: tuple[str, ...], found: _Residuals, size: np.ndarray, seed: int) -> OutputErrors:
    """Return errors on the test data, with intervals from blocks."""
    flat, rng = found.blocks.reshape(-1), np.random.default_rng(seed)
    squares = np.array([np.bincount(flat, (found.r[:, j] ** 2).reshape(-1)) for j in range(len(joints))])
    counts = np.bincount(flat, found.used.reshape(-1).astype(float))
    there = np.flatnonzero(counts)
    pick = rng.choice(there, (DRAWS, len(there)))
    drawn = squares[:, pick].sum(axis=2) / np.maximum(counts[pick].sum(axis=1), 1)
    ci95 = np.percentile(np.sqrt(drawn), [2.5, 97.5], axis=1).T
    return OutputErrors(joints, found.rms, ci95, _compute_percent(found.rms, size))


def _describe(findings: Sequence[Finding], before: OutputErrors, after: OutputErrors) -> str:
    """Return the result in a sentence."""
    named = ", ".join(f"{f.cause.replace('_', ' ')} at {f.joints[0]}" for f in findings if f.status == "confirmed")
    one, other = (f"{1e3 * float(np.sqrt(np.mean(e.rms**2))):.1f}" for e in (before, after))
    if named:
        return (
            f"The simulated loop lacks {named}; with it the held-out position error is {other} instead of {one} mrad."
        )
    return f"No cause is confirmed; the held-out position error of the simulated loop is {one} mrad."


def _search(data: LoopData, progress: Callable[[str], None]) -> tuple[LoopData, LoopData, LoopFit, LoopSearch]:
    """Return data with exact motions, their pieces, the baseline and the causes: found on pieces, fitted to the whole logs."""
    short, unknowns = data.shorten(), data.unknowns
    progress("baseline")
    problem = short.build_problem()
    base = fit_loop(problem.with_finer_differences(), progress, first=fit_from_starts(problem, progress).x)
    search = search_causes(short, base, progress)
    progress("exact motions")
    settled, near = _settle(short, search, progress)
    base, search = check_steps(settled, base, replace(search, fit=near) if settled.is_shaken else search, progress)
    search = part_twins(settled, search, progress)
    if short is data:
        return settled, settled, base, search
    progress("whole logs")
    near = fit_loop(data.build_problem(search.unknowns), progress, first=search.fit.x)
    settled, near = _settle(data, replace(search, fit=near), progress)
    base = fit_loop(settled.build_problem(unknowns), progress, first=base.x) if search.taken else near
    return settled, short, base, replace(search, fit=near)


def _settle(data: LoopData, search: LoopSearch, progress: Callable[[str], None]) -> tuple[LoopData, LoopFit]:
    """Return the data with exact loads and steps for the causes found, and their fit."""
    fine = data.with_fine_steps(search.fit)
    settled, near = fit_coupled(replace(fine, unknowns=search.unknowns), progress, search.fit)
    return replace(settled, unknowns=data.unknowns), near


def _split(train: Sequence[LoopRecord], held: Sequence[LoopRecord]) -> _Parts:
    """Return the parts: 60 / 20 / 20 by blocks, or the held-out logs in halves of blocks."""

    def mask(records: Sequence[LoopRecord], wanted: set[int], of: int) -> list[LoopRecord]:
        found = []
        for r in records:
            block = (np.arange(len(r.t)) * r.dt / min(BLOCK_S, len(r.t) * r.dt / (2 * of))).astype(int) % of
            found.append(replace(r, used=r.used & np.isin(block, list(wanted))))
        return found

    if held:
        return _Parts(list(train), mask(held, {0}, 2), mask(held, {1}, 2), False)
    return _Parts(mask(train, {0, 1, 3}, 5), mask(train, {2}, 5), mask(train, {4}, 5), True)


def _regress_on(effect: np.ndarray, residual: np.ndarray, blocks: np.ndarray) -> tuple[float, float]:
    """Return the share of an effect (M,) in a residual (M,), and its t-statistic, valid for coloured residuals."""
    power = float(effect @ effect)
    if power <= 0:
        return 0.0, 0.0
    share = float(effect @ residual) / power
    spread = float(np.sqrt((np.bincount(blocks, weights=effect * (residual - share * effect)) ** 2).sum()))
    return share, share * power / spread if spread > 0 else 0.0


def _hold_nominal(data: LoopData) -> LoopUnknowns:
    """Return fixed unknowns at the model's and the law's own values."""
    u, p, joints = data.unknowns, data.model.parameters, data.law.joints
    values = {key: np.array(value) for key, value in {**u.values, **data.law.values}.items()}
    for kind in BASELINE:
        values[kind] = np.array([p[f"{j}.{kind}"].value if f"{j}.{kind}" in p else 0.0 for j in joints])
    return replace(u, values=values, free=np.zeros_like(u.free))


def _predict(data: LoopData, u: LoopUnknowns, x: np.ndarray, records: Sequence[LoopRecord]) -> _Residuals:
    """Return the residuals of logs of the data, with their own masks, at a solution."""
    problem = data.build_problem(u, records)
    return _Residuals(problem.residuals(x[:, None])[:, :, 0], problem.blocks, problem.used)


def _confirm(data: LoopData, search: LoopSearch, parts: _Parts, seed: int) -> list[Finding]:
    """Return the causes of the search, each confirmed or suspected by its prediction on data that the search did not use."""
    findings, u, fit = [], search.unknowns, search.fit
    where = np.full(u.free.shape, -1)
    where[u.free] = np.arange(int(u.free.sum()))
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    for (cause, j), (score, twins) in search.taken.items():
        kind = LOOP_CAUSES[cause].entries[0]
        at = int(where[u.kinds.index(kind), j])
        without = np.array(fit.x)
        without[at] = data.law.values[kind][j]
        (one, full), (g0, g1) = (
            [_predict(data, u, x, records) for x in (without, fit.x)] for records in (parts.confirm, parts.gain)
        )
        d = (one.r - full.r)[:, j].reshape(-1)
        share, t = _regress_on(d, one.r[:, j].reshape(-1), one.blocks.reshape(-1))
        interval = _bootstrap(g0.r[:, j], g1.r[:, j], g0.blocks, seed)
        ok = t > CONFIRMED and 0.3 < share < 3.0 and interval[0] > 0
        joint = data.law.joints[j]
        number = Parameter(
            f"{joint}.{kind}", float(u.with_values(fit.x)[kind][j]), get_unit(kind), stderr=float(sigma[at])
        )
        values, row = u.with_values(fit.x), LOOP_CAUSES[cause]
        numbers = (
            number,
            *(Parameter(f"{joint}.{form}", float(values[form][j]), get_unit(form)) for form in row.forms),
        )
        gain = Gain(float(g0.rms[j]), float(g1.rms[j]), 100 * (1 - float(g1.rms[j] / max(g0.rms[j], 1e-12))), interval)
        shown = (share, share / t if t else np.inf)
        status: Status = "confirmed" if ok else "suspected"
        findings.append(
            Finding(
                cause,
                (joint,),
                status,
                score,
                float(norm.sf(t)),
                numbers,
                gain,
                twins,
                row.equation,
                f"{joint}: {cause.replace('_', ' ')}.",
                row.reveals if twins else "",
                channel="position",
                confirmation=shown,
                why_not_confirmed="" if ok else _explain_rejection(t, share, interval),
                is_shown=t > CONFIRMED,
            )
        )
    return findings


def _explain_rejection(t: float, share: float, interval: tuple[float, float]) -> str:
    """Return the reason why a cause is only suspected."""
    if t <= CONFIRMED:
        return "held-out data do not show it"
    if not 0.3 < share < 3.0:
        return f"held-out data show {100 * share:.0f} % of the predicted effect"
    return f"its gain is not above zero (95 % interval {interval[0]:.2g} to {interval[1]:.2g} %)"


def _compare(before: _Residuals, after: _Residuals, seed: int) -> tuple[float, float]:
    """Return the 95 % interval of the reduction of the rms over all joints, each divided by its size before [%]."""
    scale = np.maximum(before.rms, 1e-9)[None, :, None]
    one, other = (np.sqrt(((x.r / scale) ** 2).sum(axis=1)) for x in (before, after))
    return _bootstrap(one, other, before.blocks, seed)


def _find_foreign(joints: Sequence[str], fit: LoopFit, held: np.ndarray) -> list[tuple[str, float]]:
    """Return joints whose held-out rms is many times the training rms, with the ratio."""
    ratios = zip(joints, held / np.maximum(fit.sigma, 1e-12), strict=True)
    return [(joint, float(ratio)) for joint, ratio in ratios if ratio > MAX_HELD_OUT_RATIO]


def _recommend(
    joints: Sequence[str],
    findings: Sequence[Finding],
    steps: tuple[_Residuals, _Residuals, _Residuals],
    interval: tuple[float, float],
    foreign: Sequence[tuple[str, float]],
    seed: int,
) -> tuple[Choice, str]:
    """Return the recommended model and the reason, as in a diagnosis of forces."""
    nominal, before, after = steps
    if foreign:
        return "neither", "the held-out error is many times the training error: the held-out log is of another machine"
    low, high = _compare(nominal, before, seed)
    if high < -MAX_INCREASE:
        return "neither", (
            f"the held-out error of the refitted model is {-high:.2g} to {-low:.2g} % larger than with the robot file's values"
        )
    if not any(f.status == "confirmed" for f in findings):
        return "refitted", "no cause is confirmed"
    for j, joint in enumerate(joints):
        if _bootstrap(before.r[:, j], after.r[:, j], before.blocks, seed)[1] < -MAX_INCREASE:
            return "refitted", f"the confirmed causes increase the held-out error at {joint}"
    said = f"(95 % interval [{interval[0]:.2g}, {interval[1]:.2g}] %)"
    if interval[0] <= 0:
        return "refitted", f"the held-out position error does not fall significantly {said}"
    return "extended", f"the held-out position error falls {said}, and no joint becomes worse"


def _list_limits(
    data: LoopData, base: LoopFit, findings: Sequence[Finding]
) -> tuple[tuple[Limit, ...], tuple[Untestable, ...]]:
    """Return the detection limits of the causes that were not found, and the causes that these logs cannot show."""
    limits, untestable = [], []
    kept = data.build_problem().keep_inertial(base.x)
    for cause, row in LOOP_CAUSES.items():
        entry = row.entries[0]
        free = data.unknowns.kinds.index(entry) if entry in data.unknowns.kinds else -1
        if any(f.cause == cause for f in findings) or (free >= 0 and data.unknowns.free[free].any()):
            continue  # found, or a number that the baseline estimates
        known = data.law.values[entry]
        most = np.where(known > 0, known, HIGHEST.get(entry, np.inf))
        found = dict(zip(data.law.joints, compute_limits(data, base, cause, kept).tolist(), strict=True))
        if entry in LIMITS:  # found up to this number: the smallest is the worst
            shown = {joint: min(x, HIGHEST[entry]) for joint, x in found.items() if x > LOWEST[entry]}
            order = sorted(shown, key=lambda j: shown[j])
        else:
            shown = {
                joint: x for (joint, x), high in zip(found.items(), most, strict=True) if np.isfinite(x) and x < high
            }
            order = sorted(shown, key=lambda j: -shown[j])
        if shown:
            joint, unit = order[0], get_unit(entry)
            amount = f"{shown[joint]:.2g} {unit}".removesuffix(" 1")
            phrase = f"{cause.replace('_', ' ')} of {amount} at {joint}"
            limits.append(Limit(cause, shown[joint], unit, phrase, tuple(shown.items())))
        else:
            why = "these logs hardly depend on it next to the masses and friction of the refit"
            untestable.append(Untestable(cause, why, row.reveals))
    return tuple(limits), tuple(untestable)


def _bootstrap(before: np.ndarray, after: np.ndarray, blocks: np.ndarray, seed: int) -> tuple[float, float]:
    """Return the 95 % interval of the reduction of the rms [%] over draws of blocks; residuals and blocks (M, S)."""
    rng, flat = np.random.default_rng(seed), blocks.reshape(-1)
    a, b = (np.bincount(flat, weights=(r**2).reshape(-1)) for r in (before, after))
    there = np.flatnonzero((a > 0) | (b > 0))
    if len(there) < 3:
        return -np.inf, np.inf
    draws = rng.choice(there, (DRAWS, len(there)))
    falls = 100 * (1 - np.sqrt(b[draws].sum(axis=1) / np.maximum(a[draws].sum(axis=1), 1e-30)))
    low, high = np.percentile(falls, [2.5, 97.5])
    return float(low), float(high)


def _build_model(data: LoopData, fit: LoopFit, seed: int) -> Model:
    values = data.unknowns.with_values(fit.x)
    law = replace(data.law.with_values(**{key: values[key] for key in SERVO_ENTRIES}), estimated=frozenset())
    theta = data.space.at(fit.x[data.unknowns.n - data.space.n_unknowns :])
    bodies, _ = list_body_rows(data, fit, theta, seed)
    return replace(
        fill_model(data, values, theta, list_joint_rows(data, fit, values), bodies), controller=law.to_dict()
    )
