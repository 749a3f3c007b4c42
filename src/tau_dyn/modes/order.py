"""How many states: no single number says it, so several are looked at together.

One factorisation of three quarters of the training data gives first models of all orders up to a high one; each simulates the
last quarter (the held-out data stay out of it). Near the one that does best, models are refined and compared again, until the
neighbours of the leading order are known. Among the refined and stable ones,

1. the smallest order that simulates that quarter as well as the best, within two standard errors of paired blocks, is taken;
2. where BIC asks for more states, they are granted if they do not simulate worse and what is left is white, which is what BIC
   assumes.

Hannan & Deistler 1988 on what the criteria can and cannot tell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError, TauDynError
from tau_dyn.modes.methods import Start
from tau_dyn.modes.modal import Mode, find_resonances
from tau_dyn.modes.record import Record, truncate_records
from tau_dyn.modes.refinement import refine
from tau_dyn.modes.residuals import (
    SIMULATED,
    check_whiteness,
    compare_errors_paired,
    compute_aic_bic,
    compute_log_det_loss,
    compute_residuals,
    count_free_parameters,
    fit_of,
    measure_spread,
)
from tau_dyn.modes.state_space import StateSpace

SELECT_SHARE = 0.25  # of the training data on which orders are compared
MAX_SAMPLES = 6_000
"""Samples that the orders are compared on."""
PULSE = 500
"""Samples of each pulse that are kept in any case."""
MAX_ORDER = 60
"""Highest order that is looked at unless one is asked for: thirty modes in the band of one test."""
MAX_PREDICTED_ORDER = 24
"""The same where one-step predictions are compared, whose first models cost a factorisation each."""
SMALL = 8
"""Up to this order all even ones below are refined, which costs little and fills the stabilisation diagram."""
BEYOND = 4
"""Orders that are refined above the leading one: a diagram needs them, a choice does not."""
MAX_REFINED_MODELS = 14
"""Models that are refined to compare orders; a walk that has not ended by then stays where it is."""
MANY_NUMBERS = 100
"""Free numbers of a model beyond which standard errors of trials are left out and fewer rounds are spent."""
MAX_ITERATIONS = 4  # Gauss-Newton steps for a candidate order; enough to rank it
TOLERANCE = 2.0  # standard errors of the paired difference within which the smaller order is as good
PATIENCE = 16
"""Orders without any gain after which the scan stops, once it has explained most of what moves."""
GOOD_FIT_PERCENT = 80.0
"""Fit from which on patience counts: modes that come in late show only when most of them are in."""


@dataclass(frozen=True, eq=False)
class OrderTrial:
    """A model of one order.

    Attributes:
        order: Number of states.
        loss: Log det of its errors' covariance on the data it was fitted to.
        aic: Akaike's criterion.
        bic: Bayesian criterion.
        fit_percent: Mean fit on the quarter that it was not fitted to [%].
        behind: Standard errors by which its errors there exceed the best ones; 0 for the best.
        stable: Whether all poles lie inside the unit circle.
        white: Whether what it leaves is white.
        modes: Its modes, with standard errors.
        model: The model itself.
        refined: Whether it was refined; first models are shown, but not chosen from.
        plain: Whether refinement was tried and made the simulation of other data worse, so that the first model stands.
    """

    order: int
    loss: float
    aic: float
    bic: float
    fit_percent: float
    behind: float
    stable: bool
    white: bool
    modes: tuple[Mode, ...]
    model: StateSpace
    refined: bool = True
    plain: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return it for the JSON result."""
        names = ("order", "loss", "aic", "bic", "fit_percent", "behind", "stable", "white", "refined")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, eq=False)
