r"""The scan of candidates: the statistic of every cause on every group of joints with every setting, and its p-value.

The statistic of a cause and group is the `T` of the best setting. The search over settings is calibrated by draws of white
noise put through the same projection: the largest of many correlated `T` is distributed as that of `m` independent ones,
`P(T <= t) = F(t)^m`, and `m` is fitted to the draws (maximum likelihood), so that its tail reaches beyond them. A cause's
p-value takes the better of its best group alone and of all groups together.

`T` is divided by the overdispersion: the variance of the scores of 2 s blocks over their variance under the noise model (White
1980), at least 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy import optimize, stats

from tau_dyn.effects import Effect
from tau_dyn.evidence.channel import Channel
from tau_dyn.evidence.null_model import (
    NullModel,
    WhiteResidual,
    compute_overdispersion,
    compute_score_test,
    count_effective_tests,
)

FAMILY_LEVEL = 0.05
"""Family-wise significance level of causes on the training data; confirmation on other data multiplies it by its own level."""
GROUP_LEVEL = 0.01
"""Significance level at which a further joint is added to a cause."""
MIN_SHARE_OF_STRONGEST = 0.1
"""Share of the strongest group's evidence that a further group needs to be added at once; a weaker one is tested in the next
round, when the strong one is in the model and no part of its effect can leak over."""


@dataclass(frozen=True, eq=False)
class GroupTest:
    """The best setting of one cause on one group of joints.

    Attributes:
        effect: The effect at its best setting.
        statistic: Its score statistic, in units of the noise.
        n_effective_tests: Effective number `m` of independent tests in the search over settings.
        dof: Number of columns.
        overdispersion: Scatter of the blocks over their variance under the noise model, at least 1.
        noise: The statistic of the best setting on each noise draw (D,).
        neighbours: The settings before and after the best one in the grid, if they exist.
    """

    effect: Effect
    statistic: float
    n_effective_tests: float
    dof: int
    one_sided: bool
    overdispersion: float
    noise: np.ndarray
    neighbours: tuple[dict[str, float], ...] = ()

    @property
    def p_value(self) -> float:
        """p-value of `T` on this group under noise alone."""
        return float(-np.expm1(self.n_effective_tests * np.log1p(-self._tail(self.statistic / self.overdispersion))))

    @property
    def threshold(self) -> float:
        """`T` above which the group is added to a cause found elsewhere."""
        wanted = GROUP_LEVEL / self.n_effective_tests * (2 if self.one_sided else 1)
        return float(self.overdispersion * stats.chi2.isf(min(wanted, 1.0), self.dof))

    @property
    def penalised_statistic(self) -> float:
        """`T` minus the cost of choosing amplitudes and settings."""
        return self.statistic / self.overdispersion - 2 * float(np.log(max(self.n_effective_tests, 1.0))) - 2 * self.dof

    def _tail(self, T: float) -> float:
        tail = float(stats.chi2.sf(T, self.dof))
        return min(tail / 2 if self.one_sided else tail, 1 - 1e-16)


@dataclass(frozen=True, eq=False)
class CandidateCause:
    """One cause on the joints at which it is significant.

    Attributes:
        cause: Its name.
        fits: The significant groups, strongest first.
        p_value: p-value of the strongest evidence on clean data, for this cause alone.
        tested: All groups tried.
    """

    cause: str
    fits: tuple[GroupTest, ...]
    p_value: float
    tested: tuple[GroupTest, ...]

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects at their best settings."""
        return tuple(fit.effect for fit in self.fits)

    @property
    def penalised_statistic(self) -> float:
        """The statistic minus the cost of its amplitudes; causes are ranked by it."""
        return sum(fit.penalised_statistic for fit in self.fits)

    def merit_under(self, inflation: float) -> float:
        """Return the penalised statistic with one overdispersion for all groups, so that a law is not chosen for its scatter."""
        return compute_penalised_statistic(self.fits, inflation)

    @property
    def statistic(self) -> float:
        """The score statistic, in units of the noise."""
        return sum(fit.statistic / fit.overdispersion for fit in self.fits)


def compute_penalised_statistic(fits: Sequence[GroupTest], inflation: float) -> float:
    """Return the penalised statistic of several groups under one overdispersion."""
    return sum(replace(fit, overdispersion=inflation).penalised_statistic for fit in fits)


