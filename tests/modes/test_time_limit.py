"""A limit of time ends the search for a model, not the answer: one model is always fitted, and what was left out is named."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from recordings import HZ, log_of, recorded, structure

from tau_dyn.modes import build_records, find_modes
from tau_dyn.modes.methods import build_initial_estimator
from tau_dyn.modes.order import choose_order
from tau_dyn.modes.refinement import descend_to_fit
from tau_dyn.modes.time_limit import TimeLimit

IN, OUT = ("force1", "force2"), ("place1", "place2")


def test_what_is_left_out_is_remembered_once() -> None:
    """Before the limit nothing is left out; an early stage ends at its share of the time."""
    now = [0.0]
    limit = TimeLimit(10.0, lambda: now[0])
    now[0] = 6.0
    assert (
        not limit.is_over("later stages") and limit.is_over("early stages", 0.5) and limit.is_over("early stages", 0.5)
    )
    now[0] = 11.0
    assert limit.is_over("later stages") and limit.left_out == ["early stages", "later stages"]
    (said,) = limit.list_warnings()
    assert said.code == "time_limit" and "10 s" in said and said.endswith("early stages, later stages")
    assert TimeLimit(None).list_warnings() == [] and not TimeLimit(None).is_over("anything")


def test_a_search_without_time_still_finds_the_slower_mode() -> None:
    """A driven structure at 40 dB: small orders are looked at in any case, and its warning names what was not tried."""
    found = find_modes(log_of(recorded(structure(), 1500, 40)), IN, OUT, time_limit=1e-6)
    (said,) = [w for w in found.warnings if getattr(w, "code", "") == "time_limit"]
    assert "orders from" in said and "a fit to all data" in said
    assert min(abs(m.frequency_hz / HZ[0] - 1) for m in found.modes) < 0.05


def test_one_order_is_refined_when_the_time_is_over() -> None:
    """Orders are compared by refined models; without time the one that first models favour is the only one."""
    log = log_of(recorded(structure(), 1500, 40))
    records = build_records(log, IN, OUT)

    def search(limit: TimeLimit):
        return choose_order(records, lambda some: build_initial_estimator("n4sid", some), limit=limit)

    none, plenty = search(TimeLimit(1e-9)), search(TimeLimit(1e9))
    assert len(none.refined) == 1 < len(plenty.refined)
    assert max(t.order for t in none.trials) < max(t.order for t in plenty.trials)


def test_a_descent_ends_where_it_is_told_to() -> None:
    """Asked before every step: one step, then the model as it is, which is not called converged."""
    log = log_of(recorded(structure(), 1500, 40))
    records = build_records(log, IN, OUT)
    asked: list[int] = []

    def stop() -> bool:
        asked.append(1)
        return len(asked) > 1

    model = build_initial_estimator("arx", records)(4)
    path = descend_to_fit(model, records, stop=stop)
    assert path.path.steps == 1 and not path.path.converged
    assert path.loss < descend_to_fit(model, records, maximum_rounds=0).loss
    assert np.isfinite(path.loss)


@pytest.mark.parametrize("argument", ["0", "-3", "nan"])
def test_a_limit_that_is_no_time_is_refused(argument, tmp_path, capsys) -> None:
    """A positive number of seconds, and inputs."""
    from tau_dyn.cli import main

    assert main(["modes", "x.csv", "--inputs", "u", "--outputs", "y", "--time-limit", argument]) == 2
    assert "time-limit" in capsys.readouterr().err
