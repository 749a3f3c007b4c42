"""What is said about an estimate, on regressions made by hand whose answers are known beforehand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.estimate import (
    Estimate,
    InertialBody,
    PhysicalConstraints,
    Regression,
    RegressionRun,
    find_base,
    solve_least_squares,
)
from tau_dyn.evidence import compute_overfit_factor
from tau_dyn.identify import ForceErrors, identify
from tau_dyn.identify.estimate_warnings import (
    list_equivalent_models,
    list_estimate_warnings,
    list_held_out_warnings,
    list_inertia_scale_warnings,
)
from tau_dyn.message_codes import get_code
from tau_dyn.parameters import Parameter, Parameters

N = 2000


def fitted(W: np.ndarray, theta: list[float], names: str, noise: float = 1.0, unit: str = "1", **more) -> Estimate:
    """Return least squares on columns (N, p) with white noise, for parameters of this truth; all start at one."""
    rng = np.random.default_rng(11)
    y = W @ np.array(theta) + noise * rng.normal(size=len(W))
    W, y = W[:, None, :], y[:, None]
    run = RegressionRun("made", np.arange(len(y)) / 50, W, y, np.ones(y.shape, bool), W, y)
    parameters = Parameters(Parameter(name, 1.0, unit, more.pop("lower", -np.inf)) for name in names.split())
    return solve_least_squares(Regression(parameters, ("axis",), ("N",), (run,)), **more)


@pytest.fixture
def columns(rng):
    """Return independent columns (N, 4)."""
    return rng.normal(size=(N, 4))


def test_a_sound_estimate_raises_no_doubt(columns) -> None:
    """Independent columns, far from zero, within their bounds."""
    assert list_estimate_warnings(fitted(columns, [3, -2, 5, 4], "a b c d")) == []


def test_what_the_data_do_not_tell_is_listed(columns) -> None:
    """A parameter of 0.03 with an error of `1 / sqrt(2000)` = 0.022 is named, its neighbours are not."""
    (said,) = list_estimate_warnings(fitted(columns, [3, 0.03, 5, 4], "a b c d"))
    assert said.startswith("poorly determined (standard error above 30 %): b = ") and "a =" not in said
    many = fitted(np.random.default_rng(0).normal(size=(N, 12)), [0.0] * 10 + [5, 5], " ".join("abcdefghijkl"))
    (said,) = list_estimate_warnings(many)
    assert said.endswith("and 2 more") and said.count("+-") == 8


def test_a_zero_known_well_is_not_poorly_determined(columns) -> None:
    """0.03 +- 0.022 is a zero known well where the robot file leaves 1 open, and not where it leaves 0.1 open."""
    known = fitted(columns, [3, 0.03, 5, 4], "a b c d")
    assert list_estimate_warnings(known, {"b": 1.0}) == []
    assert len(list_estimate_warnings(known, {"b": 0.1})) == 1


def test_columns_that_are_nearly_one_are_named_as_a_pair(columns) -> None:
    """A cosine of 0.9999 between two columns: correlated by -0.9999, with a condition of `sqrt(1.9999 / 0.0001)` = 141."""
    a, b = np.linalg.qr(columns[:, :2])[0].T * np.sqrt(N)
    close = fitted(np.column_stack([a, 0.9999 * a + np.sqrt(1 - 0.9999**2) * b]), [300, 400], "a b")
    (said,) = list_estimate_warnings(close)
    assert said.startswith("a and b are correlated by -1.000; use only their combination")
    closer = fitted(np.column_stack([a, 0.99999 * a + np.sqrt(1 - 0.99999**2) * b]), [3000, 4000], "a b")
    assert [s.split(";")[0] for s in list_estimate_warnings(closer)] == [
        "the regression is ill-conditioned (condition number 447)",
        "a and b are correlated by -1.000",
    ]


def test_what_a_motion_does_not_show_is_named_with_the_remedy(columns) -> None:
    """A column that another motion would fill: of a joint that did not move, or of a body."""
    seen = find_base(columns[:, :2], ("axis.viscous", "b"))
    for names, dull, remedy in (
        ("axis.viscous b", [0, 1], "move axis"),
        ("b axis.viscous", [1, 0], "accelerate all joints independently"),
    ):
        W = columns[:, :2] * dull if names.startswith("axis") else columns[:, :2] * dull[::-1]
        structural = replace(seen, names=tuple(names.split()))
        (said,) = list_estimate_warnings(fitted(W, [5, 5], names, structural=structural))
        assert said.startswith(f"not excited, nominal value kept: {names.split()[0]}") and remedy in said


@pytest.mark.parametrize(("stronger", "added"), [(1.0, False), (2.3, False), (3.5, True), (20.0, True)])
def test_physics_that_the_data_mind_is_said(rng, stronger: float, added: bool) -> None:
    """A moment of inertia beyond the other two is said where the data object, and not where noise alone carries it there."""
    names = " ".join(f"arm_link.{n}" for n in ("mass", "mx", "my", "mz", "ixx", "ixy", "iyy", "ixz", "iyz", "izz"))
    theta = [2.0, 0.1, 0.0, 0.2, 0.5, 0.0, 0.5, 0.0, 0.0, 0.5]
    theta[4] = 1.0 + 0.06 * stronger  # beyond iyy + izz = 1
    W = rng.normal(size=(N, 10))
    physics = PhysicalConstraints((InertialBody("arm_link", tuple(names.split()), np.eye(10)),))
    e = fitted(W, theta, names, physics=physics)
    said = [
        s
        for s in list_estimate_warnings(e)
        if s.startswith("the unconstrained estimate is not physically consistent at arm_link")
    ]
    shift = float(np.max(np.abs(e.beta - e.beta_plain) / e.stderr))
    assert (shift > 3) is added and bool(said) is added
    if added:
        assert f"by {shift:.2g} standard errors" in said[0] and get_code(said[0]) == "not_physical"


def test_inertia_of_another_order_is_a_wrong_unit(columns) -> None:
    """Masses 1000 times the file's ask for the units, with an example; 20 times do not, nor does friction of any size."""

    def of(theta: list[float]) -> list[str]:
        e = fitted(columns[:, :3], theta, "a_link.mass b_link.mx axis.viscous")
        return list_inertia_scale_warnings(e, e.parameters.with_values(dict.fromkeys(e.parameters.names, 1.0)))

    (said,) = of([1000.0, 1100.0, 3.0])
    assert "about 1e+03 times" in said and "instead of 1 1; check the units" in said
    (said,) = of([0.9e3, 0.9e3, 3.0])
    assert "about 9e+02 times" in said
    assert of([20.0, 20.0, 3e5]) == of([1.0, 2.0, 1e5]) == []
    e = fitted(columns[:, :1], [3e5], "axis.viscous")
    assert list_inertia_scale_warnings(e, e.parameters) == []


