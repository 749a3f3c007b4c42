"""The delay of the inputs in whole samples.

A model without the delay needs one more state for each sample and input; a model with too long a delay misses the first
samples of the response. So for every delay and several orders n the poles are taken from a first model and the rest is
fitted by linear least squares,

    y_t = sum_k Re( R_k xi_{k,t} ) [+ D u_{t-d}] + free decay,   xi_{k,t+1} = lambda_k xi_{k,t} + u_{t-d},

with and without D, and the pair (d, n) with the best BIC is taken. Delays with a similar BIC are compared by refined
models, because the error of a first model's poles can hide the effect of one sample. A sampled strictly proper plant
has delay 0: the one sample that sampling adds is part of the model. If outputs respond within the sample
(accelerometers), D shows it, and refinement decides. All inputs get the same delay.

Pulse tests bound the delay from above. Before a pulse the structure is at rest or in free decay, y_t = C A^t x_0. The
decay is fitted to the samples before the pulse and extrapolated into it; the bound is the first sample at which an
output deviates from it by more than noise and rounding. A model that lacks modes may replace them by a delay; this
bound does not depend on such a model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import lfilter

from tau_dyn.exceptions import CannotAnswer, TauDynError
from tau_dyn.modes.methods import EraFactors, InitialModels
from tau_dyn.modes.record import Record, truncate_records
from tau_dyn.modes.refinement import refine
from tau_dyn.modes.residuals import SIMULATED, compute_aic_bic, compute_log_det_loss, count_free_parameters
from tau_dyn.modes.time_limit import NO_LIMIT, TimeLimit

MAX_SAMPLES = 6_000  # samples that the delays are compared on
MAX_DELAY_SAMPLES = 20  # the longest delay that is tried
ORDERS = (2, 4, 6, 8, 12, 20, 28)  # orders tried for every delay: modes that all of them lack would look like a delay
MAX_REFINED_ORDER = 12
"""Order up to which rivals are refined: beyond, first models are close enough for a delay, and refinement slow."""
SCAN_SHARE = 0.3  # of a time limit after which no further delay is tried
COARSE = 4  # step of the coarse scan, in samples
CLOSE_BIC_DIFFERENCE = 100.0  # BIC within which two delays are compared by refined models
RIVALS = 3  # delays refined at most; a scan over first models separates the others
MAX_ITERATIONS = 8  # Gauss-Newton steps for a rival; enough to rank it
DECISIVE_BIC_DIFFERENCE = 10.0  # BIC difference beyond which a rival is excluded (Kass & Raftery 1995)


@dataclass(frozen=True)
class DelayChoice:
    """The delay and the evidence for it.

    Attributes:
        delay: Whole samples.
        scan: Delay, best order for it, and its BIC minus the best delay's, for every delay tried.
        sure: BIC of the next best delay minus the best one; above 10 the next best is excluded.
        why: The reason, as a sentence.
    """

    delay: int
    scan: tuple[tuple[int, int, float], ...]
    sure: float
    why: str

    def to_dict(self) -> dict[str, Any]:
        """Return it for the JSON result."""
        rows = [{"delay": d, "order": n, "bic_above_best": gap} for d, n, gap in self.scan]
        return {"sure_by_bic": self.sure, "why": self.why, "trials": rows}


@dataclass(frozen=True, eq=False)
class DelayScan:
    """Delays compared by first models.

    Attributes:
        records: The records on which they were compared.
        longest: The longest delay tried; samples before it are left out for every delay.
        found: The best BIC and its order for each delay.
    """

    records: tuple[Record, ...]
    longest: int
    found: dict[int, tuple[float, int]]


def scan_delays(
    records: Sequence[Record],
    first: Callable[[Sequence[Record], int], InitialModels],
    *,
    orders: Sequence[int] = ORDERS,
    most: int = MAX_DELAY_SAMPLES,
    progress: Callable[[str], None] | None = None,
    limit: TimeLimit = NO_LIMIT,
) -> DelayScan:
    """Compare delays by first models of several orders; see `choose_delay` for the arguments.

    Raises:
        CannotAnswer: No delay gives a model.
    """
    few = truncate_records(records, MAX_SAMPLES)
    most = min(most, min(r.n_samples for r in few) // 20)
    found = _scan(few, first, orders, most, progress or (lambda step: None), limit)
    if not found:
        raise CannotAnswer(
            "no_solution", "no model follows from these data", "a longer log, with more excitation against the noise"
        )
    return DelayScan(tuple(few), most, found)


def choose_delay(
    records: Sequence[Record],
    first: Callable[[Sequence[Record], int], InitialModels],
    *,
    kind: str = SIMULATED,
    orders: Sequence[int] = ORDERS,
    most: int = MAX_DELAY_SAMPLES,
    least_gain: float = 0.0,
    progress: Callable[[str], None] | None = None,
    scan: DelayScan | None = None,
    limit: TimeLimit = NO_LIMIT,
) -> DelayChoice:
    """Choose the delay.

    Args:
        records: Training records, inputs and outputs as deviations.
        first: Gives, for records and a delay, first poles and first models of any order.
        kind: Criterion of the refined models of close delays: `output_error` or `prediction_error`.
        orders: Orders tried for every delay.
        most: The longest delay to try.
        least_gain: Share by which a delay that saves no states must lower the errors to be preferred; 0 relies on BIC
            alone. A true delay saves the states that would represent it; missing modes can look like a delay to BIC as
            well.
        progress: Called with a description of each step.
        scan: The comparison of the same records by first models, if known.
        limit: Time limit, after which competing delays are not refined.

    Raises:
        CannotAnswer: No delay gives a model.
    """
    scan = scan or scan_delays(records, first, orders=orders, most=most, progress=progress, limit=limit)
    few, most, found = scan.records, scan.longest, scan.found

    def refined(d: int, order: int) -> float:
        return _refined(few, first(few, d), d, order, kind, most)

    ranked = sorted((bic, d) for d, (bic, _) in found.items())
    lowest, best = ranked[0]
    gaps, order = {d: bic - lowest for bic, d in ranked}, found[best][1]
    if least_gain and order >= found.get(0, (0.0, max(orders) + 1))[1]:
        n = sum(max(0, r.n_samples - most) for r in few) * few[0].y.shape[1]
        room, after = -2 * n * float(np.log1p(-least_gain)), refined(best, order)
        for d in sorted(d for d, gap in gaps.items() if d < best and gap <= room):
            if refined(d, order) <= after + room:
                rows, sure = _summarise(d, found, gaps)
                what = f"{_samples(d)} of delay are enough" if d else "no delay is needed"
                why = f"{what}: a longer one would spare no states and lower the errors by little"
                return DelayChoice(d, rows, sure, why)
    close = [d for bic, d in ranked if bic < lowest + CLOSE_BIC_DIFFERENCE][:RIVALS]
    if (
        len(close) > 1
        and order <= MAX_REFINED_ORDER
        and not limit.is_over("refined models of close delays", SCAN_SHARE)
    ):
        after = {d: bic for d in close if np.isfinite(bic := refined(d, order))}
        if after:
            best = min(after, key=lambda d: (after[d], d))
            gaps |= {d: bic - after[best] for d, bic in after.items()}
    rows, sure = _summarise(best, found, gaps)
    what = f"a delay of {_samples(best)} explains the data best" if best else "zero delay fits best"
    behind = f"the next is only {sure:.1f} behind in BIC"
    how = "the BIC of any other is decisively worse" if sure > DECISIVE_BIC_DIFFERENCE else behind
    return DelayChoice(best, rows, sure, f"{what}; {how}")


def _summarise(
    best: int, found: dict[int, tuple[float, int]], gaps: dict[int, float]
) -> tuple[tuple[tuple[int, int, float], ...], float]:
    """Return the scan, and the BIC difference of the next best delay."""
    scan = tuple((d, found[d][1], max(gaps[d], 0.0)) for d in sorted(found))
    return scan, min((gap for d, _, gap in scan if d != best), default=float("inf"))


def _samples(delay: int) -> str:
    return f"{delay} sample{'' if delay == 1 else 's'}"


def _scan(
    records: Sequence[Record],
    first: Callable[[Sequence[Record], int], InitialModels],
    orders: Sequence[int],
    most: int,
    say: Callable[[str], None],
    limit: TimeLimit,
) -> dict[int, tuple[float, int]]:
    """Return the best BIC and its order for each delay: a coarse scan, then the neighbours of the best."""
    found: dict[int, tuple[float, int]] = {}
    wanted, tried = list(range(0, most + 1, COARSE)), set[int]()
    while wanted:
        tried.update(wanted)  # those that give no model, too, or they would be tried for ever
        for d in wanted:
            if found and limit.is_over("further delays", SCAN_SHARE):
                return found
            say(f"delay {d}")
            try:
                models = first(records, d)
            except TauDynError:
                continue
            for order in orders:
                try:
                    bic = _linear_bic(models.poles(order), records, d, most)
                except (TauDynError, np.linalg.LinAlgError):
                    continue
                if np.isfinite(bic) and (d not in found or bic < found[d][0]):
                    found[d] = (bic, order)
        best = min(found, key=lambda d: found[d], default=0)
        wanted = [d for d in (best - 2, best - 1, best + 1, best + 2) if 0 <= d <= most and d not in tried and found]
    return found


def _linear_bic(values: np.ndarray, records: Sequence[Record], delay: int, skip: int) -> float:
    """Return BIC of the best response with these poles, D zero or not, on samples whose input is known for every delay."""
    values = values.astype(complex)
    size = np.abs(values)
    values = np.where(size > 1, values / np.maximum(size, 1e-300) ** 2, values)
    rows, direct, ys, decays = [], [], [], []
    for r in records:
        u = np.vstack([np.repeat(r.u[:1], delay, axis=0), r.u[: r.n_samples - delay]])
        forced, free = _columns(values, u)
        rows.append(forced[skip:])
        direct.append(u[skip:])
        decays.append(free[skip:])
        ys.append(r.y[skip:])
    x, y = np.hstack([np.vstack(rows), _apart(decays), np.vstack(direct)]), np.vstack(ys)
    p, m = y.shape[1], records[0].u.shape[1]
    scale = np.linalg.norm(x, axis=0)
    x = x / np.where(scale > 0, scale, 1.0)
    gram, cross = x.T @ x + 1e-12 * np.eye(x.shape[1]), x.T @ y
    bic = []
    for last, answers in ((-m, False), (None, True)):
        theta = np.linalg.lstsq(gram[:last, :last], cross[:last], rcond=1e-13)[0]
        k = count_free_parameters(len(values), p, m, direct=answers, predicts=False)
        bic.append(compute_aic_bic(compute_log_det_loss([y - x[:, :last] @ theta]), len(y), k)[1])
    return min(bic)


def _columns(poles: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return states (N, n m) of every pole under every input, and free decays (N, n); real and imaginary parts."""
    forced, free = [], []
    t = np.arange(len(u))
    for pole in poles[poles.imag >= 0]:
        xi = lfilter([0.0, 1.0], [1.0, -pole], u.astype(complex), axis=0)
        decay = pole**t
        forced += [xi.real] if pole.imag == 0 else [xi.real, xi.imag]
        free += [decay.real] if pole.imag == 0 else [decay.real, decay.imag]
    return np.hstack(forced), np.column_stack(free)


