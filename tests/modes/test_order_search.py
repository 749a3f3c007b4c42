"""Which orders are tried, and in which sequence: a structure's number of states is met by few models."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tau_dyn.modes.modal import Mode
from tau_dyn.modes.operational import _take
from tau_dyn.modes.order import SMALL, _Search

EVERY = [1, 2, 3, *range(4, 61, 2)]


class Search(_Search):
    """A search over models that are as good as any from a structure's true order on."""

    def __init__(self, true: int) -> None:
        """Begin with nothing tried."""
        self.true, self.walk, self.tried, self.rows = true, [], set(), []
        self.say = lambda step: None

    def refine(self, order: int) -> None:
        """Try an order once."""
        if order not in self.tried:
            self.walk.append(order)
            self.tried.add(order)
            self.rows += self._look(order)

    def _look(self, order: int) -> list[Any]:
        if order not in self.walk:
            self.walk.append(order)
        fit = 95.0 if order >= self.true else 30.0
        return [SimpleNamespace(trial=SimpleNamespace(order=order, fit_percent=fit))]

    def _enough(self, rows: Any) -> Any:
        orders = [row.trial.order for row in rows]
        enough = [n for n in orders if n >= self.true]
        chosen = min(enough) if enough else max(orders, default=0)
        return next((row.trial for row in rows if row.trial.order == chosen), None)

    @property
    def leading(self) -> int:
        """Return the order that is chosen so far."""
        return self._enough(self.rows).order if self.rows else 0


@pytest.mark.parametrize("true", [6, 12, 22, 28])
def test_doubled_orders_bracket_the_states_of_a_decay_before_middles_close_in(true) -> None:
    """Doubling passes the true order once; only then are middles tried, until the order below is known to be too small."""
    search = Search(true)
    search.bracket(60)
    doubled = [n for n in search.walk if n & (n - 1) == 0 and n >= 2 and n > SMALL]
    middles = [n for n in search.walk if n > SMALL and n not in doubled]
    beyond = next(n for n in (2, 4, 8, 16, 32, 60) if n >= true)
    assert search.walk[: (2, 4, 8, 16, 32, 60).index(beyond) + 1] == [n for n in (2, 4, 8, 16, 32, 60) if n <= beyond]
    assert all(search.walk.index(n) > search.walk.index(d) for n in middles for d in doubled)
    assert search.leading == true and max(n for n in search.walk if n < true) >= true - 2
    assert len(search.walk) <= 14


@pytest.mark.parametrize("true", [1, 2, 8, 14, 26, 44, 60])
def test_a_scan_meets_the_smallest_order_that_is_enough_in_few_looks(true) -> None:
    """Steps are halved below the first order that is enough: the true one is met with half the models at most."""
    search = Search(true)
    found = search._enough(search.scan(EVERY))
    assert found.order == true
    assert len(search.walk) <= len(EVERY) / 2 + 2


def test_a_scan_ends_where_the_data_are_explained() -> None:
    """Sixteen states beyond those that explain the data nothing is looked at, since no mode is left to be found."""
    search = Search(6)
    search.scan(EVERY)
    assert max(search.walk) < 30


def test_orders_that_disagree_widen_an_ambient_mode() -> None:
    """Of one chain of orders none is known to be right: the differences from the one taken add to its standard errors."""
    shape = np.array([1.0 + 0j, 0.5])
    chain = [
        (n, Mode(10.0 + d, 0.01 + 0.01 * d, 0.1, 0.002, shape, 0.0))
        for n, d in ((4, 0.0), (6, 0.06), (8, -0.06), (10, 0.06))
    ]
    mode = _take(chain)
    assert mode.frequency_hz == 10.0
    assert mode.frequency_stderr == pytest.approx(np.sqrt(0.1**2 + 0.75 * 0.06**2))
    assert mode.damping_stderr == pytest.approx(np.sqrt(0.002**2 + 0.75 * 0.0006**2))
    alike = _take([(n, chain[0][1]) for n in (4, 6, 8)])
    assert (alike.frequency_stderr, alike.damping_stderr) == pytest.approx((0.1, 0.002))
