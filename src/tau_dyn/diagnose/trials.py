r"""Every cause tried on every group of joints with every setting: how much each would explain, and what noise alone would.

For each cause and group the best setting's `T` counts. What the search over settings makes of pure noise is seen from draws of
white noise put through the same projection: the largest of many correlated `T` is distributed as that of `m` independent ones,
`P(T <= t) = F(t)^m`, and `m` is fitted to the draws (maximum likelihood), so that its tail reaches beyond them. A cause's p-value
takes the better of its best group alone and of all groups together.

`T` is divided by an inflation where the residual's scatter over 2 s blocks exceeds what the noise model says (White 1980).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.ground import Ground, gains
from tau_dyn.effects import Effect

DRAWS = 60
DENSE_DRAWS = 24
"""Of a scan of thousands of periods, whose largest value hardly varies."""
_CHUNK = 64
PRIOR_BLOCKS = 10.0
"""Weight of 'the noise model is right' against the scatter of blocks, in blocks."""
GROUP_LEVEL = 0.01
"""Level at which a further joint joins a cause."""


WEAK = 0.1
"""Share of the strongest group's evidence that a further one needs to join at once; a weaker one gets its chance in the next
round, when the strong one is accounted for and nothing of it can leak over."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The best setting of one cause on one group of joints.

    Attributes:
        effect: The effect at its best setting.
        T: What it explains, in units of the noise.
        tries: Number `m` of independent tries that the search over settings amounts to.
        dof: Columns.
        inflation: Scatter of the blocks over what the noise model says, at least 1.
        noise: What the best setting explains of each noise draw (D,).
        neighbours: The settings before and after the best one in the grid, where there are.
    """

    effect: Effect
    T: float
    tries: float
    dof: int
    one_sided: bool
    inflation: float
    noise: np.ndarray
    neighbours: tuple[dict[str, float], ...] = ()

    @property
    def p_value(self) -> float:
        """Chance that noise alone reaches `T` on this group."""
        return float(-np.expm1(self.tries * np.log1p(-self._tail(self.T / self.inflation))))

    @property
    def threshold(self) -> float:
        """`T` above which the group joins a cause found elsewhere."""
        wanted = GROUP_LEVEL / self.tries * (2 if self.one_sided else 1)
        return float(self.inflation * stats.chi2.isf(min(wanted, 1.0), self.dof))

    @property
    def merit(self) -> float:
        """`T` less what choosing amplitudes and settings costs."""
        return self.T / self.inflation - 2 * float(np.log(max(self.tries, 1.0))) - 2 * self.dof

    def _tail(self, T: float) -> float:
        tail = float(stats.chi2.sf(T, self.dof))
        return min(tail / 2 if self.one_sided else tail, 1 - 1e-16)


@dataclass(frozen=True, eq=False)
class Candidate:
    """One cause on the joints that show it.

    Attributes:
        cause: Its name.
        fits: The groups that show it, strongest first.
        p_value: Chance of the strongest evidence on clean data, for this cause alone.
        tested: All groups tried.
    """

    cause: str
    fits: tuple[Fit, ...]
    p_value: float
    tested: tuple[Fit, ...]

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects at their best settings."""
        return tuple(fit.effect for fit in self.fits)

    @property
    def merit(self) -> float:
        """What it explains less the price of its freedom; causes are ranked by it."""
        return sum(fit.merit for fit in self.fits)

    @property
    def T(self) -> float:
        """What it explains, in units of the noise."""
        return sum(fit.T / fit.inflation for fit in self.fits)


class Library:
    """Columns of effects on one channel, made once."""

    def __init__(self, channel: Channel) -> None:
        """Start empty."""
        self.channel = channel
        self._made: dict[tuple, list[np.ndarray]] = {}

    def columns(self, effect: Effect) -> list[np.ndarray]:
        """Return an effect's exact columns (n, m, k) of each run."""
        key = key_of(effect)
        if key not in self._made:
            self._made[key] = self.channel.columns(effect)
        return self._made[key]


def key_of(effect: Effect) -> tuple:
    """Return what tells two effects apart."""
    return (effect.name, effect.joints, tuple(sorted(effect.settings.items())), effect.label)


def one_sided(effect: Effect) -> np.ndarray:
    """Return which amplitudes only make sense from zero up (k,)."""
    return np.array([p.lower >= 0 for p in effect.parameters])


