"""Nonlinear least squares: a published optimum, states that are no vectors, what data do not tell, and reasons to stop."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.estimate import DescentRules, descend, factor_system

MISRA1A = np.array(
    [
        [10.07, 77.6], [14.73, 114.9], [17.94, 141.1], [23.93, 190.8], [29.61, 239.9], [35.18, 289.0], [40.02, 332.8],
        [44.82, 378.4], [50.76, 434.8], [55.05, 477.3], [61.01, 536.8], [66.40, 593.1], [75.47, 689.1], [81.78, 760.0],
    ]
)  # fmt: skip
"""Dental research, NIST StRD: y = b1 (1 - exp(-b2 x)); certified to eleven digits."""


class Misra:
    """Residuals of the NIST problem; a state is b (2,), steps are taken in units of the columns' lengths."""

    def residuals(self, b):
        """Return measured minus predicted (14,)."""
        y, x = MISRA1A.T
        return y - b[0] * (1 - np.exp(-b[1] * x))

    def linearise(self, b):
        """Return the problem about a state."""
        x, e = MISRA1A[:, 1], np.exp(-b[1] * MISRA1A[:, 1])
        columns = np.column_stack([1 - e, b[0] * x * e])
        return factor_system(columns, self.residuals(b), 1 / np.linalg.norm(columns, axis=0))

    def move(self, b, step):
        """Return the state after a step."""
        return b + step

    def gain(self, b, trial):
        """Return the fall of the squares relative to the squares."""
        before, after = (float(self.residuals(x) @ self.residuals(x)) for x in (b, trial))
        return (before - after) / before


@pytest.mark.parametrize("begin", [(500.0, 1e-4), (250.0, 5e-4)])
def test_the_certified_optimum_and_its_standard_errors(begin):
    """NIST's Misra1a: parameters, standard errors and residual deviation as certified, from both of its starts."""
    problem = Misra()
    end = descend(problem, np.array(begin))
    left = problem.residuals(end.state)
    noise = np.sqrt(left @ left / (len(left) - 2))
    assert end.converged
    assert end.state == pytest.approx([2.3894212918e2, 5.5015643181e-4], rel=1e-7)
    stderr = noise * np.sqrt(np.diag(problem.linearise(end.state).covariance))
    assert stderr == pytest.approx([2.7070075241, 7.2668688436e-6], rel=1e-5)
    assert noise == pytest.approx(1.0187876330e-1, rel=1e-6)


def test_what_data_do_not_tell_is_not_moved_along():
    """Of two equal columns only the sum shows: the step is shared evenly, both count as undetermined, and leverage sums to 1."""
    x = np.linspace(0, 1, 30)
    system = factor_system(np.column_stack([x, x]), 6 * x, np.ones(2))
    step, _ = system.step(0.0)
    assert system.rank == 1 and system.undetermined.all()
    assert step == pytest.approx([3.0, 3.0], rel=1e-9)
    assert system.leverage.sum() == pytest.approx(1.0)


def test_progress_and_the_reason_for_stopping():
    """Every accepted step is told; a descent that may take one step says that it did not come to rest."""
    told: list[tuple[int, float]] = []
    end = descend(Misra(), np.array([500.0, 1e-4]), progress=lambda step, gain: told.append((step, gain)))
    assert [step for step, _ in told] == list(range(1, end.steps + 1))
    assert all(gain >= 0 for _, gain in told)
    short = descend(Misra(), np.array([500.0, 1e-4]), DescentRules(max_steps=1))
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
