"""Which drives place a robot with more drives than freedoms."""

import newcomers
import redundant
from numpy.testing import assert_allclose

from tau_dyn.message_codes import get_code
from tau_dyn.robot import Robot, load_robot_from_urdf


def load(text: str, **options) -> Robot:
    """Return the robot of a URDF text."""
    return load_robot_from_urdf(text, "robot.urdf", **options)


def test_one_of_three_arms_follows_the_other_two() -> None:
    """A point in a plane has two freedoms: two motors place it, and the first named ones that do are the actuated joints."""
    arms = load(redundant.write_three_arms())
    assert arms.na == 2 and len(arms.redundant_joints) == 1
    assert {*arms.actuated, *arms.redundant_joints} == set(redundant.ARMS)
    assert [get_code(w) for w in arms.warnings] == ["redundant_drives"]
    first = load(redundant.write_three_arms(), actuated=["shoulder3", "shoulder2", "shoulder1"])
    assert first.actuated == ("shoulder2", "shoulder3") and first.redundant_joints == ("shoulder1",)


def test_a_cart_with_two_motors_has_one_freedom() -> None:
    """Both rails lead the cart along x: one position, and no passive joint at all."""
    cart = load(redundant.write_cart())
    assert cart.actuated == ("rail1",) and cart.redundant_joints == ("rail2",) and cart.redundant_units == ("N",)


def test_as_many_drives_as_freedoms_stay_as_they_are() -> None:
    """Two motors of a five-bar place its tip: nothing is redundant, and no warning says so."""
    bar = newcomers.five_bar()
    assert bar.actuated == ("motor1", "motor2") and bar.redundant_joints == ()
    assert "redundant_drives" not in [get_code(w) for w in bar.warnings]


def test_a_dead_centre_is_no_lack_of_freedom() -> None:
    """Crank and coupler in line hold the slider to first order; next to it the slider moves, and remains the drive."""
    slider = load(redundant.write_dead_centre())
    assert set(slider.actuated) == {"slide", "lift"} and slider.redundant_joints == ()


def test_what_the_file_says_of_a_redundant_drive_is_kept() -> None:
    """A rotor's inertia seen through its gear is that of the second motor, 4e-4 kg m^2 times 50 squared per metre."""
    rotor = '<drake:rotor_inertia value="4e-4"/><drake:gear_ratio value="50"/></actuator>'
    text = redundant.write_cart().replace('<actuator name="rail2_m"/>', f'<actuator name="rail2_m">{rotor}')
    (armature,) = load(text).redundant
    assert armature.name == "rail2.armature" and armature.unit == "kg"
    assert_allclose(armature.value, 1.0)
