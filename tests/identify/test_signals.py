"""What effects feel beyond positions and forces."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.effects import Motion, ReducerCoupling, compute_travel
from tau_dyn.identify import Preparation, build_regression
from tau_dyn.log import Log
from tau_dyn.model import Model


@pytest.mark.parametrize("rate_hz", [60, 250, 1000, 8000])
@pytest.mark.parametrize("drift", [-0.4, 0.4])
def test_travel_counts_from_the_last_turning_point_at_any_rate(rate_hz: int, drift: float) -> None:
    """A play begins anew at each reversal: neither an earlier and deeper one nor a later instant is where it turned."""
    t = np.arange(2 * rate_hz) / rate_hz
    w = 2 * np.pi * 3
    q, v = 0.1 * np.cos(w * t) + drift * t, -0.1 * w * np.sin(w * t) + drift
    found = compute_travel(q, v, 0.4)
    moving = np.abs(v) > 0.4
    turns = np.flatnonzero(np.diff(np.sign(v)) != 0) + 1
    for start, stop in zip(turns[:-1], turns[1:], strict=True):
        inside = np.arange(start, stop)[moving[start:stop]]
        turned = q[start - 1 : start + 1]
        way = np.min(np.abs(q[inside] - turned[:, None]), axis=0), np.max(np.abs(q[inside] - turned[:, None]), axis=0)
        assert np.all((found[inside] > way[0] - 1e-9) & (found[inside] < way[1] + 1e-9))


@pytest.mark.parametrize("heading", [-1, 1])
def test_the_first_stretch_goes_where_the_joint_goes(heading: int) -> None:
    """At rest the sign of the speed is noise: a log's first sample does not say which way its first stretch goes."""
    t = np.arange(1000) / 1000
    q = heading * np.maximum(0, t - 0.2) ** 2
    v = heading * 2 * np.maximum(0, t - 0.2)
    v[0] = -1e-6 * heading
    np.testing.assert_allclose(compute_travel(q, v, 1e-4)[300:], np.abs(q)[300:])


class _Seal(ReducerCoupling):
    """A seal around two joints that stiffens in the cold: a cause from outside, with a temperature and a speed of its own."""

    name = "seal"
    needs = ("temperature",)

    def columns(self, motion: Motion) -> np.ndarray:
        """Return the coupling's columns, stronger in the cold."""
        return super().columns(motion) * (60 - motion.signal("temperature")[:, :1, None])


def test_a_speed_of_its_own_may_go_with_any_signal(two_link) -> None:
    """Samples where such an effect's own sign is unsure are left out whatever else it feels."""
    t = 1e-3 * np.arange(4000)
    q = np.column_stack([np.sin(3 * t), 0.8 * np.sin(4 * t)])
    channels = {
        f"{s}_{j}": x for s, X in (("q", q), ("tau", np.cos(q))) for j, x in zip(two_link.actuated, X.T, strict=True)
    }
    log = Log(t, channels | {"temp_room": 20 + t})
    preparation = Preparation(200.0, 60.0, 150.0, np.full(2, 0.02), 0.01)
    plain = build_regression(Model.of(two_link), [log], preparation=preparation)
    seal = _Seal(two_link.actuated, two_link.force_units)
    more = build_regression(Model.of(two_link, [seal]), [log], preparation=preparation)
    assert 0 < more.n_samples < plain.n_samples
