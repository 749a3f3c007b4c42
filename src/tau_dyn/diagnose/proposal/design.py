r"""Power of a planned motion to distinguish two causes.

Along a motion, let `B` be the whitened rows of all refitted parameters, `x` those of the force of cause A at its fitted
amplitude, and `C(s)` those of the columns of the alternative cause at settings s. Then

    lambda = min over s of | x - [B, C(s)] least squares |^2,

is the noncentrality of the test of A against the alternative; the motion with the largest lambda is T-optimal. Rows of separate
motions add: a motion composed of pieces has the sum of their Gram matrices, and every lambda follows from that sum by a Schur
complement. Reference: Atkinson & Fedorov 1975.

Only the noise model is low-passed here: noise that is white in the diagnosed band is assumed to be white above it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_toeplitz

from tau_dyn.diagnose.preparation import smooth_cutoff
from tau_dyn.effects import Effect, Motion, get_measured_signals
from tau_dyn.estimate import Autoregression, RegressionRun, Whitener, fit_autoregression
from tau_dyn.evidence import (
    MIN_UNABSORBED_SHARE,
    Diagnosis,
    TimeTrace,
    compute_score_statistics,
    find_nonnegative,
)
from tau_dyn.identify import find_unsure_samples, widen
from tau_dyn.log import (
    Log,
    compute_attenuation,
    decimate,
    differentiate,
    find_true_runs,
    lowpass,
    resample_segments,
)
from tau_dyn.model import COMPUTED, Model
from tau_dyn.parameters import Parameters
from tau_dyn.simulate import Trajectory

RATE_HZ = 100.0
"""Rate of the rows, about [Hz]."""
MAX_FREQUENCY_HZ = 50.0
"""Highest frequency of a diagnosis if the motion is fast and positions are accurate enough [Hz], about."""
_MIN_RATE_HZ = 80.0
"""A residual at a lower rate than this gives only the density of the noise."""
_IN_BAND = 0.28
"""Share of the rate up to which neither low-pass attenuates a residual."""
_MAX_ORDER = 8  # of the autoregressive model of the residual, selected below it
_LOOKED_AT_S = 120.0  # [s] of the logs used to judge motions; bounds computing time
_OF_PLACE = ("inertia", "weight_gradient", "passive")

Thing = tuple[tuple[Effect, ...], Parameters | None]
"""Effects whose columns are judged one by one, or, at given values, as the one column of their force together."""


@dataclass(frozen=True, eq=False)
class Setting:
    """Settings that a diagnosis gives for making rows: the model, its noise, the speeds of uncertain direction.

    Attributes:
        model: The refitted baseline, at which loads and forces are computed.
        noise: Noise of each joint's force at the rows' rate.
        rate_hz: Rate of the rows.
        threshold: Slowest speed with a certain sign (na,) [m/s or rad/s].
        window_s: Time left out around slow and reversing samples [s].
        cutoff_hz: Low-pass of positions [Hz].
        highest_hz: Frequency above which a diagnosis cannot detect causes, even with faster motion [Hz].
    """

    model: Model
    noise: tuple[Autoregression, ...]
    rate_hz: float
    threshold: np.ndarray
    window_s: float
    cutoff_hz: float
    highest_hz: float

    @classmethod
    def of(cls, diagnosis: Diagnosis) -> Setting:
        """Read it from a diagnosis; the noise is the residual of its extended model."""
        prepared = diagnosis.preparation
        assert prepared is not None  # other channels have been refused
        rate, noise = estimate_output_noise(diagnosis.traces, diagnosis.extended.rms)
        cutoff = prepared.position_cutoff_hz
        highest = max(prepared.force_cutoff_hz, min(MAX_FREQUENCY_HZ, cutoff / 2))
        return cls(diagnosis.model, noise, rate, prepared.speed_threshold, prepared.window_s, cutoff, highest)


def estimate_output_noise(traces: Sequence[TimeTrace], rms: np.ndarray) -> tuple[float, tuple[Autoregression, ...]]:
    """Return a rate near 100 Hz and the noise of each output at it.

    Args:
        traces: The residual of the extended model in them gives the spectrum of the noise.
        rms: Rms of that residual (m,), from data that are not affected by reversals, unlike the traces.
    """
    rate = 1 / float(np.median(np.diff(traces[0].t)))
    factor = max(1, round(rate / RATE_HZ))
    models = []
    for k, size in enumerate(rms):
        stretches = []
        left = np.concatenate([(x.measured - x.after)[x.usable[:, k], k] for x in traces])
        scale = size / max(float(np.sqrt(np.mean(left**2))), 1e-300) if len(left) else 1.0
        for trace in traces:
            e, usable = scale * (trace.measured - trace.after)[:, k], trace.usable[:, k]
            if factor > 1:
                e = decimate(lowpass(np.where(usable, e, 0.0), 0.4 * rate / factor, rate), factor)
                usable = decimate(usable, factor)
            stretches += [e[s] for s in find_true_runs(usable)]
        models.append(flatten_noise_spectrum(fit_autoregression(stretches, _MAX_ORDER)))
    if rate >= _MIN_RATE_HZ:
        return rate / factor, tuple(models)
    none = np.zeros(0)
    return RATE_HZ, tuple(Autoregression(none, m.variance * RATE_HZ / rate) for m in models)


def flatten_noise_spectrum(noise: Autoregression) -> Autoregression:
    """Return a noise whose spectral density continues above the low-pass as it is below it.

    The residual was low-passed near the end of its band, candidate columns are not: whitened by the small residual there, they
    would seem to have far too much power.
    """
    f = np.linspace(0, 0.5, 2049)
    turn = np.exp(-2j * np.pi * np.outer(f, np.arange(1, len(noise.phi) + 1)))
    density = 1 / np.abs(1 - turn @ noise.phi) ** 2
    density *= noise.variance / np.fft.irfft(density)[0]
    density[f > _IN_BAND] = np.mean(density[(f > _IN_BAND / 2) & (f <= _IN_BAND)])
    c = np.fft.irfft(density)[: _MAX_ORDER + 1]
    phi = np.asarray(solve_toeplitz(c[:-1], c[1:])) if c[0] > 0 and len(noise.phi) else np.zeros(0)
    return Autoregression(phi, float(c[0]))


class DesignMotion(NamedTuple):
    """A motion at the rows' rate with all signals that effects need, and the mask of usable samples (n, na)."""

    motion: Motion
    counts: np.ndarray


