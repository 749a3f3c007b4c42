r"""Changes between campaigns: effects in one log but not in the others, of several competing kinds.

    y_k = W_k theta + [k = log] C_k x,     k = 1 .. K logs

A log is one campaign. Each kind of change (a body at the tool, friction of a joint, a mass of a link, a force scale of a joint)
has columns `C`; everything else is shared by all logs. The score test of `x = 0` is that of the null model. p-values are
corrected for all logs and kinds (Bonferroni), and the statistic is divided by the scatter of blocks. The change with the
largest penalised statistic is added first, and the others are tested again. One kind may have a larger prior: tools change more
often than links and drives do. It replaces a stronger kind if it explains the whole difference of the log. Reference: Rao 1948
(score test); White 1980.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from tau_dyn.estimate import Autoregression
from tau_dyn.evidence.confirmation import Confirmation, confirm_columns
from tau_dyn.evidence.extended_fit import compute_gain
from tau_dyn.evidence.lack_of_fit import MAX_MISSED_SHARE
from tau_dyn.evidence.measurements import TEST, TRAIN, VALIDATION, Measurements, divide_training
from tau_dyn.evidence.null_model import MIN_UNABSORBED_SHARE, WhiteResidual, compute_overdispersion
from tau_dyn.evidence.result import DIFFERENCE_LEVEL, Gain
from tau_dyn.parameters import Parameter, Parameters

MIN_LEFT_P_VALUE = 1e-3
"""p-value of a log's remaining difference above which a change explains the whole difference."""
MIN_EXPLAINED_SHARE = 0.9
"""Or share of a log's difference that it explains: model errors cause differences between motions beyond any noise model."""


@dataclass(frozen=True, eq=False)
class CampaignChange:
    """One kind of change in one log.

    Attributes:
        kind: Its name.
        log: The log.
        statistic: Its score statistic, in units of the noise, divided by the scatter of blocks.
        dof: Number of identifiable amplitudes.
        p_value: p-value on equal logs, corrected for all logs and kinds.
        explains: Whether it explains all differences of this log.
    """

    kind: str
    log: str
    statistic: float
    dof: int
    p_value: float
    explains: bool = False

    @property
    def penalised_statistic(self) -> float:
        """The statistic minus the cost of its amplitudes."""
        return self.statistic - 2 * self.dof


@dataclass(frozen=True, eq=False)
class CampaignChannel(Measurements):
    """Measurements of several campaigns; effects are among the columns."""

    def with_columns(self, parameters: Parameters, columns: Sequence[np.ndarray]) -> CampaignChannel:
        """Return the channel with further columns (n, m, k) of each run, to be fitted as well."""
        runs = tuple(
            replace(run, W=np.concatenate([run.W, c], axis=2), W_all=np.concatenate([run.W_all, c], axis=2))
            for run, c in zip(self.runs, columns, strict=True)
        )
        return replace(self, parameters=self.parameters + parameters, runs=runs)

    def with_change(self, one: CampaignChange, columns: Sequence[np.ndarray]) -> CampaignChannel:
        """Return the channel with the columns (n, m, k) of each run of a change, zero outside of its log."""
        names = (f"{one.kind}.{k}@{one.log}" for k in range(columns[0].shape[2]))
        parameters = Parameters(Parameter(name, 0.0, "1") for name in names)
        return self.with_columns(parameters, self.mask_columns(columns, [one.log]))

    def mask_columns(self, columns: Sequence[np.ndarray], logs: Sequence[str]) -> list[np.ndarray]:
        """Return columns (n, m, k) of each run, zero outside of some logs."""
        return [c * float(run.name in logs) for run, c in zip(self.runs, columns, strict=True)]


def divide_every_log(channel: Measurements, gap_s: float) -> tuple[np.ndarray, ...]:
    """Return parts that divide every log into training and test data.

    The test data are a quarter of the blocks of a training log, and the test part of the other logs.
    """
    inner = divide_training(channel.runs, channel.parts, gap_s)
    found = []
    for whole, own in zip(channel.parts, inner, strict=True):
        parts = own if np.all(whole == TRAIN) else np.where(whole == VALIDATION, TRAIN, whole)
        found.append(np.where(parts == VALIDATION, TEST, parts))
    return tuple(found)


def select_campaign_changes(
    channel: CampaignChannel,
    noise: Sequence[Autoregression],
    kinds: Mapping[str, Sequence[np.ndarray]],
    logs: Sequence[str],
    *,
    likelier: str,
    companions: Sequence[str] = (),
    reference: bool = False,
) -> list[CampaignChange]:
    """Return the significant changes in the training part, the strongest first.

    Args:
        channel: The measurements, with the columns that all logs share.
        noise: Noise model of each output.
        kinds: Columns (n, m, k) of each run, by kind.
        logs: The logs that may have changed.
        likelier: The kind with the larger prior.
        companions: Kinds that change for other reasons; they do not count against the likelier kind.
        reference: Whether the channel contains an unchanged reference; otherwise one of the logs is the reference.
    """
    found: list[CampaignChange] = []
    own = [kinds[kind] for kind in companions]
    whole = [
        np.concatenate(parts, axis=2)
        for parts in zip(*(c for kind, c in kinds.items() if kind not in companions), strict=True)
    ]
    n_tests, most = len(kinds) * len(logs), len(logs) - (not reference)
    while True:
        null_model = WhiteResidual.of_columns(channel, (TRAIN,), noise)
        tests = []
        for kind, columns in kinds.items():
            taken = [one.log for one in found if one.kind == kind]
            if len(taken) < most:
                tests += [_test(null_model, channel, kind, log, columns, n_tests) for log in logs if log not in taken]
        tests = [one for one in tests if one.p_value < DIFFERENCE_LEVEL]
        if not tests:
            return found
        best = max(tests, key=lambda one: one.penalised_statistic)
        same = [one for one in tests if one.kind == likelier]
        rated = [replace(one, explains=_explains(channel, noise, one, (kinds[likelier], *own), whole)) for one in same]
        preferred = [one for one in rated if one is not best and one.explains and one.log == best.log]
        if preferred and best.kind != likelier:
            best = preferred[0]
        elif best.kind == likelier:
            best = next(one for one in rated if one.log == best.log)
        channel = channel.with_change(best, kinds[best.kind])
        found.append(best)