class OrderChoice:
    """The order, and what was known when it was chosen.

    Attributes:
        order: The order taken.
        trials: All orders that were tried, lowest first.
        by: What each criterion alone would have taken: `aic`, `bic`, `simulation`.
        why: The reason, as a sentence.
        chosen: Whether it was chosen here; False where it was asked for.
        limit: The highest order that was looked at, where more states may help; 0 where it does not bind.
    """

    order: int
    trials: tuple[OrderTrial, ...]
    by: dict[str, int]
    why: str
    chosen: bool = True
    limit: int = 0

    @property
    def taken(self) -> OrderTrial | None:
        """The trial of the order taken; None where there is none."""
        return next((t for t in self.refined if t.order == self.order), None)

    @property
    def refined(self) -> tuple[OrderTrial, ...]:
        """The trials that were refined, lowest first."""
        return tuple(t for t in self.trials if t.refined)

    def to_dict(self) -> dict[str, Any]:
        """Return it for the JSON result."""
        trials = [t.to_dict() for t in self.trials]
        return {"chosen": self.chosen, "by": self.by, "why": self.why, "limit": self.limit, "trials": trials}


def choose_order(
    records: Sequence[Record],
    start: Callable[[Sequence[Record]], Start],
    *,
    orders: Sequence[int] | None = None,
    kind: str = SIMULATED,
    asked: int | None = None,
    pulses: bool = False,
    progress: Callable[[str], None] | None = None,
) -> OrderChoice:
    """Choose the order.

    Args:
        records: Training records, inputs and outputs as deviations.
        start: Gives, for records, a function from an order to a first model.
        orders: Orders to refine; the neighbourhood of the best up to 60, where not given.
        kind: `output_error` or `prediction_error`.
        asked: An order that is wanted in any case; the trials then only show what it is among.
        pulses: Whether each record is a pulse and its decay, which must not be cut.
        progress: Told what is done.

    Raises:
        CannotAnswer: No order gives a stable model.
    """
    fitted, kept = select_pulses(records) if pulses else select_parts(records)
    make, apart = start(fitted), kept is not fitted
    search = _Search(fitted, kept, make, kind, apart, progress)
    scanned: list[_Row] = []
    if orders is not None:
        for order in _affordable(fitted, orders):
            search.refine(order)
    else:
        wanted = _affordable(
            fitted,
            [1, 2, 3, *range(4, max(MAX_ORDER if kind == SIMULATED else MAX_PREDICTED_ORDER, asked or 0) + 1, 2)],
        )
        scanned = _scan(search, wanted)
        _refine_near(search, scanned, asked)
    rows = sorted(search.rows, key=lambda row: row.order)
    if not rows:
        raise CannotAnswer(
            "no_solution", "no order gave a stable model", "a longer log, with more excitation against the noise"
        )
    best = min(rows, key=lambda row: row.lost)
    done = {row.order for row in rows}
    rows = sorted([*rows, *(r for r in scanned if r.order not in done)], key=lambda row: row.order)
    trials = tuple(_trial(row, best) for row in rows)
    if asked is not None:
        return OrderChoice(asked, trials, _by(trials), f"order {asked} was asked for", chosen=False)
    choice = _chosen(trials, apart)
    highest = max((t.order for t in trials), default=0)
    if orders is None and search.at_limit(choice.order, highest):
        why = f"{choice.why}; {highest} is the highest that was looked at, and more may help"
        return replace(choice, why=why, limit=highest)
    return choice


@dataclass(eq=False)
class _Search:
    """What refines orders, and what it has found so far."""

    fitted: Sequence[Record]
    kept: Sequence[Record]
    make: Start
    kind: str
    apart: bool
    progress: Callable[[str], None] | None

    def __post_init__(self) -> None:
        self.rows: list[_Row] = []
        self.tried: set[int] = set()
        self.affordable = set(_affordable(self.fitted, range(1, 401), strict=False))

    def refine(self, order: int) -> None:
        """Add a refined model of an order, once, where the data can pay for it."""
        if order < 1 or order in self.tried or order not in self.affordable or len(self.tried) >= MAX_REFINED_MODELS:
            return
        self.tried.add(order)
        if self.progress is not None:
            self.progress(f"order {order}")
        row = _try(self.fitted, self.kept, self.make, order, self.kind)
        if row is not None:
            self.rows.append(row)

    def leading(self) -> int:
        """Return the order that would be taken so far."""
        best = min(self.rows, key=lambda row: row.lost)
        return _chosen([_trial(row, best) for row in self.rows], self.apart).order

    def at_limit(self, order: int, highest: int) -> bool:
        """Tell whether an order is the highest there was, though neither BIC nor the data asked to stop."""
        return order >= highest - 1 and len(self.rows) > 1


