"""Is the residual of each output consistent with its noise? The condition of the verdict `nothing_found`.

The alternative hypothesis is a smooth dependence of the residual on the output's own variables (position, speed, acceleration,
force, temperature, time) and the same times the direction of motion: the columns of the noise model (`null_model.py`). Its
amplitudes are fitted separately to the training and to the held-out data, so a dependence that differs between logs counts as
well. Each score statistic is divided by its overdispersion, and the part that encoder noise alone explains is allowed for by
the parametric bootstrap. An output is inconsistent with its noise if both p-values are below the significance level; the two
data sets are independent, so the level of the test is at most its square. Reference: Draper & Smith 1998, ch. 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from tau_dyn.effects import Effect
from tau_dyn.evidence.candidate_scan import compute_fit_overdispersion
from tau_dyn.evidence.channel import TEST, TRAIN, VALIDATION, Channel
from tau_dyn.evidence.noise_only_bootstrap import NoiseOnlyBootstrap, compute_artefact_chance
from tau_dyn.evidence.null_model import WHOLE_TIME, NullModel, build_smooth_columns, compute_score_test
from tau_dyn.evidence.result import Unexplained
from tau_dyn.evidence.stepwise_selection import StepwiseSelection
from tau_dyn.evidence.unknown_structure import place_columns

CONSISTENCY_LEVEL = 0.01
"""Significance level of each of the two tests of an output, over all outputs (Bonferroni); together at most 1e-4."""
_ABSORBED = 0.01
"""Part of a smooth function that the baseline must leave: the functions are not filtered as the baseline's columns are."""
_HELD_OUT = (VALIDATION, TEST)


@dataclass(frozen=True)
class NoiseConsistency:
    """Test of one output's residual against its noise.

    Attributes:
        output: The output.
        p_value: Probability of both statistics under noise: the larger p-value of training and held-out data, over all outputs.
        share: Part of the held-out residual's variance that the smooth functions explain.
    """

    output: str
    p_value: float
    share: float

    @property
    def is_consistent(self) -> bool:
        """Whether the residual is consistent with the noise."""
        return self.p_value >= CONSISTENCY_LEVEL


def assess_noise_consistency(
    hunt: StepwiseSelection, effects: Sequence[Effect], noise: NoiseOnlyBootstrap | None = None
) -> tuple[NoiseConsistency, ...]:
    """Test the residual of each output against its noise.

    Args:
        hunt: The selection; its noise models whiten the residual.
        effects: The confirmed effects, which are in the model.
        noise: Encoder noise alone, of forces; None for other measurements.
    """
    channel = hunt.channel
    grounds = [NullModel.of(hunt.library, parts, hunt.ground.noise, effects) for parts in ((TRAIN,), _HELD_OUT)]
    found = []
    for k, output in enumerate(channel.outputs):
        tests = [_test(ground, k, effects, noise) for ground in grounds]
        p_value = min(1.0, len(channel.outputs) * max(p for p, _ in tests))
        found.append(NoiseConsistency(output, p_value, tests[1][1]))
    return tuple(found)


def _test(
    ground: NullModel, output: int, effects: Sequence[Effect], noise: NoiseOnlyBootstrap | None
) -> tuple[float, float]:
    """Return the p-value of the smooth functions of one output's variables, and their share of its residual's variance."""
    rows = np.flatnonzero(ground.whiten.index == output)
    power = float(ground.e[rows] @ ground.e[rows])
    if not power > 0:
        return 1.0, 0.0
    C = ground.whiten_columns(_build_columns(ground.channel, output))
    free = np.zeros(C.shape[1], bool)
    statistic, s, G = compute_score_test(ground, C, free, _ABSORBED)
    statistic /= compute_fit_overdispersion(ground, C, s, G)
    share = min(1.0, statistic / power)
    if noise is None:
        return float(stats.chi2.sf(statistic, len(free))), share
    made = [_build_columns(clean, output) for clean in noise.channels]
    blanks = noise.fit_null_models(ground, effects)
    return compute_artefact_chance(statistic, blanks, ground, made, free, _ABSORBED), share


def _build_columns(channel: Channel, output: int) -> list[np.ndarray]:
    """Return the smooth functions of an output's own variables as columns (n, m, k) of each run."""
    n_outputs = len(channel.outputs)
    bases = build_smooth_columns(channel.variables(), channel.outputs[output])
    return [place_columns(basis, output, n_outputs) for basis in bases]


def list_inconsistent(tests: Sequence[NoiseConsistency], channel: Channel) -> tuple[Unexplained, ...]:
    """Return the outputs with a residual above the noise as unexplained structure over their variables, largest share first."""
    names = [name for name in channel.variables()[0] if name != WHOLE_TIME]
    inconsistent = sorted((test for test in tests if not test.is_consistent), key=lambda test: -test.share)
    return tuple(
        Unexplained(
            test.output,
            tuple(name for name in names if name.split("_", 1)[-1] == test.output),
            test.share,
            "",
            test.p_value,
            "confirmed",
        )
        for test in inconsistent
    )
