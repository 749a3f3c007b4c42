r"""Encoder noise as a hypothesis: the part of a statistic that encoder noise alone explains, by a parametric bootstrap.

Encoder noise is in the columns and, times a mass, in the residual; whitening cannot remove noise that both share. The fitted
baseline is run along the measured motion without noise, its positions get new noise of the level measured in the logs, its
forces the controller's response to that noise, and the whole preparation is repeated. The mean statistic of a cause on several
draws is the noncentrality that its statistic would have on a clean log: the p-value is that of a noncentral chi-square, with
twice that noncentrality, as it is an estimate itself. Rounding at a constant speed leaves lines in the spectrum, whose phase
decides what a column sees of them: the noncentrality then differs from draw to draw, and the p-value is its mean over a gamma
distribution with the draws' mean and variance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy import special, stats

from tau_dyn.effects import Effect
from tau_dyn.evidence.candidate_scan import FAMILY_LEVEL, GROUP_LEVEL, CandidateCause, find_nonnegative
from tau_dyn.evidence.channel import Channel, ColumnCache
from tau_dyn.evidence.null_model import MIN_UNABSORBED_SHARE, NullModel, WhiteResidual, compute_score_test

N_BOOTSTRAP_DRAWS = 4
"""Draws of encoder noise; the statistic of a cause on one of them may be near zero, or four times the mean."""
NONCENTRALITY_SAFETY_FACTOR = 2.0  # factor for an estimate from few draws, which is wrong by up to a factor of two
_N_GAMMA_NODES = 24
"""Nodes of the expectation over a gamma distribution, exact for polynomials of degree 47."""
_MIN_GAMMA_SHAPE = 1e-6
"""Smallest shape: nearly all of the distribution is at zero, and the nodes of smaller shapes are no numbers."""
_MAX_GAMMA_SHAPE = 100.0
"""Shape of a gamma distribution above which it scatters by less than a tenth of its mean, which is taken for it."""


class NoiseOnlyBootstrap:
    """Channels of logs that hold only the baseline and encoder noise, made when first needed."""

    def __init__(self, make: Callable[[], Sequence[Channel]]) -> None:
        """`make` returns the channels, a draw of noise each."""
        self._make = make

    @cached_property
    def channels(self) -> Sequence[Channel]:
        """The channels, draw by draw."""
        return self._make()

    @cached_property
    def libraries(self) -> list[ColumnCache]:
        """Columns of effects on each."""
        return [ColumnCache(channel) for channel in self.channels]

    def within(self, parts: tuple[np.ndarray, ...]) -> NoiseOnlyBootstrap:
        """Return the same channels with other parts."""
        return NoiseOnlyBootstrap(lambda: [replace(channel, parts=parts) for channel in self.channels])

    def fit_null_models(self, null_model: WhiteResidual, effects: Sequence[Effect]) -> list[NullModel]:
        """Return the same parts of each channel with effects in the model, whitened as `null_model`."""
        return [NullModel.of(library, null_model.parts, null_model.noise, effects) for library in self.libraries]

    def reject_artefacts(
        self, null_model: NullModel, candidate: CandidateCause, others: Sequence[Effect], n: int
    ) -> CandidateCause | None:
        """Return a candidate without the groups that encoder noise can explain; None if it can explain the strongest one.

        Args:
            null_model: The training data of the measured channel, for its noise model and scale.
            candidate: The cause, on measured data.
            others: The other causes.
            n: Number of causes tried, for which p-values are corrected, as for the candidate's groups and settings.
        """
        noise_only_models = self.fit_null_models(null_model, others)
        chances = []
        for fit in candidate.fits:
            columns = [library.columns(fit.effect) for library in self.libraries]
            T, sided = fit.statistic / fit.overdispersion, find_nonnegative(fit.effect)
            tail = compute_artefact_chance(T, noise_only_models, null_model, columns, sided)
            chances.append(min(1.0, fit.n_effective_tests * tail))
        least = min(chances)
        if least * len(candidate.tested) * n >= FAMILY_LEVEL:
            return None
        kept = tuple(f for f, chance in zip(candidate.fits, chances, strict=True) if chance <= max(GROUP_LEVEL, least))
        return replace(candidate, fits=kept)


def compute_artefact_chance(
    statistic: float,
    noise_only_models: Sequence[NullModel],
    null_model: WhiteResidual,
    columns: Sequence[Sequence[np.ndarray]],
    sided: np.ndarray,
    absorbed: float = MIN_UNABSORBED_SHARE,
) -> float:
    """Return the p-value of a statistic of these columns under encoder noise on each null model, by a noncentral chi-square."""
    mean, variance = estimate_noncentrality(noise_only_models, null_model, columns, sided, absorbed)
    if not mean > 0:
        return float(stats.chi2.sf(statistic, len(sided)))
    biases, weights = _list_gamma_nodes(mean, variance)
    return float(weights @ stats.ncx2.sf(statistic, len(sided), NONCENTRALITY_SAFETY_FACTOR * biases))


def _list_gamma_nodes(mean: float, variance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes and weights (n,) of an expectation over a gamma distribution; one node if its scatter is small."""
    shape = mean**2 / variance if variance > 0 else np.inf
    if shape > _MAX_GAMMA_SHAPE:
        return np.array([mean]), np.ones(1)
    shape = max(shape, _MIN_GAMMA_SHAPE)
    nodes, weights = special.roots_genlaguerre(_N_GAMMA_NODES, shape - 1)
    return nodes * mean / shape, weights / np.sum(weights)


def estimate_noncentrality(
    noise_only_models: Sequence[NullModel],
    null_model: WhiteResidual,
    columns: Sequence[Sequence[np.ndarray]],
    sided: np.ndarray,
    absorbed: float = MIN_UNABSORBED_SHARE,
) -> tuple[float, float]:
    """Return mean and variance of the statistic of columns on the misfit due to encoder noise, in units of the measured noise.

    The mean is that over draws of the noise, minus the contribution of the draws' own scatter to the mean of squares; the
    variance is what the draws scatter beyond a noncentral chi-square. Encoder noise cannot cause more than the measured noise.
    If it seems so, a loop followed it: the power of the misfit, and of the columns' part of it, is `|S|^2` times that of the
    simulated logs.
    """
    T = [
        compute_score_test(b, b.whiten_columns(c), np.zeros_like(sided), absorbed)[0]
        for b, c in zip(noise_only_models, columns, strict=True)
    ]
    share = float(np.mean([min(1.0, b.scale / null_model.scale) ** 2 for b in noise_only_models]))
    mean = max(0.0, float(np.mean(T)) - len(sided) * (1 - 1 / len(T)))
    scatter = float(np.var(T, ddof=1)) if len(T) > 1 else 0.0
    return mean * share, max(0.0, scatter - 2 * len(sided) - 4 * mean) * share**2
