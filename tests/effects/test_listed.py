"""Effects as files list them and as programs build them: what each says is kept, and what cannot be is one sentence."""

from __future__ import annotations

import pytest
from raising import raises_code

from tau_dyn.effects import EFFECTS, read_effects
from tau_dyn.exceptions import InputError
from tau_dyn.robot import Robot, load_robot_from_urdf


@pytest.fixture
def robot(write) -> Robot:
    """A slide that carries a hinge."""
    slide = write.link("slide_link", 5) + write.joint("slide", "prismatic", "base_link", "slide_link", "1 0 0")
    bar = write.rod("bar_link", 2, 0.4) + write.joint("bar", "revolute", "slide_link", "bar_link", "0 1 0")
    return load_robot_from_urdf(write.text("slide", slide, bar, write.drive("slide"), write.drive("bar")), "slide")


def test_what_is_left_out_is_every_joint_and_the_effects_own_settings(robot) -> None:
    """Units are those of the robot's joints; an empty entry is as good as none."""
    for row in ({"effect": "stribeck"}, {"effect": "stribeck", "settings": None, "label": None}):
        (one,) = read_effects([row], robot, "e.yaml")
        assert one.joints == ("slide", "bar") and one.units == {"slide": "N", "bar": "N m"}
        assert one.settings == {"speed": 0.02, "power": 1.0} and one.label == ""


def test_effects_come_in_the_order_of_the_list_with_what_each_says(robot) -> None:
    """Two of one kind on one joint are told apart by their labels."""
    rows = [
        {"effect": "stribeck", "joints": ["bar"], "settings": {"speed": 0.3}, "label": "_b"},
        {"effect": "torque_offset", "joints": ["bar", "slide"]},
        {"effect": "stribeck", "joints": ["bar"], "settings": {"power": 2}},
    ]
    found = read_effects(rows, robot, "e.yaml")
    assert [(x.name, x.joints, x.label) for x in found] == [
        ("stribeck", ("bar",), "_b"), ("torque_offset", ("bar", "slide"), ""), ("stribeck", ("bar",), ""),
    ]  # fmt: skip
    assert [found[k].settings for k in (0, 2)] == [{"speed": 0.3, "power": 1.0}, {"speed": 0.02, "power": 2.0}]
    assert found[1].units == {"bar": "N m", "slide": "N"} and found[0].parameters.names == ("bar.stribeck_b",)
    assert [x.to_dict() for x in read_effects([x.to_dict() for x in found], robot, "again")] == [
        x.to_dict() for x in found
    ]
    assert read_effects([], robot, "e.yaml") == ()


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ({"effect": "stribeck"}, "^e.yaml: 'effects' must be a list$"),
        (["stribeck"], "^e.yaml: an entry of 'effects' is written {effect: NAME}, with joints and settings, not 'stribeck'$"),
        ([{"joints": ["bar"]}], "no effect named 'None'"), ([{"effect": "magic"}], "no effect named 'magic'"),
        ([{"effect": "stribeck", "joints": "bar"}], "^e.yaml: 'joints' of effect stribeck must be a list of names, not 'bar'$"),
        ([{"effect": "stribeck", "joints": ["bar", "bra"]}], "no actuated joint named 'bra'.*there are slide, bar"),
        ([{"effect": "stribeck", "settings": [0.3]}],
         "^e.yaml: 'settings' of effect stribeck must be a mapping from names to numbers$"),
        ([{"effect": "stribeck", "settings": {"speed": "slow"}}],
         "^e.yaml: setting speed of effect stribeck must be a finite number, not 'slow'$"),
        ([{"effect": "stribeck", "settings": {"speed": True}}], "must be a finite number, not True$"),
        ([{"effect": "stribeck", "settings": {"speed": float("inf")}}], "must be a finite number, not inf$"),
        ([{"effect": "stribeck", "settings": {"speed": -1}}],
         "^e.yaml: setting speed of effect stribeck must be above zero, not -1$"),
        ([{"effect": "stribeck", "settings": {7: 1.0}}], "^e.yaml: effect stribeck has no setting '7'; it has speed, power$"),
        ([{"effect": "torque_offset", "settings": {"size": 1.0}}], "effect torque_offset has no setting 'size'; it has none$"),
        ([{"effect": "cyclic_ripple", "settings": {"harmonics": 0}}],
         "harmonics of effect cyclic_ripple must be a whole number from 1 up"),
        ([{"effect": "torque_offset"}, {"effect": "reducer_coupling", "joints": ["bar"]}],
         "^e.yaml: reducer_coupling joins two joints, not 1$"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_one_sentence_with_the_files_name(robot, rows: object, said: str) -> None:
    """Wherever in the list it stands."""
    with pytest.raises(InputError, match=said) as fault:
        read_effects(rows, robot, "e.yaml")
    assert "\n" not in str(fault.value)


def test_other_settings_leave_the_rest_as_it_was(robot) -> None:
    """Joints, units, label and the other settings stay; the first effect keeps its own."""
    first = EFFECTS["stribeck"](["bar", "slide"], ["N m", "N"], label="_b", speed=0.3, power=2)
    second = first.with_settings(speed=0.1)
    assert (second.joints, second.units, second.label) == (("bar", "slide"), {"bar": "N m", "slide": "N"}, "_b")
    assert second.settings == {"speed": 0.1, "power": 2.0} and first.settings["speed"] == 0.3
    assert second.to_dict() == {
        "effect": "stribeck", "joints": ["bar", "slide"], "settings": {"speed": 0.1, "power": 2.0}, "label": "_b",
    }  # fmt: skip
    assert EFFECTS["torque_offset"](["bar"], ["N m"]).to_dict() == {"effect": "torque_offset", "joints": ["bar"]}
    with pytest.raises(ValueError, match="zip"):
        EFFECTS["stribeck"](["bar", "slide"], ["N m"])
    with raises_code("unknown_name"):
        read_effects([{"effect": "stribeck", "joints": [3]}], robot, "e.yaml")
