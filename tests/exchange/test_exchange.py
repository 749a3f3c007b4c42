"""A model written for other programs and read back gives the same forces."""

from xml.etree.ElementTree import fromstring

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from tau_dyn.effects import EFFECTS, AsymmetricFriction, Stribeck, SymmetricFriction, build_friction_model
from tau_dyn.exchange import build_mjcf, build_urdf
from tau_dyn.mechanism import TreeMechanism
from tau_dyn.model import Model
from tau_dyn.robot import list_stock_robots, load_robot, load_robot_from_urdf, read_visuals
from tau_dyn.simulate import free_motion

ROBOTS = {
    "simplified": lambda write: load_robot("gantry_tau", gravity_mass=22.38),
    "complete": lambda write: load_robot("gantry_tau", arms="complete", prototype="d1"),
    "axis": lambda write: load_robot("linear_axis"),
    "four_bar": lambda write: load_robot_from_urdf(write.four_bar(), "four_bar"),
    "turning": lambda write: load_robot_from_urdf(write.two_link().replace("revolute", "continuous"), "turning"),
}


@pytest.fixture(params=ROBOTS)
def model(request, write, rng):
    """A robot whose masses, drive inertias and friction are none of the file's."""
    robot = ROBOTS[request.param](write)
    units = robot.force_units
    made = Model.of(robot, [SymmetricFriction(robot.actuated, units)])
    changed = {}
    for p in made.parameters:
        if p.name.endswith(".mass"):
            changed[p.name] = p.value * 1.3 + 0.1
        elif p.name.endswith((".coulomb", ".viscous", ".armature")):
            changed[p.name] = float(rng.uniform(0.5, 3))
        elif p.name.endswith((".ixx", ".iyy", ".izz")):
            changed[p.name] = p.value * 1.2 + 0.05
        elif p.name.endswith((".mx", ".my", ".mz", ".ixy", ".ixz", ".iyz")):
            changed[p.name] = p.value + float(rng.uniform(-0.02, 0.02))
    return made.with_values(changed)


def motion(robot, rng, n=5):
    q = robot.home + rng.uniform(-0.1, 0.1, (n, robot.na))
    return q, rng.standard_normal((n, robot.na)), rng.standard_normal((n, robot.na))


def test_a_urdf_reads_back_with_the_same_forces(model, rng):
    """Written and loaded again the robot needs the same forces, to 1e-9 of the largest."""
    again = load_robot_from_urdf(build_urdf(model).text, "again")
    assert again.actuated == model.robot.actuated
    q, v, a = motion(model.robot, rng)
    want = model.mechanism.inverse_dynamics(q, v, a)
    assert_allclose(Model.of(again).mechanism.inverse_dynamics(q, v, a), want, atol=1e-9 * np.abs(want).max())


@pytest.mark.parametrize("source", ["a---b", "a--->b", "a-->b", "-", "a\x01\x1bb"])
@pytest.mark.parametrize("write_file", [build_urdf, build_mjcf])
def test_no_file_name_ends_the_comment_at_the_top(source, write_file):
    """An XML comment holds no two hyphens in a row and nothing that is no character; what a file is called may."""
    robot = load_robot_from_urdf(load_robot("linear_axis").urdf, source)
    assert fromstring(write_file(Model.of(robot)).text).tag in ("robot", "mujoco")


def test_a_urdf_carries_friction_as_pinocchio_reads_it(model):
    """`<dynamics>` holds the viscous and Coulomb coefficients of each drive."""
    again = load_robot_from_urdf(build_urdf(model).text, "again")
    for joint, index in zip(again.actuated, again.active_v, strict=True):
        assert_allclose(again.model.damping[index], model.parameters[f"{joint}.viscous"].value, rtol=1e-12)
        assert_allclose(again.model.friction[index], model.parameters[f"{joint}.coulomb"].value, rtol=1e-12)


