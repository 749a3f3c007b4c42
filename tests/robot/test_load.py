"""What a robot file means: names, loops, actuated joints, home, parameters, drive inertia."""

from __future__ import annotations

import os

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.robot import load_robot, load_robot_from_urdf


def test_short_name_and_path_mean_the_same_robot() -> None:
    """The short name `linear_axis` is the file of that name in `urdf/`."""
    by_name = load_robot("linear_axis")
    from tau_dyn.robot import find_robot

    by_path = load_robot(find_robot("linear_axis"))
    assert by_name.urdf == by_path.urdf and by_name.sha256 == by_path.sha256
    assert by_name.actuated == ("axis",) and by_name.parameters.names == ("carriage_link.mass", "axis.armature")


def test_a_xacro_argument_reaches_the_robot() -> None:
    """The nominal mass of the linear axis is what the argument says, and the robot remembers it."""
    robot = load_robot("linear_axis", mass=71.5)
    assert robot.parameters["carriage_link.mass"].value == 71.5
    assert dict(robot.arguments) == {"mass": "71.5"}


def test_simplified_gantry_tau_has_seven_masses_and_three_drive_inertias() -> None:
    """Contract 2: three carts, three rods, the plate; drive inertia is fixed at its nominal zero."""
    robot = load_robot("gantry_tau")
    masses = {p.name: p.value for p in robot.parameters if p.free}
    expected = {"cart1_link.mass": 13.58, "cart2_link.mass": 13.64, "cart3_link.mass": 38.23, "plate_link.mass": 9.13}
    assert masses == pytest.approx({**expected, "rod1_link.mass": 0.8, "rod2_link.mass": 1.6, "rod3_link.mass": 2.4})
    assert [p.name for p in robot.parameters if not p.free] == [f"cart{i}.armature" for i in (1, 2, 3)]
    assert robot.position_units == ("m",) * 3 and robot.force_units == ("N",) * 3


def test_without_loops_and_transmissions_all_joints_are_actuated_and_it_says_so(write) -> None:
    """A plain URDF from elsewhere works at once, with a warning that names the joints."""
    urdf = write.two_link().replace(write.drive("shoulder"), "").replace(write.drive("elbow"), "")
    robot = load_robot_from_urdf(urdf, "plain.urdf")
    assert robot.actuated == ("shoulder", "elbow")
    assert len(robot.warnings) == 1 and "shoulder, elbow" in robot.warnings[0] and "transmission" in robot.warnings[0]


def test_actuated_overrides_transmissions_and_keeps_the_trees_order(write) -> None:
    """`--actuated` names the joints; vectors follow the tree, not the order of asking."""
    both = load_robot_from_urdf(write.two_link(), "arm", actuated=["elbow", "shoulder"])
    assert both.actuated == ("shoulder", "elbow")
    rocker = load_robot_from_urdf(write.four_bar(driven="crank"), "bars", actuated=["rocker"])
    assert rocker.actuated == ("rocker",) and not rocker.warnings


def test_home_is_what_the_file_says_else_the_middle_of_the_range(write) -> None:
    """Home starts the search for an assembly mode."""
    urdf = write.two_link().replace("</robot>", '<tau_dyn:home joint="elbow" value="0.7"/></robot>')
    urdf = urdf.replace('lower="-3" upper="3"', 'lower="-1" upper="2"')
    assert_allclose(load_robot_from_urdf(urdf, "arm").home, [0.5, 0.7])


def test_a_continuous_joint_has_no_range_and_home_at_zero(write) -> None:
    """Pinocchio stores it as a cosine and a sine; a user sees one angle without limits."""
    robot = load_robot_from_urdf(write.four_bar(kind="continuous"), "bars")
    assert robot.model.nq == robot.model.nv + 1
    assert robot.home == [0.0] and robot.lower == [-np.inf] and robot.upper == [np.inf]
    assert robot.joint_kinds == ("revolute",)


def test_limits_come_from_the_file_and_zero_means_none(block, write) -> None:
    """Speed and force limits in SI units; a file that writes 0 gives none."""
    assert_allclose([block.lower, block.upper, block.velocity_limit, block.effort_limit], [[-3], [3], [10], [100]])
    free = load_robot_from_urdf(write.block().replace('velocity="10" effort="100"', 'velocity="0" effort="0"'), "block")
    assert free.velocity_limit == [np.inf] and free.effort_limit == [np.inf]


