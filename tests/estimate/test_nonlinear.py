"""Nonlinear least squares: published optima and standard errors, priors, bounds, outliers, and what data do not tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from tau_dyn.estimate import DescentRules, descend, factor_system, fit_nonlinear
from tau_dyn.estimate.weights import compute_loss, compute_robust_weights, compute_tuning_constant
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.parameters import Parameter, Parameters

MISRA1A = np.array(
    [
        [10.07, 77.6], [14.73, 114.9], [17.94, 141.1], [23.93, 190.8], [29.61, 239.9], [35.18, 289.0], [40.02, 332.8],
        [44.82, 378.4], [50.76, 434.8], [55.05, 477.3], [61.01, 536.8], [66.40, 593.1], [75.47, 689.1], [81.78, 760.0],
    ]
)  # fmt: skip
"""Dental research, NIST StRD: y = b1 (1 - exp(-b2 x)); certified to eleven digits."""


def start(*values: float, **common: float) -> Parameters:
    """Return parameters b1, b2, ... to start from."""
    return Parameters(Parameter(f"b{k + 1}", v, "1", **common) for k, v in enumerate(values))


def misra(b: np.ndarray) -> np.ndarray:
    """Return measured minus predicted of the NIST problem."""
    y, x = MISRA1A.T
    return y - b[0] * (1 - np.exp(-b[1] * x))


def misra_slope(b: np.ndarray) -> np.ndarray:
    """Return its derivative (14, 2)."""
    x, e = MISRA1A[:, 1], np.exp(-b[1] * MISRA1A[:, 1])
    return -np.column_stack([1 - e, b[0] * x * e])


@pytest.mark.parametrize("jacobian", [None, misra_slope])
@pytest.mark.parametrize("begin", [(500.0, 1e-4), (250.0, 5e-4)])
def test_the_certified_optimum_and_its_standard_errors(jacobian, begin):
    """NIST's Misra1a: parameters, standard errors and residual deviation as certified, from both of its starts."""
    found = fit_nonlinear(misra, start(*begin), jacobian=jacobian)
    assert found.converged
    assert found.parameters.values == pytest.approx([2.3894212918e2, 5.5015643181e-4], rel=1e-7)
    assert [p.stderr for p in found.parameters] == pytest.approx([2.7070075241, 7.2668688436e-6], rel=1e-5)
    assert found.noise == pytest.approx(1.0187876330e-1, rel=1e-6)


def test_a_valley_is_followed_to_its_end():
    """Rosenbrock's curved valley has its minimum at (1, 1), where nothing is left."""
    found = fit_nonlinear(lambda b: np.array([10 * (b[1] - b[0] ** 2), 1 - b[0]]), start(-1.2, 1.0), noise=1.0)
    assert found.parameters.values == pytest.approx([1, 1], abs=1e-9)
    assert found.cost < 1e-18


def test_a_prior_weighs_as_its_standard_deviation_says():
    """A linear problem with a prior has its solution and covariance in closed form."""
    rng = np.random.default_rng(3)
    W, y = rng.standard_normal((20, 2)), rng.standard_normal(20)
    known = Parameters([Parameter("b1", 0.5, "1", prior_stderr=0.1), Parameter("b2", 0.0, "1")])
    found = fit_nonlinear(lambda b: y - W @ b, known, stderr=2.0, noise=1.0)
    H = W.T @ W / 4 + np.diag([100.0, 0.0])
    assert found.parameters.values == pytest.approx(np.linalg.solve(H, W.T @ y / 4 + np.array([50.0, 0])), abs=1e-8)
    assert found.cov == pytest.approx(np.linalg.inv(H), rel=1e-6)


def test_bounds_hold_and_the_others_make_the_best_of_it():
    """The constrained minimum is SciPy's; what stands at its bound has no standard error."""
    tight = Parameters([Parameter("b1", 230.0, "1", upper=235.0), Parameter("b2", 5e-4, "1")])
    found = fit_nonlinear(misra, tight, jacobian=misra_slope)
    best = least_squares(misra, [230.0, 5e-4], bounds=([0, 0], [235.0, 1]), x_scale=[1e2, 1e-4], xtol=1e-15, ftol=1e-15)
    assert found.parameters.values == pytest.approx(best.x, rel=1e-6)
    assert found.parameters["b1"].value == 235.0
    assert found.parameters["b1"].stderr is None
    assert found.parameters["b2"].stderr is not None


