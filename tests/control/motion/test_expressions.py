"""The solver's expressions are the model: the same forces, exact derivatives, loops closed by unknowns of their own."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code
from scipy.interpolate import make_interp_spline

from tau_dyn.control.motion.coordinates import Along, JointPath
from tau_dyn.control.motion.expressions import ForceLaw, build_force_law
from tau_dyn.control.motion.transcription import build_integration_constraints, compute_simpson_weights
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

sys.path.insert(0, str(Path(__file__).parent))
from planned_robots import l1

ca = pytest.importorskip("casadi")


def states(model: Model, n: int = 4) -> tuple[np.ndarray, ...]:
    """Return random positions near home, speeds and accelerations (n, na)."""
    rng, na = np.random.default_rng(3), model.robot.na
    return model.robot.home + 0.05 * rng.standard_normal((n, na)), *rng.standard_normal((2, n, na))


def forces(law: ForceLaw, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the expressions' forces (n, na) and the largest residual of their loops."""
    p = law.passive(q)
    y = law.inner(q, v, a, p)
    rows = list(zip(q, v, a, p, y, strict=True))
    gap = max(float(np.abs(np.array(law.residual(*row))).max(initial=0.0)) for row in rows)
    return np.array([np.array(law.forces(*row)).ravel() for row in rows]), gap


def test_the_closed_form_is_the_models():
    """On the simplified Gantry-Tau with friction, expressions and Python agree to rounding."""
    model = l1(60.0, 80.0)
    law = build_force_law(model, np.full(3, 0.02))
    q, v, a = states(model)
    tau, _ = forces(law, q, v, a)
    assert_allclose(tau, law.feedforward(q, v, a), rtol=1e-10)


def test_loops_in_general_are_closed_by_unknowns():
    """On the delta robot the passive joints and inner systems close the loops and give the model's forces."""
    model = Model.of(load_robot("delta"))
    law = build_force_law(model, np.full(3, 0.02))
    q, v, a = states(model, 2)
    tau, gap = forces(law, q, v, a)
    assert law.n_passive > 0 and gap < 1e-9
    assert_allclose(tau, law.feedforward(q, v, a), atol=1e-9)


def test_derivatives_are_exact():
    """The derivative of the forces by the positions is that of central differences."""
    model = l1(60.0, 80.0)
    law = build_force_law(model, np.full(3, 0.5))
    x, v, a = (ca.SX.sym(name, 3) for name in "qva")
    none = ca.SX(0, 1)
    slope = ca.Function("slope", [x, v, a], [ca.jacobian(law.forces(x, v, a, none, none), x)])
    q, v0, a0 = (z[:1] for z in states(model))
    step, rows = 1e-6, []
    for unit in np.eye(3):
        ahead, behind = (law.feedforward(q + d * unit, v0, a0)[0] for d in (step, -step))
        rows.append((ahead - behind) / (2 * step))
    assert_allclose(np.array(slope(q[0], v0[0], a0[0])), np.array(rows).T, rtol=1e-5, atol=1e-4)


def test_what_cannot_be_planned_with_is_named():
    """An effect that needs a history is left out, and the plan says so."""
    from tau_dyn.effects import Backlash

    plain = l1()
    robot = plain.robot
    model = Model.of(robot, [Backlash(robot.actuated[:1], robot.force_units[:1])])
    assert "backlash" in build_force_law(model, np.full(3, 0.02)).warnings[0]


def test_casadi_is_asked_for_by_name(monkeypatch):
    """Without casadi the sentence says which extra brings it."""
    monkeypatch.setitem(sys.modules, "casadi", None)
    with raises_code("missing_package"):
        build_force_law(l1(), np.full(3, 0.02))


def test_integration_is_exact_where_accelerations_are_linear():
    """A cubic fulfils the equations between nodes to rounding, and Simpson's rule integrates it exactly."""
    N, cubic = 5, np.polynomial.Polynomial([0.3, -1.0, 2.0, 4.0])
    t, fine = np.linspace(0, 1, N + 1), np.linspace(0, 1, 2 * N + 1)
    x, dx, ddx = (ca.DM(cubic.deriv(k)(t)[None]) for k in range(3))
    assert np.abs(np.array(build_integration_constraints(x, dx, ddx, N))).max() < 1e-12
    weights = compute_simpson_weights(N)
    assert weights @ cubic(fine) == pytest.approx(cubic.integ()(1), rel=1e-12)


def test_a_path_bends_by_the_square_of_its_speed():
    """Positions, speeds and accelerations along a curve are those of `q(s(t / T))`, by differences."""
    points = np.random.default_rng(4).standard_normal((9, 2))
    path = Along(JointPath(make_interp_spline(np.linspace(0, 1, 9), points, k=5), 1.0))
    x, dx, ddx, T, h = 0.4, 0.8, -1.5, 2.0, 1e-3

    def place(t: float) -> np.ndarray:
        return path.path.q(x + dx * t / T + ddx * (t / T) ** 2 / 2)

    found = [np.array(ca.evalf(part)).ravel() for part in path.symbols(*map(ca.DM, (x, dx, ddx, T)))]
    assert_allclose(found[0], place(0.0), rtol=1e-9)
    assert_allclose(found[1], (place(h) - place(-h)) / (2 * h), rtol=1e-4)
    assert_allclose(found[2], (place(h) - 2 * place(0.0) + place(-h)) / h**2, rtol=1e-4)
