"""Search for causes in the loop, tested one by one and added joint by joint: the entries of the law that explain the residual.

Every cause is fitted at all joints at once, together with all causes already added, because a joint's loop depends on its own
parameters alone. Its score is its value divided by the value's standard error from the scatter of blocks of time. The best one
at each joint is added, in rounds: first where it explains most, then at the joints that waited, which try their best ones again.
Causes that a later one makes superfluous are removed.
Reference: Liang & Zeger 1986 (blocks); Efroymson 1960 (forward and backward selection).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tau_dyn.effects import LOOP_CAUSES
from tau_dyn.servo.by_gain import DELAYS, SPRING, TRY_ITERATIONS, free_causes, list_starts, read_kind, start_best
from tau_dyn.servo.data import LoopData, fit_precisely, refit_again
from tau_dyn.servo.fit import LoopFit, count_worth, fit_loop
from tau_dyn.servo.unknowns import LIMITS, LoopUnknowns, measure_change

MIN_SCORE = 5.0
"""Score from which a cause is added: one false cause in 1,000 candidates with about 60 blocks."""
MIN_CHANGE = 0.05
"""Relative change of a value of the law from which it is a cause: masses are trusted to 2 %, so a gain to twice that."""
MIN_SHARE = 0.03
"""Least share of a joint's residual variance that a cause explains; less does not change a simulation."""
TWIN_SHARE = 0.95
"""Share of the best cause's reduction of the residual from which another cause is indistinguishable from it here."""
APART = 9.0
"""Twice the log-likelihood ratio from which two causes are distinguished: three standard errors."""
MAX_ROUNDS = 4  # causes at one joint; each explains at least 3 %
RIVAL_SHARE = 0.8
"""Share of the best cause's reduction of the residual, or of the least significant one, from which another cause may be the
best."""
TOGETHER = 0.5
"""Share of the best cause's reduction of its joint's residual from which other joints' causes are added with it. The rest wait,
as the model error of a joint disturbs its neighbours."""
FINALISTS = 2  # starts of a joint from which a search goes on
FIRST_ITERATIONS = 2  # with which they are chosen
WHITE_LAGS = 20  # samples over which residuals are compared
_CHANCE = 4.0  # standard errors of an autocorrelation
MAIN_SHARE = 0.5
"""Share of a joint's residual variance from which a cause is kept even if its value is uncertain: on a ridge with others, such
as gain and mass, or far from its limit, a value changes without effect on the simulation."""
POWER_Z = 1.645
"""Standard errors above the threshold at which a value is found in 95 of 100 logs."""


@dataclass(frozen=True, eq=False)
class TriedCause:
    """A cause tried at all joints.

    Attributes:
        score: Distance of each value from its null in standard errors (na,); zero where the cause is already added.
        share: Share of the residual variance that it explains (na,).
        start: Start values of the best search of each joint, by entry (na,).
    """

    score: np.ndarray
    share: np.ndarray
    start: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class LoopSearch:
    """The end of a search.

    Attributes:
        unknowns: Unknowns of the extended model.
        fit: Their fit.
        taken: Cause and joint -> score, and indistinguishable causes.
    """

    unknowns: LoopUnknowns
    fit: LoopFit
    taken: Mapping[tuple[str, int], tuple[float, tuple[str, ...]]]