def combine_group_tests(cause: str, fits: list[GroupTest]) -> CandidateCause:
    """Combine a cause's groups: its p-value, and the significant groups."""
    best = max(fits, key=lambda fit: fit.penalised_statistic)
    alone = min(fit.p_value for fit in fits)
    p_alone = float(-np.expm1(len(fits) * np.log1p(-min(alone, 1 - 1e-16))))
    p_value = p_alone
    if len(fits) > 1:
        p_value = min(1.0, 2 * min(p_alone, _together(fits)))
    chosen = [
        fit
        for fit in fits
        if fit is best or fit.statistic > max(fit.threshold, MIN_SHARE_OF_STRONGEST * best.statistic)
    ]
    return CandidateCause(
        cause, tuple(sorted(_disjoint(chosen), key=lambda f: -f.penalised_statistic)), p_value, tuple(fits)
    )


def _disjoint(fits: list[GroupTest]) -> list[GroupTest]:
    """Keep the best of groups that share a joint; one instance for all joints competes with one for each."""
    whole = max(fits, key=lambda fit: len(fit.effect.joints))
    parts = [fit for fit in fits if not set(fit.effect.joints) & set(whole.effect.joints) or fit is whole]
    alone = [fit for fit in fits if len(fit.effect.joints) < len(whole.effect.joints)]
    if (
        alone
        and len(whole.effect.joints) > 2
        and compute_penalised_statistic(alone, whole.overdispersion) > whole.penalised_statistic
    ):
        return _disjoint(alone)
    kept: list[GroupTest] = []
    for fit in sorted(parts, key=lambda f: -f.penalised_statistic):
        if not any(set(fit.effect.joints) & set(other.effect.joints) for other in kept):
            kept.append(fit)
    return kept


def _together(fits: list[GroupTest]) -> float:
    """Return the p-value of the sum of the groups' statistics, from a gamma law with the moments of the sum under noise.

    The moments of each group follow from its effective number of tests. Groups on different joints are independent; the
    correlation of groups that share a joint is estimated from the noise draws.
    """
    total = sum(fit.statistic / fit.overdispersion for fit in fits)
    moments = np.array([compute_null_moments(fit.n_effective_tests, fit.dof, fit.one_sided) for fit in fits])
    size = np.sqrt(moments[:, 1])
    mean, variance = float(moments[:, 0].sum()), float(size @ _correlate(fits) @ size)
    if mean <= 0 or variance <= 0:
        return 1.0
    scale = max(variance / mean, 2.0)  # no tail of chi-squares decreases faster than exp(-t / 2)
    return float(stats.gamma.sf(total, mean / scale, scale=scale))


_MOMENT_POINTS = 400
"""Points of the integrals of the null moments: their error is below 1e-4."""


@lru_cache(maxsize=4096)
def compute_null_moments(n_tests: float, dof: int, one_sided: bool) -> tuple[float, float]:
    """Return mean and variance of the largest of `n_tests` independent chi-square statistics.

    With the distribution `F(t)^m` they are `E = int 1 - F^m dt` and `E2 = 2 int t (1 - F^m) dt`. A one-sided statistic is zero
    with probability one half.
    """
    half = 2.0 if one_sided else 1.0
    t = np.linspace(0.0, float(stats.chi2.isf(min(half * 1e-12 / n_tests, 0.5), dof)), _MOMENT_POINTS)
    above = -np.expm1(n_tests * np.log1p(-np.minimum(stats.chi2.sf(t, dof) / half, 1 - 1e-16)))
    mean, square = float(np.trapezoid(above, t)), float(np.trapezoid(2 * t * above, t))
    return mean, max(square - mean**2, 0.0)


def _correlate(fits: list[GroupTest]) -> np.ndarray:
    """Return the correlations (g, g) of the groups' statistics under noise; zero for groups without a common joint."""
    draws = min(len(fit.noise) for fit in fits)
    noise = np.array([fit.noise[:draws] for fit in fits])
    size = noise.std(axis=1)
    unit = (noise - noise.mean(axis=1, keepdims=True)) / np.where(size > 0, size, 1.0)[:, None]
    joints = [set(fit.effect.joints) for fit in fits]
    shared = np.array([[bool(one & other) for other in joints] for one in joints])
    found = np.where(shared, np.clip(unit @ unit.T / max(draws, 1), 0.0, 1.0), 0.0)
    np.fill_diagonal(found, 1.0)
    return found