def test_mujoco_gives_the_same_forces(model, rng):
    """`mj_inverse` of the MJCF's tree, projected through our loops, is the model's force; friction and light links aside."""
    mujoco = pytest.importorskip("mujoco")
    theirs = mujoco.MjModel.from_xml_string(build_mjcf(model).text)
    theirs.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    theirs.dof_damping[:] = 0
    light = (theirs.body_mass < 1e-6) & (theirs.body_gravcomp == 0)
    theirs.body_mass[light], theirs.body_inertia[light] = 0.0, 0.0
    data = mujoco.MjData(theirs)
    mujoco.mj_setConst(theirs, data)
    robot = model.robot
    order = [theirs.joint(n).dofadr[0] for n in list(robot.model.names)[1:]]
    tree = TreeMechanism(robot)
    for q, v, a in zip(*motion(robot, rng), strict=True):
        state = tree.solver.state(q, v, a)
        x = state.q if robot.model.nq == robot.model.nv else q
        data.qpos[order], data.qvel[order], data.qacc[order] = x, state.v, state.a
        mujoco.mj_inverse(theirs, data)
        want = model.mechanism.inverse_dynamics(q[None], v[None], a[None])[0]
        assert_allclose(state.G.T @ data.qfrc_inverse[order], want, atol=1e-9 * np.abs(data.qfrc_inverse).max())


def test_mujocos_loops_are_closed_at_home(model):
    """At the keyframe `home` the ends of every `<connect>` meet, and stepping the simulation keeps them together."""
    mujoco = pytest.importorskip("mujoco")
    theirs = mujoco.MjModel.from_xml_string(build_mjcf(model).text)
    data = mujoco.MjData(theirs)
    mujoco.mj_resetDataKeyframe(theirs, data, 0)
    mujoco.mj_forward(theirs, data)
    assert theirs.neq == len(model.robot.loops)
    for k in range(theirs.neq):
        ends = data.site_xpos[[theirs.eq_obj1id[k], theirs.eq_obj2id[k]]]
        assert_allclose(ends[0], ends[1], atol=1e-10)


def test_what_a_format_cannot_carry_is_said():
    """A Stribeck term and friction that differs by direction are named; the mean of both directions is written."""
    robot = load_robot("linear_axis")
    effects = [AsymmetricFriction(("axis",), ("N",)), Stribeck(("axis",), ("N",))]
    model = Model.of(robot, effects).with_values({"axis.coulomb_pos": 20.0, "axis.coulomb_neg": 24.0})
    made = build_urdf(model)
    assert any("stribeck" in s for s in made.left_out) and any("20 and 24" in s for s in made.left_out)
    dynamics = fromstring(made.text).find("joint[@name='axis']/dynamics")
    assert dynamics is not None and float(dynamics.get("friction", "")) == 22.0
    assert "carriage_link.mass" in made.nominal  # no data determined it


def test_a_stock_arm_whose_meshes_are_elsewhere_becomes_mjcf():
    """A UR5's file names meshes of a package that is not there; its bodies do not need them, and what is left out is said."""
    shape = '<visual><geometry><mesh filename="package://nowhere/base.dae"/></geometry></visual>'
    urdf = (
        f'<robot name="arm"><link name="base_link">{shape}</link><link name="arm_link">{shape}<inertial><origin xyz="0.2 0 0"/>'
        '<mass value="2"/><inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="turn" type="revolute"><parent link="base_link"/><child link="arm_link"/><axis xyz="0 1 0"/>'
        '<limit lower="-2" upper="2" velocity="2" effort="50"/></joint></robot>'
    )
    mujoco = pytest.importorskip("mujoco")
    made = build_mjcf(Model.of(load_robot_from_urdf(urdf, "arm", actuated=["turn"])))
    assert "mesh" not in made.text and not made.meshes
    assert any("package://nowhere/base.dae" in sentence for sentence in made.left_out)
    assert mujoco.MjModel.from_xml_string(made.text).nbody == 2


def test_meshes_in_mjcf_stand_where_the_urdf_has_them(tmp_path):
    """MuJoCo draws a Panda's hand where its Collada file is put; the tool is a site; pictures weigh nothing."""
    mujoco, q = pytest.importorskip("mujoco"), np.array([0.3, -0.5, 0.2, -2.0, 0.4, 1.5, 0.6, 0.01])
    robot = (
        load_robot("panda") if "panda" in list_stock_robots() else pytest.skip("example-robot-data is not installed")
    )
    made = build_mjcf(Model.of(robot), "p.")
    assert len(made.meshes) == 10 and not made.left_out  # both fingers are one mesh
    for name, content in made.meshes.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "p.xml").write_text(made.text)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "p.xml"))
    theirs, data = mujoco.MjData(model), robot.model.createData()
    theirs.qpos[:] = [*q, q[-1]]
    mujoco.mj_kinematics(model, theirs)
    pin.forwardKinematics(robot.model, data, np.array([*q, q[-1]]))
    pin.updateFramePlacements(robot.model, data)
    assert_allclose(theirs.site(robot.tool).xpos, data.oMf[robot.tool_frame].translation, atol=1e-9)
    (hand,) = [v for v in read_visuals(robot)[0] if v.name == "panda_hand_0"]
    place = data.oMi[hand.joint] * hand.placement
    ours = hand.shape.vertices @ place.rotation.T + place.translation
    mesh = model.mesh("hand").id
    (geom,) = np.flatnonzero(model.geom_dataid == mesh)
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    drawn = model.mesh_vert[start : start + count] @ theirs.geom_xmat[geom].reshape(3, 3).T + theirs.geom_xpos[geom]
    assert_allclose(drawn.min(axis=0), ours.min(axis=0), atol=1e-6)
    assert_allclose(drawn.max(axis=0), ours.max(axis=0), atol=1e-6)
    assert model.body_mass.sum() == pytest.approx(sum(link.nominal[0] for link in robot.links), rel=1e-6)