def search_causes(data: LoopData, base: LoopFit, progress: Callable[[str], None]) -> LoopSearch:
    """Return the model extended by the causes that explain the residual of a baseline's fit."""
    u, fit = data.unknowns, base
    taken: dict[tuple[str, int], tuple[float, tuple[str, ...]]] = {}
    refused: set[tuple[str, int]] = set()
    waiting: dict[
        int, list[str]
    ] = {}  # joints whose cause waits for that of another joint, and the causes that it may be
    tried: dict[str, TriedCause] = {}
    restarted, turn = False, 0
    while waiting or turn < MAX_ROUNDS:
        coarse, data = data, data.with_fine_steps(fit)
        if data is not coarse:
            fit = fit_loop(data.build_problem(u).with_finer_differences(), progress, first=fit.x)
        coloured = _find_coloured(data, u, fit)
        if not coloured.any():
            break
        turn += not waiting
        joints = [j for j in np.flatnonzero(coloured).tolist() if j in waiting or not waiting]
        tell = partial(_tell, progress, turn)
        if waiting:
            again = [c for c in tried if any(c in waiting[j] for j in joints)]
            tried = _try_again(data, u, fit, {c: tried[c] for c in again}, tell)
        else:
            tried = _try_all(data, u, fit, joints, tell)
        best: dict[int, dict[str, float]] = {}  # joints -> causes and their shares
        for j in joints:
            shares = {
                c: float(row.share[j])
                for c, row in tried.items()
                if row.share[j] > (MIN_SHARE if row.score[j] > MIN_SCORE else MAIN_SHARE) and (c, j) not in refused
            }
            if shares:
                best[j] = dict(sorted(shares.items(), key=lambda one: -one[1]))
        if not best and waiting:
            waiting = {}
            continue
        if not best:
            better = None if restarted else _restart_springs(data, u, fit, taken, progress)
            if better is None:
                break
            restarted = True
            u, fit, _ = _drop_superfluous(data, *better, taken, progress)
            refused.clear()
            continue
        chosen, starts, most = [], {}, max(max(shares.values()) for shares in best.values())
        waiting = {}
        for j, shares in best.items():
            cause, *others = shares
            if shares[cause] < TOGETHER * most:
                waiting[j] = [c for c in shares if shares[c] > RIVAL_SHARE * shares[cause]]
                continue
            chosen.append((cause, j))
            starts[cause] = tried[cause].start
            twins = tuple(c for c in others if shares[c] > TWIN_SHARE * shares[cause])
            taken[cause, j] = (float(tried[cause].score[j]), twins)
        u = free_causes(data, u, fit, chosen, starts)
        fit = fit_precisely(data.build_problem(u), progress)
        u, fit, dropped = _drop_superfluous(data, u, fit, taken, progress)
        refused |= dropped
    return LoopSearch(u, fit, taken)


def check_steps(
    data: LoopData, base: LoopFit, search: LoopSearch, progress: Callable[[str], None]
) -> tuple[LoopFit, LoopSearch]:
    """Return baseline and extended model, fitted again to data with exact loads and steps.

    A cause that compensated an error of loads or steps is superfluous with exact ones.
    """
    u, again, taken = search.unknowns, search.fit, dict(search.taken)
    if not taken:
        fine = _refit_baseline(data, base, search, progress)
        return fine, replace(search, unknowns=data.unknowns, fit=fine)
    if not replace(data, unknowns=u).is_shaken:  # that fit already uses exact motions
        again = refit_again(data.build_problem(u), search.fit, progress)
    u, again, _ = _drop_superfluous(data, u, again, taken, progress)
    for cause, j in sorted(taken, key=lambda place: taken[place][0]):
        if sum(k == j for _, k in taken) > 1:  # with the others, it may explain less than without them
            found = _take_out(data, u, again, (cause, j), MIN_SHARE, progress)
            if found is not None:
                u, again = found
                del taken[cause, j]
    search = replace(search, unknowns=u, fit=again, taken=taken)
    return _refit_baseline(data, base, search, progress), search


def _refit_baseline(data: LoopData, base: LoopFit, search: LoopSearch, progress: Callable[[str], None]) -> LoopFit:
    """Return the baseline's fit, restarted at its end and at the extended model's without causes: the one of smaller residual.

    A cause's gain is compared with the best fit without it, not with the end of a search that was stuck.
    """
    fine = refit_again(data.build_problem(), base, progress)
    if search.unknowns is data.unknowns:
        return fine
    _, start = _hold_null(data, search.unknowns, search.fit, search.taken)
    other = fit_loop(data.build_problem().with_finer_differences(), progress, first=start.x)
    return min(fine, other, key=lambda fit: float(np.log(fit.sigma).sum()))


