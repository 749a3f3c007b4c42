"""The robot files: every variant expands, loads in four programs that agree, and closes its loops at home."""

from __future__ import annotations

import io
import itertools
import re
from functools import lru_cache
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring

import numpy as np
import pinocchio as pin
import pytest
import xacro

URDF = Path(__file__).parents[2] / "urdf"
DRAKE, OURS = "{http://drake.mit.edu}ball_constraint", "{urn:tau_dyn}"
VARIANTS = list(itertools.product(("l1", "l2", "d1", "t1"), ("simplified", "complete"), ("uniform", "point")))
GEOMETRIES = list(itertools.product(("l1", "l2", "d1", "t1"), ("simplified", "complete")))
L1 = {"origin": [(0.04, 0, 1.44), (0.25, -1.31, 1.46), (0, 0, 0)], "length": [2.05, 1.82, 1.81]}  # Table 5.7, tape


@lru_cache(maxsize=64)
def expand(file: str, **arguments: str) -> str:
    return xacro.process_file(str(URDF / f"{file}.urdf.xacro"), mappings=arguments).toprettyxml()


def gantry_tau(prototype: str, arms: str, rods: str = "uniform", **more: str) -> str:
    return expand("gantry_tau", prototype=prototype, arms=arms, rod_mass_model=rods, **more)


def build(urdf: str) -> pin.Model:
    return pin.buildModelFromXML(re.sub(r"<\?xml[^>]*\?>", "", urdf))


def home(root: Element, model: pin.Model) -> np.ndarray:
    q = pin.neutral(model)
    for note in root.findall(f"{OURS}home"):
        q[model.joints[model.getJointId(note.get("joint"))].idx_q] = float(note.get("value"))
    return q


def balls(root: Element) -> list[tuple[str, np.ndarray, str, np.ndarray]]:
    def part(ball: Element, name: str) -> Element:
        found = ball.find(f"{DRAKE}_{name}")
        assert found is not None
        return found

    def point(ball: Element, name: str) -> np.ndarray:
        return np.array([float(x) for x in part(ball, name).get("value", "").split()])

    return [(part(b, "body_A").get("name", ""), point(b, "p_AP"), part(b, "body_B").get("name", ""), point(b, "p_BQ"))
            for b in root.findall(DRAKE)]  # fmt: skip