def test_a_bound_is_left_again_where_the_minimum_is_inside():
    """A start on a bound that the minimum does not need ends inside."""
    inside = Parameters([Parameter("b1", 200.0, "1", lower=200.0), Parameter("b2", 5e-4, "1", lower=0.0)])
    found = fit_nonlinear(misra, inside)
    assert found.parameters["b1"].value == pytest.approx(2.3894212918e2, rel=1e-6)


@pytest.mark.parametrize("loss", ["huber", "biweight"])
def test_outliers_do_not_move_a_robust_fit(loss):
    """A tenth of the measurements off by a hundred deviations moves a robust fit by less than two standard errors."""
    rng = np.random.default_rng(5)
    x = np.linspace(0, 4, 200)
    y = 2 * np.exp(-0.7 * x)[:, None] * [1.0, 0.5] + 0.01 * rng.standard_normal((200, 2))
    y[::10] += 1.0
    found = fit_nonlinear(lambda b: y - b[0] * np.exp(-b[1] * x)[:, None] * [1.0, 0.5], start(1.0, 1.0), loss=loss)
    if loss == "biweight":
        assert np.all(found.weights[::10] == 0)
        assert found.noise == pytest.approx(0.01, rel=0.15)
        for p, true in zip(found.parameters, (2.0, 0.7), strict=True):
            assert abs(p.value - true) < 3 * p.stderr
    assert found.parameters.values == pytest.approx([2.0, 0.7], rel=0.03)


def test_robust_standard_errors_are_those_of_repeated_fits():
    """Gaussian noise, biweight: a mean's errors scatter as its standard error says, 1 / 0.95 of the plain variance."""
    rng = np.random.default_rng(7)
    values, said = [], []
    for _ in range(300):
        y = rng.standard_normal(100)
        found = fit_nonlinear(
            lambda b, y=y: y - b[0], start(0.0), jacobian=lambda b: -np.ones((100, 1)), loss="biweight"
        )
        values.append(found.parameters["b1"].value)
        said.append(found.parameters["b1"].stderr)
    assert np.std(values) == pytest.approx(np.sqrt(1 / 95), rel=0.1)
    assert np.mean(said) == pytest.approx(np.sqrt(1 / 95), rel=0.1)


@pytest.mark.parametrize("exact", [True, False])
def test_what_data_do_not_tell_keeps_its_start(exact):
    """Of b1 b2 only the product shows: it is found, the blind direction is not moved along, and neither has an error."""
    x = np.linspace(0, 1, 30)
    y = 6 * x + 0.001 * np.sin(50 * x)
    slope = (lambda b: -np.column_stack([b[1] * x, b[0] * x, 0 * x])) if exact else None
    found = fit_nonlinear(lambda b: y - b[0] * b[1] * x, start(2.0, 2.0, 7.0), jacobian=slope)
    b = found.parameters.values
    assert b[0] * b[1] == pytest.approx(float(x @ y / (x @ x)), rel=1e-9)
    assert b[0] == pytest.approx(b[1], rel=1e-6)
    assert b[2] == 7.0
    assert found.rank == 1
    assert [p.stderr for p in found.parameters] == [None] * 3


def test_fixed_parameters_stay_and_unknown_losses_are_refused():
    """A fixed parameter is not touched; wrong input names what is wrong."""
    fixed = Parameters([Parameter("b1", 240.0, "1", free=False), Parameter("b2", 5e-4, "1")])
    assert fit_nonlinear(misra, fixed).parameters["b1"] == fixed["b1"]
    with pytest.raises(UnknownName):
        fit_nonlinear(misra, fixed, loss="median")
    with pytest.raises(InputError):
        fit_nonlinear(misra, Parameters([replace(p, free=False) for p in fixed]))
    with pytest.raises(InputError):
        fit_nonlinear(lambda b: np.full(3, np.nan), fixed)


def test_values_without_an_answer_are_not_visited():
    """A model that has no answer below zero is fitted from a start whose first step would go there."""
    y = np.log(np.array([0.01, 0.011]))
    found = fit_nonlinear(lambda b: y - np.log(b[0]), start(5.0), noise=1.0)
    assert found.parameters["b1"].value == pytest.approx(np.sqrt(0.01 * 0.011), rel=1e-6)