def part_twins(data: LoopData, search: LoopSearch, progress: Callable[[str], None]) -> LoopSearch:
    """Return the search with each cause replaced by the best of its indistinguishable alternatives, and the other alternatives.

    Two causes are distinguished if the likelihood ratio of the joint's residual, with the effective number of independent
    samples, exceeds three standard errors.
    """
    for cause, j in list(search.taken):
        score, twins = search.taken[cause, j]
        alike = [c for c in LOOP_CAUSES[cause].mistaken_for if c in LOOP_CAUSES]
        twins = [c for c in dict.fromkeys((*twins, *alike)) if (c, j) not in search.taken]
        if not twins:
            continue
        progress(f"{cause.replace('_', ' ')} or {', '.join(twins).replace('_', ' ')}")
        tried = {cause: (search.unknowns, search.fit)}
        left, without = _hold_null(data, search.unknowns, search.fit, [(cause, j)])
        clear = max(-np.log1p(-MIN_SHARE), 2 * APART / _count_independent(data, search.unknowns, search.fit, j))
        most = search.fit.sigma[j] * np.exp(clear / 2)
        for twin in twins:
            wide = start_best(data, left, without, {twin: list_starts(data, left, without, twin)}, [j])
            problem = data.build_problem(wide)
            tried[twin] = wide, fit_precisely(problem, progress, lambda near, j=j, most=most: near.sigma[j] > most)
        best = min(tried, key=lambda c: tried[c][1].sigma[j])
        u, fit = tried[best]
        count = _count_independent(data, u, fit, j)
        ratio = {c: count * 2 * np.log(one.sigma[j] / fit.sigma[j]) for c, (_, one) in tried.items()}
        same = tuple(c for c in tried if c != best and ratio[c] < APART)
        first = next(c for c in LOOP_CAUSES if c == best or c in same)  # the table begins with the most frequent causes
        best, same, (u, fit) = first, tuple(c for c in (best, *same) if c != first), tried[first]
        taken = {key: value for key, value in search.taken.items() if key != (cause, j)}
        search = LoopSearch(u, fit, {**taken, (best, j): (score, same)})
    return search


def _count_independent(data: LoopData, u: LoopUnknowns, fit: LoopFit, j: int) -> float:
    """Return the effective number of independent samples of a joint's residual."""
    problem = data.build_problem(u)
    return problem.count / count_worth(problem.residuals(fit.x[:, None])[:, j, 0], problem.used)


def _take_out(
    data: LoopData,
    u: LoopUnknowns,
    fit: LoopFit,
    place: tuple[str, int],
    least: float,
    progress: Callable[[str], None],
) -> tuple[LoopUnknowns, LoopFit] | None:
    """Return unknowns and fit without a cause at a joint; None if it explains more than a share of the variance there."""
    cause, j = place
    progress(f"without {cause.replace('_', ' ')}")
    left, _ = _hold_null(data, u, fit, [place])

    def is_missed(without: LoopFit) -> bool:
        return 1 - (fit.sigma[j] / without.sigma[j]) ** 2 >= least

    without = fit_precisely(data.build_problem(left), progress, is_missed)
    return None if is_missed(without) else (left, without)


def _hold_null(
    data: LoopData, u: LoopUnknowns, fit: LoopFit, places: Iterable[tuple[str, int]]
) -> tuple[LoopUnknowns, LoopFit]:
    """Return unknowns and vector of a solution, with causes at some joints fixed at their null."""
    values, free = {key: np.array(x) for key, x in u.with_values(fit.x).items()}, np.array(u.free)
    for cause, j in places:
        row = LOOP_CAUSES[cause]
        for entry in (*row.entries, *row.forms):
            values[entry][j] = data.law.values[entry][j]
        for entry in row.entries:
            free[u.kinds.index(entry), j] = False
    left = replace(u, values=values, free=free)
    x = left.pack()
    x[left.n - data.space.n_unknowns :] = fit.x[u.n - data.space.n_unknowns :]
    return left, replace(fit, x=x)


def _restart_springs(
    data: LoopData,
    u: LoopUnknowns,
    fit: LoopFit,
    taken: dict[tuple[str, int], tuple[float, tuple[str, ...]]],
    progress: Callable[[str], None],
) -> tuple[LoopUnknowns, LoopFit] | None:
    """Return a better solution for joints with a coloured residual in spite of their spring, or None; `taken` is changed.

    A late torque excites a spring, so that neither is found without the other.
    """
    coloured = _find_coloured(data, u, fit)
    joints = [j for cause, j in taken if cause == SPRING and coloured[j]]
    if not joints:
        return None
    left, without = _hold_null(data, u, fit, [place for place in taken if place[1] in joints])
    found = []
    for late in ("command_delay", "delay"):
        progress(f"a spring and a {late.replace('_', ' ')}")
        (entry,) = LOOP_CAUSES[late].entries
        delays = [{entry: data.law.values[entry] + x} for x in DELAYS]
        starts = {SPRING: list_starts(data, left, without, SPRING), late: delays}
        wide = start_best(data, left, without, starts, joints)
        found.append((late, wide, fit_precisely(data.build_problem(wide), progress)))
    late, wide, again = min(found, key=lambda one: float(np.log(one[2].sigma[joints]).sum()))
    if not np.all(again.sigma[joints] < np.sqrt(1 - MIN_SHARE) * fit.sigma[joints]):
        return None
    for place in [place for place in taken if place[1] in joints]:
        del taken[place]
    taken.update({(cause, j): (0.0, ()) for cause in (SPRING, late) for j in joints})
    return wide, again


