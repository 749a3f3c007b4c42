"""Residuals of a model on records: likelihood and information criteria, fit, and tests of whiteness and independence.

    loss = log det (1/N) sum e_t e_t',     BIC = N loss + k log N,   AIC = N loss + 2 k
    fit = 100 (1 - |y - y_hat| / |y - mean(y)|)                                     per output
    r_e(k) = corr(e_t, e_{t-k}),      99 % band  +- 2.58 / sqrt(N)
    r_eu(k) = corr(e_t, u_{t-k}),     99 % band  +- 2.58 sqrt(P_0 / N),  P_j = sum_k r_e(k) r_u(k + j)
    v_t = sum_{k=1}^{L} F_k v_{t-k} + e_t

`e` is the error of a free simulation, or of a prediction one step ahead for closed loops and for tests of whiteness;
`k` is the number of free parameters. With coloured noise the criteria of a simulation favour too many states, because
they assume that `e` is white. The correlation with the inputs is tested on white or coloured residuals: `P` accounts
for the autocorrelation of both signals. A whole curve is tested by one statistic, `N r' P^-1 r`, chi-squared with as
many degrees of freedom as lags. Lags from 0 up show dynamics that the model lacks; negative lags show inputs that
respond to past residuals, which is feedback. The last line is an autoregression of the simulation residuals `v`, for
predictions a few steps ahead; L is selected by BIC, and L = 0 means that `v` is white (its long-memory counterpart is
the innovation form in `refinement.py`). Reference: Ljung 1999, 16.4, 16.6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.fft import irfft, rfft
from scipy.fft import next_fast_len
from scipy.linalg import solve_toeplitz, toeplitz
from scipy.stats import chi2, norm

from tau_dyn.modes.record import Record
from tau_dyn.modes.state_space import StateSpace, predict, simulate
from tau_dyn.results import Brief

SIMULATED = "output_error"
PREDICTED = "prediction_error"


def compute_residuals(model: StateSpace, records: Sequence[Record], kind: str = SIMULATED) -> list[np.ndarray]:
    """Return measured minus simulated, or minus predicted one step ahead, (N - delay, p) a record.

    Initial states are estimated; the first `delay` samples respond to inputs before the record and are left out.
    """
    follow = simulate if kind == SIMULATED else lambda m, r: predict(m, r, 1)
    return [(r.y - follow(model, r))[model.delay :] for r in records]


def compute_covariance(errors: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean of e e' over all records (p, p)."""
    return np.sum([e.T @ e for e in errors], axis=0) / sum(len(e) for e in errors)


def compute_mean_squares(errors: Sequence[np.ndarray]) -> np.ndarray:
    """Return each column's mean square over all records (p,)."""
    return np.sum([np.sum(e**2, axis=0) for e in errors], axis=0) / sum(len(e) for e in errors)


def compute_log_det_loss(errors: Sequence[np.ndarray]) -> float:
    """Return log det of the errors' covariance; infinite if a simulation diverges."""
    sigma = compute_covariance(errors)
    if not np.all(np.isfinite(sigma)):
        return float("inf")
    sign, value = np.linalg.slogdet(sigma)
    return float(value) if sign > 0 else float("-inf")


def measure_spread(errors: Sequence[np.ndarray]) -> float:
    """Return the sum of the outputs' log mean squares, a loss that treats outputs separately; infinite if one diverges."""
    power = np.diag(compute_covariance(errors))
    return float(np.sum(np.log(np.maximum(power, 1e-300)))) if np.all(np.isfinite(power)) else float("inf")


def count_free_parameters(order: int, p: int, m: int, *, direct: bool, predicts: bool) -> int:
    """Return the free numbers of a model: its states' freedom of basis taken out (McKelvey & Helmersson 2004)."""
    return order * (p + m) + (p * m if direct else 0) + (order * p if predicts else 0)