N_NULL_DRAWS = 60  # draws of noise; their mean and scatter fix the level of a scan over many settings to 13 %
DENSE_DRAWS = 24
"""Draws for a scan of thousands of periods, whose largest value hardly varies."""
_CHUNK = 64  # settings computed at once; bounds memory
_WORTH_MATCHING = 30.0
"""Least statistic of a setting that is fitted before it is chosen; the best by chance is about 20."""
_PROPOSAL_MARGIN = 0.03
"""Share of the best setting's statistic that a proposed one may lack."""
_MATCHES = 12  # evaluations of the search for a setting between two of the grid
_MATCHED = 2e-3
"""Relative accuracy of a setting that agrees with its amplitude: below any standard error."""


def find_nonnegative(effect: Effect) -> np.ndarray:
    """Return the mask of amplitudes that must not be negative (k,)."""
    return np.array([p.lower >= 0 for p in effect.parameters])


def scan_causes(
    null_model: NullModel,
    draws: np.ndarray,
    causes: Sequence[type[Effect]],
    taken: set[tuple],
    progress: Callable[[str], None] = lambda step: None,
) -> list[CandidateCause]:
    """Scan every cause; return those that can be tested.

    Args:
        null_model: The residual with everything that is in the model.
        draws: Noise after the same projection (R, D).
        causes: The causes.
        taken: `(cause, joints)` that are already in the model.
        progress: Called with the progress.
    """
    found = []
    for k, cls in enumerate(causes, start=1):
        progress(f"trying cause {k} of {len(causes)}: {cls.name}")
        tried = [
            fit_group(null_model, draws, cls, group) for group in list_joint_groups(null_model.channel, cls, taken)
        ]
        fits = [fit for fit in tried if fit is not None]
        if fits:
            found.append(combine_group_tests(cls.name, fits))
    return found


def list_joint_groups(channel: Channel, cls: type[Effect], taken: set[tuple]) -> list[tuple[str, ...]]:
    """Return the groups of joints to try."""
    if cls.untestable(channel.scene) is not None:
        return []
    mine = {joint for cause, joints in taken if cause == cls.name for joint in joints}
    groups = cls.groups(channel.scene)  # pairs may share a joint with another pair
    return [group for group in groups if (cls.name, group) not in taken and not set(group) <= mine]


def fit_group(null_model: NullModel, draws: np.ndarray, cls: type[Effect], group: tuple[str, ...]) -> GroupTest | None:
    """Scan one cause's settings on one group of joints; None if there is no setting to try."""
    scene = null_model.channel.scene
    grid = cls.grid(scene, group)
    if not grid:
        return None
    units = [scene.units[scene.index(j)] for j in group]
    plain = cls(group, units)
    effects = [plain.with_settings(**setting) for setting in grid]
    both = np.concatenate([null_model.e[:, None], draws], axis=1)
    if cls.dense:
        return _fit_alike(effects, null_model, both[:, : 1 + DENSE_DRAWS])
    sizes = [len(effect.parameters) for effect in effects]
    alike = [[e for e, size in zip(effects, sizes, strict=True) if size == n] for n in sorted(set(sizes))]
    fits = [_fit_alike(part, null_model, both) for part in alike]
    best = max(fits, key=lambda fit: fit.penalised_statistic)
    return replace(best, n_effective_tests=best.n_effective_tests * len(alike))


def _fit_alike(effects: list[Effect], null_model: NullModel, both: np.ndarray) -> GroupTest:
    """Scan settings with the same number of columns against the residual and the noise draws (R, 1 + D)."""
    sided = find_nonnegative(effects[0])
    explained = compute_explained(effects, null_model, both)
    best = int(np.argmax(explained[:, 0]))
    noise = explained[:, 1:].max(axis=0)
    simple = bool(sided.all()) and len(sided) == 1
    tries = _tries(noise, len(sided), simple)
    near = tuple(dict(effects[k].settings) for k in (best - 1, best + 1) if 0 <= k < len(effects))
    T = float(explained[best, 0])
    fit = GroupTest(effects[best], T, tries, len(sided), simple, 1.0, noise, near)
    fit = rescore_group(fit, null_model) if T > 4 else fit
    return match_settings(fit, null_model) if T > _WORTH_MATCHING else fit