def _test(
    null_model: WhiteResidual,
    channel: CampaignChannel,
    kind: str,
    log: str,
    columns: Sequence[np.ndarray],
    n_tests: int,
) -> CampaignChange:
    statistic, dof = compute_score(null_model, channel.mask_columns(columns, [log]))
    p_value = min(1.0, n_tests * float(stats.chi2.sf(statistic, dof))) if dof else 1.0
    return CampaignChange(kind, log, statistic, dof, p_value)


def _explains(
    channel: CampaignChannel,
    noise: Sequence[Autoregression],
    one: CampaignChange,
    accounted: Sequence[Sequence[np.ndarray]],
    whole: Sequence[np.ndarray],
) -> bool:
    """Return whether a change, with its companions in the model, explains all or nearly all of its log's difference."""
    for number, columns in enumerate(accounted):
        channel = channel.with_change(replace(one, kind=f"{one.kind} {number}"), columns)
    left, dof = compute_score(
        WhiteResidual.of_columns(channel, (TRAIN,), noise), channel.mask_columns(whole, [one.log])
    )
    everything = left + one.statistic
    return (
        not dof
        or float(stats.chi2.sf(left, dof)) > MIN_LEFT_P_VALUE
        or one.statistic > MIN_EXPLAINED_SHARE * everything
    )


def compute_score(null_model: WhiteResidual, columns: Sequence[np.ndarray]) -> tuple[float, int]:
    """Return the score statistic of columns (n, m, k) over the runs, divided by the scatter of blocks, and its rank."""
    C = null_model.whiten_columns(columns)
    norm = np.linalg.norm(C, axis=0)
    C = C[:, norm > 0] / norm[norm > 0]
    if not C.shape[1]:
        return 0.0, 0
    values, vectors = np.linalg.eigh(null_model.gram(C))
    seen = values > MIN_UNABSORBED_SHARE
    along = null_model.project_out(C @ vectors[:, seen]) / np.sqrt(values[seen])
    scores = along.T @ null_model.e
    T, fitted = float(scores @ scores), along @ scores
    rest = null_model.e - fitted
    return T / compute_overdispersion(null_model.whiten.block, fitted * rest, float(fitted @ fitted)), int(seen.sum())


def confirm_campaign_change(
    channel: CampaignChannel, noise: Sequence[Autoregression], columns: Sequence[np.ndarray]
) -> Confirmation:
    """Test columns (n, m, k) of each run on the test samples, with amplitudes of the training part."""
    null_model = WhiteResidual.of_columns(channel, (TRAIN,), noise)
    return confirm_columns(null_model, [columns], (), (TEST,), (TRAIN,))


def compute_campaign_gain(
    channel: CampaignChannel,
    logs: Sequence[str],
    before: Sequence[np.ndarray],
    after: Sequence[np.ndarray],
    rng: np.random.Generator,
    shown: Confirmation,
) -> Gain:
    """Return the reduction of the error in some logs on the test samples; zero without test samples.

    Args:
        channel: The measurements.
        logs: The logs.
        before: Residuals (n, m) of each run without the change.
        after: The same with it.
        rng: Random numbers of the bootstrap.
        shown: Share of the predicted force that these samples show.
    """
    parts = tuple(np.where(run.name in logs, part, -1) for run, part in zip(channel.runs, channel.parts, strict=True))
    own = replace(channel, parts=parts)
    if not any(mask.any() for mask in own.masks(TEST)):
        return Gain(0.0, 0.0, 0.0, (0.0, 0.0))
    return compute_gain(own, before, after, channel.outputs, rng, shown)


def explain_misfit(channel: CampaignChannel, logs: Sequence[str], gain: Gain) -> str:
    """Return the reason why a change in some logs is not claimed if the model's remaining error is larger; empty otherwise.

    A model with an error of more than `MAX_MISSED_SHARE` of the force lacks a force, and any other column absorbs part of it.
    With such a model a change is accepted only if it exerts as much force in these logs as the remaining error.

    Args:
        channel: The measurements.
        logs: The logs.
        gain: Gain of the change, in these logs.
    """
    runs = list(zip(channel.runs, channel.masks(TEST), strict=True))
    forces = [run.y[mask] for run, mask in runs if run.name in logs]
    force = float(np.sqrt(np.mean(np.concatenate(forces) ** 2))) if any(len(x) for x in forces) else 0.0
    missed = gain.rms_after / force if force > 0 else 0.0
    taken_off = np.sqrt(max(0.0, gain.rms_before**2 - gain.rms_after**2))
    if missed <= MAX_MISSED_SHARE or taken_off >= gain.rms_after:
        return ""
    return f"the model misses {100 * missed:.0f} % of the force in these logs with it, more than the change exerts"