def compute_aic_bic(loss: float, n_samples: int, k: int) -> tuple[float, float]:
    """Return AIC and BIC."""
    return n_samples * loss + 2 * k, n_samples * loss + k * float(np.log(n_samples))


def compare_errors_paired(errors: Sequence[np.ndarray], best: Sequence[np.ndarray], blocks: int = 20) -> float:
    """Return by how many standard errors some errors are larger than the best ones on the same samples.

    Every output is weighed by its best errors. Blocks of time are compared in pairs, so neither colour nor common
    errors count, and in ratios, so that the large amplitudes at the beginning of a decay do not hide the rest.
    """
    weight = 1 / np.maximum(np.diag(compute_covariance(best)), 1e-300)
    length = max(20, sum(len(e) for e in best) // blocks)
    rows = []
    for e, b in zip(errors, best, strict=True):
        pair = np.column_stack([x**2 @ weight for x in (e, b)])
        parts = [part.mean(axis=0) for part in np.array_split(pair, max(1, len(pair) // length))]
        rows += [float(np.log(one / other)) for one, other in parts if one > 0 and other > 0]
    if not np.all(np.isfinite(rows)):
        return float("inf")
    scatter = float(np.std(rows, ddof=1)) / np.sqrt(len(rows)) if len(rows) > 2 else float(np.abs(np.mean(rows)))
    return float(np.mean(rows)) / scatter if scatter > 0 else 0.0


MAX_NOISE_ORDER = 30  # of the noise's autoregression; BIC chooses below it
MAX_NOISE_SAMPLES = 50_000  # samples used; coefficients of thirty lags are known to a per cent by then


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """An autoregressive model of errors.

    Attributes:
        F: (L, p, p), one step back first.
    """

    F: np.ndarray

    @property
    def lags(self) -> int:
        """Number of lags L."""
        return len(self.F)

    def ahead(self, v: np.ndarray, k: int) -> np.ndarray:
        """Return the errors (N, p) of predictions k samples ahead; the first ones know no past."""
        if not self.lags:
            return v
        known = np.vstack([np.zeros((self.lags, v.shape[1])), v])
        window = [known[self.lags - j : len(known) - j] for j in range(1, self.lags + 1)]  # v_{t-1}, v_{t-2}, ..
        for _ in range(k):
            guess = np.sum([x @ f.T for x, f in zip(window, self.F, strict=True)], axis=0)
            window = [guess, *window[:-1]]
        late = np.vstack([np.zeros((k - 1, v.shape[1])), guess[: len(v) - k + 1]])  # made at t - k for t
        return v - late


def fit_noise_model(errors: Sequence[np.ndarray]) -> NoiseModel:
    """Fit the model to a simulation's errors, one (N, p) per record; BIC selects its length.

    The fit uses tapered autocovariances (Yule-Walker), which make the model stable for any errors.
    """
    few, left = [], MAX_NOISE_SAMPLES
    for v in errors:
        if left > 0:
            few.append(v[:left])
            left -= len(v)
    n, p = sum(len(v) for v in few), few[0].shape[1]
    most = int(max(0, min(MAX_NOISE_ORDER, min(len(v) for v in few) // 4, n // (10 * p))))
    size = np.sqrt(np.sum([np.sum(v**2, axis=0) for v in few], axis=0) / n)
    size[size == 0] = 1.0
    R = np.array([np.sum([v[k:].T @ v[: len(v) - k] for v in few], axis=0) for k in range(most + 1)]) / n
    R = R / size[:, None] / size  # E v_t v_{t-k}'
    R[0] += 1e-9 * np.eye(p)
    block = np.arange(most)
    past = np.concatenate([R[:0:-1].swapaxes(1, 2), R])[most + block - block[:, None]]  # R_{j-i}, R_{-k} = R_k'
    past = past.swapaxes(1, 2).reshape(most * p, most * p)
    best, chosen = np.inf, np.zeros((0, p, p))
    for lags in range(most + 1):
        ahead = R[1 : lags + 1].swapaxes(0, 1).reshape(p, lags * p)
        F = np.linalg.solve(past[: lags * p, : lags * p].T, ahead.T).T
        score = n * np.linalg.slogdet(R[0] - F @ ahead.T)[1] + lags * p * p * np.log(n)
        if score < best:
            best, chosen = score, F.reshape(p, lags, p).transpose(1, 0, 2)
    return NoiseModel(chosen * size[:, None] / size)


Z99 = float(norm.ppf(0.995))
LAGS = 25  # lags of the correlation tests, as usual in the field
PASS = 0.01  # smallest p-value with which a curve passes


@dataclass(frozen=True, eq=False)
class FitQuality:
    """How well the model follows some records.

    Attributes:
        percent: Fit of a free simulation per output (p,), initial state estimated.
        ahead: The same for predictions, by number of samples ahead; one and ten, if noise was modelled.
        n_samples: Number of samples.
        rms: Root mean square of the simulation error, per output (p,).
    """

    percent: np.ndarray
    ahead: Mapping[int, np.ndarray]
    n_samples: int
    rms: np.ndarray

    @property
    def mean(self) -> float:
        """Mean over the outputs [%]."""
        return float(np.mean(self.percent))


@dataclass(frozen=True, eq=False)
class CorrelationTest(Brief):
    """One correlation curve, its band, and the test of the whole curve.

    Attributes:
        output: Output whose residual is tested.
        input: Input it is correlated with; empty for the residual with itself.
        lags: Lags in samples (L,).
        values: Correlation at these lags (L,), between -1 and 1.
        band: Half width of the 99 % band.
        p_value: p-value of the tested lags.
        judged: Tested lags (L,) bool; the others are only drawn.
    """

    output: str
    input: str
    lags: np.ndarray
    values: np.ndarray
    band: float
    p_value: float
    judged: np.ndarray

    @property
    def passed(self) -> bool:
        """Whether chance alone explains the curve."""
        return self.p_value >= PASS

    @property
    def outside(self) -> float:
        """Share of judged lags outside the band; 1 % of them by chance."""
        return float(np.mean(np.abs(self.values[self.judged]) > self.band)) if self.judged.any() else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return it for the JSON result."""
        name = {"output": self.output} | ({"input": self.input} if self.input else {})
        return name | {"p_value": self.p_value, "passed": self.passed, "share_outside_99_percent": self.outside}


def fit_of(measured: Sequence[np.ndarray], simulated: Sequence[np.ndarray]) -> np.ndarray:
    """Return the fit of simulations of records per output (p,) [%]; 100 is exact, 0 is no better than the mean."""
    missed = np.sum([np.sum((y - s) ** 2, axis=0) for y, s in zip(measured, simulated, strict=True)], axis=0)
    moved = np.sum([np.sum((y - y.mean(axis=0)) ** 2, axis=0) for y in measured], axis=0)
    return 100 * (1 - np.sqrt(missed / np.where(moved > 0, moved, np.nan)))


def check_whiteness(
    errors: Sequence[np.ndarray], outputs: Sequence[str], lags: int = LAGS
) -> tuple[CorrelationTest, ...]:
    """Test whether prediction errors are autocorrelated: one test per output (Ljung-Box).

    Args:
        errors: One-step prediction errors, one (N, p) a record.
        outputs: Names of the outputs.
        lags: Number of lags.
    """
    tests = []
    for k, name in enumerate(outputs):
        columns = [_centred(e[:, k]) for e in errors]
        n, lags_here = _count(columns), min(lags, min(len(c) for c in columns) // 4)
        r = _correlation(columns, columns, lags_here)[lags_here:]
        r = r / r[0] if r[0] > 0 else np.zeros_like(r)
        q = n * (n + 2) * np.sum(r[1:] ** 2 / (n - np.arange(1, lags_here + 1)))
        lag = np.arange(lags_here + 1)
        tests.append(CorrelationTest(name, "", lag, r, Z99 / np.sqrt(n), float(chi2.sf(q, lags_here)), lag > 0))
    return tuple(tests)


def check_independence(
    errors: Sequence[np.ndarray],
    u: Sequence[np.ndarray],
    outputs: Sequence[str],
    inputs: Sequence[str],
    *,
    lags: int = LAGS,
    used: int = 0,
) -> tuple[CorrelationTest, ...]:
    """Test whether the residuals are correlated with the inputs: one test for each pair.

    Args:
        errors: Residuals of the model, one (N, p) per record; may be coloured.
        u: Inputs (N, m) of the same records, as late as the model's delay makes them act.
        outputs: Names of the outputs.
        inputs: Names of the inputs.
        lags: Lags from 0 up to here are judged, and as many negative ones are drawn.
        used: Degrees of freedom that the fit to these very data used up in each pair; 0 on held-out data.
    """
    return tuple(
        _pair([_centred(e[:, i]) for e in errors], [_centred(x[:, j]) for x in u], output, name, lags, used)
        for i, output in enumerate(outputs)
        for j, name in enumerate(inputs)
    )


def _pair(e: list[np.ndarray], u: list[np.ndarray], output: str, name: str, lags: int, used: int) -> CorrelationTest:
    n, lags = _count(e), min(lags, min(len(c) for c in e) // 4)
    far = min(min(len(c) for c in e) // 2, 20 * lags)
    own_e, own_u = (_autocorrelation(c, far) for c in (e, u))
    sizes = np.sqrt(max(sum(c @ c for c in e) * sum(c @ c for c in u), 1e-300))
    r = _correlation(e, u, lags) * n / sizes
    colour = _colour(own_e, own_u, lags + 1)
    judged = np.arange(-lags, lags + 1) >= 0
    x = n * float(r[judged] @ _solve(colour, r[judged]))
    p = float(chi2.sf(x, max(lags + 1 - used, 1)))
    return CorrelationTest(output, name, np.arange(-lags, lags + 1), r, Z99 * float(np.sqrt(colour[0] / n)), p, judged)


def _colour(own_e: np.ndarray, own_u: np.ndarray, n: int) -> np.ndarray:
    """Return `P_j`, j = 0 .. n-1, from autocorrelations on lags from 0 up; tapered, so that it stays a covariance."""
    far = len(own_e) - 1
    taper = 1 - np.arange(far + 1) / (far + 1)
    both_e, both_u = (np.concatenate([(taper * r)[:0:-1], taper * r]) for r in (own_e, own_u))
    full = np.convolve(both_e, both_u)  # the autocorrelations are even, so correlation is convolution
    return full[2 * far : 2 * far + n]


def _solve(column: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve with a Toeplitz covariance; a small white-noise term keeps it regular for periodic inputs."""
    column = column.copy()
    column[0] *= 1 + 1e-6
    try:
        return solve_toeplitz(column, right)
    except np.linalg.LinAlgError:
        return np.linalg.lstsq(toeplitz(column), right, rcond=1e-6)[0]


def _autocorrelation(columns: list[np.ndarray], lags: int) -> np.ndarray:
    r = _correlation(columns, columns, lags)[lags:]
    return r / r[0] if r[0] > 0 else np.eye(1, lags + 1)[0]


def _correlation(a: list[np.ndarray], b: list[np.ndarray], lags: int) -> np.ndarray:
    """Return mean of a_t b_{t-k} for k = -lags .. lags, over all records, without joining records."""
    total = np.zeros(2 * lags + 1)
    for x, y in zip(a, b, strict=True):
        size = int(next_fast_len(len(x) + lags + 1, real=True) or 0)
        both = irfft(rfft(x, size) * np.conj(rfft(y, size)), size)
        total += np.concatenate([both[size - lags :], both[: lags + 1]])
    return total / _count(a)


def _centred(x: np.ndarray) -> np.ndarray:
    return x - x.mean()


def _count(columns: Sequence[np.ndarray]) -> int:
    return sum(len(c) for c in columns)