def _find_coloured(data: LoopData, u: LoopUnknowns, fit: LoopFit) -> np.ndarray:
    """Return the joints (na,) whose residuals are autocorrelated by at least the share that a cause explains.

    The effect of a cause is smooth or oscillates, so that a white residual contains no cause.
    """
    problem = data.build_problem(u)
    r = problem.residuals(fit.x[:, None])[:, :, 0]
    power = (r**2).sum(axis=(0, 2))
    alike = [np.abs((r[lag:] * r[:-lag]).sum(axis=(0, 2))) / power for lag in range(1, WHITE_LAGS + 1)]
    return np.max(alike, axis=0) > compute_share_wanted(problem.count)


def compute_share_wanted(samples: int) -> float:
    """Return the share of a joint's residual variance from which causes are searched; in short logs chance explains as much."""
    return min(max(MIN_SHARE, _CHANCE / np.sqrt(samples)), 0.5)


def _tell(progress: Callable[[str], None], turn: int, step: str) -> None:
    progress(f"round {turn}: {step.replace('_', ' ')}")


def _try_again(
    data: LoopData,
    u: LoopUnknowns,
    fit: LoopFit,
    tried: Mapping[str, TriedCause],
    progress: Callable[[str], None],
) -> dict[str, TriedCause]:
    """Return the results of causes from their best starts, with all sensitivities simulated."""
    found = dict(tried)
    for cause, row in tried.items():
        progress(f"{cause} again")
        found[cause] = _try(data, u, fit, cause, [row.start]) or row
    return found


def _try_all(
    data: LoopData,
    u: LoopUnknowns,
    fit: LoopFit,
    joints: Sequence[int],
    progress: Callable[[str], None],
) -> dict[str, TriedCause]:
    """Return the results of all causes; those that may be added at a joint are repeated with all sensitivities simulated."""
    kept = data.build_problem(u).keep_inertial(fit.x)
    tried = {}
    for cause in LOOP_CAUSES:
        progress(cause)
        row = _try(data, u, fit, cause, list_starts(data, u, fit, cause), kept)
        if row is not None:
            tried[cause] = row
    if kept is None or not tried:
        return tried
    most = np.max([row.share for row in tried.values()], axis=0)
    least = RIVAL_SHARE * max(MIN_SHARE, TOGETHER * most[list(joints)].max())
    first = [j for j in joints if most[j] > least]
    again = {cause: row for cause, row in tried.items() if np.any(row.share[first] > RIVAL_SHARE * most[first])}
    return tried | _try_again(data, u, fit, again, progress)


def _try(
    data: LoopData,
    u: LoopUnknowns,
    fit: LoopFit,
    cause: str,
    starts: list[dict[str, np.ndarray]],
    kept: list[np.ndarray] | None = None,
) -> TriedCause | None:
    """Return the result of a cause at all joints without it, refitted with everything else; None if all joints have it."""
    entry, na = LOOP_CAUSES[cause].entries[0], len(data.law.joints)
    there = u.free[u.kinds.index(entry)] if entry in u.kinds else np.zeros(na, bool)
    if there.all():
        return None
    places = [(cause, int(j)) for j in np.flatnonzero(~there)]

    def search(start: dict[str, np.ndarray], iterations: int) -> tuple[LoopUnknowns, LoopFit]:
        wide = free_causes(data, u, fit, places, {cause: start})
        return wide, fit_loop(data.build_problem(wide).with_inertial(kept), max_iterations=iterations)

    def combine(chosen: np.ndarray) -> dict[str, np.ndarray]:
        """Return the chosen start (na,) of each joint."""
        return {key: np.array([starts[k][key][j] for j, k in enumerate(chosen)]) for key in starts[0]}

    if len(starts) > FINALISTS:
        order = np.argsort([search(start, FIRST_ITERATIONS)[1].sigma for start in starts], axis=0)
        starts = [combine(row) for row in order[:FINALISTS]]
    found = [search(start, TRY_ITERATIONS) for start in starts]
    best = np.argmin([one.sigma for _, one in found], axis=0)
    start = combine(best)
    score, share = np.zeros((2, na))
    for k, (wide, one) in enumerate(found):
        value, sigma = read_kind(wide, one, entry)
        away, sigma = measure_change(entry, value, data.law.values[entry], sigma)
        away = np.where(away < _get_least_change(entry, data.law.values[entry]), 0.0, away)
        mine = (best == k) & ~there
        score[mine] = np.divide(away, sigma, out=np.zeros(na), where=sigma > 0)[mine]
        share[mine] = (1 - (one.sigma / fit.sigma) ** 2)[mine]
    return TriedCause(score, share, start)