def closure(urdf: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the loops' errors (n, 3) at home and their Jacobian (3n, nv)."""
    root, model = fromstring(urdf), build(urdf)
    data, errors, rows = model.createData(), [], []
    q = home(root, model)
    pin.forwardKinematics(model, data, q)
    for a, p_a, b, p_b in balls(root):
        ends = []
        for link, point in ((a, p_a), (b, p_b)):
            body = model.frames[model.getFrameId(link, pin.FrameType.BODY)]
            place = body.placement * pin.SE3(np.eye(3), point)
            frame = model.addFrame(pin.Frame(f"end{model.nframes}", body.parentJoint, 0, place, pin.FrameType.OP_FRAME))
            J = pin.computeFrameJacobian(model, model.createData(), q, frame, pin.LOCAL_WORLD_ALIGNED)
            ends.append(((data.oMi[body.parentJoint] * place).translation, J[:3]))
        errors.append(ends[0][0] - ends[1][0])
        rows.append(ends[0][1] - ends[1][1])
    return np.array(errors), np.vstack(rows)


@pytest.mark.parametrize(("prototype", "arms"), GEOMETRIES)
def test_loops_close_at_home_and_leave_three_freedoms(prototype: str, arms: str) -> None:
    errors, J = closure(gantry_tau(prototype, arms))
    loops, nv = (3, 12) if arms == "simplified" else (6, 21)
    assert errors.shape == (loops, 3)
    assert np.abs(errors).max() < 1e-9
    assert J.shape == (3 * loops, nv)
    assert np.linalg.matrix_rank(J) == 3 * loops
    carts = [build(gantry_tau(prototype, arms)).getJointId(f"cart{i}") - 1 for i in (1, 2, 3)]
    passive = np.delete(J, carts, axis=1)
    assert passive.shape[0] == passive.shape[1]  # the carts determine everything else
    assert np.linalg.cond(passive) < 100


@pytest.mark.parametrize(("prototype", "arms", "rods"), VARIANTS)
def test_pinocchio_has_the_names_and_masses(prototype: str, arms: str, rods: str) -> None:
    urdf = gantry_tau(prototype, arms, rods)
    root, model = fromstring(urdf), build(urdf)
    carrying = {link.get("name") for link in root.findall("link") if link.find("inertial") is not None}
    assert {note.get("name") for note in root.findall(f"{OURS}link")} == carrying
    names = ["1", "2", "3"] if arms == "simplified" else ["1", "2a", "2b", "3a", "3b", "3c"]
    assert carrying == {"plate_link", *(f"cart{i}_link" for i in "123"), *(f"rod{n}_link" for n in names)}
    assert [t.find("joint").get("name") for t in root.findall("transmission")] == ["cart1", "cart2", "cart3"]
    links, joints = ({e.get("name") for e in root.findall(tag)} for tag in ("link", "joint"))
    assert not links & joints and all(name.endswith("_link") for name in links)
    for n in names:
        rod = model.inertias[model.getJointId(f"rod{n}_pitch")]
        length = 2 * rod.lever[0]
        expected = 0.0 if rods == "point" else rod.mass * length**2 / 12
        assert np.abs(np.diag(rod.inertia) - [0, expected, expected]).max() < 2e-12
    assert model.existFrame("tool")


@pytest.mark.parametrize(("prototype", "arms", "rods"), VARIANTS)
def test_mujoco_agrees(prototype: str, arms: str, rods: str) -> None:
    mujoco = pytest.importorskip("mujoco")
    urdf = gantry_tau(prototype, arms, rods)
    model, other = build(urdf), mujoco.MjModel.from_xml_string(urdf)
    assert other.nv == model.nv
    assert other.body_mass.sum() == pytest.approx(sum(i.mass for i in model.inertias), abs=1e-7)
    for name in model.names[1:]:
        k = mujoco.mj_name2id(other, mujoco.mjtObj.mjOBJ_JOINT, name)
        i = model.joints[model.getJointId(name)].idx_q
        assert other.jnt_range[k] == pytest.approx([model.lowerPositionLimit[i], model.upperPositionLimit[i]])


@pytest.mark.parametrize(("prototype", "arms", "rods"), VARIANTS)
def test_drake_adds_the_constraints(prototype: str, arms: str, rods: str) -> None:
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    urdf = gantry_tau(prototype, arms, rods)
    root, model, plant = fromstring(urdf), build(urdf), MultibodyPlant(1e-3)
    Parser(plant).AddModelsFromString(urdf, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base_link"))
    plant.Finalize()
    assert plant.num_constraints() == len(balls(root)) == (3 if arms == "simplified" else 6)
    assert plant.num_velocities() == model.nv
    assert plant.num_actuators() == 3
    context = plant.CreateDefaultContext()
    for note in root.findall(f"{OURS}home"):
        plant.GetJointByName(note.get("joint")).set_translation(context, float(note.get("value")))
    for a, p_a, b, p_b in balls(root):
        ends = [plant.GetBodyByName(link).EvalPoseInWorld(context) @ point for link, point in ((a, p_a), (b, p_b))]
        assert ends[0] == pytest.approx(ends[1], abs=1e-9)
    for name in model.names[1:]:
        i, joint = model.joints[model.getJointId(name)].idx_q, plant.GetJointByName(name)
        assert joint.position_lower_limits()[0] == pytest.approx(model.lowerPositionLimit[i])
        assert joint.position_upper_limits()[0] == pytest.approx(model.upperPositionLimit[i])
    assert plant.CalcTotalMass(context) == pytest.approx(sum(i.mass for i in model.inertias))


def test_drake_holds_the_loops_while_the_plate_falls() -> None:
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.systems.analysis import Simulator

    urdf = gantry_tau("l1", "simplified")
    root, plant = fromstring(urdf), MultibodyPlant(1e-3)
    Parser(plant).AddModelsFromString(urdf, "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base_link"))
    plant.Finalize()
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    plant.get_actuation_input_port().FixValue(context, np.zeros(3))
    for note in root.findall(f"{OURS}home"):
        plant.GetJointByName(note.get("joint")).set_translation(context, float(note.get("value")))
    simulator.AdvanceTo(0.2)
    tool = plant.GetBodyByName("tool_link").EvalPoseInWorld(context).translation()
    assert tool[2] < 0.75 - 0.01  # it falls ...
    for a, p_a, b, p_b in balls(root):  # ... and the rods hold on to it
        ends = [plant.GetBodyByName(link).EvalPoseInWorld(context) @ point for link, point in ((a, p_a), (b, p_b))]
        assert ends[0] == pytest.approx(ends[1], abs=1e-3)


@pytest.mark.parametrize(("prototype", "arms"), GEOMETRIES)
def test_yourdfpy_agrees(prototype: str, arms: str) -> None:
    yourdfpy = pytest.importorskip("yourdfpy")
    urdf = gantry_tau(prototype, arms)
    model = build(urdf)
    other = yourdfpy.URDF.load(io.BytesIO(urdf.encode()), load_meshes=False, build_scene_graph=False).robot
    movable = {j.name: j for j in other.joints if j.type != "fixed"}
    assert set(movable) == set(model.names[1:])
    for name, joint in movable.items():
        i = model.joints[model.getJointId(name)].idx_q
        assert [joint.limit.lower, joint.limit.upper] == pytest.approx(
            [model.lowerPositionLimit[i], model.upperPositionLimit[i]]
        )
        assert joint.limit.velocity == pytest.approx(model.velocityLimit[i])
        assert joint.limit.effort == pytest.approx(model.effortLimit[i])
    masses = {link.name: link.inertial.mass for link in other.links if link.inertial is not None}
    for name, joint in movable.items():
        assert masses.get(joint.child, 0.0) == pytest.approx(model.inertias[model.getJointId(name)].mass)


def test_l1_is_table_5_7_with_rods_towards_x() -> None:
    urdf = gantry_tau("l1", "simplified")
    root, model = fromstring(urdf), build(urdf)
    data, q = model.createData(), home(root, model)
    pin.framesForwardKinematics(model, data, q)
    tool = data.oMf[model.getFrameId("tool")].translation
    for i in range(3):
        cart = data.oMi[model.getJointId(f"cart{i + 1}")].translation
        along = q[model.joints[model.getJointId(f"cart{i + 1}")].idx_q]
        assert cart - [along, 0, 0] == pytest.approx(L1["origin"][i])
        assert np.linalg.norm(tool - cart) == pytest.approx(L1["length"][i])
        assert tool[0] > cart[0]
    masses = {name: inertia.mass for name, inertia in zip(model.names, model.inertias, strict=True)}
    assert [masses[j] for j in ("cart1", "cart2", "cart3", "plate_z")] == [13.58, 13.64, 38.23, 9.13]
    assert [masses[f"rod{i}_pitch"] for i in (1, 2, 3)] == [0.8, 1.6, 2.4]


@pytest.mark.parametrize("prototype", ["l1", "l2", "t1"])
def test_complete_is_simplified_at_home(prototype: str) -> None:
    """The same carts hold the tool at the same home position."""
    notes = [{n.get("joint"): float(n.get("value")) for n in fromstring(gantry_tau(prototype, arms)).findall(f"{OURS}home")}
             for arms in ("simplified", "complete")]  # fmt: skip
    assert notes[0] == pytest.approx(notes[1], abs=1e-12)


@pytest.mark.parametrize("prototype", ["l1", "l2", "t1", "d1"])
def test_closed_form_is_declared_for_simplified_arms_only(prototype: str) -> None:
    """Three arms are named where the closed form holds, whatever the guideways' directions."""
    (mechanism,) = fromstring(gantry_tau(prototype, "simplified")).findall(f"{OURS}mechanism")
    assert len(mechanism.findall(f"{OURS}arm")) == 3
    assert not fromstring(gantry_tau(prototype, "complete")).findall(f"{OURS}mechanism")


@pytest.mark.parametrize("arms", ["simplified", "complete"])
def test_gravity_mass_adds_what_is_missing(arms: str) -> None:
    assert not fromstring(gantry_tau("l1", arms)).findall(f"{OURS}gravity_mass")
    (note,) = fromstring(gantry_tau("l1", arms, gravity_mass="22.38")).findall(f"{OURS}gravity_mass")
    assert note.get("link") == "plate_link"
    assert float(note.get("value")) == pytest.approx(22.38 - 9.13 - 2.4, abs=1e-9)


def test_tubes_have_a_radius_if_asked() -> None:
    model = build(gantry_tau("l1", "simplified", rod_radius="0.02"))
    rod = model.inertias[model.getJointId("rod1_pitch")]
    assert np.diag(rod.inertia) == pytest.approx([0.8 * 0.02**2, *2 * [0.8 * (2.05**2 / 12 + 0.02**2 / 2)]])


@pytest.mark.parametrize("bad", [{"prototype": "l7"}, {"arms": "both"}, {"rod_mass_model": "heavy"}])
def test_unknown_variants_are_refused(bad: dict[str, str]) -> None:
    with pytest.raises(xacro.XacroException, match=next(iter(bad.values()))):
        expand("gantry_tau", **bad)


@pytest.mark.parametrize("prototype", ["l1", "l2", "d1", "t1"])
def test_what_is_assumed_is_said(prototype: str) -> None:
    assert fromstring(gantry_tau(prototype, "simplified")).findall(f"{OURS}assumed")


def test_linear_axis() -> None:
    urdf = expand("linear_axis")
    root, model = fromstring(urdf), build(urdf)
    assert list(model.names) == ["universe", "axis"]
    assert model.inertias[1].mass == 95
    assert model.lowerPositionLimit[0] < -0.3 and model.upperPositionLimit[0] > 0.3
    assert model.velocityLimit[0] > 0.2 and model.effortLimit[0] > 351
    assert model.existFrame("tool") and len(root.findall("transmission")) == 1
    assert build(expand("linear_axis", mass="100")).inertias[1].mass == 100
    mujoco = pytest.importorskip("mujoco")
    assert mujoco.MjModel.from_xml_string(urdf).nv == 1
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(urdf, "urdf")
    assert plant.num_actuators() == 1
