"""How many states: no single number says it, so several are looked at together.

Models of even orders, and of those next to the best, are refined on three quarters of the training data and simulate
the last quarter (the held-out data stay out of it). Among the stable ones,

1. the smallest order that simulates that quarter as well as the best, within two standard errors of paired blocks, is taken;
2. where BIC asks for more states, they are granted if they do not simulate worse and what is left is white, which is what BIC
   assumes.

Hannan & Deistler 1988 on what the criteria can and cannot tell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError, TauDynError
from tau_dyn.modes.checks import fit_of, whiteness
from tau_dyn.modes.leftover import SIMULATED, criteria, free_count, leftovers, loss_of, worse
from tau_dyn.modes.methods import Start
from tau_dyn.modes.modal import Mode
from tau_dyn.modes.record import Record, shortened
from tau_dyn.modes.refine import refine
from tau_dyn.modes.state_space import StateSpace

SELECT_SHARE = 0.25
LONGEST = 6_000
"""Samples that the orders are compared on."""
PULSE = 500
"""Samples of each pulse that are kept in any case."""
HIGHEST = 20
BEYOND = 4
"""Orders that are still looked at above the best so far: a diagram needs them, a choice does not."""
ROUNDS = 4
TOLERANCE = 2.0


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

    def to_dict(self) -> dict[str, Any]:
        """Return it for the JSON result."""
        names = ("order", "loss", "aic", "bic", "fit_percent", "behind", "stable", "white")
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
    """

    order: int
    trials: tuple[OrderTrial, ...]
    by: dict[str, int]
    why: str
    chosen: bool = True

    def to_dict(self) -> dict[str, Any]:
        """Return it for the JSON result."""
        return {"chosen": self.chosen, "by": self.by, "why": self.why, "trials": [t.to_dict() for t in self.trials]}


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
        orders: Orders to try; the even ones up to 20, and the neighbours of the best, where not given.
        kind: `output_error` or `prediction_error`.
        asked: An order that is wanted in any case; the trials then only show what it is among.
        pulses: Whether each record is a pulse and its decay, which must not be cut.
        progress: Told what is done.

    Raises:
        CannotAnswer: No order gives a stable model.
    """
    fitted, kept = _pulses(records) if pulses else _parts(records)
    wanted = _affordable(fitted, orders or range(2, max(HIGHEST, asked or 0) + 1, 2))
    make, apart = start(fitted), kept is not fitted
    rows: list[_Row] = []
    for order in wanted:
        _add(rows, fitted, kept, make, order, kind, progress)
        if orders is None and rows and order >= max(_leading(rows, apart), asked or 0) + BEYOND:
            break
    if orders is None and rows:
        for order in _affordable(
            fitted, sorted({_leading(rows, apart) - 1, _leading(rows, apart) + 1} - {0}), strict=False
        ):
            _add(rows, fitted, kept, make, order, kind, progress)
    rows.sort(key=lambda row: row.order)
    if not rows:
        raise CannotAnswer("no order gave a stable model", "a longer log, with more excitation against the noise")
    best = min(rows, key=lambda row: row.lost)
    trials = tuple(_trial(row, best) for row in rows)
    if asked is not None:
        return OrderChoice(asked, trials, _by(trials), f"order {asked} was asked for", chosen=False)
    return _chosen(trials, apart)


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


def _add(
    rows: list[_Row],
    fitted: Sequence[Record],
    kept: Sequence[Record],
    make: Start,
    order: int,
    kind: str,
    progress: Callable[[str], None] | None,
) -> None:
    if progress is not None:
        progress(f"order {order}")
    row = _try(fitted, kept, make, order, kind)
    if row is not None:
        rows.append(row)


def _leading(rows: Sequence[_Row], apart: bool) -> int:
    """Return the order that would be taken so far."""
    best = min(rows, key=lambda row: row.lost)
    return _chosen([_trial(row, best) for row in rows], apart).order


def _try(fitted: Sequence[Record], kept: Sequence[Record], make: Start, order: int, kind: str) -> _Row | None:
    """Return a model of an order, or None where the method or the refinement finds none."""
    try:
        refined = refine(make(order), fitted, kind=kind, maximum_rounds=ROUNDS)
    except (TauDynError, np.linalg.LinAlgError):
        return None
    model = refined.model
    if model.spectral_radius() >= 1:
        return None
    errors, others = leftovers(model, fitted, kind), leftovers(model, kept, kind)
    p, m = model.D.shape
    k = free_count(order, p, m, direct=bool(np.any(model.D)), predicts=kind != SIMULATED)
    white = min(t.p_value for t in whiteness(errors, [""] * p)) * p > 0.001
    measured = [r.y[model.delay :] for r in kept]
    fit = float(np.mean(fit_of(measured, [y - e for y, e in zip(measured, others, strict=True)])))
    n = sum(len(e) for e in errors)
    return _Row(order, k, n, loss_of(errors), loss_of(others), others, fit, white, model, tuple(refined.modes))


def _trial(row: _Row, best: _Row) -> OrderTrial:
    aic, bic = criteria(row.loss, row.n, row.k)
    behind = 0.0 if row is best else worse(row.kept, best.kept)
    return OrderTrial(row.order, row.loss, aic, bic, row.fit, behind, True, row.white, row.modes, row.model)


def _by(trials: Sequence[OrderTrial]) -> dict[str, int]:
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
    simple, bic = by["simulation"], next(t for t in trials if t.order == by["bic"])
    why = f"order {simple} is the smallest that simulates data it was not fitted to as well as any"
    if bic.order <= simple:
        agree = "; BIC agrees" if bic.order == simple else f"; BIC would take {bic.order}"
        return OrderChoice(simple, tuple(trials), by, why + agree)
    if bic.white and bic.behind <= TOLERANCE:
        why = f"order {bic.order} is what BIC takes; it leaves white noise, and simulates other data as well as any"
        return OrderChoice(bic.order, tuple(trials), by, why)
    return OrderChoice(simple, tuple(trials), by, f"{why}; BIC would take {bic.order}, but what is left is not white")


def _pulses(records: Sequence[Record]) -> tuple[Sequence[Record], Sequence[Record]]:
    """Return pulses to fit on and the last quarter to compare on, if what is left still hits every input; else all twice."""
    records = shortened(records, LONGEST, PULSE)
    kept = max(1, round(SELECT_SHARE * len(records)))
    peaks = np.array([np.abs(r.u).max(axis=0) for r in records])
    alike = peaks[:-kept] > 0.05 * peaks.max(axis=0)
    if len(records) - kept >= peaks.shape[1] and bool(alike.any(axis=0).all()):
        return records[:-kept], records[-kept:]
    return records, records


def _parts(records: Sequence[Record]) -> tuple[list[Record], list[Record]]:
    """Return what to fit on and what to compare on: the last quarter of each record."""
    records = shortened(records, LONGEST)
    fitted = [r.window(slice(0, round((1 - SELECT_SHARE) * r.n_samples))) for r in records]
    kept = [r.window(slice(round((1 - SELECT_SHARE) * r.n_samples), None)) for r in records]
    return fitted, kept


def _affordable(records: Sequence[Record], orders: Sequence[int], *, strict: bool = True) -> list[int]:
    """Return the orders whose free numbers have eight samples each, at least."""
    p, m = records[0].y.shape[1], records[0].u.shape[1]
    n = sum(r.n_samples for r in records)
    kept = [o for o in orders if 8 * free_count(o, p, m, direct=True, predicts=False) <= n * p]
    if strict and not kept:
        raise InputError(f"{n} samples cannot pay for order {min(orders)} with {m} inputs and {p} outputs")
    return kept
