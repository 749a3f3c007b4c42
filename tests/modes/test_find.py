"""The whole path from columns to modes: the right order, delay and method, and intervals that hold the truth."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from raising import raises_code
from scipy.io import loadmat

sys.path.insert(0, str(Path(__file__).parent))
from recordings import DAMPING, HZ, in_loop, log_of, pulses, recorded, structure

from tau_dyn.cli.execute import format_json
from tau_dyn.exceptions import InputError
from tau_dyn.log import Log
from tau_dyn.modes import Modes, find_modes
from tau_dyn.modes.find import choose_error_kind
from tau_dyn.modes.residuals import PREDICTED, SIMULATED

IN, OUT = ("force1", "force2"), ("place1", "place2")


@pytest.fixture(scope="module")
def found() -> Modes:
    """A driven structure at 40 dB with three samples of delay, its outputs far from zero."""
    return find_modes(log_of(recorded(structure(), 2400, 40, delay=3), offset=20.0), IN, OUT)


def _close(found: Modes, sigmas: float = 4.0) -> None:
    assert len(found.modes) == 2
    for mode, f, z in zip(found.modes, HZ, DAMPING, strict=True):
        assert abs(mode.frequency_hz - f) < sigmas * mode.frequency_stderr
        assert abs(mode.damping_ratio - z) < sigmas * mode.damping_stderr


def test_order_delay_and_modes_are_found(found):
    """Two modes make order 4; three samples of delay; frequencies and damping within four standard errors."""
    assert (found.order, found.delay, found.method) == (4, 3, "n4sid")
    _close(found)
    assert found.holdout is not None and found.holdout.mean > 98.5  # 40 dB of noise leave 99 %
    assert all(t.passed for t in found.independence)


def test_a_figure_has_the_responses_and_the_modes(found):
    """A row an output: measured and modelled magnitude from each input, and a line at each of two modes near its peak."""
    axes = found.plot().axes
    assert [axis.get_ylabel() for axis in axes] == list(OUT)
    lines = axes[0].lines
    assert len(lines) == 2 * len(IN) + 2
    peak = lines[len(IN)].get_xdata()[np.argmax(lines[len(IN)].get_ydata())]
    assert min(abs(line.get_xdata()[0] - peak) for line in lines[-2:]) < 0.05 * peak


def test_mass_damping_and_stiffness_follow(found):
    """Unit modal masses in mm per N are a mass matrix of 1e-3, and static compliance is that of the truth."""
    assert found.mechanical is not None and found.mechanical.status == "identified"
    np.testing.assert_allclose(found.mechanical.M, 1e-3 * np.eye(2), atol=2e-5)
    truth = structure().frequency_response(np.array([1e-6]))[0].real
    np.testing.assert_allclose(np.linalg.inv(found.mechanical.K), truth, rtol=0.01, atol=1e-3)


def test_the_result_is_that_of_the_contract(found):
    """The JSON result holds what is promised, as strict JSON."""
    result = json.loads(format_json(found.to_dict()))
    assert {"order", "delay_samples", "modes", "fit_percent", "residual_tests", "mdk"} <= set(result)
    assert set(result["modes"][0]) >= {"frequency_hz", "damping_ratio", "frequency_stderr", "damping_stderr"}
    assert result["fit_percent"]["holdout"] == pytest.approx(found.holdout.mean)
    assert set(result["mdk"]) >= {"status", "M", "D", "K", "stderr", "valid_hz", "why"}
    low, high = result["modes"][0]["frequency_ci95"]
    assert low < HZ[0] < high or abs(found.modes[0].frequency_hz - HZ[0]) < 4 * found.modes[0].frequency_stderr


def test_blows_go_to_era():
    """Hammer tests are recognised, cut and given to ERA, and the modes are right."""
    found = find_modes(log_of(pulses(structure(), 500, 6, 40)), IN, OUT)
    assert found.method == "era" and found.kind == "impulse" and found.order == 4
    _close(found, 5.0)


def test_a_loop_goes_to_pbsid():
    """Under feedback with a coloured disturbance the method changes, says so, and damping stays within a tenth."""
    record, _ = in_loop(structure(damping=(0.04, 0.04)), 5000, gain=0.5, disturbance=0.4)
    found = find_modes(log_of(record), IN, OUT, delay=0)
    assert found.method == "pbsid" and "disturbances" in found.why["method"]
    for f in HZ:
        mode = min(found.modes, key=lambda m: abs(m.frequency_hz - f))
        assert mode.frequency_hz == pytest.approx(f, rel=0.02)
        assert mode.damping_ratio == pytest.approx(0.04, rel=0.15)


def test_options_are_checked():
    """Unknown methods, orders and delays, and methods that do not suit the data, are refused in words."""
    log = log_of(recorded(structure(), 600))
    for option, word in (({"order": "0"}, "--order 0"), ({"order": 999}, "999"), ({"order": "many"}, "many"),
                         ({"method": "magic"}, "n4sid"), ({"delay": "-1"}, "--delay -1")):  # fmt: skip
        with pytest.raises(InputError, match=word):
            find_modes(log, IN, OUT, **option)
    with raises_code("bad_option"):
        find_modes(log, IN, OUT, order=150, delay=0)
    with raises_code("poor_excitation"):
        find_modes(log, IN, OUT, method="era")


@pytest.mark.parametrize(("ratio", "taken"), [(0.9, PREDICTED), (1.0, SIMULATED)])
def test_prediction_errors_are_minimised_where_that_simulates_better(ratio: float, taken: str) -> None:
    """The quarter kept apart decides: 0.9 times the simulation error is taken, as much is not."""
    plain = SimpleNamespace(kind=SIMULATED, simulation_errors=lambda _: 1.0, relative_error=lambda _: 0.5)
    other = SimpleNamespace(kind=PREDICTED, simulation_errors=lambda _: ratio)
    data = cast(Any, SimpleNamespace(kind="continuous"))
    best, why = choose_error_kind(cast(Any, plain), data, lambda: cast(Any, other))
    assert best.kind == taken and ("prediction errors" in why) == (taken == PREDICTED)
    small = SimpleNamespace(kind=SIMULATED, simulation_errors=lambda _: 1.0, relative_error=lambda _: 0.01)
    assert choose_error_kind(cast(Any, small), data, lambda: pytest.fail("a fit of 99 % needs no second try"))[1] == ""


def test_a_public_set_with_coloured_disturbances_is_simulated_as_well_as_by_slicot(measured) -> None:
    """A four-stage evaporator, three inputs and outputs: SLICOT's subspace model of order 4 fits 56.9 % of the last 30 %."""
    x = loadmat(measured("vibration/evaporator_dat.mat"))["evaporator_dat"]
    columns = {f"u{k}": x[:, k] for k in range(3)} | {f"y{k}": x[:, 3 + k] for k in range(3)}
    log = Log(np.arange(len(x), dtype=float), columns, name="evaporator")
    assert find_modes(log, ["u0", "u1", "u2"], ["y0", "y1", "y2"]).to_dict()["fit_percent"]["holdout"] > 56.9