def rescore_group(fit: GroupTest, null_model: NullModel) -> GroupTest:
    """Return a fit with its exact `T` and its overdispersion by blocks."""
    C = null_model.rows(fit.effect)
    T, s, G = compute_score_test(null_model, C, find_nonnegative(fit.effect))
    return replace(fit, statistic=T, overdispersion=compute_fit_overdispersion(null_model, C, s, G))


def match_settings(fit: GroupTest, null_model: NullModel) -> GroupTest:
    """Return a fit whose matched setting equals its amplitude, the best between points of the grid, and its statistic there.

    The constrained misfit `|e - x c(x)|^2` is minimised over `x`, with `c(x)` the column at the setting `x` (Brent 1973,
    without derivatives): the part of a column that the baseline leaves may decrease with its setting's square, so amplitude and
    setting do not agree automatically. A proposal of a fit of the whole baseline that explains as much is better: `e` is
    whitened by a noise model that contains the effect itself.
    """
    effect = fit.effect
    if not effect.matched:
        return fit
    ((key, _),) = effect.matched.items()
    scene = null_model.channel.scene

    def misfit(x: float) -> float:
        if x == 0:
            return 0.0
        c = null_model.rows(effect.with_settings(**{key: x}))
        return float(x**2 * null_model.gram(c)[0, 0] - 2 * x * (c.T @ null_model.e)[0])

    grid = sorted({setting[key] for setting in type(effect).grid(scene, effect.joints)})
    tried = grid if key in effect.positive else sorted({*(-x for x in grid), *grid})
    best = min(tried, key=misfit)
    k = tried.index(best)
    low = tried[k - 1] if k > 0 else best
    high = tried[k + 1] if k + 1 < len(tried) else best
    if low < high:
        options = {"xatol": _MATCHED * abs(best), "maxiter": _MATCHES}
        found = optimize.minimize_scalar(misfit, bounds=(low, high), method="bounded", options=options)
        best = float(found.x) if found.fun < misfit(best) else best
    proposed = type(effect).propose(scene, effect.joints)
    if proposed is not None and misfit(proposed) < (1 - _PROPOSAL_MARGIN) * misfit(best):
        best = proposed
    exact = rescore_group(replace(fit, effect=effect.with_settings(**{key: best})), null_model)
    return replace(exact, statistic=max(0.0, -misfit(best)))


def compute_explained(effects: Sequence[Effect], null_model: NullModel, both: np.ndarray) -> np.ndarray:
    """Return the statistic of each setting for each column of white residuals (R, d): (g, d), by the channel's fast methods."""
    channel = null_model.channel
    scanned = channel.scan(effects, null_model.whiten, both) if effects[0].dense else None
    found = np.full((len(effects), both.shape[1]), np.nan) if scanned is None else scanned
    left = np.flatnonzero(np.isnan(found[:, 0]))
    for start in range(0, len(left), _CHUNK):
        part = [effects[k] for k in left[start : start + _CHUNK]]
        quick = [channel.quick_columns(effect) for effect in part]
        exact = [effect for c, effect in zip(quick, part, strict=True) if c is None]
        exactly = iter(null_model.library.make_together(exact, null_model.whiten.runs))
        made = [next(exactly) if c is None else c for c in quick]
        found[left[start : start + _CHUNK]] = null_model.explained(made, both, find_nonnegative(effects[0]))
    return found


def _tries(noise: np.ndarray, dof: int, simple: bool) -> float:
    """Return the effective number of independent tests; a draw with a negative one-sided amplitude counts as `T <= 0`."""
    tail = stats.chi2.sf(noise, dof) / (2 if simple else 1)
    seen = int(np.sum(noise > 0)) if simple else len(noise)
    return count_effective_tests(np.clip(tail, 1e-12, 0.5 if simple else 1 - 1e-12), seen)


def compute_fit_overdispersion(null_model: WhiteResidual, C: np.ndarray, s: np.ndarray, G: np.ndarray) -> float:
    """Return the overdispersion along the direction that white rows (R, k) with scores `s` and Gram matrix `G` fit."""
    along = null_model.project_out(C @ np.linalg.lstsq(G, s, rcond=1e-9)[0])
    square = float(along @ along)
    e = null_model.e - along * float(along @ null_model.e) / max(square, 1e-300)
    return compute_overdispersion(null_model.whiten.block, along * e, square)
