"""A planned campaign: candidates keep their distances, the tour is short and free, files say what is driven, nothing is lost."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code

sys.path.insert(0, str(Path(__file__).parent))
from pose_rigs import at, camera, candidates, l1, six_axes

from tau_dyn.calibrate.poses import (
    CalibrationCampaign,
    PathCheck,
    Safety,
    format_rapid_module,
    format_tour_csv,
    plan_campaign,
    read_progress,
)
from tau_dyn.calibrate.poses.campaign_files import build_new_progress, run_campaign
from tau_dyn.calibrate.poses.reachable import find_reachable
from tau_dyn.calibrate.poses.tour import plan_tour
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.kinematics import Surroundings
from tau_dyn.kinematics.obstacles import build_surroundings
from tau_dyn.kinematics.workspace import PoseRequirements, build_machine
from tau_dyn.render.kinds.calibration_words import (
    describe_plan as describe_headline,
    describe_plan_inputs as describe_inputs,
    describe_rehearsal,
)

LAB = build_surroundings(
    {"obstacles": [{"name": "table", "box": {"centre": [2.5, -1.7, -0.1], "size": [1.0, 0.6, 0.8]}}]}, "lab"
)


@pytest.fixture(scope="module")
def plan() -> CalibrationCampaign:
    """A plan for L1 with a camera and a table."""
    return plan_campaign(l1(), camera(), 20, demands=PoseRequirements(surroundings=LAB), candidates=250, runs=2)


def test_plan_has_what_was_asked_for(plan: CalibrationCampaign) -> None:
    """Twenty poses are visited once each, all in sight, and rehearsals are about as accurate as predicted."""
    assert sorted(plan.tour.pose[plan.tour.pose >= 0]) == list(range(20))
    assert (plan.device.reasons(plan.tool(plan.choice.q)) == "").all()
    assert plan.rehearsal.achieved < 3 * plan.choice.predicted.rms
    assert plan.rehearsal.achieved < 0.5 * np.sqrt(np.mean(plan.rehearsal.before**2))


def test_the_tour_is_shorter_and_free(plan: CalibrationCampaign) -> None:
    """The tour is shorter than the poses as listed, and no place on it, looked at more finely, is forbidden."""
    assert plan.tour.length < 0.8 * plan.tour.as_given
    track = np.vstack([l1().home, plan.tour.q])
    fine = np.concatenate(
        [a + np.linspace(0, 1, 25)[:, None] * (b - a) for a, b in zip(track[:-1], track[1:], strict=True)]
    )
    assert (plan.check.reasons(fine) == "").all()


def test_candidates_keep_their_distance() -> None:
    """With safety distances, the tool can go as far to every side, the ball joints and the travel keep their reserve."""
    machine = build_machine(l1())
    safety = Safety(distance=0.1, angle=np.deg2rad(10.0), travel=0.05)
    found = find_reachable(machine, PoseRequirements(surroundings=LAB), safety, wanted=200)
    assert found.n > 30
    plain = PathCheck(machine, PoseRequirements(surroundings=LAB, ball_angle=np.deg2rad(35.0 + 1e-6), collisions=False))
    assert (plain.reasons(found.q) == "").all()
    for step in 0.099 * np.vstack([np.eye(3), -np.eye(3)]):
        moved = machine.solve(at(*(found.tool.position + step)))
        assert moved.ok.all()
    travel = l1().upper - l1().lower
    assert (found.q >= l1().lower + 0.05 * travel).all() and (found.q <= l1().upper - 0.05 * travel).all()
    wide = find_reachable(machine, PoseRequirements(collisions=False), Safety(0.1, 0.0, 0.0), wanted=200)
    free = PathCheck(machine, PoseRequirements(collisions=False))
    for step in 0.099 * np.vstack([np.eye(3), -np.eye(3)]):
        assert (free.reasons(machine.solve(at(*(wide.tool.position + step))).q) == "").all()
    assert LAB.obstacles[0].distance(found.tool.position).min() >= 0.1
    assert find_reachable(machine, PoseRequirements(), Safety(0.0, 0.0, 0.0), wanted=200).n > 0


def test_more_safety_leaves_fewer_poses_and_too_much_none() -> None:
    """A safety distance beyond half the workspace leaves nothing; that is said, with what would help."""
    machine = build_machine(l1())
    with raises_code("no_solution"):
        find_reachable(machine, PoseRequirements(), Safety(distance=1.2), wanted=200)
    with raises_code("invalid_value"):
        Safety(travel=0.7)
    with raises_code("invalid_value"):
        Safety(distance=float("nan"))


class _Floor:
    """A machine in the plane with a wall from y = -1 to 0.5 at x = 0: moves across are free above it."""

    travel = np.array([2.0, 2.0])

    def blocked(self, start: np.ndarray, end: np.ndarray) -> list[str]:
        out = []
        for a, b in zip(start, end, strict=True):
            crosses = (a[0] < 0) != (b[0] < 0)
            y = a[1] + (b[1] - a[1]) * (0 - a[0]) / (b[0] - a[0]) if crosses else 1.0
            out.append("obstacle: wall" if crosses and y < 0.5 else "")
        return out


def test_a_tour_goes_round_a_wall() -> None:
    """Poses on both sides of a wall are all visited, every move is free, through a place beside the wall if need be."""
    rng = np.random.default_rng(2)
    low = rng.uniform([-1, -1], [1, 0.2], (12, 2))
    tour = plan_tour(low, np.array([-0.5, -0.5]), _Floor(), np.array([[-0.1, 0.9], [0.1, 0.9], [0.0, 0.95]]))  # type: ignore[arg-type]
    assert sorted(tour.pose[tour.pose >= 0]) == list(range(12))
    assert (tour.pose < 0).sum() == 1  # the wall is crossed once
    track = np.vstack([[-0.5, -0.5], tour.q])
    assert not any(_Floor().blocked(track[:-1], track[1:]))


def test_what_nothing_leads_to_is_left_out_and_named() -> None:
    """Without a way round, the poses behind the wall are left out with the reason."""
    poses = np.array([[-0.9, 0.0], [0.9, 0.0], [-0.2, 0.1]])
    tour = plan_tour(poses, np.array([-0.5, -0.5]), _Floor())  # type: ignore[arg-type]
    assert tour.left_out == {1: "obstacle: wall"} and sorted(tour.pose) == [0, 2]


def test_two_opt_undoes_crossings() -> None:
    """On a ring of places the short tour goes once around, no longer than the ring itself."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    free = type("Free", (), {"travel": np.ones(2), "blocked": lambda self, a, b: [""] * len(a)})()
    shuffled = ring[np.random.default_rng(0).permutation(24)]
    assert plan_tour(shuffled, ring[0], free).length < np.sum(np.max(np.abs(np.diff(ring, axis=0)), axis=1)) * 1.05