def _apart(decays: Sequence[np.ndarray]) -> np.ndarray:
    """Return free decays side by side, each of its own record, one below the other."""
    n = sum(len(d) for d in decays)
    out, at = np.zeros((n, sum(d.shape[1] for d in decays))), 0
    for k, d in enumerate(decays):
        out[at : at + len(d), k * d.shape[1] : (k + 1) * d.shape[1]] = d
        at += len(d)
    return out


def _refined(records: Sequence[Record], first: InitialModels, delay: int, order: int, kind: str, skip: int) -> float:
    """Return BIC of a refined model on samples whose input is known for every delay; infinite if there is no model."""
    try:
        refined = refine(first.model(order), records, kind=kind, maximum_rounds=MAX_ITERATIONS, covariance=False)
    except (TauDynError, np.linalg.LinAlgError):
        return float("inf")
    model, errors = refined.model, [e[skip - delay :] for e in refined.residuals]
    p, m = model.D.shape
    k = count_free_parameters(model.order, p, m, direct=bool(np.any(model.D)), predicts=kind != SIMULATED)
    return compute_aic_bic(compute_log_det_loss(errors), sum(len(e) for e in errors), k)[1]


ONSET_ORDER = 12  # states of the free decay, at most
MIN_ONSET_SNR = 8.0  # deviation from the free decay over the noise before the pulse, from which on it is a response
OF_PEAK = 2e-4  # part of the output's peak that it must reach at least
STARTED = 0.005  # part of the peak of the force at which the pulse has begun