def _drop_superfluous(
    data: LoopData,
    u: LoopUnknowns,
    fit: LoopFit,
    taken: dict[tuple[str, int], tuple[float, tuple[str, ...]]],
    progress: Callable[[str], None],
) -> tuple[LoopUnknowns, LoopFit, set[tuple[str, int]]]:
    """Remove from `taken` the causes that do not differ significantly from their null values, and refit without them."""
    dropped: set[tuple[str, int]] = set()
    needed: set[tuple[str, int]] = set()
    while True:
        weak = []
        for (cause, j), (_, twins) in taken.items():
            entry = LOOP_CAUSES[cause].entries[0]
            value, sigma = read_kind(u, fit, entry)
            away, error = (float(x[j]) for x in measure_change(entry, value, data.law.values[entry], sigma))
            score = away / error if error > 0 else 0.0
            taken[cause, j] = (score, twins)
            least = _get_least_change(entry, data.law.values[entry])[j]
            if (cause, j) not in needed and (score < MIN_SCORE or away < least):
                weak.append((score, cause, j))
        if not weak:
            return u, fit, dropped
        _, cause, j = min(weak)
        found = _take_out(data, u, fit, (cause, j), MAIN_SHARE, progress)
        if found is None:
            needed.add((cause, j))
        else:
            u, fit = found
            del taken[cause, j]
            dropped.add((cause, j))


def _get_least_change(entry: str, null: np.ndarray) -> np.ndarray:
    """Return the change (na,) of a value of the law from which it is a cause; for limits, that of their inverses."""
    return MIN_CHANGE * np.abs(1 / null if entry in LIMITS else null)


def compute_limits(data: LoopData, base: LoopFit, cause: str, kept: list[np.ndarray] | None = None) -> np.ndarray:
    """Return the value (na,) that a cause must have at each joint to be found; infinite where these logs cannot show it.

    The value is its standard error next to the baseline's unknowns, from the sensitivities at its smallest start and residuals
    as coloured as the baseline's, times the threshold plus the margin for a power of 95 %; it also has to be enough to colour
    the residual. A profile's limit is found up to this value, which is zero if it never shows.

    Args:
        data: The logs.
        base: The baseline's fit.
        cause: The cause.
        kept: Sensitivities to inertial unknowns near the baseline, joint by joint; None to simulate them.
    """
    na = len(data.law.joints)
    start = list_starts(data, data.unknowns, base, cause)[-1 if cause == SPRING else 0]
    entry = LOOP_CAUSES[cause].entries[0]
    wide = free_causes(data, data.unknowns, base, [(cause, j) for j in range(na)], {cause: start})
    problem = data.build_problem(wide).with_inertial(kept)
    x = wide.pack()
    x[wide.n - data.space.n_unknowns :] = base.x[data.unknowns.n - data.space.n_unknowns :]
    _, slopes = problem.differentiate(x)
    residual = data.build_problem().residuals(base.x[:, None])[:, :, 0]
    where = np.full(wide.free.shape, -1)
    where[wide.free] = np.arange(int(wide.free.sum()))
    limits = np.full(na, np.inf)
    for j, (S, mine) in enumerate(zip(slopes.rows, slopes.owners, strict=True)):
        at = int(where[wide.kinds.index(entry), j])
        column = int(np.flatnonzero(mine == at)[0])
        rest, own = np.delete(S, column, axis=0).T, S[column]
        rest = rest[:, np.linalg.norm(rest, axis=0) > 0]
        rest = rest / np.linalg.norm(rest, axis=0)
        size = float(np.linalg.norm(own - rest @ np.linalg.lstsq(rest, own, rcond=1e-8)[0]))
        if size > 1e-6 * float(np.linalg.norm(own)):
            worth = count_worth(residual[:, j], problem.used)
            spread = base.sigma[j] * np.sqrt(worth) / size
            share = compute_share_wanted(problem.count)
            seen = base.sigma[j] * np.sqrt(share / (1 - share) * problem.count) / size
            if entry in LIMITS:  # by the inverse, as they act
                seen, spread = (x / float(x0) ** 2 for x, x0 in ((seen, start[entry][j]), (spread, start[entry][j])))
            least = float(_get_least_change(entry, data.law.values[entry])[j])
            limits[j] = max(least, max(seen, MIN_SCORE * spread) + POWER_Z * spread)
    return 1 / limits if entry in LIMITS else limits