def try_all(
    library: Library, ground: Ground, draws: np.ndarray, causes: Sequence[type[Effect]], taken: set[tuple]
) -> list[Candidate]:
    """Try every cause; return those that can be tried at all.

    Args:
        library: Makes columns.
        ground: What is accounted for already.
        draws: Noise after the same projection (R, D).
        causes: The causes.
        taken: `(cause, joints)` that are in the model already.
    """
    found = []
    for cls in causes:
        tried = [fit_group(library, ground, draws, cls, group) for group in groups(library.channel, cls, taken)]
        fits = [fit for fit in tried if fit is not None]
        if fits:
            found.append(judge(cls.name, fits))
    return found


def groups(channel: Channel, cls: type[Effect], taken: set[tuple]) -> list[tuple[str, ...]]:
    """Return the groups of joints worth trying."""
    if cls.untestable(channel.scene) is not None:
        return []
    mine = {joint for cause, joints in taken if cause == cls.name for joint in joints}
    return [
        group for group in cls.groups(channel.scene) if (cls.name, group) not in taken and not _covered(group, mine)
    ]


def _covered(group: tuple[str, ...], taken: set[str]) -> bool:
    """Tell whether a cause acts on all joints of a group already; pairs may share a joint with another pair."""
    return set(group) <= taken


def fit_group(
    library: Library, ground: Ground, draws: np.ndarray, cls: type[Effect], group: tuple[str, ...]
) -> Fit | None:
    """Scan one cause's settings on one group of joints; None where there is nothing to try."""
    scene = library.channel.scene
    grid = cls.grid(scene, group)
    if not grid:
        return None
    units = [scene.units[scene.index(j)] for j in group]
    plain = cls(group, units)
    effects = [plain.with_settings(**setting) for setting in grid]
    both = np.concatenate([ground.e[:, None], draws], axis=1)
    if getattr(cls, "dense", False):
        return _fit_alike(effects, library, ground, both[:, : 1 + DENSE_DRAWS])
    sizes = [len(effect.parameters) for effect in effects]
    alike = [[e for e, size in zip(effects, sizes, strict=True) if size == n] for n in sorted(set(sizes))]
    fits = [_fit_alike(part, library, ground, both) for part in alike]
    best = max(fits, key=lambda fit: fit.merit)
    return replace(best, tries=best.tries * len(alike))


def _fit_alike(effects: list[Effect], library: Library, ground: Ground, both: np.ndarray) -> Fit:
    """Scan settings with the same number of columns against the residual and the noise draws (R, 1 + D)."""
    sided = one_sided(effects[0])
    explained = _explained(effects, library, ground, both)
    best = int(np.argmax(explained[:, 0]))
    noise = explained[:, 1:].max(axis=0)
    simple = bool(sided.all()) and len(sided) == 1
    tries = _tries(noise, len(sided), simple)
    near = tuple(dict(effects[k].settings) for k in (best - 1, best + 1) if 0 <= k < len(effects))
    T = float(explained[best, 0])
    fit = Fit(effects[best], T, tries, len(sided), simple, 1.0, noise, near)
    return weighed(fit, library, ground) if T > 4 else fit


def weighed(fit: Fit, library: Library, ground: Ground) -> Fit:
    """Return a fit with its exact `T` and its inflation by blocks."""
    C = ground.rows(library.columns(fit.effect))
    s, G = C.T @ ground.e, ground.gram(C)
    T = float(gains(s[None, :, None], G[None], np.sum(C**2, axis=0)[None], one_sided(fit.effect))[0, 0])
    return Fit(fit.effect, T, fit.tries, fit.dof, fit.one_sided, _inflation(ground, C, s, G), fit.noise, fit.neighbours)


def judge(cause: str, fits: list[Fit]) -> Candidate:
    """Combine a cause's groups: its p-value, and which groups show it."""
    best = max(fits, key=lambda fit: fit.merit)
    alone = min(fit.p_value for fit in fits)
    p_alone = float(-np.expm1(len(fits) * np.log1p(-min(alone, 1 - 1e-16))))
    p_value = p_alone
    if len(fits) > 1:
        p_value = min(1.0, 2 * min(p_alone, _together(fits)))
    chosen = [fit for fit in fits if fit is best or fit.T > max(fit.threshold, WEAK * best.T)]
    return Candidate(cause, tuple(sorted(_disjoint(chosen), key=lambda f: -f.merit)), p_value, tuple(fits))


