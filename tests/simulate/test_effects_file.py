"""Effects files: short names, full names, and every fault in one sentence."""

import pytest
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.simulate import read_effects_file


@pytest.fixture
def read(gantry, tmp_path):
    """Return a function that reads YAML text as an effects file for the gantry."""

    def of(text):
        (tmp_path / "e.yaml").write_text(text)
        return read_effects_file(tmp_path / "e.yaml", gantry.robot)

    return of


def test_short_and_full_names_reach_their_parameters(read):
    """A quantity means all joints of its effect; a full name one of them; the robot's own values can be set too."""
    model = read(
        "effects:\n"
        "- {effect: asymmetric_friction, joints: [cart1, cart3], parameters: {coulomb_pos: 189.1, cart3.viscous_neg: 7}}\n"
        "- {effect: torque_offset, parameters: {offset: -2}}\n"
        "parameters: {plate_link.mass: 10.2, cart2.offset: 4}\n"
    )
    values = {p.name: p.value for p in model.parameters}
    assert values["cart1.coulomb_pos"] == values["cart3.coulomb_pos"] == 189.1
    assert values["cart1.viscous_neg"] == 0.0 and values["cart3.viscous_neg"] == 7.0
    assert (values["cart1.offset"], values["cart2.offset"]) == (-2.0, 4.0)
    assert values["plate_link.mass"] == 10.2 and values["cart1_link.mass"] == 13.58


def test_parameters_alone_are_a_rigid_robot(read):
    """No effects, one changed mass."""
    model = read("parameters: {cart1_link.mass: 20}")
    assert model.effects == () and model.mechanism.m_cart[0] == 20.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[1, 2]", "an effects file holds"),
        ("effect: [1]", "an effects file holds"),
        ("effects: {a: 1}", "'effects' must be a list"),
        ("effects: [{effect: magic}]", "no effect named 'magic'; there are symmetric_friction"),
        ("effects: [{effect: torque_offset, joints: cart1}]", "must be a list"),
        ("effects: [{effect: torque_offset, joints: [cart9]}]", "no actuated joint named 'cart9'"),
        ("effects: [{effect: torque_offset, values: {}}]", "not 'values'"),
        ("effects: [{effect: torque_offset, parameters: {coulomb: 1}}]", "no parameter named 'coulomb'"),
        ("effects: [{effect: torque_offset, parameters: [1]}]", "mapping from names to numbers"),
        ("effects: [{effect: torque_offset, parameters: {offset: yes}}]", "must be a finite number in N, not True"),
        ("effects: [{effect: symmetric_friction, parameters: {coulomb: -3}}]", "is not between 0 and inf"),
        ("effects: [{effect: symmetric_friction, parameters: {coulomb: .nan}}]", "must be a finite number"),
        (f"effects: [{{effect: stribeck, settings: {{speed: {'9' * 350}}}}}]", "must be a finite number, not inf"),
        (f"parameters: {{plate_link.mass: {'9' * 350}}}", "must be a finite number in kg, not inf"),
        ("parameters: {plate_link.weight: 1}", "no parameter named 'plate_link.weight'"),
        ("effects: [", "not valid YAML"),
    ],
)
def test_each_fault_is_one_sentence(read, text, words):
    """Named with the file, on one line."""
    with pytest.raises(InputError, match="e.yaml") as fault:
        read(text)
    assert words in str(fault.value) and "\n" not in str(fault.value)


def test_missing_file_is_said(gantry, tmp_path):
    """No traceback for a wrong path."""
    with raises_code("file_not_found"):
        read_effects_file(tmp_path / "none.yaml", gantry.robot)