def _scan(search: _Search, orders: Sequence[int]) -> list[_Row]:
    """Return first models of orders, unrefined; the scan stops where the data are explained and no order gains."""
    if search.progress is not None:
        search.progress("scanning orders")
    rows: list[_Row] = []
    for order in orders:
        try:
            row = _judge(search.make(order), search.fitted, search.kept, search.kind)
        except (TauDynError, np.linalg.LinAlgError):
            continue
        if row is None:
            continue
        rows.append(row)
        best = min(rows, key=lambda r: r.lost)
        if best.fit > GOOD_FIT_PERCENT and order >= best.order + PATIENCE:
            break
    return rows


def _refine_near(search: _Search, scanned: Sequence[_Row], asked: int | None) -> None:
    """Refine the neighbourhood of the order that first models favour, until the leading order's neighbours are known."""
    first = asked or 4
    if scanned:
        best = min(scanned, key=lambda row: row.lost)
        first = min(
            row.order for row in scanned if row is best or compare_errors_paired(row.kept, best.kept) <= TOLERANCE
        )
        first = asked or first
    if first <= SMALL:
        for order in range(2, first + 1, 2):
            search.refine(order)
    search.refine(first)
    while search.rows:
        before = len(search.tried)
        leading = search.leading() if asked is None else asked
        around = (leading - 2, leading + 2)
        if leading <= SMALL:
            around = (*around, leading + BEYOND, leading - 1, leading + 1)
        for order in around:
            search.refine(order)
        if len(search.tried) == before:
            return


@dataclass(frozen=True, eq=False)
class _Row:
    order: int
    k: int
    n: int
    loss: float
    lost: float
    kept: list[np.ndarray]
    fit: float
    white: bool
    model: StateSpace
    modes: tuple[Mode, ...]
    refined: bool = False
    plain: bool = False


def _try(fitted: Sequence[Record], kept: Sequence[Record], make: Start, order: int, kind: str) -> _Row | None:
    """Return a refined model of an order, or None where the method or the refinement finds none.

    Where refinement makes the simulation of other data worse, the first model stands: likelihood under white errors and
    correlated outputs is not what a simulation is asked for.
    """
    try:
        first = make(order)
        p, m = first.D.shape
        refined = refine(
            first, fitted, kind=kind, maximum_rounds=MAX_ITERATIONS, covariance=order * (p + m) <= MANY_NUMBERS
        )
    except (TauDynError, np.linalg.LinAlgError):
        return None
    row = _judge(refined.model, fitted, kept, kind)
    if kind == SIMULATED and kept is not fitted:
        plain = _judge(first, fitted, kept, kind)
        if plain is not None and (row is None or compare_errors_paired(row.kept, plain.kept) > TOLERANCE):
            return replace(plain, refined=True, plain=True)
    return None if row is None else replace(row, modes=tuple(refined.modes), refined=True)


def _judge(model: StateSpace, fitted: Sequence[Record], kept: Sequence[Record], kind: str) -> _Row | None:
    """Return how a model does on what it was fitted to and on what it was not; None where it is not stable."""
    if model.spectral_radius() >= 1:
        return None
    if kind != SIMULATED and np.abs(np.linalg.eigvals(model.A - model.K @ model.C)).max(initial=0) >= 1:
        return None  # its predictor runs away
    errors, others = compute_residuals(model, fitted, kind), compute_residuals(model, kept, kind)
    if not all(np.isfinite(e).all() for e in (*errors, *others)):
        return None
    p, m = model.D.shape
    k = count_free_parameters(model.order, p, m, direct=bool(np.any(model.D)), predicts=kind != SIMULATED)
    white = min(t.p_value for t in check_whiteness(errors, [""] * p)) * p > 0.001
    measured = [r.y[model.delay :] for r in kept]
    fit = float(np.mean(fit_of(measured, [y - e for y, e in zip(measured, others, strict=True)])))
    n = sum(len(e) for e in errors)
    return _Row(
        model.order,
        k,
        n,
        compute_log_det_loss(errors),
        measure_spread(others),
        others,
        fit,
        white,
        model,
        find_resonances(model),
    )