def _disjoint(fits: list[Fit]) -> list[Fit]:
    """Keep the best of groups that share a joint; one instance for all joints competes with one for each."""
    whole = max(fits, key=lambda fit: len(fit.effect.joints))
    parts = [fit for fit in fits if not set(fit.effect.joints) & set(whole.effect.joints) or fit is whole]
    alone = [fit for fit in fits if len(fit.effect.joints) < len(whole.effect.joints)]
    if alone and len(whole.effect.joints) > 2 and _merit(alone, whole.inflation) > whole.merit:
        return _disjoint(alone)
    kept: list[Fit] = []
    for fit in sorted(parts, key=lambda f: -f.merit):
        if not any(set(fit.effect.joints) & set(other.effect.joints) for other in kept):
            kept.append(fit)
    return kept


def _merit(fits: list[Fit], inflation: float) -> float:
    """Return the merit of several groups under one inflation, so that its own scatter does not choose between laws."""
    return sum(replace(fit, inflation=inflation).merit for fit in fits)


def _explained(effects: list[Effect], library: Library, ground: Ground, both: np.ndarray) -> np.ndarray:
    """Return what each setting explains of the residual and of each noise draw (g, 1 + D)."""
    scanned = library.channel.scan(effects, ground, both)
    found = np.full((len(effects), both.shape[1]), np.nan) if scanned is None else scanned
    left = np.flatnonzero(np.isnan(found[:, 0]))
    for start in range(0, len(left), _CHUNK):
        part = left[start : start + _CHUNK]
        found[part] = _explained_exactly([effects[k] for k in part], library, ground, both)
    return found


def _explained_exactly(effects: list[Effect], library: Library, ground: Ground, both: np.ndarray) -> np.ndarray:
    C = np.stack([ground.rows(library.columns(e)) for e in effects], axis=1)
    R, g, k = C.shape
    flat = C.reshape(R, g * k)
    s = (flat.T @ both).reshape(g, k, -1)
    A = (ground.Q.T @ flat).reshape(-1, g, k)
    G = np.einsum("rgk,rgl->gkl", C, C) - np.einsum("rgk,rgl->gkl", A, A)
    return gains(s, G, np.einsum("rgk,rgk->gk", C, C), one_sided(effects[0]))


def _tries(noise: np.ndarray, dof: int, simple: bool) -> float:
    """Return the number of independent tries `m` with `P(T <= t) = F(t)^m`, by maximum likelihood.

    Where all amplitudes of a one-sided column come out negative `T` is zero: a draw seen only as `T <= 0`.
    """
    tail = stats.chi2.sf(noise, dof) / (2 if simple else 1)
    seen = int(np.sum(noise > 0)) if simple else len(noise)
    return float(max(1.0, -seen / np.sum(np.log1p(-np.clip(tail, 1e-12, 0.5 if simple else 1 - 1e-12)))))


def _together(fits: list[Fit]) -> float:
    """Return the chance that the groups' sum reaches what it does, from a gamma law fitted to the noise draws."""
    total = sum(fit.T / fit.inflation for fit in fits)
    draws = min(len(fit.noise) for fit in fits)
    noise = np.sum([fit.noise[:draws] for fit in fits], axis=0)
    mean, variance = float(noise.mean()), float(noise.var())
    if mean <= 0 or variance <= 0:
        return 1.0
    scale = max(variance / mean, 2.0)  # no tail of chi-squares falls faster than exp(-t / 2)
    return float(stats.gamma.sf(total, mean / scale, scale=scale))


def _inflation(ground: Ground, C: np.ndarray, s: np.ndarray, G: np.ndarray) -> float:
    """Return the scatter of 2 s blocks' scores along the fitted direction over what the noise model says."""
    amplitude = np.linalg.lstsq(G, s, rcond=1e-9)[0]
    along = ground.left(C @ amplitude)
    square = float(along @ along)
    if square <= 0:
        return 1.0
    e = ground.e - along * float(along @ ground.e) / square
    blocks = np.bincount(ground.whiten.block, along * e)
    count = len(np.unique(ground.whiten.block))
    ratio = float(np.sum(blocks**2)) / square
    return max(1.0, (count * ratio + PRIOR_BLOCKS) / (count + PRIOR_BLOCKS))