FREE = {
    "l1": lambda: load_robot("gantry_tau", gravity_mass=22.38),
    "d1": lambda: load_robot("gantry_tau", arms="complete", prototype="d1"),
    "f1": lambda: load_robot("gantry_tau_f1"),
    "delta": lambda: load_robot("delta"),
    "stewart": lambda: load_robot("stewart"),
    "ur5": lambda: load_robot("ur5"),
}
SPEEDS = {"stewart": 0.02}
"""Speed at the start [m/s or rad/s] where 0.2 would leave the workspace."""


@pytest.mark.parametrize("friction", [False, True])
@pytest.mark.parametrize("name", FREE)
def test_mujoco_moves_as_we_do(name, friction, rng, in_mujoco):
    """Half a second of `mj_step` from the file as it is, weight held, ends within 0.1 % of our own motion, friction included."""
    if name == "ur5" and name not in list_stock_robots():
        pytest.skip("example-robot-data is not installed")
    robot = FREE[name]()
    effects = [*build_friction_model("asymmetric", robot.actuated, robot.force_units)] if friction else []
    effects += [EFFECTS[c](robot.actuated, robot.force_units) for c in ("drive_gain", "armature") if friction]
    model = Model.of(robot, effects)
    mass, weight = model.mechanism.mass_and_bias(robot.home, np.zeros(robot.na))
    speed = SPEEDS.get(name, 0.2)
    stops = np.diag(mass) * speed  # what would stop a joint within a second
    size = {"coulomb_pos": 0.2, "coulomb_neg": 0.15, "viscous_pos": 0.3 / speed, "viscous_neg": 0.3 / speed}
    size = {n: {j: x * s for j, s in zip(robot.actuated, stops, strict=True)} for n, x in size.items()}
    size |= {"gain_error": dict.fromkeys(robot.actuated, 0.05)}
    size |= {"armature_error": {j: 0.2 * m for j, m in zip(robot.actuated, np.diag(mass), strict=True)}}
    model = model.with_values({n: size[n.split(".")[1]][n.split(".")[0]] for n in model.effect_parameters.names})
    v0, force = speed * rng.standard_normal(robot.na), weight * (1.05 if friction else 1.0)
    ours = free_motion(model, robot.home, v0, 0.5, dt=5e-4, tau=force).q[::2]
    with in_mujoco.open_in_mujoco(build_mjcf(model)) as opened:
        theirs = in_mujoco.move_in_mujoco(robot, opened, v0, force, 0.5)
    assert np.abs(theirs - ours).max() < 1e-3 * np.ptp(ours, axis=0).max()


def test_a_urdf_says_what_ros2_control_may_command():
    """Each drive takes an effort within its limit and shows position and velocity."""
    robot = load_robot("gantry_tau")
    system = fromstring(build_urdf(Model.of(robot)).text).find("ros2_control")
    assert system is not None and [j.get("name") for j in system.findall("joint")] == list(robot.actuated)
    drive = system.find("joint")
    assert drive is not None and drive.find("command_interface").get("name") == "effort"
    assert float(drive.findtext("command_interface/param[@name='max']")) == robot.effort_limit[0]
    assert [s.get("name") for s in drive.findall("state_interface")] == ["position", "velocity"]