def _trial(row: _Row, best: _Row) -> OrderTrial:
    aic, bic = compute_aic_bic(row.loss, row.n, row.k)
    behind = 0.0 if row is best else compare_errors_paired(row.kept, best.kept)
    return OrderTrial(
        row.order, row.loss, aic, bic, row.fit, behind, True, row.white, row.modes, row.model, row.refined, row.plain
    )


def _by(trials: Sequence[OrderTrial]) -> dict[str, int]:
    trials = [t for t in trials if t.refined]
    good = [t for t in trials if t.behind <= TOLERANCE]
    return {
        "simulation": min(t.order for t in good),
        "aic": min(trials, key=lambda t: t.aic).order,
        "bic": min(trials, key=lambda t: t.bic).order,
    }


def _chosen(trials: Sequence[OrderTrial], apart: bool) -> OrderChoice:
    by = _by(trials)
    if not apart:
        why = f"order {by['bic']} is what BIC takes; there was no second pulse to compare on"
        return OrderChoice(by["bic"], tuple(trials), by, why)
    simple, bic = by["simulation"], next(t for t in trials if t.refined and t.order == by["bic"])
    why = f"order {simple} is the smallest that simulates data it was not fitted to as well as any"
    if bic.order <= simple:
        agree = "; BIC agrees" if bic.order == simple else f"; BIC would take {bic.order}"
        return OrderChoice(simple, tuple(trials), by, why + agree)
    if bic.white and bic.behind <= TOLERANCE:
        why = f"order {bic.order} is what BIC takes; it leaves white noise, and simulates other data as well as any"
        return OrderChoice(bic.order, tuple(trials), by, why)
    return OrderChoice(simple, tuple(trials), by, f"{why}; BIC would take {bic.order}, but what is left is not white")


def select_pulses(records: Sequence[Record]) -> tuple[Sequence[Record], Sequence[Record]]:
    """Return pulses to fit on and the last quarter to compare on, if what is left still hits every input; else all twice."""
    records = truncate_records(records, MAX_SAMPLES, PULSE)
    kept = max(1, round(SELECT_SHARE * len(records)))
    peaks = np.array([np.abs(r.u).max(axis=0) for r in records])
    alike = peaks[:-kept] > 0.05 * peaks.max(axis=0)
    if len(records) - kept >= peaks.shape[1] and bool(alike.any(axis=0).all()):
        return records[:-kept], records[-kept:]
    return records, records


def select_parts(records: Sequence[Record]) -> tuple[list[Record], list[Record]]:
    """Return what to fit on and what to compare on: the last quarter of each record."""
    records = truncate_records(records, MAX_SAMPLES)
    fitted = [r.window(slice(0, round((1 - SELECT_SHARE) * r.n_samples))) for r in records]
    kept = [r.window(slice(round((1 - SELECT_SHARE) * r.n_samples), None)) for r in records]
    return fitted, kept


def _affordable(records: Sequence[Record], orders: Sequence[int], *, strict: bool = True) -> list[int]:
    """Return the orders whose free numbers have eight samples each, at least."""
    p, m = records[0].y.shape[1], records[0].u.shape[1]
    n = sum(r.n_samples for r in records)
    kept = [o for o in orders if 8 * count_free_parameters(o, p, m, direct=True, predicts=False) <= n * p]
    if strict and not kept:
        raise InputError(
            "invalid_value", f"{n} samples cannot pay for order {min(orders)} with {m} inputs and {p} outputs"
        )
    return kept
