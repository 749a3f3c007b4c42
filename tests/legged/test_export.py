"""An exported walker is the same robot with a free base: MuJoCo moves it by the same forces, and its URDF is read again."""

from __future__ import annotations

from io import BytesIO
from xml.etree.ElementTree import fromstring

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from tau_dyn.cli import main
from tau_dyn.effects import build_friction_model
from tau_dyn.exchange import build_mjcf, build_randomisation, build_urdf
from tau_dyn.mechanism import build_mechanism
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

FEET = [f"{leg}_foot" for leg in ("fl", "fr", "hl", "hr")]


@pytest.fixture
def model(walker) -> Model:
    """Return an identified walker: another mass of its trunk, a rotor and friction in every joint."""
    found = Model.of(walker, build_friction_model("symmetric", walker.driven, walker.driven_units))
    values = {f"{joint}.coulomb": 0.2 for joint in walker.driven} | {
        f"{joint}.armature": 0.01 for joint in walker.driven
    }
    return found.with_values({**values, "trunk.mass": 6.6})


def test_mujoco_moves_it_by_the_same_forces(model, rng):
    """Inverse dynamics of 18 coordinates at random states; the free joint's are linear in the world, angular in the base."""
    plain = model.with_values({p.name: 0.0 for p in model.effect_parameters})
    plant = mujoco.MjModel.from_xml_string(build_mjcf(plain).text)
    data, mechanism = mujoco.MjData(plant), build_mechanism(plain.robot)
    assert (plant.nq, plant.nv, plant.nu) == (19, 18, 12)
    for _ in range(5):
        q = np.concatenate([rng.uniform(1, 2, 3), rng.uniform(-0.5, 0.5, 3), np.tile([0, 0.6, -1.2], 4)])
        v, a = rng.standard_normal((2, 18))
        W, change = turn_rates(q[3:6], v[3:6])
        x, y, z, w = Rotation.from_euler("ZYX", q[3:6]).as_quat()
        data.qpos[:] = np.concatenate([q[:3], [w, x, y, z], q[6:]])
        data.qvel[:] = np.concatenate([v[:3], W @ v[3:6], v[6:]])
        data.qacc[:] = np.concatenate([a[:3], W @ a[3:6] + change @ v[3:6], a[6:]])
        mujoco.mj_inverse(plant, data)
        found = np.concatenate([data.qfrc_inverse[:3], W.T @ data.qfrc_inverse[3:6], data.qfrc_inverse[6:]])
        assert_allclose(found, mechanism.inverse_dynamics(q[None], v[None], a[None])[0], atol=1e-6)


def turn_rates(angles: np.ndarray, rates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return angular velocity in the base per rate of yaw, pitch and roll (3, 3), and its derivative in time by differences."""

    def at(x: np.ndarray) -> np.ndarray:
        (_, p, r) = x
        sp, cp, sr, cr = np.sin(p), np.cos(p), np.sin(r), np.cos(r)
        return np.array([[-sp, 0, 1], [sr * cp, cr, 0], [cr * cp, -sr, 0]])

    return at(angles), (at(angles + 1e-6 * rates) - at(angles - 1e-6 * rates)) / 2e-6


def test_it_stands_on_its_feet_in_mujoco(model):
    """Home puts the lowest foot on the ground, and each foot is a ball of its radius."""
    text = build_mjcf(model).text.replace("</worldbody>", '<geom type="plane" size="2 2 1"/></worldbody>')
    plant = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(plant)
    mujoco.mj_resetDataKeyframe(plant, data, 0)
    mujoco.mj_kinematics(plant, data)
    balls = [plant.geom(foot) for foot in FEET]
    assert {float(ball.size[0]) for ball in balls} == {0.02}
    assert_allclose(min(float(data.geom_xpos[ball.id][2]) for ball in balls), 0.02, atol=1e-9)
    assert_allclose(float(plant.body("trunk").mass[0]), 6.6)
    assert_allclose(plant.dof_frictionloss, [0] * 6 + [0.2] * 12)
    assert_allclose(plant.dof_armature, [0] * 6 + [0.01] * 12)


def test_its_urdf_is_read_again(model, tmp_path):
    """Its root is the trunk, as in the file that it came from; all inertial numbers and rotors come back."""
    text = build_urdf(model).text
    root = fromstring(text)
    assert "trunk" not in {e.get("link") for e in root.iter("child")}
    assert not [e.get("name") for e in root.iter() if (e.get("name") or "").startswith("base_")]
    (tmp_path / "again.urdf").write_text(text)
    again = load_robot(tmp_path / "again.urdf", base="floating", contacts=FEET)
    assert again.driven == model.robot.driven
    assert_allclose(again.parameters.values, model.robot.parameters.values, atol=1e-9)


def test_samples_of_its_posterior_name_its_joints(model):
    """A trainer's table has the joints of the file, not the base's coordinates."""
    samples = np.tile(model.parameters.values, (3, 1))
    made = build_randomisation(model, samples, "playground", "walker.npz")
    table = np.load(BytesIO(made.table))
    assert tuple(table["joints"]) == model.robot.driven and table["armature"].shape == (3, 12)


def test_the_command_exports_a_walker(model, tmp_path):
    """`export` reads the base from the model file."""
    model.save(tmp_path / "walker.yaml")
    assert (
        main(["export", str(tmp_path / "walker.yaml"), "--to", "mjcf", "--out", str(tmp_path / "w.xml"), "--quiet"])
        == 0
    )
    assert "<freejoint" in (tmp_path / "w.xml").read_text()