@pytest.mark.parametrize("name", ["two_link", "linear_axis"])
def test_drake_moves_as_we_do(name, write):
    """Half a second of Drake from the exported URDF, drive inertia and damping included, is our own motion to 0.1 %."""
    pytest.importorskip("pydrake")
    from pydrake.all import DiagramBuilder, MultibodyPlant, Parser, Simulator

    robot = load_robot(name) if name == "linear_axis" else load_robot_from_urdf(write.two_link(), name)
    model = Model.of(robot, [SymmetricFriction(robot.actuated, robot.force_units)])
    model = model.with_values({n: 2.0 for n in model.parameters.names if n.endswith((".viscous", ".armature"))})
    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(0.0))
    Parser(plant).AddModelsFromString(build_urdf(model).text, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base_link"))
    plant.Finalize()
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    force = np.full(robot.na, 3.0)
    plant.get_actuation_input_port().FixValue(context, force)
    joints = [plant.GetJointByName(j) for j in robot.actuated]
    plant.SetPositions(context, robot.home)
    simulator.AdvanceTo(0.5)
    q = plant.GetPositions(context)[[j.position_start() for j in joints]]
    ours = free_motion(model, robot.home, 0 * robot.home, 0.5, dt=2.5e-4, tau=force).q
    assert np.abs(q - ours[-1]).max() < 1e-3 * np.ptp(ours, axis=0).max()


MIMIC = '<mimic joint="shoulder" multiplier="-0.5" offset="0.2"/>'


def _couple(write, rule: str, *, plugin: bool = False) -> str:
    """Return two links of which the elbow follows the shoulder, by URDF's element or by Gazebo's plugin; both have motors."""
    if plugin:
        law = "<multiplier>-0.5</multiplier><offset>0.2</offset>"
        gazebo = (
            f'<gazebo><plugin name="m"><joint>shoulder</joint><mimicJoint>elbow</mimicJoint>{law}</plugin></gazebo>'
        )
        return write.two_link().replace("</robot>", f"{gazebo}</robot>")
    elbow = '<joint name="elbow" type="revolute">'
    return write.two_link().replace(elbow, elbow + rule)


@pytest.mark.parametrize("plugin", [False, True])
@pytest.mark.parametrize("actuated", [["shoulder"], ["shoulder", "elbow"]])
def test_a_coupling_that_does_not_count_is_not_written(write, plugin, actuated, rng):
    """A follower that was named as a drive is one in the file too; one that follows still follows."""
    robot = load_robot_from_urdf(_couple(write, MIMIC, plugin=plugin), "arm", actuated=actuated)
    again = load_robot_from_urdf(build_urdf(Model.of(robot)).text, "again")
    assert list(again.actuated) == actuated and again.mimics == robot.mimics
    q, v, a = motion(robot, rng)
    want = Model.of(robot).mechanism.inverse_dynamics(q, v, a)
    assert_allclose(Model.of(again).mechanism.inverse_dynamics(q, v, a), want, atol=1e-9 * np.abs(want).max())


@pytest.mark.parametrize("rule", ["", MIMIC.replace("shoulder", "elbow")])
def test_joints_that_are_held_do_not_swing_in_other_programs(write, rule):
    """A joint of a tree without a motor is held still by us, so MJCF and SDF have one body of it and of what follows it."""
    import mujoco

    from tau_dyn.exchange import build_sdf

    hand = write.rod("hand_link", 1, 0.2) + write.joint(
        "wrist", "revolute", "lower_link", "hand_link", "0 1 0", "0.3 0 0"
    )
    text = write.two_link().replace("</robot>", f"{hand}</robot>")
    wrist = '<joint name="wrist" type="revolute">'
    robot = load_robot_from_urdf(text.replace(wrist, wrist + rule), "arm", actuated=["shoulder"], tool="hand_link")
    model = Model.of(robot)
    q, v, a = (np.array([[x]]) for x in (0.4, 0.7, -0.9))
    want = model.mechanism.inverse_dynamics(q, v, a)[0, 0]
    found = mujoco.MjModel.from_xml_string(build_mjcf(model).text)
    data = mujoco.MjData(found)
    assert [found.joint(k).name for k in range(found.njnt)] == ["shoulder"]
    data.qpos[:], data.qvel[:], data.qacc[:] = 0.4, 0.7, -0.9
    mujoco.mj_inverse(found, data)
    assert_allclose(data.qfrc_inverse[0], want, rtol=1e-9)
    kinds = {e.get("name"): e.get("type") for e in fromstring(build_sdf(model).text).iter("joint")}
    assert kinds == {"shoulder": "revolute"}