def test_friction_descriptions_that_fit_alike_are_given(columns) -> None:
    """18 forwards and 22 backwards are 20 with an offset of -2; viscous friction that differs is not one coefficient."""
    names = "axis.coulomb_pos axis.coulomb_neg axis.viscous_pos axis.viscous_neg"
    (said,) = list_equivalent_models(
        fitted(columns, [18, 22, 100, 100], names, noise=1e-6, unit="N"), ("axis", "other")
    )
    assert said.startswith(
        "axis: Coulomb friction 18 / 22 N is the same as 20 N in both directions with a constant offset of -2 N"
    )
    still = fitted(columns, [1e-6, 1e-6, 100, 100], names, noise=1.0)
    assert list_equivalent_models(still, ("axis",)) == ()  # Coulomb friction that is consistent with zero
    (said,) = list_equivalent_models(fitted(columns, [18, 22, 100, 110], names), ("axis",))
    assert "one viscous coefficient" not in said
    (said,) = list_equivalent_models(fitted(columns, [18, 22, 100, 100.01], names), ("axis",))
    assert said.endswith("; one viscous coefficient is sufficient")
    assert (
        list_equivalent_models(fitted(columns, [18, 22, 100, 110], names.replace("coulomb_neg", "other")), ("axis",))
        == ()
    )


def test_a_turned_sign_is_suspected(axis, axis_log, l1, monday) -> None:
    """Friction that would push, with a force whose sign is turned, is told from a motion that is merely dull."""
    turned = axis_log.with_channels(tau_axis=-axis_log.channels["tau_axis"])
    with raises_code("not_identifiable", "tau_axis"):
        identify(axis, turned)
    assert not any("estimated friction is negative" in text for text in identify(axis, axis_log).warnings)
    one = monday.with_channels(tau_cart1=-monday.channels["tau_cart1"])
    said = [text for text in identify(l1, one).warnings if "estimated friction is negative" in text]
    assert len(said) == 1 and said[0].startswith("cart1: estimated friction is negative")


def test_a_log_that_is_far_too_short_cannot_answer(l1, monday) -> None:
    """A sixth of a second of motion: the data cannot tell, which is no contradiction in what was asked for."""
    with raises_code("too_little_data"):
        identify(l1, monday.window(0, 40))


@pytest.mark.parametrize(("held", "codes"), [((2.0, 5.0), []), ((2.0, 7.0), ["holdout_differs"])])
def test_held_out_logs_of_another_machine_are_told(held: tuple[float, float], codes: list[str]) -> None:
    """Another motion makes errors of 2.5 times; 3.5 times at a joint is another machine or tool, and the joint is named."""
    train, holdout = (ForceErrors(("a", "b"), np.array(rms), 1.0, np.ones(2), 1.0, None) for rms in ((2.0, 2.0), held))
    said = list_held_out_warnings(train, holdout)
    assert [get_code(one) for one in said] == codes and all("b (3.5 times)" in one for one in said)
    assert list_held_out_warnings(train, None) == []
    assert (
        list_held_out_warnings(train, holdout, overfit=1.3) == []
    )  # so many parameters that chance explains the ratio


def test_many_parameters_make_held_out_errors_larger_than_training_errors(rng) -> None:
    """60 values and 40 parameters: a true model predicts new data 2.2 times worse than the data of its fit."""
    n, p, ratios = 60, 40, []
    for _ in range(40):
        X, new, theta = rng.normal(size=(n, p)), rng.normal(size=(2000, p)), rng.normal(size=p)
        y = X @ theta + rng.normal(size=n)
        fitted = np.linalg.lstsq(X, y)[0]
        held = new @ (theta - fitted) + rng.normal(size=2000)
        ratios.append(np.mean(held**2) / np.mean((y - X @ fitted) ** 2))
    factor = compute_overfit_factor(n, p)
    assert factor == pytest.approx(np.sqrt((1 + 2 / 3) / (1 - 2 / 3)))
    assert 1.0 < np.sqrt(np.mean(ratios)) / factor < 1.5  # random motions excite the parameters unequally
    assert compute_overfit_factor(1e6, 40) == pytest.approx(1.0, rel=1e-4) and compute_overfit_factor(40, 40) == np.inf
