"""Numbers of a payload and of a watch against definitions: intervals, point masses, a reference's scatter, how long to record."""

from __future__ import annotations

import re
from bisect import bisect_left
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from numpy.testing import assert_allclose

from tau_dyn.identify import build_model
from tau_dyn.monitor import payload as module
from tau_dyn.monitor.directions import _describe_point
from tau_dyn.monitor.normal_state import BlockScore, NormalState
from tau_dyn.monitor.payload import PayloadEstimate, PropertyEstimate, _compare_friction, _propose_motion
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import load_robot


def test_intervals_are_two_standard_errors_and_a_mass_is_not_negative() -> None:
    """A centre of 1 to 0.1 lies within 0.196 of it, a mass of 0.1 to 0.1 kg above zero; up to 0.296 kg may hide."""
    centre = PropertyEstimate(np.array([1.0, -2.0]), np.array([0.1, 0.2]), "m", True).to_dict()
    assert_allclose(centre["ci95"], [[0.804, 1.196], [-2.392, -1.608]], atol=1e-4)
    mass = PropertyEstimate(np.array([0.1]), np.array([0.1]), "kg", False)
    assert_allclose(mass.to_dict()["ci95"], [0.0, 0.296], atol=1e-4)
    largest = PayloadEstimate.largest_mass.fget  # type: ignore[attr-defined]
    assert_allclose(largest(SimpleNamespace(mass=mass)), 0.296, atol=1e-4)
    none = SimpleNamespace(mass=PropertyEstimate(np.array([-0.5]), np.array([0.1]), "kg", False))
    assert_allclose(largest(none), 0.196, atol=1e-4)


def test_a_kilogram_at_a_point_has_the_moments_of_its_place() -> None:
    """Kinetic energy `v^2 / 2` of a point at p that turns with w is `w' J w / 2` with `v = w x p`."""
    place, w = np.array([0.3, -0.2, 0.5]), np.array([0.7, 1.1, -0.4])
    mass, *first, ixx, ixy, iyy, ixz, iyz, izz = _describe_point(place)
    J = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    assert_allclose(w @ J @ w, np.sum(np.cross(w, place) ** 2), rtol=1e-12)
    assert_allclose([mass, *first], [1.0, *place])


def test_the_scatter_of_a_reference_counts_what_it_has_learnt(rng) -> None:
    """Four blocks that tell three directions leave a quarter of the freedom: the scatter is 1 in the mean of 400 references."""
    found = []
    for _ in range(400):
        blocks = []
        for k in range(4):
            root = rng.normal(size=(3, 3))
            G = 50 * root @ root.T
            z = np.linalg.cholesky(G) @ rng.normal(size=3)
            blocks.append(BlockScore((float(k), k + 1.0), "log", z, G, float(z @ np.linalg.solve(G, z)), 3))
        found.append(NormalState.of(blocks, np.full(3, 1e3)).phi)
    assert_allclose(np.mean(found), 1.0, atol=0.12)


def test_friction_of_many_joints_counts_all_of_them(monkeypatch) -> None:
    """A chance of one in a hundred at each of two joints is one in fifty for the robot."""
    names = [f"{joint}.{law}_change" for joint in ("a", "b") for law in ("coulomb", "viscous")]
    estimate = SimpleNamespace(
        base=SimpleNamespace(names=names, kept=np.arange(4)),
        parameters=Parameters([Parameter(n, 0.1, "N") for n in names]),
    )
    monkeypatch.setattr(module, "compute_contrast_p_value", lambda *_: 0.01)
    rows = _compare_friction(
        cast(Any, SimpleNamespace(driven=("a", "b"), actuated=("a", "b"), na=2)), cast(Any, estimate)
    )
    assert_allclose([row.p_value for row in rows], 0.02)


def test_half_the_error_takes_four_times_as_long() -> None:
    """The experiment that is proposed grows with the square of the accuracy that is asked for."""
    model = build_model(load_robot("linear_axis"), "symmetric")
    body = model.robot.links[0]

    def seconds(allowed: float) -> float:
        return float(re.findall(r"for (\d+) s,", _propose_motion(model, body, None, allowed, 0))[0])

    tried = np.geomspace(1.0, 1e-4, 60)
    allowed = tried[bisect_left(tried, 80, key=lambda x: seconds(float(x)))]
    assert_allclose(seconds(float(allowed) / 2) / seconds(float(allowed)), 4.0, rtol=0.2)
