"""The whole family of robots: each loads, has the freedoms it should, closes its loops, and Drake reads the same mechanism."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import LoopSolver
from tau_dyn.robot import Robot, load_robot

FAMILY = {
    "gantry_tau_f1": {"drives": 6, "loops": 6},
    "gantry_tau_t2": {"drives": 6, "loops": 6},
    "gantry_tau_5dof": {"drives": 5, "loops": 6, "reach": 0.02},  # carts of one guideway apart turn the plate
    "gantry_tau_queensland": {"drives": 3, "loops": 5},
    "gantry_tau_queensland dof=5": {"drives": 5, "loops": 5},
    "gantry_tau_queensland telescopic=true": {"drives": 4, "loops": 5},
    "gantry_tau_queensland dof=5 telescopic=true": {"drives": 6, "loops": 5},
    "gantry_tau wrist=serial2 wrist_moves=true": {"drives": 5, "loops": 3},
    "gantry_tau wrist=serial2 wrist_moves=true arms=complete prototype=d1": {"drives": 5, "loops": 6},
    "delta": {"drives": 3, "loops": 6},
    "delta arms=simplified": {"drives": 3, "loops": 3},
    "parallelogram": {"drives": 1, "loops": 1},
    "stewart": {"drives": 6, "loops": 6},
    "triglide": {"drives": 3, "loops": 6},
    "triglide arms=simplified": {"drives": 3, "loops": 3},
    "hexaglide": {"drives": 6, "loops": 6},
    "hexarot": {"drives": 6, "loops": 6},
    "scara_tau": {"drives": 3, "loops": 6},
    "h4": {"drives": 4, "loops": 8},
    "hexa_321": {"drives": 6, "loops": 6},
}


@cache
def robot(words: str) -> Robot:
    name, *arguments = words.split()
    return load_robot(name, **dict(a.split("=") for a in arguments))


def moves(r: Robot, words: str, count: int = 3) -> np.ndarray:
    """Return positions (count, na) that leave home by a tenth of each joint's range at most."""
    rng = np.random.default_rng(11)
    reach = FAMILY[words].get("reach", 0.1)
    return r.home + reach * (r.upper - r.lower) * rng.uniform(-1, 1, (count, r.na))


def tool(r: Robot, solver: LoopSolver, q: np.ndarray) -> pin.SE3:
    pin.forwardKinematics(solver.model, solver.data, solver.close(q))
    return pin.SE3(pin.updateFramePlacement(solver.model, solver.data, r.tool_frame))


@pytest.mark.parametrize("words", FAMILY)
def test_drives_determine_the_mechanism(words: str) -> None:
    """A robot has as many freedoms as drives, which leave nothing else free, and stands far from singularities at home."""
    r, solver = robot(words), LoopSolver(robot(words))
    assert (r.na, len(r.loops)) == (FAMILY[words]["drives"], FAMILY[words]["loops"])
    assert not r.warnings
    assert solver.free_motions().shape[1] == 0
    jacobian = solver._constraints.jacobian(solver.close(r.home))
    assert r.model.nv - np.linalg.matrix_rank(jacobian, tol=1e-8) == r.na
    assert solver.condition(r.home) < 50


@pytest.mark.parametrize("words", FAMILY)
def test_loops_close_at_home_with_passive_joints_at_zero_and_near_it(words: str) -> None:
    """Home is exact in the file itself; a tenth of every joint's range around it is free of singularities."""
    r, solver = robot(words), LoopSolver(robot(words))
    q = pin.neutral(r.model)
    q[r.active_q] = r.home
    assert solver.closure_error(q) < 1e-12
    for q_a in moves(r, words):
        assert solver.closure_error(solver.close(q_a)) < 1e-12
        assert solver.condition(q_a) < 150
    assert np.all(r.lower < r.home) and np.all(r.home < r.upper)
    assert np.all(np.isfinite(np.concatenate([r.velocity_limit, r.effort_limit])))


@pytest.mark.parametrize("words", [w for w in FAMILY if "telescopic" not in w])
def test_every_drive_moves_the_tool(words: str) -> None:
    """Near home no arm stands across its drive's motion: all drives of a kind move the tool by alike, and independently."""
    r, solver = robot(words), LoopSolver(robot(words))
    slides = np.array([kind == "prismatic" for kind in r.joint_kinds])
    for q_a in [r.home, *moves(r, words)]:
        state = solver.state(q_a, np.zeros(r.na), np.zeros(r.na))
        J = pin.computeFrameJacobian(r.model, solver.data, state.q, r.tool_frame, pin.LOCAL_WORLD_ALIGNED) @ state.G
        J[3:] *= 0.2  # [m] so that turns count as what they move that far away
        size = np.linalg.norm(J, axis=0)
        for kind in (slides, ~slides):
            assert not kind.any() or size[kind].min() > 0.1 * size[kind].max()
        assert np.linalg.cond(J / size) < 50