def test_progress_and_the_reason_for_stopping():
    """Every accepted step is told; a descent that may take one step says that it did not come to rest."""
    told: list[tuple[int, float]] = []
    found = fit_nonlinear(misra, start(500.0, 1e-4), progress=lambda step, gain: told.append((step, gain)))
    assert [step for step, _ in told] == list(range(1, found.steps + 1))
    assert all(gain >= 0 for _, gain in told)
    short = fit_nonlinear(misra, start(500.0, 1e-4), rules=DescentRules(max_steps=1))
    assert short.reason == "max_steps"
    assert not short.converged


class Rotations:
    """Vectors b = R a, R unknown: its state is a matrix, its step a turn."""

    a, b = np.eye(3), None

    def linearise(self, state):
        """Return the problem about a rotation."""
        seen = self.a @ state.T
        columns = np.vstack([[np.cross(e, p) for e in np.eye(3)] for p in seen]).reshape(3, 3, 3).swapaxes(1, 2)
        return factor_system(columns.reshape(9, 3), (self.b - seen).ravel(), np.ones(3))

    def move(self, state, step):
        """Return the turned rotation."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_rotvec(step).as_matrix() @ state

    def gain(self, state, trial):
        """Return the fall of the squares."""
        return float(np.sum((self.b - self.a @ state.T) ** 2) - np.sum((self.b - self.a @ trial.T) ** 2))


def test_states_need_not_be_vectors():
    """A rotation is found from matched vectors, turned step by step."""
    from scipy.spatial.transform import Rotation

    problem, true = Rotations(), Rotation.from_rotvec([0.8, -0.4, 1.1]).as_matrix()
    problem.b = problem.a @ true.T
    end = descend(problem, np.eye(3), DescentRules(small_step=1e-12))
    assert end.converged
    assert end.state == pytest.approx(true, abs=1e-10)


def test_a_prior_pulls_towards_its_value_in_every_step():
    """NIST's Misra1a with b1 known as 250 to 0.5: the minimum is SciPy's with the prior as one more residual, from afar, too."""
    known = Parameters([Parameter("b1", 250.0, "1", prior_stderr=0.5), Parameter("b2", 3e-4, "1")])
    found = fit_nonlinear(misra, known, jacobian=misra_slope, noise=0.1)
    best = least_squares(
        lambda b: np.append(misra(b) / 0.1, (b[0] - 250.0) / 0.5),
        [250.0, 5e-4],
        x_scale=[1e2, 1e-4],
        xtol=1e-15,
        ftol=1e-15,
    )
    assert found.parameters.values == pytest.approx(best.x, rel=1e-6)
    assert found.cost == pytest.approx(2 * best.cost, rel=1e-9)


def test_hubers_minimum_is_the_one_of_another_program():
    """A curve with a tenth of far measurements: the minimum of Huber's loss is SciPy's with the same constant."""
    rng = np.random.default_rng(11)
    x = np.linspace(0, 4, 100)
    y = 2 * np.exp(-0.7 * x) + 0.01 * rng.standard_normal(100)
    y[::10] += 0.3 * np.arange(10)
    c = compute_tuning_constant("huber", 1)
    found = fit_nonlinear(lambda b: y - b[0] * np.exp(-b[1] * x), start(1.0, 1.0), loss="huber", noise=0.01)
    best = least_squares(
        lambda b: (y - b[0] * np.exp(-b[1] * x)) / 0.01, [1.0, 1.0], loss="huber", f_scale=c, xtol=1e-15, ftol=1e-15
    )
    assert found.parameters.values == pytest.approx(best.x, rel=1e-5)
    assert found.cost == pytest.approx(2 * best.cost, rel=1e-6)


@pytest.mark.parametrize("loss", ["none", "huber", "biweight"])
def test_the_slope_of_a_loss_is_twice_the_distance_by_its_weight(loss):
    """`rho' = 2 d w(d)`: loss and weights are of one law, smooth where it turns over from near to far."""
    d = np.linspace(0.05, 8, 160)
    step = 1e-6
    slope = (compute_loss(loss, d + step, 2) - compute_loss(loss, d - step, 2)) / (2 * step)
    assert slope == pytest.approx(2 * d * compute_robust_weights(loss, d, 2), abs=1e-4)