def test_drive_inertia_is_the_rotors_times_the_gear_ratio_squared(write) -> None:
    """Seen from the joint a rotor turns faster by the gear ratio, so its energy grows with the square."""
    gear = '<drake:rotor_inertia value="1e-4"/><drake:gear_ratio value="50"/>'
    robot = load_robot_from_urdf(write.pendulum(2.0, 0.5, write.drive("pivot", gear)), "geared")
    armature = robot.parameters["pivot.armature"]
    assert armature.value == pytest.approx(0.25) and armature.unit == "kg m^2" and not armature.free


def test_a_point_mass_hangs_where_the_file_puts_it(pendulum) -> None:
    """Ten numbers about the joint's origin: 2 kg at -0.5 m along z, inertia m l^2 across."""
    values = {p.name.split(".")[1]: p.value for p in pendulum.parameters}
    assert_allclose([values[k] for k in ("mass", "mx", "my", "mz")], [2, 0, 0, -1], atol=1e-15)
    assert_allclose([values[k] for k in ("ixx", "iyy", "izz", "ixy")], [0.5, 0.5, 0, 0], atol=1e-15)


def test_parameters_tied_to_the_mass_scale_the_whole_link(write) -> None:
    """With parameters="mass", twice the mass is twice every one of the ten numbers."""
    note = '<tau_dyn:link name="upper_link" parameters="mass"/></robot>'
    robot = load_robot_from_urdf(write.two_link().replace("</robot>", note), "arm")
    assert [n for n in robot.parameters.names if n.startswith("upper_link")] == ["upper_link.mass"]
    model = robot.model_with(robot.parameters.with_values({"upper_link.mass": 6.0}))
    assert_allclose(model.inertias[1].toDynamicParameters(), 2 * robot.model.inertias[1].toDynamicParameters())


def test_untied_numbers_become_parameters_and_keep_their_values(write) -> None:
    """Untying the centre of a link adds one parameter and moves nothing."""
    robot = load_robot("gantry_tau")
    free = robot.untied(["rod1_link.mx", "rod1_link.mass"])
    assert set(free.parameters.names) - set(robot.parameters.names) == {"rod1_link.mx"}
    assert free.parameters["rod1_link.mx"].value == pytest.approx(0.8 * 2.05 / 2)
    for before, after in zip(robot.model.inertias, free.model_with(free.parameters).inertias, strict=True):
        assert_allclose(after.toDynamicParameters(), before.toDynamicParameters(), atol=1e-14)
    heavier = free.model_with(free.parameters.with_values({"rod1_link.mass": 1.6}))
    rod = next(li for li in free.links if li.link == "rod1_link")
    assert heavier.inertias[rod.joint_id].toDynamicParameters()[1] == pytest.approx(0.8 * 2.05 / 2)


def test_a_file_without_any_mass_starts_from_zero_and_says_so(write) -> None:
    """Calibrated kinematics often come without inertia; identification then has no nominal values."""
    urdf = write.text(
        "bare", write.link("a_link"), write.joint("a", "revolute", "base_link", "a_link"), write.drive("a")
    )
    robot = load_robot_from_urdf(urdf, "bare")
    assert robot.parameters.names[:2] == ("a_link.mass", "a_link.mx") and not robot.parameters.values.any()
    assert any("no mass" in w for w in robot.warnings)


def test_gravity_mass_is_felt_by_gravity_only(rng) -> None:
    """The thesis' 22.38 kg: forces at rest grow in proportion, the mass matrix does not change at all."""
    from tau_dyn.mechanism import build_mechanism

    light, heavy = (
        build_mechanism(load_robot("gantry_tau")),
        build_mechanism(load_robot("gantry_tau", gravity_mass=22.38)),
    )
    q = light.robot.home + rng.uniform(-0.1, 0.1, (5, 3))
    zero = np.zeros_like(q)
    extra = heavy.robot.parameters["plate_link.gravity_mass"].value
    assert extra == pytest.approx(22.38 - 9.13 - (0.8 + 1.6 + 2.4) / 2)
    ratio = heavy.inverse_dynamics(q, zero, zero) / light.inverse_dynamics(q, zero, zero)
    assert_allclose(ratio, 22.38 / (9.13 + 2.4), rtol=1e-12)
    v = rng.standard_normal(3)
    assert_allclose(heavy.mass_and_bias(q[0], v)[0], light.mass_and_bias(q[0], v)[0], atol=1e-12)


def test_reading_a_robot_leaves_standard_error_where_it_was(write) -> None:
    """What Pinocchio's parser says is collected; afterwards a program's own words go where they went before."""
    before = os.fstat(2)
    opened = len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0
    for urdf in (write.pendulum(), "<robot/>"):
        try:
            load_robot_from_urdf(urdf, "some")
        except InputError:
            continue
    after = os.fstat(2)
    assert (after.st_dev, after.st_ino) == (before.st_dev, before.st_ino)
    assert not opened or len(os.listdir("/proc/self/fd")) == opened