@pytest.mark.parametrize("words", FAMILY)
def test_drake_reads_the_same_mechanism(words: str) -> None:
    """Drake's parser finds the same joints, drives and ball constraints, and puts tool and loops where Pinocchio does."""
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    r, plant = robot(words), MultibodyPlant(1e-3)
    Parser(plant).AddModelsFromString(r.urdf, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base_link"))
    plant.Finalize()
    assert (plant.num_velocities(), plant.num_actuators(), plant.num_constraints()) == (r.model.nv, r.na, len(r.loops))
    solver, context = LoopSolver(r), plant.CreateDefaultContext()
    q_a = moves(r, words, 1)[0]
    q = solver.close(q_a)
    for name in r.model.names[1:]:
        joint, x = plant.GetJointByName(name), q[r.model.joints[r.model.getJointId(name)].idx_q]
        (joint.set_translation if hasattr(joint, "set_translation") else joint.set_angle)(context, x)
    ours = tool(r, solver, q_a)
    theirs = plant.GetFrameByName("tool_link").CalcPoseInWorld(context)
    assert np.abs(theirs.translation() - ours.translation).max() < 1e-12
    assert np.abs(theirs.rotation().matrix() - ours.rotation).max() < 1e-12
    assert plant.CalcTotalMass(context) == pytest.approx(sum(i.mass for i in r.model.inertias))
    for end_a, end_b in loop_ends(r):
        gap = plant.GetBodyByName(end_a[0]).EvalPoseInWorld(context) @ end_a[1]
        gap = gap - plant.GetBodyByName(end_b[0]).EvalPoseInWorld(context) @ end_b[1]
        assert np.abs(gap).max() < 1e-12


@pytest.mark.parametrize("words", FAMILY)
def test_mujoco_reads_the_same_tree(words: str) -> None:
    """MuJoCo, which knows no loops in URDF, finds the same joints and masses."""
    mujoco = pytest.importorskip("mujoco")
    r = robot(words)
    other = mujoco.MjModel.from_xml_string(r.urdf)
    assert other.nv == r.model.nv
    assert other.body_mass.sum() == pytest.approx(sum(i.mass for i in r.model.inertias), abs=1e-7)


def loop_ends(r: Robot) -> list[list[tuple[str, np.ndarray]]]:
    """Return link and point of both ends of every ball constraint, as the file's text has them."""
    value = r'ball_constraint_{} (?:name|value)="([^"]*)"'
    parts = [re.findall(value.format(p), r.urdf) for p in ("body_A", "p_AP", "body_B", "p_BQ")]
    numbers = [[np.array([float(x) for x in text.split()]) for text in parts[k]] for k in (1, 3)]
    return [[(a, p), (b, q)] for a, p, b, q in zip(parts[0], numbers[0], parts[2], numbers[1], strict=True)]


@pytest.mark.parametrize("words", FAMILY)
def test_names_and_masses(words: str) -> None:
    """Link names end in _link and are no joint's; every driven and every rod link carries mass, which is a parameter."""
    r = robot(words)
    links = re.findall(r'<link name="([^"]*)"', r.urdf)
    assert all(name.endswith("_link") for name in links)
    assert r.tool_frame is not None and r.assumed
    carrying = {link.link for link in r.links}
    solid = re.compile(
        r"(cart|arm|rod|leg|telescope|joint_plate)\d[a-c]?(_tilt)?_link|plate_link|bar\d_link|triangle3_link"
    )
    assert {name for name in links if solid.fullmatch(name)} == carrying - {
        name for name in carrying if "cylinder" in name or "wrist" in name
    }
    assert {f"{name}.mass" for name in carrying} <= set(r.parameters.names)
    for inertia in r.model.inertias[1:]:
        moments = np.linalg.eigvalsh(inertia.inertia)
        assert moments[0] >= 0 and moments[2] <= moments[0] + moments[1] + 1e-12


def test_f1_is_table_5_5() -> None:
    """Rod lengths, ball joints on the plate and cart positions are the printed ones; q4 and q5 turn about opposed level axes."""
    r = robot("gantry_tau_f1")
    assert set(r.actuated) == {"cart1", "cart2", "cart3", "q4", "q5", "q6"}
    lengths = [p[0] for (link, p), _ in loop_ends(r)]
    assert lengths == pytest.approx([1.92258, 1.50186, 1.50427, 1.50199, 1.50119, 1.50524], abs=1e-12)
    on_plate = np.array([p for _, (link, p) in loop_ends(r)])
    assert on_plate[[0, 5]] == pytest.approx(1e-3 * np.array([[-134.75, -0.48, -309.28], [-184.92, -86.25, -193.93]]))
    solver = LoopSolver(r)
    J = pin.computeJointJacobians(r.model, solver.data, solver.close(r.home))
    axes = {j: J[3:, r.model.joints[r.model.getJointId(j)].idx_v] for j in ("q4", "q5", "q6")}
    assert axes["q4"] @ axes["q5"] < -0.99  # so that q4 = -q5 keeps the links' parallelograms, section 4.5
    assert abs(axes["q5"] @ axes["q6"]) < 0.05
    for i, origin in enumerate([(-0.23572, 3.29890), (-0.97438, 2.75112), (0.71976, 2.23866)]):
        assert solver.data.oMi[r.model.getJointId(f"cart{i + 1}")].translation[:2] == pytest.approx(origin)


def test_t2_turns_its_plate_with_q4_against_q5_and_q6() -> None:
    """With q4 = -q5 the plate turns by q4 about that axis, with q6 about the tilt axis: the thesis' 5-DOF case, Figure 4.15."""
    r = robot("gantry_tau_t2")
    solver, index = LoopSolver(r), {j: k for k, j in enumerate(r.actuated)}
    q = r.home.copy()
    q[index["q4"]], q[index["q5"]] = 0.15, -0.15
    assert pin.log3(tool(r, solver, q).rotation) == pytest.approx([0, 0, 0.15], abs=1e-9)
    q = r.home.copy()
    q[index["q6"]] = 0.1
    assert pin.log3(tool(r, solver, q).rotation) == pytest.approx([0, 0.1, 0], abs=1e-9)


@pytest.mark.parametrize("words", ["delta", "triglide"])
def test_parallel_rods_keep_the_plate_level_and_simplify_exactly(words: str) -> None:
    """Pairs of equal parallel rods leave the plate three translations, the same as one rod an arm gives."""
    r, one = robot(words), robot(f"{words} arms=simplified")
    both = LoopSolver(r), LoopSolver(one)
    for q in moves(r, words):
        complete, simplified = tool(r, both[0], q), tool(one, both[1], q)
        assert np.abs(complete.rotation - np.eye(3)).max() < 1e-10
        assert complete.translation == pytest.approx(simplified.translation, abs=1e-11)


def test_delta_arm_points_as_the_paper_says() -> None:
    """Arm 1 stands at 60 degrees: it turns about u_1 = (cos 60, sin 60, 0), and positive q lifts its rods, (10) and (11)."""
    r = robot("delta")
    solver = LoopSolver(r)
    J = pin.computeJointJacobians(r.model, solver.data, solver.close(r.home))
    k = r.model.joints[r.model.getJointId("arm1")].idx_v
    assert J[3:, k] == pytest.approx([0.5, np.sqrt(0.75), 0])
    up, down = (tool(r, solver, r.home + d) for d in (0.1, -0.1))
    assert up.translation[2] > down.translation[2]


def test_h4_turns_about_the_vertical_only() -> None:
    """Four drives give three translations and a turn about z."""
    r = robot("h4")
    solver, turns = LoopSolver(r), []
    for q in moves(r, "h4"):
        turns.append(pin.log3(tool(r, solver, q).rotation))
    assert np.abs(np.array(turns)[:, :2]).max() < 1e-10
    assert np.abs(np.array(turns)[:, 2]).max() > 1e-2


def test_scara_tau_turns_with_its_arm_of_three_rods() -> None:
    """The prism of three rods hands arm 3's angle on to the plate, the parallelogram keeps it level."""
    r = robot("scara_tau")
    solver = LoopSolver(r)
    for q in moves(r, "scara_tau"):
        assert pin.log3(tool(r, solver, q).rotation) == pytest.approx([0, 0, q[2] - r.home[2]], abs=1e-10)


def test_queensland_turns_as_it_moves_and_the_gantry_tau_does_not() -> None:
    """The triangular link couples orientation to position (thesis 2.2); the six parallel rods do not."""
    r, other = robot("gantry_tau_queensland"), load_robot("gantry_tau", arms="complete")
    q = np.array([0.1, -0.1, 0.05])
    assert np.linalg.norm(pin.log3(tool(r, LoopSolver(r), r.home + q).rotation)) > 0.02
    assert np.linalg.norm(pin.log3(tool(other, LoopSolver(other), other.home + q).rotation)) < 1e-10


def test_telescopic_arm_is_redundant() -> None:
    """With the telescope in arm 1 there are four drives and the plate still has three freedoms."""
    r = robot("gantry_tau_queensland telescopic=true")
    solver = LoopSolver(r)
    state = solver.state(r.home, np.zeros(4), np.zeros(4))
    J = pin.computeFrameJacobian(r.model, solver.data, state.q, r.tool_frame, pin.LOCAL_WORLD_ALIGNED) @ state.G
    assert np.linalg.matrix_rank(J, tol=1e-8) == 3


def test_hexa_321_rods_meet_three_two_and_one() -> None:
    """The plate's points are three, held by three, two and one rods."""
    points = [tuple(np.round(p, 9)) for _, (_, p) in loop_ends(robot("hexa_321"))]
    assert sorted(points.count(p) for p in set(points)) == [1, 2, 3]


@pytest.mark.parametrize("angle", [-0.6, 0.0, 0.3])
@pytest.mark.parametrize("h", [0.0, 0.1, 0.2])
def test_parallelogram_is_equation_34(angle: float, h: float) -> None:
    """The tool moves by l sin q and keeps its orientation, whatever h is."""
    r = load_robot("parallelogram", h=h)
    pose = tool(r, LoopSolver(r), np.array([angle]))
    assert pose.translation == pytest.approx([0.95 * np.sin(angle), 0, -0.95 * np.cos(angle) - h], abs=1e-12)
    assert np.abs(pose.rotation - np.eye(3)).max() < 1e-12


def test_stewart_leg_is_as_long_as_its_slide_says() -> None:
    """A leg's length is its shortest plus q."""
    r = robot("stewart")
    solver = LoopSolver(r)
    q = moves(r, "stewart", 1)[0]
    pin.forwardKinematics(r.model, solver.data, solver.close(q))
    roots = [solver.data.oMi[r.model.getJointId(f"leg{k}_yaw")].translation for k in range(1, 7)]
    tips = [solver.data.oMi[r.model.getJointId(f"leg{k}")].translation for k in range(1, 7)]
    lengths = np.linalg.norm(np.array(tips) - np.array(roots), axis=1)
    assert np.ptp(lengths - q) < 1e-12
    assert np.all(lengths - q > 0.3)


def test_moving_wrist_is_the_standing_one_at_home() -> None:
    """Driven at zero the wrist weighs and stands as the fixed one; the tool is then the gauge block's frame."""
    still = load_robot("gantry_tau", arms="complete", wrist="serial2")
    moving = load_robot("gantry_tau", arms="complete", wrist="serial2", wrist_moves="true")
    places, centres = [], []
    for r, frame in ((still, "gauge_block_link"), (moving, "tool")):
        solver = LoopSolver(r)
        q = solver.close(r.home)
        centres.append(pin.centerOfMass(r.model, solver.data, q).copy())
        pin.updateFramePlacements(r.model, solver.data)
        places.append(solver.data.oMf[r.model.getFrameId(frame)].translation)
    assert places[0] == pytest.approx(places[1], abs=1e-12)
    assert centres[0] == pytest.approx(centres[1], abs=1e-12)
    assert moving.actuated == ("cart1", "cart2", "cart3", "wrist1", "wrist2")


@pytest.mark.parametrize(("name", "arguments", "said"), [
    ("delta", {"arms": "both"}, "complete or simplified"),
    ("triglide", {"arms": "none"}, "complete or simplified"),
    ("gantry_tau_queensland", {"dof": "4"}, "3 or 5"),
    ("gantry_tau_queensland", {"telescopic": "maybe"}, "true or false"),
    ("gantry_tau", {"wrist_moves": "true"}, "serial2"),
    ("gantry_tau", {"wrist": "serial2", "wrist_moves": "yes"}, "true or false"),
])  # fmt: skip
def test_unknown_choices_are_refused(name: str, arguments: dict[str, str], said: str) -> None:
    """A choice that the file does not know is a sentence, not a robot."""
    with pytest.raises(InputError, match=said):
        load_robot(name, **arguments)