def find_response_onset(records: Sequence[Record], decays: EraFactors, most: int) -> int:
    """Return the number of samples from a pulse's first one until an output moves; `most` if no output moves earlier.

    Args:
        records: Pulses with some samples of rest before them.
        decays: Their decays, which give the free response of the structure.
        most: Number of samples examined.
    """
    peaks = np.max([np.abs(r.u).max(axis=0) for r in records], axis=0)
    found = [_answer(r, decays, most, peaks) for r in records]
    return min([k for k in found if k is not None], default=most)


MIN_REST_SAMPLES = 10
"""Samples of rest before a pulse that a test of the onset needs: the states before it are fitted to them."""


def _answer(record: Record, decays: EraFactors, most: int, peaks: np.ndarray) -> int | None:
    """Return the onset in one record, or None; `peaks` (r,) are the inputs' largest forces over all records."""
    size = np.abs(record.u / np.maximum(peaks, 1e-300)).max(axis=1)
    hit = int(np.argmax(size))
    if hit < MIN_REST_SAMPLES:
        return None  # the recording begins with the pulse
    noise = np.quantile(size[: max(hit - 5, 1)], 0.9)
    begun = np.flatnonzero(size > max(STARTED, 4 * noise))
    start = int(begun[0]) if len(begun) else 0
    order = min(ONSET_ORDER, start * record.y.shape[1] // 3)
    if start < MIN_REST_SAMPLES or order < 1:
        return None
    A, C = decays.dynamics(order)
    y = record.y[: start + most] / decays.scales.y
    gamma = np.array([C @ np.linalg.matrix_power(A, t) for t in range(len(y))])
    x0 = np.linalg.lstsq(gamma[:start].reshape(-1, order), y[:start].ravel(), rcond=1e-8)[0]
    off = np.abs(y - gamma @ x0)
    limit = np.maximum(
        MIN_ONSET_SNR * np.sqrt(np.mean(off[:start] ** 2, axis=0)),
        OF_PEAK * np.abs(record.y).max(axis=0) / decays.scales.y,
    )
    moved = np.flatnonzero((off[start:] > limit).any(axis=1))
    return int(moved[0]) if len(moved) else None
