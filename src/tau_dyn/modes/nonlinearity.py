r"""Is what a linear model leaves correlated with powers of the response: a test for nonlinear stiffness, damping or friction.

With y the simulated output, z = y^k (k = 2, 3) less its regression on lags of the inputs and of y (for a Gaussian input the
Hermite polynomial, uncorrelated with anything linear, Bussgang 1952), the residual e of a linear structure satisfies

    corr(e_t, z_{t-l}) = 0,   l = 0 .. 25,        e.g. Duffing:  m y'' + c y' + k y = u - k3 y^3   gives   e = -G k3 y^3 + ...

judged with the colours of both (Ljung 1999, 16.6). Reference: Billings & Voon 1986 (higher-order correlation tests).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.linalg import qr

from tau_dyn.modes.checks import LAGS, check_independence

POWERS = (2, 3)
SIGNIFICANCE_LEVEL = 1e-3  # of a nonlinearity that is not there; one set in a thousand
MIN_VARIANCE_SHARE = 0.1
"""Share of the residual's variance that a power must explain to count: everything real is slightly nonlinear."""
LINEAR_LAGS = 30  # of the inputs, taken out of the powers
OWN_LAGS = 2  # of the response, taken out of its powers
MAX_SAMPLES = 20_000  # samples looked at


@dataclass(frozen=True)
class Nonlinearity:
    """Whether a structure responds nonlinearly.

    Attributes:
        suspected: Whether a power is significant and explains enough.
        p_value: How often a linear structure would look more nonlinear, over all outputs and powers.
        share: Share of the residual's variance that the power explains.
        output: The output concerned.
        power: 2 where the response depends on its sign, 3 where on its size.
    """

    suspected: bool
    p_value: float
    share: float
    output: str
    power: int

    def to_dict(self) -> dict[str, Any]:
        """Return it for the JSON result."""
        return asdict(self)


def detect_nonlinearity(
    errors: Sequence[np.ndarray], simulated: Sequence[np.ndarray], u: Sequence[np.ndarray], outputs: Sequence[str]
) -> Nonlinearity | None:
    """Test the longest record; None where it is too short.

    Args:
        errors: Measured minus simulated outputs, one (N, p) a record.
        simulated: Simulated outputs (N, p) of the same samples.
        u: Inputs (N, m), as late as the model's delay makes them act.
        outputs: Names of the outputs.
    """
    longest = int(np.argmax([len(e) for e in errors]))
    e, y, u_long = (x[longest][:MAX_SAMPLES] for x in (errors, simulated, u))
    if len(e) < 20 * LINEAR_LAGS * max(1, u_long.shape[1]):
        return None
    inputs = np.asarray(qr(np.hstack([np.ones((len(y), 1)), _lagged(u_long, LINEAR_LAGS)]), mode="economic")[0])
    found: list[tuple[float, int, int, np.ndarray]] = []
    for i, name in enumerate(outputs):
        size = y[:, i].std()
        if size == 0:
            continue
        powers = np.column_stack([(y[:, i] / size) ** k for k in POWERS])
        left = np.hstack([_lagged(y[:, i : i + 1], OWN_LAGS), powers])
        left -= inputs @ (inputs.T @ left)
        own, powers = left[:, : OWN_LAGS + 1], left[:, OWN_LAGS + 1 :]
        powers = powers - own @ np.linalg.lstsq(own, powers, rcond=None)[0]
        tests = check_independence([e[:, i : i + 1]], [powers], [name], [""] * len(POWERS))
        found += [(t.p_value, i, k, z) for t, k, z in zip(tests, POWERS, powers.T, strict=True)]
    if not found:
        return None
    p, i, power, z = min(found, key=lambda row: row[0])
    columns = _lagged(z[:, None], LAGS)
    error = e[:, i] - e[:, i].mean()
    missed = error - columns @ np.linalg.lstsq(columns, error, rcond=None)[0]
    share = 1 - float(np.var(missed) / max(float(np.var(error)), 1e-300))
    p = min(1.0, p * len(found))
    return Nonlinearity(p < SIGNIFICANCE_LEVEL and share > MIN_VARIANCE_SHARE, p, share, outputs[i], power)


def _lagged(x: np.ndarray, lags: int) -> np.ndarray:
    """Return columns (N, c) as they were 0 to `lags` samples before, side by side; zero before the record."""
    return np.hstack([np.vstack([np.zeros((k, x.shape[1])), x[: len(x) - k]]) for k in range(lags + 1)])