def build_planned_motion(setting: Setting, planned: Trajectory, needs: Iterable[str] = ()) -> DesignMotion:
    """Return a planned motion with the requested computed signals."""
    log = Log(planned.t, {f"q_{j}": planned.q[:, k] for k, j in enumerate(planned.joints)}, planned.name)
    return _thin(setting, log, planned.q, planned.v, planned.a, needs, None)


def build_measured_motions(setting: Setting, logs: Iterable[Log], needs: Iterable[str]) -> list[DesignMotion]:
    """Return the measured motions with the requested computed signals, at most two minutes of them."""
    stretches, found = [piece for log in logs for piece in resample_segments(log)], []
    smooth_hz = smooth_cutoff(setting.model.robot, stretches) if stretches else 0.0
    for log in stretches:
        rate = log.rate_hz
        q = lowpass(log.joint("q", setting.model.robot.actuated), min(smooth_hz, setting.cutoff_hz, 0.4 * rate), rate)
        v = differentiate(q, log.dt, accuracy=4)
        most = max(16, int(_LOOKED_AT_S * setting.rate_hz / len(stretches)))
        found.append(_thin(setting, log, q, v, differentiate(v, log.dt, accuracy=4), needs, most))
    return found


def _thin(
    setting: Setting, log: Log, q: np.ndarray, v: np.ndarray, a: np.ndarray, needs: Iterable[str], most: int | None
) -> DesignMotion:
    """Return a limited number of samples at the rows' rate, with loads and forces at the refitted baseline.

    Signals that depend on the position alone are computed at every fourth sample and interpolated.
    """
    joints, step = setting.model.robot.actuated, max(1, round(log.rate_hz / setting.rate_hz))
    measured = get_measured_signals(log, joints, q, v, setting.threshold)
    counts = ~widen(find_unsure_samples(v, setting.threshold), int(np.ceil(setting.window_s * log.rate_hz)))
    part = slice(None, None if most is None else most * step, step)
    q, v, a, t, counts = (x[part] for x in (q, v, a, log.t, counts))
    few = np.unique(np.append(np.arange(0, len(t), 4), len(t) - 1))
    still, mechanism = np.zeros((len(few), q.shape[1])), setting.model.mechanism
    places = {name: COMPUTED[name](mechanism, q[few], still, still) for name in _OF_PLACE if name in needs}
    signals = {name: x[part] for name, x in measured.items()}
    signals |= {name: np.asarray(CubicSpline(t[few], x)(t)) for name, x in places.items()}
    return DesignMotion(setting.model.motion(q, v, a, np.sign(v), t=t, signals=signals, needs=needs), counts)


def compute_columns(setting: Setting, motion: Motion, others: Sequence[Effect], things: Sequence[Thing]) -> np.ndarray:
    """Return columns (N, na, k): of the model's free parameters and of other refitted effects, then of all things."""
    made = [setting.model.columns(motion)[:, :, setting.model.parameters.free], *(e.columns(motion) for e in others)]
    for effects, values in things:
        each = [_weaken(setting, effect, motion) for effect in effects]
        if values is None:
            made += each
        else:
            amplitudes = (values.select(effect.parameters.names).values for effect in effects)
            made.append(np.sum([c @ x for c, x in zip(each, amplitudes, strict=True)], axis=0)[:, :, None])
    return np.concatenate(made, axis=2)


