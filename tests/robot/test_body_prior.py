"""The one prior of bodies: stated errors come first, else an accurate file for a test and a rough one where logs are silent."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.parameters import Parameter
from tau_dyn.robot import (
    ACCURATE_FILE,
    ROUGH_FILE,
    BodyPrior,
    Robot,
    compute_body_radius,
    compute_nominal_stderr,
    find_placeholders,
    load_robot,
    load_robot_from_urdf,
)

ROD = """<robot name="rod"><link name="base_link"/><link name="rod_link"><inertial><origin xyz="0.3 0 0"/><mass value="2"/>
<inertia ixx="0" ixy="0" ixz="0" iyy="0.06" iyz="0" izz="0.06"/></inertial></link><joint name="turn" type="revolute">
<parent link="base_link"/><child link="rod_link"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
<transmission name="t"><type>transmission_interface/SimpleTransmission</type><joint name="turn"/>
<actuator name="m"/></transmission>
</robot>"""


def test_a_stated_error_counts_before_the_default() -> None:
    """A weighed mass has its own error, another one a share of itself, and friction has no trusted nominal value."""
    assert compute_nominal_stderr(Parameter("arm_link.mass", 9.0, "kg", prior_stderr=0.05)) == 0.05
    assert compute_nominal_stderr(Parameter("arm_link.mass", -9.0, "kg")) == pytest.approx(9.0 * ACCURATE_FILE)
    assert compute_nominal_stderr(Parameter("axis.coulomb_pos", 20.0, "N")) is None


def test_errors_are_shares_of_the_bodys_size() -> None:
    """A uniform rod of 0.6 m and 2 kg about its end has the radius 0.6 / sqrt(3); its inertia is off by a share of m r^2."""
    robot = load_robot_from_urdf(ROD, "rod")
    (link,) = robot.links
    radius = 0.6 / np.sqrt(3)
    assert_allclose(compute_body_radius(link, 2.0), radius, rtol=1e-12)
    prior = BodyPrior.of(robot)
    for share, known in ((1.0, prior.size), (ACCURATE_FILE, prior.accurate), (ROUGH_FILE, prior.rough)):
        assert_allclose(known["rod_link.mass"], share * 2.0, rtol=1e-12)
        assert_allclose(known["rod_link.my"], share * 2.0 * radius, rtol=1e-12)
        assert_allclose(known["rod_link.izz"], share * 2.0 * radius**2, rtol=1e-12)


def test_a_weighed_body_has_its_stated_error_in_both_answers() -> None:
    """2 +- 0.001 kg: the mass is known so in a test and where logs are silent; its centre is known no better for that."""
    robot = load_robot_from_urdf(ROD, "rod")
    plain = BodyPrior.of(robot)
    weighed = BodyPrior.of(robot, robot.parameters.update({"rod_link.mass": {"prior_stderr": 1e-3}}))
    assert weighed.accurate["rod_link.mass"] == weighed.rough["rod_link.mass"] == 1e-3
    for key in ("accurate", "rough"):
        assert getattr(weighed, key)["rod_link.mx"] == getattr(plain, key)["rod_link.mx"]


def test_a_body_known_worse_than_the_default_is_so_in_all_its_numbers() -> None:
    """A mass trusted to 40 % has a centre and an inertia that are trusted to 40 % of the body's size."""
    robot = load_robot_from_urdf(ROD, "rod")
    doubted = BodyPrior.of(robot, robot.parameters.update({"rod_link.mass": {"prior_stderr": 0.8}}))
    for name, size in doubted.size.items():
        assert_allclose([doubted.accurate[name], doubted.rough[name]], 0.4 * size, rtol=1e-12)


ROUND = '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>'
SLENDER = '<inertia ixx="0.001" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/>'


def build_chain(n: int, inertia: str, centre: float = 0.0) -> Robot:
    """Return a chain of equal links, the second of which is fixed to the first."""
    body = f'<inertial><origin xyz="{centre} 0 0"/><mass value="0.5"/>{inertia}</inertial>'
    parts = ['<link name="link0"/>']
    for k in range(1, n + 1):
        kind = "fixed" if k == 2 else "revolute"
        parts.append(
            f'<link name="link{k}">{body}</link><joint name="j{k}" type="{kind}"><parent link="link{k - 1}"/>'
            f'<child link="link{k}"/><origin xyz="0.3 0 0"/><axis xyz="0 0 1"/>'
            '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        )
    return load_robot_from_urdf(f'<robot name="chain">{"".join(parts)}</robot>', "chain")


def test_equal_spheres_are_placeholders() -> None:
    """No three parts of a robot are equal spheres on their joints; three equal rods or arms may be, and so may two balls."""
    robot = build_chain(4, ROUND)
    assert find_placeholders(robot.model) == {1, 2, 3}
    assert any("placeholders" in sentence for sentence in robot.warnings)
    prior = BodyPrior.of(robot)
    for name, size in prior.size.items():
        assert prior.rough[name] == size and prior.accurate[name] == pytest.approx(ACCURATE_FILE * size)
    for other in (build_chain(4, SLENDER), build_chain(4, ROUND, 0.1), build_chain(2, ROUND)):
        assert not find_placeholders(other.model)


def test_a_file_without_mass_tells_nothing() -> None:
    """No body has a size where nothing has mass."""
    start, stop = ROD.index("<inertial>"), ROD.index("</link><joint")
    prior = BodyPrior.of(load_robot_from_urdf(ROD[:start] + ROD[stop:], "bare"))
    assert prior.rough == prior.size == {}


def test_the_makers_totals_give_the_spread_of_a_rough_file() -> None:
    """The file of the UR5 is 20.99 kg, its data sheet 18.4 kg: independent errors of the links of 28 %, not of 2 %."""
    moving = [float(link.nominal[0]) for link in load_robot("ur5").links]
    masses = np.array([4.0, *moving])  # the base does not move
    assert_allclose(masses.sum(), 20.99, atol=0.01)
    share = (masses.sum() - 18.4) / 18.4 * masses.sum() / np.linalg.norm(masses)
    assert 0.8 * ROUGH_FILE < share < 1.25 * ROUGH_FILE and share > 10 * ACCURATE_FILE
