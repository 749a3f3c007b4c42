"""A model beside a log: prediction, residual, fit and figure."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

import tau_dyn as td
from tau_dyn.identify import build_model

MASS_KG, COULOMB_N = 90.0, 20.0


@pytest.fixture(scope="module")
def log() -> td.Log:
    """An axis of 90 kg with 20 N of Coulomb friction, its forces 10 % above it, with a gap of 1 s."""
    t = np.delete(np.arange(0.0, 20.0, 0.002), slice(5000, 5500))
    w = np.array([[3.0], [7.0]])
    q, v, a = (np.sum(x, axis=0) for x in (0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t), -0.1 * w**2 * np.sin(w * t)))
    return td.Log(t, {"q_axis": q, "v_true": v, "a_true": a, "tau_axis": 1.1 * (MASS_KG * a + COULOMB_N * np.sign(v))})


@pytest.fixture(scope="module")
def model() -> td.Model:
    """The axis as it is."""
    friction = {"axis.coulomb_pos": COULOMB_N, "axis.coulomb_neg": COULOMB_N}
    return build_model(td.load_robot("linear_axis"), "asymmetric").with_values(
        {"carriage_link.mass": MASS_KG, **friction}
    )


def test_prediction_is_mass_times_acceleration_and_friction(log, model) -> None:
    """At the log's own samples, away from gaps, ends and reversals, to 0.2 % of the largest force."""
    predicted = model.predict(log)[:, 0]
    exact = log["tau_axis"] / 1.1
    edges = np.flatnonzero(np.diff(log.t) > 0.1)
    near_end = (
        np.min(np.abs(log.t[:, None] - [log.t[0], log.t[-1], *log.t[edges], *log.t[edges + 1]]), axis=1) < 0.6
    )  # three periods of the low-pass
    good = ~near_end & (np.abs(log["v_true"]) > 0.05)
    assert predicted.shape == log.t.shape and good.sum() > 5000
    assert_allclose(predicted[good], exact[good], atol=2e-3 * np.abs(exact).max())
    assert_allclose(model.residuals(log)[good, 0], 0.1 * exact[good], atol=2e-3 * np.abs(exact).max())


def test_the_fit_of_a_force_that_is_10_percent_larger(log, model) -> None:
    """The error is 0.1 / 1.1 of the measured force; the fit by the mean is 100 % minus the same, as the mean is zero."""
    fit = td.compare_fit(model, log)
    assert_allclose(fit.errors.relative_error_percent, 100 * 0.1 / 1.1, rtol=1e-2)
    assert_allclose(fit.fit_percent["axis"], 100 - 100 * 0.1 / 1.1, rtol=1e-2)
    assert "axis: fit 90.9 %" in repr(fit)


def test_errors_are_those_of_identify(log) -> None:
    """A model compared with its own training log has the training error that `identify` reports."""
    found = td.identify("linear_axis", log.to_frame())
    fit = td.compare_fit(found.model, log)
    assert_allclose(fit.errors.per_joint_percent, found.train.per_joint_percent, rtol=1e-6)


def test_a_model_file_and_a_path_are_taken(log, model, tmp_path) -> None:
    """Paths in the place of objects change nothing."""
    model.save(tmp_path / "axis.yaml")
    log.to_csv(tmp_path / "axis.csv")
    fit = td.compare_fit(tmp_path / "axis.yaml", str(tmp_path / "axis.csv"))
    assert_allclose(fit.fit_percent["axis"], td.compare_fit(model, log).fit_percent["axis"], rtol=1e-6)


def test_figures_have_a_row_a_joint(log, model) -> None:
    """Measured, predicted and residual of each stretch between gaps."""
    fit, found = td.compare_fit(model, log), td.identify("linear_axis", log)
    for figure in (fit.plot(), found.plot()):
        (axes,) = figure.axes
        assert len(axes.lines) == 3 * 2 and axes.get_ylabel() == "axis [N]"


def test_options_that_do_not_exist_are_named(log) -> None:
    """A mistyped option is refused with those that there are; so is a log in the place of the robot."""
    with raises_code("unknown_name", "hold_out", "holdout"):
        td.identify("linear_axis", log, hold_out=log)  # type: ignore[call-overload]
    with raises_code("invalid_value", "no robot"):
        td.identify(log, "linear_axis")  # type: ignore[call-overload]


def test_a_notebook_shows_a_figure_as_a_picture(log, model) -> None:
    """Without pyplot a notebook asks the figure itself for a picture: a PNG of the figure's size in dots."""
    from struct import unpack

    pytest.importorskip("matplotlib")
    figure = td.compare_fit(model, log).plot()
    picture = figure._repr_png_()
    width, height = unpack(">II", picture[16:24])
    assert picture[:8] == b"\x89PNG\r\n\x1a\n"
    assert (width, height) == tuple(int(x) for x in figure.get_size_inches() * figure.dpi)
