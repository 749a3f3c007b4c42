"""Logs that tell nothing: refused early and for the reason that holds; and which estimator answers where one cannot."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.estimate import Autoregression, Estimate, Regression, find_base
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify import build_model, build_regression, choose_preparation, estimators, identify
from tau_dyn.identify.estimators import Estimator
from tau_dyn.identify.streaming import refuse_missing
from tau_dyn.log import Log
from tau_dyn.parameters import Parameter, Parameters

T = np.arange(4000) / 250.0
PATH = 0.2 * np.sin(2.0 * T) + 0.1 * np.sin(5.3 * T)


def on_disk(name: str, *columns: str) -> Any:
    """Return a recording that must not be read."""
    return SimpleNamespace(name=name, columns=columns, has=lambda column: column in columns)


@pytest.mark.parametrize(
    ("columns", "missing"),
    [(("t", "tau_axis"), "q_axis"), (("t", "q_axis"), "tau_axis"), (("t", "q_axis", "tau_axis"), "flag"), (("t",), "q_axis"),
     (("t", "q_axis", "tau_axis", "flag"), "")],
)  # fmt: skip
def test_a_recording_without_a_column_is_refused_before_any_is_read(
    axis, columns: tuple[str, ...], missing: str
) -> None:
    """Positions, forces and flags to leave samples out by, of the second recording as of the first."""
    model = build_model(axis, "asymmetric")
    good = on_disk("a.parquet", "t", "q_axis", "tau_axis", "flag")
    recordings = cast("Any", [good, on_disk("b.parquet", *columns)])
    if missing:
        with raises_code("missing_column", "b.parquet", f"{missing}", f"{', '.join(columns)}"):
            refuse_missing(model, recordings, ("flag",))
    else:
        refuse_missing(model, recordings, ("flag",))


def moved(axis, force: np.ndarray, path: np.ndarray = PATH, **more: np.ndarray) -> Log:
    return Log(T, {"q_axis": path, "tau_axis": force, **more}, "made.csv")


@pytest.mark.parametrize("missing", ["q_axis", "tau_axis"])
def test_a_held_out_log_without_a_column_is_refused_by_its_name(axis, rng, missing: str) -> None:
    """Positions and forces are asked of each log, not of the first alone."""
    channels = {"q_axis": PATH, "tau_axis": 95 * np.gradient(np.gradient(PATH, T), T) + rng.standard_normal(len(T))}
    held = Log(T, {name: x for name, x in channels.items() if name != missing}, "held.csv")
    with raises_code("missing_column", missing, "held.csv"):
        identify(axis, Log(T, channels, "a.csv"), holdout=held)


def test_forces_at_their_limits_or_flagged_leave_nothing(axis, rng) -> None:
    """A log in which most forces saturate says so, with the share and the limit; so does one that flags them."""
    limit = float(axis.effort_limit[0])
    saturated = np.where(np.arange(T.size) % 10 > 0, limit, 0.0)
    with raises_code("bad_sample", "90", f"{limit:g}") as fault:
        identify(axis, moved(axis, saturated))
    assert "check the units of tau" in str(fault.value)
    with raises_code("bad_sample", "100"):
        identify(axis, moved(axis, rng.normal(size=T.size), flag=np.ones(T.size)), exclude=("flag",))


def test_a_robot_that_never_moves_surely_is_told_so_and_not_its_forces(axis, rng) -> None:
    """Where no speed has a sure sign the answer is a better motion, with the speed to exceed; noise alone says so earlier."""
    log, model = moved(axis, rng.normal(size=T.size)), build_model(axis, "asymmetric")
    preparation = replace(choose_preparation(axis, [log]), speed_threshold=np.array([12.5]))
    with raises_code("poor_excitation", "12", "m/s") as fault:
        build_regression(model, [log], preparation=preparation)
    assert "move axis in both directions" in str(fault.value)
    with raises_code("poor_excitation", "made.csv"):
        identify(axis, moved(axis, rng.normal(size=T.size), 1e-6 * rng.normal(size=T.size)))


class Refining(Estimator):
    """An automatic choice whose refinements are given: what each finds, or that it cannot answer; with what was asked."""

    found: dict[str, Any]
    asked: list[str]

    def _refined(self, first: Any, kind: str) -> Any:
        self.asked.append(kind)
        if self.found[kind] is None:
            raise CannotAnswer("not_identifiable", "the instruments do not separate the parameters", "record more")
        return self.found[kind]


def fit(cov: float) -> Any:
    """Return what stands for an estimate of one parameter."""
    regression = Regression(Parameters([Parameter("a", 1.0, "1")]), ("axis",), ("N",), ())
    base = find_base(np.eye(1), ("a",))
    one, noise = np.ones(1), (Autoregression(np.zeros(0), 1.0),)
    return Estimate(
        regression,
        regression.parameters,
        base,
        one,
        one,
        np.array([[cov]]),
        np.array([[cov]]),
        None,
        1.0,
        noise,
        one,
        {},
    )


@pytest.mark.parametrize(
    ("iv", "ml", "asked", "taken"),
    [
        ((0.5, True), (0.4, True), ["iv"], "iv"), ((0.5, False), (0.4, True), ["iv"], "wls"),
        (None, (0.4, True), ["iv", "ml"], "ml"), ((1.5, True), (0.4, True), ["iv", "ml"], "ml"),
        (None, None, ["iv", "ml"], "wls"), (None, (0.4, False), ["iv", "ml"], "wls"),
        ((1.0, True), (1.0, True), ["iv", "ml"], "wls"),
    ],
)  # fmt: skip
def test_instruments_come_first_and_what_cannot_answer_makes_room_for_the_next(
    axis, monkeypatch, iv, ml, asked, taken
) -> None:
    """More precise than least squares, and only where noise explains the residual: iv, then ml, else weighted least squares."""
    log = moved(axis, np.cos(T), q_ref_axis=PATH)
    chosen = Refining("auto", build_model(axis, "asymmetric"), [log])
    found = {
        kind: None if x is None else SimpleNamespace(estimate=fit(x[0]), white=x[1])
        for kind, x in (("iv", iv), ("ml", ml))
    }
    object.__setattr__(chosen, "found", found)
    object.__setattr__(chosen, "asked", [])
    monkeypatch.setattr(estimators, "is_residual_white", lambda refined: refined.white)
    first = fit(1.0)
    first = replace(first, regression=replace(first.regression, runs=(None,)))
    answer = chosen(first)
    assert chosen.asked == asked and answer.estimator == taken
    expected = {"iv": iv, "ml": ml, "wls": (1.0, True)}[taken]
    assert answer.cov[0, 0] == expected[0]