def test_a_link_with_its_mass_alone_is_a_line_of_ten_numbers(write) -> None:
    """A uniform rod of m: `pi = m (1, l/2, 0, 0, ...)`, so the map from its mass is that line, and untied numbers leave it."""
    text = write.text(
        "rod", write.rod("rod_link", 3.0, 0.4), write.joint("j", "revolute", "base_link", "rod_link"), write.drive("j"),
        '<tau_dyn:link name="rod_link" parameters="mass"/>',
    )  # fmt: skip
    (link,) = load_robot_from_urdf(text, "rod").links
    across = 0.4**2 / 3
    assert_allclose(link.map, np.array([[1, 0.2, 0, 0, 1e-4 / 3, 0, across, 0, 0, across]]).T, rtol=1e-12)
    (untied,) = load_robot_from_urdf(text, "rod").untied(["rod_link.mx"]).links
    assert_allclose(untied.map[:, 0], [1, 0, 0, 0, 1e-4 / 3, 0, across, 0, 0, across], rtol=1e-12)
    assert_allclose(untied.map[:, 1], np.eye(10)[1])


def test_parameters_have_units_and_bounds(two_link) -> None:
    """Masses in kg and moments about an axis are not negative; first moments in kg m and products in kg m^2 may be."""
    for p in two_link.parameters:
        quantity = p.name.rsplit(".", 1)[-1]
        unit = "kg" if quantity == "mass" else "kg m" if quantity in ("mx", "my", "mz") else "kg m^2"
        lower = 0.0 if quantity in ("mass", "ixx", "iyy", "izz", "armature") else -np.inf
        assert (p.unit, p.lower, p.upper) == (unit, lower, np.inf)
    with raises_code("unknown_name", "elbow_link.mx", "lower_link.mx"):
        two_link.untied(["elbow_link.mx"])


def test_the_arguments_of_a_file_are_kept(pendulum) -> None:
    """As text, and none where none were given."""
    assert dict(load_robot("gantry_tau", prototype="l2").arguments) == {"prototype": "l2"}
    assert dict(load_robot("gantry_tau").arguments) == dict(pendulum.arguments) == {}
    assert load_robot("gantry_tau").tool_frame is not None


def test_the_tool_frame_is_named_or_evident(write) -> None:
    """A lone leaf is the tool; of two leaves the usual name counts; two strange ones leave it open; a name decides."""
    chain = (write.rod("rod_link", 3.0, 0.4), write.joint("j", "revolute", "base_link", "rod_link"), write.drive("j"))
    lone = load_robot_from_urdf(write.text("rod", *chain), "rod")
    assert lone.tool == "rod_link" and lone.model.frames[lone.tool_frame].name == "rod_link"
    ends = [
        f'<link name="{n}"/>{write.joint(f"to_{n}", "fixed", "rod_link", n)}'
        for n in ("camera_link", "tool0", "x_link")
    ]
    assert load_robot_from_urdf(write.text("rod", *chain, *ends), "rod").tool == "tool0"
    open_ended = write.text("rod", *chain, ends[0], ends[2])
    assert load_robot_from_urdf(open_ended, "rod").tool_frame is None
    assert load_robot_from_urdf(open_ended, "rod", tool="camera_link").tool == "camera_link"
    with raises_code("unknown_name", "camra_link"):
        load_robot_from_urdf(open_ended, "rod", tool="camra_link")


def test_a_model_file_keeps_the_tool_frame(write, tmp_path) -> None:
    """The frame that was named at the command line is the tool of the model read back."""
    from tau_dyn.model import Model

    ends = [f'<link name="{n}"/>{write.joint(f"to_{n}", "fixed", "rod_link", n)}' for n in ("camera_link", "x_link")]
    text = write.text("rod", write.rod("rod_link", 3.0, 0.4), write.joint("j", "revolute", "base_link", "rod_link"),
                      write.drive("j"), *ends)  # fmt: skip
    Model.of(load_robot_from_urdf(text, "rod", tool="camera_link"), []).save(tmp_path / "model.yaml")
    assert Model.load(tmp_path / "model.yaml").robot.tool == "camera_link"


def test_a_stock_arm_is_known_by_its_name() -> None:
    """`ur5` is the file of `example-robot-data`, where that is installed; its tool frame is evident."""
    from tau_dyn.robot import list_robots, list_stock_robots

    if "ur5" not in list_stock_robots():
        pytest.skip("example-robot-data is not installed")
    assert load_robot("ur5").tool == "tool0" and load_robot("ur5").na == 6
    assert list(list_robots())[0] == "delta"  # those that come along stand first
