"""Frames of device and target: undone they are where they were, and their derivatives are those of what the device sees."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tau_dyn.calibrate.frames import DeviceFrames, Frame, compute_rotation_between
from tau_dyn.calibrate.measured import PoseSet
from tau_dyn.calibrate.starting_frames import estimate_campaign_frames
from tau_dyn.mechanism import Poses


def placed(rng: np.random.Generator) -> Frame:
    return Frame(Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix(), rng.normal(size=3))


def posed(rng: np.random.Generator, n: int = 5) -> Poses:
    return Poses(rng.normal(size=(n, 3)), Rotation.random(n, random_state=int(rng.integers(1 << 30))).as_matrix())


def test_a_placement_undone_leaves_points_where_they_were(rng) -> None:
    """There and back by the inverse, a point is where it was."""
    frame, point = placed(rng), rng.normal(size=3)
    there = frame.rotation @ point + frame.translation
    assert_allclose(frame.inverse.rotation @ there + frame.inverse.translation, point, atol=1e-12)


def test_derivatives_of_frames_are_those_of_what_is_seen(rng) -> None:
    """Steps of device and target, each alone: translation and turn of what the device sees, by central differences."""
    frames, base, setup = DeviceFrames((placed(rng),), (placed(rng),)), posed(rng), np.zeros(5, int)
    columns = frames.columns(base, frames.measured(base, setup), setup)
    for which, made in enumerate(columns):
        for k in range(6):
            ends = []
            for h in (1e-6, -1e-6):
                steps = [np.zeros(6), np.zeros(6)]
                steps[which][k] = h
                ends.append(frames.moved(*steps).measured(base, setup))
            assert_allclose(made[:, :3, k], (ends[0].position - ends[1].position) / 2e-6, atol=1e-7)
            assert_allclose(
                made[:, 3:, k], compute_rotation_between(ends[0].rotation, ends[1].rotation) / 2e-6, atol=1e-7
            )


def test_twists_are_carried_to_the_target_and_back(rng) -> None:
    """A tool that turns by a small vector moves the target by that turn's lever; brought back it is the same turn."""
    frames, base, setup = DeviceFrames((placed(rng),), (placed(rng),)), posed(rng), np.zeros(5, int)
    twist = rng.normal(size=(5, 6, 1))
    ends = []
    for h in (1e-6, -1e-6):
        turned = Rotation.from_rotvec(h * twist[:, 3:, 0]).as_matrix() @ base.rotation
        ends.append(frames.measured(Poses(base.position + h * twist[:, :3, 0], turned), setup))
    carried = frames.carried(base, twist, setup)
    assert_allclose(carried[:, :3, 0], (ends[0].position - ends[1].position) / 2e-6, atol=1e-7)
    assert_allclose(carried[:, 3:, 0], compute_rotation_between(ends[0].rotation, ends[1].rotation) / 2e-6, atol=1e-7)
    assert_allclose(frames.brought(base, carried, setup), twist, atol=1e-10)


@pytest.mark.parametrize("turned", [True, False])
def test_frames_of_campaigns_come_from_their_own_poses(rng, turned) -> None:
    """Exact poses of two campaigns, one of them a turn about one axis where orientations count, give both frames exactly."""
    truth = DeviceFrames((placed(rng), placed(rng)), (Frame(placed(rng).rotation, np.array([0.1, -0.05, 0.2])),))
    base, campaign = posed(rng, 40), np.repeat([0, 1], 20)
    if turned:
        turn = Rotation.from_rotvec(np.outer(np.linspace(-1, 1, 20), [0, 0, 1])).as_matrix()
        base = Poses(
            np.concatenate([turn @ [0.5, 0.0, 0.3], base.position[20:]]), np.concatenate([turn, base.rotation[20:]])
        )
    seen = truth.measured(base, campaign)
    poses = PoseSet(np.zeros((40, 1)), seen.position, seen.rotation, campaign=campaign, campaigns=("1", "2"))
    start = DeviceFrames().apart(2, 1)
    found = estimate_campaign_frames(poses, base, np.ones(40, bool), start, turned=turned, tool=True)
    made = found.measured(base, campaign)
    assert_allclose(made.position, seen.position, atol=1e-9 if turned else 1e-3)
    if turned:
        assert_allclose(made.rotation, seen.rotation, atol=1e-9)
