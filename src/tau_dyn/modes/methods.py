"""From records to a first model of any order, by the method asked for; every method guards against instability.

`n4sid` is the canonical variate analysis of `subspace.py`, `pbsid` bears feedback, `arx` reduces a long ARX model,
`era` takes impulse tests. Refinement starts here and mends what these leave; which method suits the data is decided
in `find.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.modes.arx import arx
from tau_dyn.modes.era import EraFactors, decompose_pulse_tests
from tau_dyn.modes.pbsid import pbsid
from tau_dyn.modes.record import Record
from tau_dyn.modes.reduce import reduce_order
from tau_dyn.modes.state_space import StateSpace
from tau_dyn.modes.subspace import choose_default_horizon, compress_subspace_data

METHODS = ("n4sid", "pbsid", "arx", "era")
ARX_LAGS = 60
"""Lags of the long ARX model, where the data can pay for them."""
SLOWEST = 1 - 1e-6
"""Largest magnitude of a pole that a first model may have."""

Start = Callable[[int], StateSpace]


def build_initial_estimator(method: str, records: Sequence[Record], *, delay: int = 0, highest: int = 20) -> Start:
    """Return a function from an order to a stable first model; each order, and what all share, is computed once.

    Args:
        method: `n4sid`, `pbsid`, `arx` or `era`.
        records: To fit on.
        delay: Whole samples by which the inputs act late.
        highest: The highest order that will be asked for.

    Raises:
        InputError: There is no such method, or the records are too short for it.
    """
    if method == "n4sid":
        factors = compress_subspace_data(records, delay=delay)
        return cache(lambda order: stabilise_poles(factors.model(order)))
    if method == "pbsid":
        return cache(lambda order: stabilise_poles(pbsid(records, order, delay=delay)))
    if method == "arx":
        long = arx(records, _lags(records, highest), delay=delay)
        return cache(lambda order: stabilise_poles(reduce_order(long, order)))
    if method == "era":
        decays = decompose_pulse_tests(records, delay=delay)
        return cache(lambda order: stabilise_poles(decays.model(order)))
    raise InputError("bad_option", f"--method {method}: there are auto, {', '.join(METHODS)}")


@dataclass(frozen=True, eq=False)
class InitialModels:
    """First looks at records under one delay.

    Attributes:
        poles: From an order to poles (n,) in the z plane; cheap.
        model: From an order to a first model.
    """

    poles: Callable[[int], np.ndarray]
    model: Start


def estimate_first_poles(
    method: str,
    records: Sequence[Record],
    *,
    delay: int,
    horizon: int = 30,
    decays: EraFactors | None = None,
) -> InitialModels:
    """Return first poles and models of any order, as cheaply as a scan over many delays needs them.

    Args:
        method: `n4sid`, `pbsid`, `arx` or `era`; poles come from the subspace method, or from `era` for pulses.
        records: To fit on.
        delay: Whole samples by which the inputs act late.
        horizon: Block rows of past and of future; fewer where the records are short.
        decays: For `era`, the decays as the longest delay leaves them: their poles are those of every delay.
    """
    if method == "era":
        late = decays or decompose_pulse_tests(records, delay=delay)
        here = decompose_pulse_tests(records, delay=delay)
        return InitialModels(lambda n: np.linalg.eigvals(late.dynamics(n)[0]), lambda n: stabilise_poles(here.model(n)))
    aligned = [r.aligned(delay) for r in records]
    factors = compress_subspace_data(records, delay=delay, horizon=min(horizon, choose_default_horizon(aligned)))
    if method == "pbsid":
        return InitialModels(
            lambda n: np.linalg.eigvals(factors.dynamics(n)[0]), build_initial_estimator(method, records, delay=delay)
        )
    return InitialModels(
        lambda n: np.linalg.eigvals(factors.dynamics(n)[0]), lambda n: stabilise_poles(factors.model(n))
    )


def stabilise_poles(model: StateSpace) -> StateSpace:
    """Return the model with unstable poles mirrored into the unit circle; frequencies stay, growth becomes decay."""
    if model.spectral_radius() < SLOWEST:
        return model
    values, vectors = np.linalg.eig(model.A)
    size = np.abs(values)
    inside = np.where(
        size >= SLOWEST, values / np.maximum(size, 1e-300) * np.minimum(1 / np.maximum(size, 1), SLOWEST), values
    )
    return replace(model, A=np.real(vectors @ np.diag(inside) @ np.linalg.inv(vectors)))


def _lags(records: Sequence[Record], highest: int) -> int:
    """Return how many lags the samples can pay for: ten samples an unknown, and never fewer than the order needs."""
    p, m = records[0].y.shape[1], records[0].u.shape[1]
    paid = sum(r.n_samples for r in records) // (10 * (p + m))
    needed = -(-highest // p)
    return max(needed, min(ARX_LAGS, paid), 2)
