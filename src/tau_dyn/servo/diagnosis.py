"""What a servo loop's simulation misses, and why: causes that act in the loop, tested on positions.

    logs -> baseline -> every cause, refitted -> the best at each joint, in turn -> confirmed -> gain

Every cause is fitted at all joints at once, with everything that the baseline fits, because a joint's loop feels its own
numbers alone. Its score is its number over that number's error from the scatter of blocks of time. A cause is confirmed
where held-out positions move with the effect that it predicts, and its gain is measured on data used for nothing else.
Reference: Liang & Zeger 1986 (blocks).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify import Choices, drop_repeated_logs, get_log_list
from tau_dyn.log import Log, Recording
from tau_dyn.message_codes import CodedWarning, format_warnings
from tau_dyn.model import Model
from tau_dyn.results import Z95, Shown
from tau_dyn.robot import Robot
from tau_dyn.servo.by_gain import extend_unknowns, read_kind
from tau_dyn.servo.contact import find_contacts
from tau_dyn.servo.data import LoopData
from tau_dyn.servo.doubts import list_loop_warnings
from tau_dyn.servo.fit import LoopFit, LoopProblem, LoopUnknowns, fit_loop, get_unit
from tau_dyn.servo.identification import (
    build_start,
    fill_model,
    guess_law,
    prepare_loop,
    refuse_stillness,
    require_in_memory,
    split_choices,
)
from tau_dyn.servo.records import LoopRecord, build_records, build_waves, compute_load_waves
from tau_dyn.simulate import SERVO_ENTRIES, ServoLaw


class LoopCause(NamedTuple):
    """A cause in the loop: the law's entry that it changes, its equation, and what reveals it."""

    entry: str
    equation: str
    reveals: str
    twins: tuple[str, ...] = ()


LOOP_CAUSES = {
    "gain_error": LoopCause(
        "position_gain",
        "u = position_gain e",
        "a weighed mass, or gravity at several positions",
        ("drive_gain", "link_mass"),
    ),
    "dead_band": LoopCause("dead_band", "e less dead_band", "slow sweeps of small amplitude", ("stiction",)),
    "supply_sag": LoopCause(
        "supply_sag", "u (1 - supply_sag |u|)", "large steps and small ones at one load", ("drive_law",)
    ),
    "drive_law": LoopCause(
        "drive_exponent", "tau ~ |x|^drive_exponent", "large steps and small ones at one load", ("supply_sag",)
    ),
    "back_emf": LoopCause(
        "back_emf", "x = u - back_emf v", "steps that saturate the servo, or phases with the motor off"
    ),
    "command_delay": LoopCause(
        "command_delay", "goal(t) = command(t - command_delay)", "steps and fast sweeps", ("delay",)
    ),
    "stiction": LoopCause(
        "stiction", "friction + stiction exp(-|v| / stiction_speed)", "slow sweeps through rest", ("dead_band",)
    ),
    "load_friction": LoopCause("load_friction", "friction + load_friction |tau|", "slow motion at several loads"),
}
"""Causes that act in a servo's loop."""
BASELINE = ("armature", "coulomb", "viscous", "offset")
"""What the simulation has already, and is refitted."""
MIN_SCORE = 5.0
"""Score from which a cause is taken in: one false one in 1,000 candidates where some 60 blocks count."""
CONFIRMED = 2.6
"""Score on held-out data from which an effect is confirmed: one in 200 by chance."""
MIN_CHANGE = 0.05
"""Change of a number that the law gives, from which it is a cause: masses are trusted to 2 %, so a gain to twice that."""
MIN_SHARE = 0.03
"""Share of a joint's residual variance that a cause takes off at least; less changes no simulation."""
TWIN_SHARE = 0.95
"""Share of what the best cause takes off from which another one is indistinguishable from it here."""
MAX_ROUNDS = 4  # causes at one joint; each takes off at least 3 %
_ITERATIONS, _TRY_ITERATIONS = 8, 5  # from a solution of all but the new numbers
_FIRST = {"command_delay": 0.01, "stiction": 3e-3, "dead_band": 0.006, "load_friction": 0.15, "supply_sag": 0.15,
          "drive_exponent": -0.1}  # fmt: skip