def _weaken(setting: Setting, effect: Effect, motion: Motion) -> np.ndarray:
    """Return an effect's columns, attenuated at local frequencies above the low-pass."""
    made = effect.columns(motion)
    if not effect.dense:
        return made
    f = effect.local_frequency(motion)[:, :, None]  # type: ignore[attr-defined]
    return made / compute_attenuation(f, setting.highest_hz)


def compute_gram_matrix(setting: Setting, motion: Motion, counts: np.ndarray, W: np.ndarray) -> np.ndarray:
    """Return the Gram matrix of white rows of columns (N, na, k) along a motion."""
    assert motion.t is not None
    blank = np.zeros(counts.shape)
    rows = Whitener.of([RegressionRun("plan", motion.t, W, blank, counts, W, blank, {})], [counts], setting.noise)([W])
    rate = (len(motion.t) - 1) / float(motion.t[-1] - motion.t[0])
    return rows.T @ rows * (setting.rate_hz / rate)  # the noise is given at the rows' rate, near that of a log


_RANK = 1e-10  # ratio of eigenvalues; less is rounding


@dataclass(frozen=True, eq=False)
class SchurComplement:
    """Gram matrix `G` (n, n) of the residuals of columns on the refitted ones, and the columns' own squares `raw` (n,)."""

    G: np.ndarray
    raw: np.ndarray

    @classmethod
    def of(cls, total: np.ndarray, p: int) -> SchurComplement:
        """Project the first p columns out of a Gram matrix."""
        raw = np.diag(total)[p:].copy()
        norm = np.sqrt(np.maximum(np.diag(total), 1e-300))
        scaled = total / norm[:, None] / norm
        values, vectors = np.linalg.eigh(scaled[:p, :p])
        keep = values > _RANK * max(values.max(initial=0.0), 1e-300)
        across = (vectors[:, keep] / np.sqrt(values[keep])).T @ scaled[:p, p:]
        left = (scaled[p:, p:] - across.T @ across) * norm[p:, None] * norm[p:]
        return cls(left, raw)

    def without(self, columns: np.ndarray) -> SchurComplement:
        """Project further columns out."""
        inverse = np.linalg.pinv(self.G[np.ix_(columns, columns)], rcond=MIN_UNABSORBED_SHARE, hermitian=True)
        across = self.G[:, columns]
        return replace(self, G=self.G - across @ inverse @ across.T)


@dataclass(frozen=True, eq=False)
class AlternativeCause:
    """An alternative cause: its effects on each group of joints, one for each setting, and the indices of their columns."""

    groups: tuple[tuple[Effect, ...], ...]
    columns: tuple[tuple[np.ndarray, ...], ...]

    def best(self, schur: SchurComplement, x: int) -> tuple[float, list[tuple[Effect, np.ndarray]]]:
        """Return the residual square of column x on the alternative at its best settings, and these settings with amplitudes.

        Groups are added one by one, the one that explains most first; a joint belongs to one group only.
        """
        chosen: list[tuple[Effect, np.ndarray]] = []
        open_groups = list(range(len(self.groups)))
        while open_groups and schur.G[x, x] > 0:
            T, k, setting = max(self._explained(schur, x, k) for k in open_groups)
            if T <= 0:
                break
            effect, columns = self.groups[k][setting], self.columns[k][setting]
            chosen.append((effect, columns))
            rest = schur.G[x, x] - T
            schur = schur.without(columns)
            schur.G[x, x] = max(rest, schur.G[x, x])  # bounds at zero leave a larger residual
            open_groups = [j for j in open_groups if not set(self.groups[j][0].joints) & set(effect.joints)]
        return max(float(schur.G[x, x]), 0.0), chosen

    def _explained(self, schur: SchurComplement, x: int, k: int) -> tuple[float, int, int]:
        """Return the largest statistic of a group, the group, and the setting; settings may differ in their number of columns."""
        best = (0.0, k, 0)
        sizes = np.array([len(c) for c in self.columns[k]])
        for size in np.unique(sizes):
            same = np.flatnonzero(sizes == size)
            index = np.array([self.columns[k][j] for j in same])
            s, G = schur.G[index, x][:, :, None], schur.G[index[:, :, None], index[:, None, :]]
            T = compute_score_statistics(s, G, schur.raw[index], find_nonnegative(self.groups[k][same[0]]))[:, 0]
            best = max(best, (float(T.max()), k, int(same[np.argmax(T)])))
        return best


def compute_imitating_amplitudes(
    schur: SchurComplement, x: int, chosen: Sequence[tuple[Effect, np.ndarray]]
) -> Parameters:
    """Return the values at which chosen effects imitate column x best, within their bounds at zero."""
    columns = np.concatenate([c for _, c in chosen])
    G = schur.G[np.ix_(columns, columns)]
    value = np.linalg.pinv(G, rcond=MIN_UNABSORBED_SHARE, hermitian=True) @ schur.G[columns, x]
    parameters = [p for effect, _ in chosen for p in effect.parameters]
    found = [replace(p, value=float(max(v, p.lower))) for p, v in zip(parameters, value, strict=True)]
    return Parameters(found)