def test_rapid_holds_targets_in_mm_and_degrees() -> None:
    """Slides are written in mm, turning joints in degrees, quaternions with the scalar first, unused axes as 9E9."""
    q = np.array([[0.1234, np.pi / 2], [0.2, 0.0]])
    text = format_rapid_module(
        q, np.array([0, -1]), at((1, 2, 3), (0, 0, 0)), ["prismatic", "revolute"], actuated=["a", "b"]
    )
    assert "[[123.4000,90.0000,0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]" in text
    assert "[[1000.0000,2000.0000,3000.0000],[1.00000000,0.00000000" in text
    assert "pose_number{2} := [1, 0]" in text and text.count("MODULE") == 2
    assert len(re.findall(r"\bPROC\b", text)) == len(re.findall("ENDPROC", text))
    assert all(len(line) < 400 for line in text.splitlines())
    with raises_code("missing_input"):
        format_rapid_module(q[:0], np.zeros(0, int), at(), ["prismatic", "revolute"])
    with raises_code("unsupported", "12"):
        format_rapid_module(np.zeros((1, 13)), np.zeros(1, int), at((0, 0, 0)), ["revolute"] * 13)
    with raises_code("invalid_value"):
        format_rapid_module(q, np.array([0, 1]), at((1, 2, 3), (0, 0, 0)), ["prismatic", "revolute"], name="1 poses")


def test_csv_repeats_the_numbers() -> None:
    """The CSV holds each place's positions and the pose measured there, 0 on the way."""
    q = candidates()[:3]
    rows = format_tour_csv(q, np.array([1, -1, 0]), l1().actuated).splitlines()
    assert rows[0] == "pose,q_cart1,q_cart2,q_cart3"
    table = np.array([[float(x) for x in row.split(",")] for row in rows[1:]])
    assert table[:, 0].tolist() == [2, 0, 1] and np.allclose(table[:, 1:], q, atol=1e-8)


class _Interrupted(Exception):
    pass