"""First values of causes off their null, stiction as a share of the loop's stiffness."""
BLOCK_S = 4.0  # of the split into training, confirmation and gain
DRAWS = 400
"""Bootstrap draws of blocks for the gain's interval."""


@dataclass(frozen=True, eq=False)
class LoopFinding:
    """One cause at one joint.

    Attributes:
        cause: Its name.
        joint: The joint.
        status: `confirmed` or `suspected`.
        score: Its number in standard errors.
        p_value: Of the confirmation.
        value: Its number [unit].
        stderr: Its standard error.
        unit: Its unit.
        before: rms of the joint's held-out residual without it [rad].
        after: With it [rad].
        interval: 95 % interval of the reduction [%].
        twins: Causes that explain the same here.
    """

    cause: str
    joint: str
    status: str
    score: float
    p_value: float
    value: float
    stderr: float
    unit: str
    before: float
    after: float
    interval: tuple[float, float]
    twins: tuple[str, ...]

    @property
    def reduction(self) -> float:
        """Fall of the held-out rms [%]."""
        return 100 * (1 - self.after / self.before) if self.before > 0 else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's form."""
        row = {"name": f"{self.joint}.{LOOP_CAUSES[self.cause].entry}", "value": self.value, "unit": self.unit}
        wide = Z95 * self.stderr
        return {
            "cause": self.cause, "joints": [self.joint], "status": self.status, "score": self.score, "p_value": self.p_value,
            "parameters": [row | {"stderr": self.stderr, "ci95": [self.value - wide, self.value + wide]}],
            "gain": {"rms_before": self.before, "rms_after": self.after, "reduction_percent": self.reduction,
                     "ci95": list(self.interval)},
            "indistinguishable_from": list(self.twins), "equation": LOOP_CAUSES[self.cause].equation,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class LoopDiagnosis(Shown):
    """What the simulated loops miss, and why.

    Attributes:
        verdict: `named`, `nothing_found` or `cannot_tell`.
        findings: Causes, strongest first.
        joints: Actuated joints.
        baseline: Held-out rms of the baseline (na,) [rad].
        extended: Held-out rms of the extended model (na,) [rad].
        interval: 95 % interval of the fall of the held-out rms of all joints [%].
        untestable: Causes that these logs cannot tell: cause, why, experiment.
        extended_model: The model with its law.
        warnings: What is doubtful.
        seed: Seed of the bootstrap.
    """

    verdict: str
    findings: tuple[LoopFinding, ...]
    joints: tuple[str, ...]
    baseline: np.ndarray
    extended: np.ndarray
    interval: tuple[float, float]
    untestable: tuple[dict[str, str], ...]
    extended_model: Model
    warnings: tuple[str, ...]
    seed: int

    @property
    def exit_status(self) -> int:
        """3 where the data cannot tell, else 0."""
        return CannotAnswer.exit_status if self.verdict == "cannot_tell" else 0

    @property
    def recommendation(self) -> str:
        """`extended` where held-out positions are better with the causes, else `refitted`."""
        return "extended" if self.interval[0] > 0 and self.findings else "refitted"

    def to_dict(self) -> dict[str, Any]:
        """Return the contract's JSON result."""

        def rows(rms: np.ndarray) -> dict[str, Any]:
            return {"rms_per_joint": dict(zip(self.joints, map(float, rms), strict=True))}

        return {
            "status": "cannot_answer" if self.verdict == "cannot_tell" else "ok",
            "seed": self.seed, **format_warnings(self.warnings), "measured": "position", "verdict": self.verdict,
            "baseline": rows(self.baseline), "extended": rows(self.extended), "noise_floor": None,
            "waterfall": [{"step": step, **rows(rms), "ci95": None}
                          for step, rms in (("refitted", self.baseline), ("extended", self.extended))],
            "findings": [f.to_dict() for f in self.findings], "untestable": list(self.untestable),
            "gain_percent_ci95": list(self.interval), "recommendation": self.recommendation,
            "recommendation_why": "the fall of the held-out position error "
            + ("is above zero with its interval" if self.recommendation == "extended" else "is not beyond its uncertainty"),
            "unexplained": [], "detection_limits": {}, "controller": dict(self.extended_model.controller),
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Parts:
    """Masks (N, S) of what serves for the search, the confirmation and the gain, in records of their own."""

    train: Sequence[LoopRecord]
    confirm: Sequence[LoopRecord]
    gain: Sequence[LoopRecord]
    same_logs: bool


def diagnose_loop(
    robot: Robot,
    logs: Log | Recording | Iterable[Log | Recording],
    *,
    law: ServoLaw | None = None,
    holdout: Log | Recording | Iterable[Log | Recording] = (),
    model: str | Path | Model = "asymmetric",
    choices: Choices | None = None,
    exclude: tuple[str, ...] = (),
    seed: int = 0,
    progress: Callable[[str], None] = lambda step: None,
) -> LoopDiagnosis:
    """Say what servo loops' simulation misses, from logs of commands and positions; see `identify_loop` for the arguments."""
    train, held, doubled = drop_repeated_logs(get_log_list(logs), get_log_list(holdout))
    train, held = require_in_memory(train), require_in_memory(held)
    friction = model if isinstance(model, str) else ""
    law = law or guess_law(robot)
    own, theirs = split_choices(choices or Choices(), robot)
    started = theirs.apply(build_start(robot, friction))
    contacts, records = find_contacts(started, build_records(started, law, [*train, *held], exclude))
    refuse_stillness(records[: len(train)])
    parts = _split(records[: len(train)], records[len(train) :])
    data = prepare_loop(started, law, parts.train, own, friction, progress)
    data = replace(data, unknowns=_drop_kinds(data))
    progress("baseline")
    base = fit_loop(data.build_problem(), progress)
    first, fit, scores, untestable = _search(data, base, progress)
    others = _list_other_loads(data, parts)
    progress("confirmation and gain")
    findings = _confirm(data, base, first, fit, scores, parts, others, seed)
    before, after, interval = _measure_gain(data, base, first, fit, parts, others, seed)
    warnings = [*doubled, *(CodedWarning("contact", c.describe()) for c in contacts)]
    warnings += list_loop_warnings(
        law, parts.train, [] if parts.same_logs else parts.confirm, [*train, *held], data, base
    )
    confirmed = [f for f in findings if f.status == "confirmed"]
    verdict = (
        "named" if confirmed else "cannot_tell" if findings and all(f.twins for f in findings) else "nothing_found"
    )
    return LoopDiagnosis(
        verdict, tuple(sorted(findings, key=lambda f: -f.score)), law.joints, before, after, interval, tuple(untestable),
        _build_model(replace(data, unknowns=first), fit), tuple(dict.fromkeys(warnings)), seed,
    )  # fmt: skip


def _drop_kinds(data: LoopData):  # noqa: ANN202
    """Return the unknowns of the baseline: none that is a candidate cause, unless the law asks for its estimate."""
    u, kept = data.unknowns, (*BASELINE, *data.law.estimated)
    rows = [k for k, kind in enumerate(u.kinds) if kind in kept]
    values = {key: np.array(value) for key, value in u.values.items()}
    for kind in u.kinds:
        if kind not in kept:
            values[kind] = np.array(data.law.values[kind])
    return replace(
        u, values=values, kinds=tuple(u.kinds[k] for k in rows), free=u.free[rows], lower=u.lower[rows], upper=u.upper[rows],
        prior=u.prior[rows],
    )  # fmt: skip


def _split(train: Sequence[LoopRecord], held: Sequence[LoopRecord]) -> _Parts:
    """Return 60 / 20 / 20 by blocks, or the held-out logs by halves of blocks."""

    def mask(records: Sequence[LoopRecord], wanted: set[int], of: int) -> list[LoopRecord]:
        found = []
        for r in records:
            block = (np.arange(len(r.t)) * r.dt / min(BLOCK_S, len(r.t) * r.dt / (2 * of))).astype(int) % of
            found.append(replace(r, used=r.used & np.isin(block, list(wanted))))
        return found

    if held:
        return _Parts(list(train), mask(held, {0}, 2), mask(held, {1}, 2), False)
    return _Parts(mask(train, {0, 1, 3}, 5), mask(train, {2}, 5), mask(train, {4}, 5), True)


def _list_other_loads(data: LoopData, parts: _Parts):  # noqa: ANN202
    return data.loads if parts.same_logs else [compute_load_waves(data.space, *r.motion, r.dt) for r in parts.confirm]


class _Tried(NamedTuple):
    """A cause tried at all joints: how far each number is from its null value in standard errors, and what it takes off (na,)."""

    score: np.ndarray
    share: np.ndarray


def _search(data: LoopData, base: LoopFit, progress: Callable[[str], None]):  # noqa: ANN202
    """Return the extended unknowns, their fit, the scores of what was taken in, and what cannot be told."""
    u, fit, taken = data.unknowns, base, {}
    untestable: list[dict[str, str]] = []
    for turn in range(MAX_ROUNDS):
        tried = {}
        for cause in LOOP_CAUSES:
            progress(f"round {turn + 1}: {cause.replace('_', ' ')}")
            tried[cause] = _try(data, u, fit, cause)
        if turn == 0:
            untestable = [
                {
                    "cause": c,
                    "why": "masses and friction of the refit absorb it in these logs",
                    "experiment": LOOP_CAUSES[c].reveals,
                }
                for c, row in tried.items()
                if row is not None
                and np.all(row.score < 1.0)
                and np.all(row.share < MIN_SHARE)
                and c in ("gain_error", "back_emf")
            ]
        chosen = []
        for j in range(len(data.law.joints)):
            rows = {
                c: row
                for c, row in tried.items()
                if row is not None and row.score[j] > MIN_SCORE and row.share[j] > MIN_SHARE
            }
            if not rows:
                continue
            best = max(rows, key=lambda c: rows[c].share[j])
            twins = [c for c in rows if c != best and rows[c].share[j] > TWIN_SHARE * rows[best].share[j]]
            chosen.append((best, j))
            taken[best, j] = (float(rows[best].score[j]), tuple(twins))
        if not chosen:
            break
        u = _free(data, u, fit, chosen)
        fit = fit_loop(data.build_problem(u), progress, _ITERATIONS, fit.step)
    return u, fit, taken, untestable


def _try(data: LoopData, u: LoopUnknowns, fit: LoopFit, cause: str) -> _Tried | None:
    """Return what a cause does at all joints that do not have it yet, refitted with everything else; None where none is left."""
    entry, na = LOOP_CAUSES[cause].entry, len(data.law.joints)
    there = u.free[u.kinds.index(entry)] if entry in u.kinds else np.zeros(na, bool)
    if there.all():
        return None
    wide = _free(data, u, fit, [(cause, int(j)) for j in np.flatnonzero(~there)])
    found = fit_loop(data.build_problem(wide), max_iterations=_TRY_ITERATIONS, step=fit.step)
    value, sigma = read_kind(wide, found, entry)
    away = np.abs(value - data.law.values[entry])
    away = np.where(away < MIN_CHANGE * np.abs(data.law.values[entry]), 0.0, away)
    score = np.divide(away, sigma, out=np.zeros(na), where=(sigma > 0) & ~there)
    return _Tried(score, np.where(there, 0.0, 1 - (found.sigma / fit.sigma) ** 2))


def _regress_on(effect: np.ndarray, residual: np.ndarray, blocks: np.ndarray) -> tuple[float, float]:
    """Return how much of an effect (M,) a residual (M,) holds, and that over its error, which coloured residuals do not lower."""
    power = float(effect @ effect)
    if power <= 0:
        return 0.0, 0.0
    share = float(effect @ residual) / power
    spread = float(np.sqrt((np.bincount(blocks, weights=effect * (residual - share * effect)) ** 2).sum()))
    return share, share * power / spread if spread > 0 else 0.0


def _free(data: LoopData, u, fit: LoopFit, chosen: Sequence[tuple[str, int]]):  # noqa: ANN001, ANN202
    """Return the unknowns at a solution with causes free at their joints."""
    entries = list(dict.fromkeys(LOOP_CAUSES[cause].entry for cause, _ in chosen))
    wide = extend_unknowns(u, fit.x, entries, data)
    free, n = np.array(wide.free), len(u.kinds)
    free[n:] = False
    values = {key: np.array(value) for key, value in wide.values.items()}
    stiff = values["position_gain"] * values["force_per_unit"]
    for cause, j in chosen:
        entry = LOOP_CAUSES[cause].entry
        free[wide.kinds.index(entry), j] = True
        if values[entry][j] == data.law.values[entry][j]:  # off its null value, where friction that holds has no slope
            values[entry][j] += _FIRST.get(entry, 0.0) * (stiff[j] if entry == "stiction" else 1.0)
    free[:n] |= u.free
    return replace(wide, free=free, values=values)


def _predict_linear(data: LoopData, u, x: np.ndarray, step: float, records, loads):  # noqa: ANN001, ANN202
    """Return residuals (N, na, S) and blocks (N, S) of records at a solution, loads along the measured motion."""
    problem = LoopProblem(u, build_waves(data.space, records, loads, data.law), records).with_step(step)
    return problem.residuals(x[:, None])[:, :, 0], problem.blocks, problem.used


def _confirm(data, base, u, fit, scores, parts, loads, seed) -> list[LoopFinding]:  # noqa: ANN001
    """Return the causes taken in, each confirmed or suspected by what it predicts on data that the search did not see."""
    findings = []
    where = np.full(u.free.shape, -1)
    where[u.free] = np.arange(int(u.free.sum()))
    sigma = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    for (cause, j), (score, twins) in scores.items():
        kind = LOOP_CAUSES[cause].entry
        at = int(where[u.kinds.index(kind), j])
        without = np.array(fit.x)
        without[at] = data.law.values[kind][j]
        pair = [
            [_predict_linear(data, u, x, fit.step, records, loads) for x in (without, fit.x)]
            for records in (parts.confirm, parts.gain)
        ]
        (r0, blocks, used), (r1, _, _) = pair[0]
        d = (r0 - r1)[:, j].reshape(-1)
        share, t = _regress_on(d, r0[:, j].reshape(-1), blocks.reshape(-1))
        (g0, blocks, used), (g1, _, _) = pair[1]
        count = max(int(used.sum()), 1)
        before, after = (float(np.sqrt((g[:, j] ** 2).sum() / count)) for g in (g0, g1))
        interval = _bootstrap(g0[:, j], g1[:, j], blocks, seed)
        ok = t > CONFIRMED and 0.3 < share < 3.0 and interval[0] > 0
        findings.append(
            LoopFinding(
                cause, data.law.joints[j], "confirmed" if ok else "suspected", score, float(norm.sf(t)),
                float(u.with_values(fit.x)[kind][j]), float(sigma[at]), get_unit(kind), before, after, interval, twins,
            )
        )  # fmt: skip
    return findings


def _measure_gain(data, base, u, fit, parts, loads, seed):  # noqa: ANN001, ANN202
    """Return the held-out rms (na,) of baseline and extended model, and the interval of the fall over all joints [%]."""
    r0, blocks, used = _predict_linear(data, data.unknowns, base.x, base.step, parts.gain, loads)
    r1, _, _ = _predict_linear(data, u, fit.x, fit.step, parts.gain, loads)
    count = max(int(used.sum()), 1)
    before, after = (np.sqrt((r**2).sum(axis=(0, 2)) / count) for r in (r0, r1))
    scale = np.maximum(before, 1e-9)[None, :, None]
    one, other = (np.sqrt(((r / scale) ** 2).sum(axis=1)) for r in (r0, r1))
    return before, after, _bootstrap(one, other, blocks, seed)


def _bootstrap(before: np.ndarray, after: np.ndarray, blocks: np.ndarray, seed: int) -> tuple[float, float]:
    """Return the 95 % interval of the fall of the rms [%] over draws of blocks; residuals and blocks (N, S)."""
    rng, flat = np.random.default_rng(seed), blocks.reshape(-1)
    a, b = (np.bincount(flat, weights=(r**2).reshape(-1)) for r in (before, after))
    there = np.flatnonzero((a > 0) | (b > 0))
    if len(there) < 3:
        return -np.inf, np.inf
    draws = rng.choice(there, (DRAWS, len(there)))
    falls = 100 * (1 - np.sqrt(b[draws].sum(axis=1) / np.maximum(a[draws].sum(axis=1), 1e-30)))
    low, high = np.percentile(falls, [2.5, 97.5])
    return float(low), float(high)


def _build_model(data: LoopData, fit: LoopFit) -> Model:
    values = data.unknowns.with_values(fit.x)
    law = replace(data.law.with_values(**{key: values[key] for key in SERVO_ENTRIES}), estimated=frozenset())
    theta = data.space.at(fit.x[data.unknowns.n - data.space.n_unknowns :])
    return replace(fill_model(data, values, theta, (), ()), controller=law.to_dict())
