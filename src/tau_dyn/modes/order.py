"""Selection of the model order from several criteria together, because no single one is reliable.

One factorisation of three quarters of the training data gives first models of any order up to a high one. Models of
some orders simulate the last quarter (held-out data are not used), in steps that are halved below the smallest
sufficient order. Near that order, models are refined and compared again, until the neighbours of the best order are
known. Among the refined and stable models,

1. the smallest order that simulates that quarter as well as the best, within two standard errors of paired blocks, is taken;
2. if BIC selects more states, they are accepted if they do not simulate worse and the residuals are white, as BIC
   assumes;
3. if BIC selects fewer and the residuals are white, those are accepted up to four standard errors: the best of many
   orders is better by chance.

Reference: Hannan & Deistler 1988 (properties of the criteria).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError, TauDynError
from tau_dyn.modes.methods import Start
from tau_dyn.modes.modal import Mode, find_resonances
from tau_dyn.modes.record import Record, split_pulses, truncate_records
from tau_dyn.modes.refinement import RefinementPath, descend_to_fit
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
from tau_dyn.modes.time_limit import NO_LIMIT, TimeLimit
from tau_dyn.results import Brief

SELECT_SHARE = 0.25  # of the training data on which orders are compared
MAX_SAMPLES = 6_000  # samples that the orders are compared on
PULSE = 500  # samples of each pulse that are kept in any case
MAX_ORDER = 60  # highest order that is tried unless one is requested: thirty modes in the band of one test
MAX_PREDICTED_ORDER = 24
"""The same if one-step predictions are compared, whose first models cost a factorisation each."""
SCAN_SHARE = 0.6  # of a time limit after which no further first model is tried
COARSE_RATIO = 1.3  # of an order to the one before it in the coarse scan of orders above the small ones
SMALL = 8  # up to this order all even ones below are refined, which costs little and fills the stabilisation diagram
BEYOND = 4  # orders that are refined above the leading one: a diagram needs them, a choice does not
NEIGHBOURS = 4
"""States by which a model may differ, whose modes standard errors have to allow for if it simulates as well."""
MAX_REFINED_MODELS = 14
"""Models that are refined to compare orders; an unfinished search then keeps its current order."""
MANY_NUMBERS = 100
"""Free numbers of a model beyond which standard errors of trials are left out and fewer rounds are spent."""
MAX_ITERATIONS = 4  # Gauss-Newton steps for a candidate order; enough to rank it
TOLERANCE = 2.0  # standard errors of the paired difference within which the smaller order is as good
MAX_BEHIND_WHITE = 4.0
"""The same for an order with white residuals that BIC selects."""
PATIENCE = 16  # orders without any gain after which the scan stops, once it has explained most of what moves
MIN_WHITE_P_VALUE = 0.001  # over all outputs, from which on the residuals count as white
GOOD_FIT_PERCENT = 80.0  # fit from which on `PATIENCE` applies: modes that enter late appear only after most others


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
        white: Whether its residuals are white.
        modes: Its modes, with standard errors near the order taken (`add_standard_errors`).
        model: The model itself.
        refined: Whether it was refined; first models are shown, but not chosen from.
        plain: Whether refinement was tried and made the simulation of other data worse, so that the first model is
            kept.
        path: How it was refined, from which standard errors follow.
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
    path: RefinementPath | None = field(default=None, repr=False)

    def to_dict(self) -> dict[str, Any]:
        """Return it for the JSON result."""
        names = ("order", "loss", "aic", "bic", "fit_percent", "behind", "stable", "white", "refined")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, eq=False)
class OrderChoice(Brief):
    """The order and the evidence for it.

    Attributes:
        order: The order taken.
        trials: All orders that were tried, lowest first.
        by: Order that each criterion alone would select: `aic`, `bic`, `simulation`.
        why: The reason, as a sentence.
        chosen: Whether it was chosen here; False if it was requested.
        limit: The highest order that was tried, if more states may help; 0 if it does not bind.
    """

    order: int
    trials: tuple[OrderTrial, ...]
    by: dict[str, int]
    why: str
    chosen: bool = True
    limit: int = 0

    @property
    def taken(self) -> OrderTrial | None:
        """The trial of the order taken; `None` without one."""
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
    limit: TimeLimit = NO_LIMIT,
) -> OrderChoice:
    """Choose the order.

    Args:
        records: Training records, inputs and outputs as deviations.
        start: Gives, for records, a function from an order to a first model.
        orders: Orders to refine; the neighbourhood of the best up to 60, where not given.
        kind: `output_error` or `prediction_error`.
        asked: An order that is used in any case; the trials then serve for comparison only.
        pulses: Whether each record is a pulse and its decay, which must not be cut.
        progress: Called with a description of each step.
        limit: Ends the search once one order has been refined.

    Raises:
        CannotAnswer: No order gives a stable model.
    """
    fitted, kept = select_pulses(records) if pulses else select_parts(records)
    search = _Search(fitted, kept, start(fitted), kind, progress or (lambda step: None), pulses, limit)
    scanned: list[_Row] = []
    if orders is not None:
        for order in _affordable(fitted, orders):
            search.refine(order)
    else:
        highest = max(MAX_ORDER if kind == SIMULATED else MAX_PREDICTED_ORDER, asked or 0)
        scanned = search.scan(_affordable(fitted, [1, 2, 3, *range(4, highest + 1, 2)]))
        search.refine_near(scanned, asked)
    if not search.rows:
        raise CannotAnswer(
            "no_solution", "no order gave a stable model", "a longer log, with more excitation against the noise"
        )
    done = {row.trial.order for row in search.rows}
    trials = search.compare(row for row in scanned if row.trial.order not in done)
    if asked is not None:
        return OrderChoice(asked, trials, _by(trials), f"order {asked} was asked for", chosen=False)
    choice = _chosen(trials, search.apart)
    highest = max(t.order for t in trials)
    if (
        orders is None and choice.order >= highest - 1 and len(search.rows) > 1
    ):  # neither BIC nor the data asked to stop
        why = f"{choice.why}; {highest} is the highest that was looked at, and more may help"
        return replace(choice, why=why, limit=highest)
    return choice


def add_standard_errors(choice: OrderChoice) -> OrderChoice:
    """Return the choice with standard errors of the modes of the order taken and of its neighbours, where they cost little."""

    def finish(trial: OrderTrial) -> OrderTrial:
        near = abs(trial.order - choice.order) <= NEIGHBOURS
        if trial.path is None or not near or trial.order * sum(trial.model.D.shape) > MANY_NUMBERS:
            return trial
        return replace(trial, modes=trial.path.finish().modes)

    return replace(choice, trials=tuple(map(finish, choice.trials)))


@dataclass(frozen=True, eq=False)
class _Row:
    """A trial, with its errors (N, p) on data that it was not fitted to, and their spread."""

    trial: OrderTrial
    kept: list[np.ndarray]
    lost: float


@dataclass(eq=False)
class _Search:
    """The search over orders, with the models refined so far."""

    fitted: Sequence[Record]
    kept: Sequence[Record]
    make: Start
    kind: str
    say: Callable[[str], None]
    pulses: bool = False
    limit: TimeLimit = NO_LIMIT

    def __post_init__(self) -> None:
        self.rows: list[_Row] = []
        self.tried: set[int] = set()
        self.affordable = set(_affordable(self.fitted, range(1, 401), strict=False))
        self.apart = self.kept is not self.fitted

    def compare(self, others: Iterable[_Row] = ()) -> tuple[OrderTrial, ...]:
        """Return the refined trials and others, lowest order first, compared with the best refined one."""
        best = min(self.rows, key=lambda row: row.lost)
        trials = [
            row.trial if row is best else replace(row.trial, behind=compare_errors_paired(row.kept, best.kept))
            for row in (*self.rows, *others)
        ]
        return tuple(sorted(trials, key=lambda trial: trial.order))

    def lead(self, rows: Sequence[_Row]) -> _Row:
        """Return the best of some rows, by their errors on other data, or by BIC if there are no other data."""
        return min(rows, key=lambda row: row.lost if self.apart else row.trial.bic)

    def is_as_good(self, row: _Row, best: _Row) -> bool:
        """Return whether a row's errors on other data are as small as those of the best one."""
        return row is best or (self.apart and compare_errors_paired(row.kept, best.kept) <= TOLERANCE)

    def scan(self, orders: Sequence[int]) -> list[_Row]:
        """Return first models of orders, unrefined: a coarse scan, then halved steps below the smallest sufficient order.

        The coarse scan stops when the data are explained and no order improves the fit.
        """
        rows: list[_Row] = []
        coarse, tried = list(_thin(orders)), set[int]()
        for k, order in enumerate(coarse, start=1):
            if rows and order > SMALL and self.limit.is_over(f"orders from {order} up", SCAN_SHARE):
                break
            self.say(f"scanning orders, {k} of {len(coarse)}")
            tried.add(order)
            rows += self._look(order)
            best = self._enough(rows)
            if best and best.fit_percent > GOOD_FIT_PERCENT and order >= best.order + PATIENCE:
                break
        while not self.pulses and (best := self._enough(rows)) is not None:  # pulses are bracketed by refined models
            below = max((n for n in tried if n < best.order), default=0)
            between = [n for n in orders if below < n < best.order]
            if not between or self.limit.is_over("orders between those scanned", SCAN_SHARE):
                break
            order = between[len(between) // 2]
            tried.add(order)
            rows += self._look(order)
        return rows

    def _look(self, order: int) -> list[_Row]:
        """Return the first model of an order, as a list; empty if there is no stable model."""
        try:
            row = self._judge(self.make(order))
        except (TauDynError, np.linalg.LinAlgError):
            return []
        return [] if row is None else [row]

    def _enough(self, rows: Sequence[_Row]) -> OrderTrial | None:
        """Return the trial of the smallest order that is as good as the best; `None` without trials."""
        if not rows:
            return None
        best = self.lead(rows)
        return min((r for r in rows if self.is_as_good(r, best)), key=lambda r: r.trial.order).trial

    def refine_near(self, scanned: Sequence[_Row], asked: int | None) -> None:
        """Refine the neighbourhood of the order that first models favour, until the leading order's neighbours are known."""
        if self.pulses and scanned and not asked:
            self.bracket(max(row.trial.order for row in scanned))
            return
        enough = None if asked else self._enough(scanned)
        first = asked or (enough.order if enough else 4)
        for order in (*range(2, first + 1 if first <= SMALL else 0, 2), first):
            self.refine(order)
        while self.rows:
            before = len(self.tried)
            leading = asked or self.leading
            around = (leading - 2, leading + 2)
            if leading <= SMALL:
                around = (*around, leading + BEYOND, leading - 1, leading + 1)
            for order in around:
                self.refine(order)
            if len(self.tried) == before:
                return

    def bracket(self, highest: int) -> None:
        """Refine doubled orders until the choice stops growing, then orders midway to the neighbours of the chosen one.

        First models of pulses do not show which order refined models need.
        """
        leading, tried = 0, 0
        for order in (*(n for n in (2, 4, 8, 16, 32) if n < highest), 2 * (highest // 2)):
            self.refine(order)
            leading = self.leading
            if 0 < leading < order and self.rows[-1].trial.fit_percent > GOOD_FIT_PERCENT:
                break
        while len(self.tried) > tried and leading:
            tried, leading = len(self.tried), self.leading
            below = max((n for n in self.tried if n < leading), default=leading)
            above = min((n for n in self.tried if n > leading), default=leading)
            far = max(below, above, key=lambda n: abs(n - leading))
            near = () if leading > SMALL else (leading - 1, leading + 1)
            for order in (2 * round((leading + far) / 4),) if abs(far - leading) > 2 else near:
                self.refine(order)

    @property
    def leading(self) -> int:
        """The order chosen among those refined so far; 0 without any."""
        return _chosen(self.compare(), self.apart).order if self.rows else 0

    def refine(self, order: int) -> None:
        """Add a refined model of an order, once, if the data are sufficient for it and it exists.

        If refinement makes the simulation of other data worse, the first model is kept: the likelihood under white
        errors and correlated outputs is not a criterion of simulation.
        """
        if order < 1 or order in self.tried or order not in self.affordable or len(self.tried) >= MAX_REFINED_MODELS:
            return
        self.tried.add(order)
        if self.rows and self.limit.is_over("more refined orders"):
            return
        self.say(f"order {order}")
        try:
            first = self.make(order)
            path = descend_to_fit(first, self.fitted, kind=self.kind, maximum_rounds=MAX_ITERATIONS)
            refined = path.finish(covariance=False)
        except (TauDynError, np.linalg.LinAlgError):
            return
        row, changed = self._judge(refined.model), {"modes": tuple(refined.modes), "path": path}
        if self.kind == SIMULATED and self.apart:
            plain = self._judge(first)
            if plain is not None and (row is None or compare_errors_paired(row.kept, plain.kept) > TOLERANCE):
                row, changed = plain, {"plain": True}
        if row is not None:
            self.rows.append(replace(row, trial=replace(row.trial, refined=True, **changed)))

    def _judge(self, model: StateSpace) -> _Row | None:
        """Return the quality of a model on its training data and on other data; `None` if it is not stable."""
        if model.spectral_radius() >= 1:
            return None
        if self.kind != SIMULATED and np.abs(np.linalg.eigvals(model.A - model.K @ model.C)).max(initial=0) >= 1:
            return None  # its predictor is unstable
        errors, others = (compute_residuals(model, records, self.kind) for records in (self.fitted, self.kept))
        if not all(np.isfinite(e).all() for e in (*errors, *others)):
            return None
        p, m = model.D.shape
        k = count_free_parameters(model.order, p, m, direct=bool(np.any(model.D)), predicts=self.kind != SIMULATED)
        loss, n = compute_log_det_loss(errors), sum(len(e) for e in errors)
        white = min(t.p_value for t in check_whiteness(errors, [""] * p)) * p > MIN_WHITE_P_VALUE
        measured = [r.y[model.delay :] for r in self.kept]
        fit = float(np.mean(fit_of(measured, [y - e for y, e in zip(measured, others, strict=True)])))
        trial = OrderTrial(
            model.order, loss, *compute_aic_bic(loss, n, k), fit, 0.0, True, white, find_resonances(model), model, False
        )
        return _Row(trial, others, measure_spread(others))


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
    if bic.order < simple and bic.white and bic.behind <= MAX_BEHIND_WHITE:
        why = f"order {bic.order} is what BIC takes; it leaves white noise, and more states gain no more than chance"
        return OrderChoice(bic.order, tuple(trials), by, why)
    if bic.order <= simple:
        agree = "; BIC agrees" if bic.order == simple else f"; BIC would take {bic.order}"
        return OrderChoice(simple, tuple(trials), by, why + agree)
    if bic.white and bic.behind <= TOLERANCE:
        why = f"order {bic.order} is what BIC takes; it leaves white noise, and simulates other data as well as any"
        return OrderChoice(bic.order, tuple(trials), by, why)
    return OrderChoice(simple, tuple(trials), by, f"{why}; BIC would take {bic.order}, but the residual is not white")


def select_pulses(records: Sequence[Record]) -> tuple[Sequence[Record], Sequence[Record]]:
    """Return pulses to fit on and some to compare on; all of them for both if there are too few."""
    records = truncate_records(records, MAX_SAMPLES, PULSE)
    fitted, kept = split_pulses(records, SELECT_SHARE)
    return (fitted, kept) if kept else (records, records)


def select_parts(records: Sequence[Record]) -> tuple[list[Record], list[Record]]:
    """Return what to fit on and what to compare on: the last quarter of each record."""
    records = truncate_records(records, MAX_SAMPLES)
    fitted = [r.window(slice(0, round((1 - SELECT_SHARE) * r.n_samples))) for r in records]
    kept = [r.window(slice(round((1 - SELECT_SHARE) * r.n_samples), None)) for r in records]
    return fitted, kept


def _thin(orders: Sequence[int]) -> Iterator[int]:
    """Yield the orders of the coarse scan: all small ones, then steps of about a third, and the last one."""
    last = 0
    for order in orders:
        if order <= SMALL or order >= COARSE_RATIO * last or order == orders[-1]:
            last = order
            yield order


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


def read_whole_number(option: str, value: str | int, least: int, most: int, what: str) -> int | None:
    """Return the number that an option asks for, None for `auto`.

    Raises:
        InputError: It is no whole number between `least` and `most`.
    """
    if value == "auto":
        return None
    try:
        number = int(value)
    except ValueError:
        number = least - 1
    if not least <= number <= most:
        raise InputError("bad_option", f"--{option} {value}: write auto, or a number of {what}")
    return number
