"""A dull motion's negative rod mass (Dressler 2012, section 6.2) is put right, named, and costs little elsewhere."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def experiment():
    """Return `experiments/dull_motion.py`."""
    spec = importlib.util.spec_from_file_location("dull_motion", ROOT / "experiments" / "dull_motion.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(("motion", "worse"), [("A", 1.05), ("B", 1.0)])
def test_a_negative_rod_mass_becomes_possible_and_is_named(experiment, motion, worse):
    """Plain least squares gives a rod a negative mass, by a hidden ball-joint friction (A) or by noise alone (B).

    The consistent estimate has none, each negative one stays at its bound, and a warning names those more than three standard
    errors below it. On a motion that is not dull the constraint costs less than 5 % where the truth is outside the model, and
    helps where it is inside.
    """
    rows = experiment.trial(motion, 0)
    negative = [row for row in rows if row["plain"] < 0]
    assert negative
    assert all(row["consistent"] >= 0 for row in rows)
    assert all(row["at_bound"] for row in negative)
    assert all(row["named"] == (-row["plain"] > 3 * row["stderr"]) for row in negative)
    assert rows[0]["rms_consistent"] < worse * rows[0]["rms_plain"]
    assert rows[0]["cond"] > 200  # which is said as well


def test_the_hidden_friction_does_negative_work(experiment):
    """The drives' power against the ball joints is `2 moment |w|` a rod, never negative: virtual work, checked by power."""
    import numpy as np

    from tau_dyn.model import Model
    from tau_dyn.robot import load_robot

    model = Model.of(load_robot("gantry_tau", prototype="l1"))
    T, V, A = experiment.path(experiment.MOTIONS["A"], 5.0)
    q, v, a, d = experiment.cart_motion(model, T, V, A)
    np.testing.assert_allclose(model.mechanism.tool_position(q), T, atol=1e-9)
    np.testing.assert_allclose(np.gradient(q, 1 / experiment.RATE_HZ, axis=0)[5:-5], v[5:-5], atol=2e-3)
    force = experiment.passive_friction(V, v, d, 1.0)
    w = np.linalg.norm(np.cross(d, V[:, None, :] - v[..., None] * [1.0, 0, 0]), axis=2) / np.sum(d**2, axis=2)
    np.testing.assert_allclose(np.sum(force * v, axis=1), 2 * w @ experiment.RODS_IN_ARM, atol=1e-9)
