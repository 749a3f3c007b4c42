"""A floating base is six coordinates without a motor in front of the joints, whatever the file says of the root."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.exchange import build_sdf
from tau_dyn.mechanism import build_mechanism
from tau_dyn.model import Model
from tau_dyn.robot import BASE_COORDINATES, load_robot

MJCF = """<mujoco><compiler angle="radian"/><worldbody><geom type="plane" size="1 1 1"/>
<body name="trunk" pos="0 0 0.5"><freejoint/><geom type="box" size="0.2 0.1 0.05" mass="4"/>
<body name="leg" pos="0.1 0 0"><joint name="hip" axis="0 1 0"/><geom type="sphere" size="0.03" pos="0 0 -0.2" mass="0.5"/>
<site name="foot" pos="0 0 -0.2"/></body></body></worldbody><actuator><motor joint="hip"/></actuator></mujoco>"""


def test_the_base_has_six_coordinates_before_the_joints(walker):
    """The trunk is a link with ten inertial numbers; nothing drives the base, so it has no rotor and no limit."""
    assert walker.actuated[:6] == walker.base_coordinates == BASE_COORDINATES
    assert walker.driven == walker.actuated[6:] and len(walker.driven) == 12
    assert walker.links[0].link == "trunk" and walker.links[0].nominal[0] == 6.0
    assert np.isinf(walker.lower[:6]).all() and np.isinf(walker.effort_limit[:6]).all()
    held = [walker.parameters[f"{name}.armature"] for name in BASE_COORDINATES]
    assert not any(p.free or p.value for p in held)


def test_round_feet_take_their_radius_from_the_file(walker, walker_file, walk):
    """A foot's sphere is the collision that the link shows; one that is given counts instead; a flat foot has none."""
    assert {(c.kind, c.radius) for c in walker.contacts} == {("point", walk.radius)}
    given = load_robot(walker_file, base="floating", contacts=["fl_foot=0.05", "fr_foot=flat"]).contacts
    assert [(c.kind, c.radius) for c in given] == [("point", 0.05), ("flat", 0.0)]


def test_a_free_joint_of_mjcf_and_a_floating_joint_of_urdf_are_that_base(tmp_path, write):
    """Both files say themselves which body floats; it takes its mass along, and stands still only where it is asked to."""
    (tmp_path / "free.xml").write_text(MJCF)
    free = load_robot(tmp_path / "free.xml", base="floating", contacts=["foot"])
    assert free.driven == ("hip",) and free.parameters["trunk.mass"].value == 4.0
    assert not free.warnings
    assert any("here it is fixed" in sentence for sentence in load_robot(tmp_path / "free.xml").warnings)
    arm = write.link("leg", 0.5, "0 0 -0.1", "1e-3 1e-3 1e-4") + write.joint("hip", "revolute", "trunk", "leg", "0 1 0")
    trunk = write.link("trunk", 4, "0 0 0", "0.02 0.06 0.07") + write.joint("root", "floating", "base_link", "trunk")
    (tmp_path / "free.urdf").write_text(write.text("free", trunk, arm, write.drive("hip")))
    assert load_robot(tmp_path / "free.urdf", base="floating").driven == ("hip",)


def test_what_floats_weighs_its_mass(walker):
    """At rest the force along z is the weight of all links, and those across are zero."""
    q = np.zeros((1, walker.na))
    tau = build_mechanism(walker).inverse_dynamics(q, q, q)[0]
    assert_allclose(tau[:3], [0, 0, 9.81 * 11.6], atol=1e-9)


def test_a_saved_model_keeps_base_and_feet(walker, tmp_path):
    """The model file holds the coordinates and the feet, and needs no robot file."""
    Model.of(walker).save(tmp_path / "walker.yaml")
    kept = Model.load(tmp_path / "walker.yaml").robot
    assert kept.base_coordinates == walker.base_coordinates and kept.contacts == walker.contacts


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"base": "free"}, "unknown_name"),
        ({"contacts": ["fl_foot"]}, "bad_option"),
        ({"base": "floating", "contacts": ["fl_foot=round"]}, "bad_option"),
        ({"base": "floating", "contacts": ["fl_paw"]}, "unknown_name"),
    ],
)
def test_bases_and_feet_that_cannot_be_are_refused(walker_file, options, code):
    """A base is fixed or floating, feet belong to a floating one, and are links of the robot."""
    with raises_code(code):
        load_robot(walker_file, **options)


def test_sdf_takes_no_floating_base(walker):
    """An SDF whose base is six joints would be another robot to every program."""
    with raises_code("unsupported", "fixed base"):
        build_sdf(Model.of(walker))
