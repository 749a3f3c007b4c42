"""A second cause beside another one on the same joint: when it may be only what the other's law leaves."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tau_dyn.effects import Stribeck, ViscousCurvature
from tau_dyn.evidence import Unexplained, plausibility
from tau_dyn.evidence.claims import select_confirmed, select_supported
from tau_dyn.evidence.plausibility import MAX_LAW_ERROR, compute_least_forces, demote_small, find_companion
from tau_dyn.evidence.stepwise_selection import select_causes
from tau_dyn.evidence.validation import confirm_cause
from tau_dyn.parameters import Parameter, Parameters


@pytest.mark.parametrize(("sizes", "companion"), [((30.0, 2.0), False), ((30.0, 1.0), True)])
def test_what_is_far_smaller_than_another_cause_may_be_its_inexactness(monkeypatch, sizes, companion: bool):
    """Beside a cause of 30 N on a joint one of 2 N stands; one of 1 N is less than the other's law is known to."""
    kept = [SimpleNamespace(candidate=SimpleNamespace(cause=c, effects=())) for c in ("drive_gain", "stribeck")]
    monkeypatch.setattr(plausibility, "measure_net_forces", lambda *_: np.array(sizes)[:, None])
    library = SimpleNamespace(channel=SimpleNamespace(scene=SimpleNamespace(joints=())))
    found = find_companion(cast(Any, library), cast(Any, kept), cast(Any, None))
    assert (found is not None) is companion
    if found:
        assert found[0] == 1 and "drive_gain" in found[1]


def search(channel, rng) -> tuple[dict[str, str], list[str]]:
    """Return why each cause found is not confirmed, and the causes that stand."""
    selection = select_causes(channel, rng, lambda step: None)
    claims = select_confirmed(selection, [confirm_cause(selection, one) for one in selection.found])
    claims, _ = select_supported(selection, claims, rng)
    why = {one.candidate.cause: w for one, w in zip(claims.found, claims.why_not, strict=True)}
    return why, [one.candidate.cause for one in claims.kept]


def test_one_curve_of_friction_is_one_cause(make, rng):
    """Friction with the 0.7th power of speed needs two laws of the library to be met; only one is confirmed."""

    def curve(motion):
        return 150 * motion.sign * np.abs(motion.v) ** 0.7

    channel = make.bench(rng, curve, n=16000, noise=0.3, causes=(ViscousCurvature, Stribeck))
    why, kept = search(channel, rng)
    assert len(why) == 2 and len(kept) == 1
    assert f"{kept[0]} alone meets the joint's friction" in "".join(why.values())


@pytest.mark.parametrize(("knee", "peak", "companion"), [(0.1, 0.3, True), (0.5, 1.0, False)])
def test_two_curves_of_friction_are_two_causes(monkeypatch, knee: float, peak: float, companion: bool):
    """A small peak where friction levels off anyway is one curve; a large one far below the knee needs both laws."""
    curved, stribeck = ViscousCurvature("x", "N", knee=knee), Stribeck("x", "N", speed=0.05)
    fitted = {"coulomb": 0.5, "viscous": 0.3, "viscous_curvature": 1.0, "stribeck": peak}
    values = Parameters(Parameter(f"x.{name}", value, "N") for name, value in fitted.items())
    laws = ((curved, 80.0), (stribeck, 20.0))
    kept = [SimpleNamespace(candidate=SimpleNamespace(cause=e.name, effects=(e,), statistic=T)) for e, T in laws]
    scene = SimpleNamespace(joints=("x",), index=lambda joint: 0, slow=np.array([0.02]), fast=np.array([1.0]))
    monkeypatch.setattr(plausibility, "measure_net_forces", lambda *_: np.ones((2, 1)))
    library = SimpleNamespace(channel=SimpleNamespace(scene=scene))
    found = find_companion(cast(Any, library), cast(Any, kept), values)
    assert (found is not None) is companion
    if found:  # of two laws that meet the curve, the one with the weaker evidence goes
        assert found[0] == 1


@pytest.mark.parametrize(("largest", "status"), [(1.0, "confirmed"), (30.0, "suspected")])
def test_a_structure_far_smaller_than_a_named_cause_is_suspected(largest, status):
    """A quarter of a residual of 2 N is 1 N; beside a cause of 30 N it may be that cause's inexactness."""
    item = Unexplained("b", ("v_b",), 0.25, "", 1e-9, "confirmed")
    (found,) = demote_small([item], ("a", "b"), np.array([9.0, 2.0]), MAX_LAW_ERROR * np.array([500.0, largest]))
    assert found.status == status


def test_what_filters_leave_of_exact_forces_is_no_structure():
    """Of 300 N forces are told to 3 mN: a structure of 2 mN is suspected, one of 4 mN stands."""
    runs = [SimpleNamespace(y=np.full((10, 1), -300.0)), SimpleNamespace(y=np.full((30, 1), 300.0))]
    least = compute_least_forces(cast(Any, SimpleNamespace(runs=runs)))
    assert least == pytest.approx([3e-3])
    item = Unexplained("a", ("v_a",), 0.25, "", 1e-9, "confirmed")
    told = [demote_small([item], ("a",), np.array([rms]), least)[0].status for rms in (4e-3, 8e-3)]
    assert told == ["suspected", "confirmed"]
