"""Springs in robot files: read, refused where they make no sense, and locked for every rigid purpose."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism import TreeMechanism
from tau_dyn.robot import Spring, load_robot, load_robot_from_urdf


def on_the_elbow(write: SimpleNamespace, note: str) -> str:
    """The two-link arm, driven at the shoulder only."""
    elbow_drive = write.drive("elbow")
    return write.two_link().replace(elbow_drive, note)


def test_a_spring_is_read_and_locked(write: SimpleNamespace) -> None:
    """The arm with a spring at its elbow is the rigid arm with a stiff elbow."""
    robot = load_robot_from_urdf(
        on_the_elbow(write, '<tau_dyn:spring joint="elbow" stiffness="50" damping="0.5"/>'), "arm"
    )
    assert robot.springs == (Spring("elbow", 50.0, 0.5),)
    assert robot.actuated == ("shoulder",) and robot.model.nv == 1 and robot.warnings == ()
    straight = 3 * 0.4**2 / 3 + 2 * (0.3**2 / 12 + 0.55**2)  # both rods about the shoulder
    assert TreeMechanism(robot).inertia(np.zeros((1, 1)))[0, 0, 0] == pytest.approx(straight)


def test_a_spring_can_be_left_free(write: SimpleNamespace) -> None:
    """Asked for as it is, the arm with a spring keeps both joints; one without springs has nothing to lock."""
    sprung = on_the_elbow(write, '<tau_dyn:spring joint="elbow" stiffness="50"/>')
    free = load_robot_from_urdf(sprung, "arm", actuated=["shoulder", "elbow"], lock_springs=False)
    assert free.actuated == ("shoulder", "elbow") and free.model.nv == 2
    assert free.springs == (Spring("elbow", 50.0, 0.0),)  # without a word on damping there is none
    assert load_robot_from_urdf(write.two_link(), "arm").model.nv == 2


@pytest.mark.parametrize(
    ("note", "complaint"),
    [
        ('<tau_dyn:spring joint="wrist" stiffness="50"/>', "names joint 'wrist'"),
        ('<tau_dyn:spring joint="elbow" stiffness="0"/>', "stiffness above"),
        ('<tau_dyn:spring joint="elbow" stiffness="5" damping="-1"/>', "damping from zero"),
        ('<tau_dyn:spring joint="elbow" stiffness="soft"/>', "finite number"),
        ('<tau_dyn:spring joint="elbow" stiffness="5"/>' * 2, "two springs"),
        ('<tau_dyn:spring joint="shoulder" stiffness="5"/>', "has a <transmission>"),
    ],
)
def test_springs_that_make_no_sense_are_refused(write: SimpleNamespace, note: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        load_robot_from_urdf(on_the_elbow(write, note), "arm")


def test_the_default_robot_has_neither_springs_nor_wrist() -> None:
    for arms in ("simplified", "complete"):
        robot = load_robot("gantry_tau", arms=arms)
        assert robot.springs == () and "tau_dyn:spring " not in robot.urdf
        assert "wrist4_link" not in robot.urdf and robot.parameters["plate_link.mass"].value == 9.13


def test_the_flexible_robot_is_the_rigid_one_when_locked() -> None:
    """Same names, same masses, same forces: springs matter only to those who ask for them."""
    rigid, flexible = (load_robot("gantry_tau", arms="complete", flexible=f) for f in ("false", "true"))
    assert flexible.parameters.names == rigid.parameters.names
    np.testing.assert_allclose(flexible.parameters.values, rigid.parameters.values, rtol=1e-12)
    assert len(flexible.springs) == 27  # 6 rods, 3 + 6 + 6 at the mounts, 2 a guideway
    sample = rigid.home[None] + 0.02, np.array([[0.3, -0.2, 0.1]]), np.array([[1.0, -1.0, 0.5]])
    forces = [TreeMechanism(robot).inverse_dynamics(*sample) for robot in (rigid, flexible)]
    np.testing.assert_allclose(forces[0], forces[1], rtol=1e-9)


def test_the_wrist_adds_what_gravity_felt() -> None:
    """Plate, wrist and half the rods weigh the 22.38 kg of section 6.2."""
    for arms in ("simplified", "complete"):
        robot = load_robot("gantry_tau", arms=arms, wrist="serial2")
        assert robot.parameters["plate_link.mass"].value + 2.4 == pytest.approx(22.38)
    assert load_robot("gantry_tau", prototype="d1", wrist="serial2").parameters["plate_link.mass"].value > 12


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"wrist": "serial3"}, "none or serial2"),
        ({"wrist": "serial2", "prototype": "l2"}, "l1 and d1"),
        ({"flexible": "maybe"}, "true or false"),
        ({"flexible": "true"}, "arms:=complete"),
        ({"flexible": "true", "arms": "complete", "prototype": "d1"}, "l1 only"),
        ({"flexible": "true", "arms": "complete", "rod_mass_model": "point"}, "uniform"),
    ],
)
def test_variants_without_known_springs_are_refused(arguments: dict[str, str], complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        load_robot("gantry_tau", **arguments)


def test_spring_arguments_scale_the_springs() -> None:
    """Rods, mounts and framework can be made stiffer, and all damping larger."""
    base = {s.joint: s for s in load_robot("gantry_tau", arms="complete", flexible="true").springs}
    other = load_robot(
        "gantry_tau", arms="complete", flexible="true", rod_stiffness="5e6", mount_scale="2", frame_scale="3",
        damping_scale="4",
    ).springs  # fmt: skip
    factors = {"mount": 2.0, "frame": 3.0}
    for spring in other:
        if spring.joint.startswith("rod"):
            assert spring.stiffness == 5e6
            continue
        factor = factors[spring.joint[:5]]
        assert spring.stiffness == pytest.approx(factor * base[spring.joint].stiffness)
        assert spring.damping == pytest.approx(4 * factor * base[spring.joint].damping)