def test_a_campaign_killed_at_any_place_goes_on(tmp_path: Path) -> None:
    """Stopped during any place, the next call measures that place again and no other twice; the result is the same."""
    q, pose = candidates()[:6], np.array([0, -1, 2, 1, -1, 3])
    told = build_new_progress(l1().actuated, q, pose)

    def measured(k: int) -> tuple[np.ndarray, np.ndarray]:
        return np.full(3, float(k)), np.eye(3)

    for stop in range(6):
        path, calls = tmp_path / f"{stop}.json", []

        def device(k: int, where: np.ndarray, stop: int = stop, calls: list = calls):  # noqa: ANN202
            calls.append(k)
            if len(calls) == stop + 1:
                raise _Interrupted
            return measured(k) if k != 1 else None

        with pytest.raises(_Interrupted):
            run_campaign(told, device, path)
        json.loads(path.read_text())  # whole at any time
        found = run_campaign(told, device, path)
        assert len(calls) == 7 and [k for k in calls if k >= 0].count(int(pose[stop])) == (2 if pose[stop] >= 0 else 0)
        assert found.position[:, 0].tolist() == [0, 2, 3] and found.rotation is not None
        assert found.names == ("pose 1", "pose 3", "pose 4") and np.allclose(found.q, q[[0, 2, 5]])
        assert run_campaign(told, device, path).n == 3 and len(calls) == 7  # nothing is left to do
        assert read_progress(path, l1().actuated).state.count("missed") == 1
    assert not list(tmp_path.glob("*.part"))


def test_a_progress_file_of_something_else_is_refused(tmp_path: Path) -> None:
    """Another plan, another robot, or no progress file at all: each is a sentence, and nothing is overwritten."""
    told = build_new_progress(l1().actuated, candidates()[:4], np.arange(4))
    path = tmp_path / "p.json"
    told.save(path)
    before = path.read_text()
    other = replace(told, q=told.q + 0.1)
    with raises_code("mismatch"):
        run_campaign(other, lambda k, where: None, path)
    with raises_code("mismatch"):
        read_progress(path, ("a", "b", "c"))
    assert path.read_text() == before
    for text in ("{}", "[1", '{"version": 1, "actuated": ["a"], "places": [{"pose": 1, "q": [NaN], "state": "open"}]}'):
        path.write_text(text)
        with raises_code("file_format"):
            read_progress(path, ("a",))
    with raises_code("not_visible", "4"):
        run_campaign(told, lambda k, where: None, tmp_path / "q.json")


def test_the_gate_refuses_with_what_would_help(plan: CalibrationCampaign) -> None:
    """An accuracy beyond so many poses is refused with the number that would do; an impossible one asks for a better device."""
    few = {"demands": PoseRequirements(collisions=False), "candidates": 250, "runs": 1}
    with raises_code("not_accurate_enough") as fault:
        plan_campaign(l1(), camera(), 10, required=0.6 * plan.choice.predicted.rms, **few)
    assert re.search(r"about \d+ poses instead of 10", fault.value.experiment)
    with raises_code("not_accurate_enough") as fault:
        plan_campaign(l1(), camera(), 10, required=1e-6, **few)
    assert "times as exact" in fault.value.experiment


def test_zones_for_the_tool_hide_nothing() -> None:
    """A zone that only the tool must keep out of stands in no line of sight; a solid in its place does."""
    zone = {"name": "zone", "box": {"centre": [4.0, -0.6, 0.7], "size": [0.2, 3.0, 3.0]}}
    made = []
    for blocks in ("tool", "robot"):
        around: Surroundings = build_surroundings({"obstacles": [zone | {"blocks": blocks}]}, "lab")
        try:
            given = PoseRequirements(surroundings=around, collisions=False)
            made.append(len(plan_campaign(l1(), camera(), 10, demands=given, candidates=120, runs=1).visible.index))
        except CannotAnswer as fault:
            assert "hidden by zone" in str(fault)
            made.append(0)
    assert made[0] > 20 and made[1] == 0


def test_a_serial_arm_is_planned_too() -> None:
    """A six-axis arm's poses are spread over its joints, and moves may pass its singularities; the prediction comes true."""
    plan = plan_campaign(six_axes(), None, 15, candidates=150, runs=2)
    assert plan.choice.n == 15 and plan.rehearsal.achieved < 2 * plan.choice.predicted.rms
    assert plan.choice.predicted.turn > 0 and plan.choice.predicted.rms < plan.choice.at_random


def test_what_the_terminal_says(plan: CalibrationCampaign) -> None:
    """The headline has the number of poses and the accuracy, the summary what was seen and the fewest poses."""
    assert describe_headline(plan).startswith("20 poses: predicted RMS error")
    assert describe_inputs(plan).endswith("at least 8 poses") and "camera" in describe_inputs(plan)
    assert "simulated" in describe_rehearsal(plan)
