"""Flexible robots: matrices, sag, compliance and resonances against paper, virtual work and the rigid mechanism."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from raising import raises_code

from tau_dyn.mechanism import L1_DRIVES, FlexibleModel, Linearised, PositionDrives, TreeMechanism
from tau_dyn.robot import load_robot, load_robot_from_urdf

MASS, STIFF, DAMP = 2.0, 5000.0, 3.0
FRAMES = {"none": "tool", "serial2": "gauge_block_link"}


def spring(joint: str, stiffness: float = STIFF, damping: float = 0.0) -> str:
    return f'<tau_dyn:spring joint="{joint}" stiffness="{stiffness}" damping="{damping}"/>'


def chain(write: SimpleNamespace, *more: str, axis: str = "1 0 0", damping: float = DAMP) -> FlexibleModel:
    """A driven carriage, a spring, a mass, the same spring, the same mass with the tool."""
    ball = "0.01 0.01 0.01"
    parts = [
        write.link("cart_link", 1.0, "0 0 0", ball) + write.joint("cart", "prismatic", "base_link", "cart_link", axis),
        write.link("one_link", MASS, "0 0 0", ball) + write.joint("one", "prismatic", "cart_link", "one_link", axis),
        write.link("two_link", MASS, "0 0 0", ball) + write.joint("two", "prismatic", "one_link", "two_link", axis),
        '<link name="tool_link"/><joint name="tool" type="fixed"><parent link="two_link"/><child link="tool_link"/></joint>',
        write.drive("cart"),
        spring("one", damping=damping) + spring("two", damping=damping),
    ]
    return FlexibleModel(load_robot_from_urdf(write.text("chain", *parts, *more), "chain"))


@lru_cache(maxsize=8)
def l1(wrist: str, **more: str) -> FlexibleModel:
    return FlexibleModel(load_robot("gantry_tau", arms="complete", flexible="true", wrist=wrist, **more))


@lru_cache(maxsize=2)
def l1_at_home(wrist: str) -> Linearised:
    return l1(wrist).at(tool=FRAMES[wrist], pushed="tool")


def test_a_chain_of_two_masses_has_the_frequencies_of_the_golden_section(write: SimpleNamespace) -> None:
    """Two equal masses on two equal springs swing at sqrt(k/m) times (sqrt 5 -+ 1)/2."""
    expected = np.sqrt(STIFF / MASS) * (np.sqrt(5) + np.array([-1, 1])) / 2 / (2 * np.pi)
    np.testing.assert_allclose(chain(write).at([0.0]).natural_frequencies(), expected, rtol=1e-9)
    low, high = chain(write).at([0.0]).modes()
    ratios = 0.5 * DAMP / STIFF * 2 * np.pi * expected  # damping in proportion to stiffness
    assert [low.damping_ratio, high.damping_ratio] == pytest.approx(ratios, rel=1e-6)
    assert abs(low.tool[0]) > abs(low.springs[1])  # both springs stretch the same way


def test_a_pendulum_on_a_spring_is_stiffened_by_its_weight(write: SimpleNamespace) -> None:
    """A hanging point mass on a torsion spring: omega^2 = (k + m g l) / (m l^2)."""
    m, length, k = 2.0, 0.5, 3.0
    parts = (
        write.link("cart_link", 1.0, "0 0 0", "1e-2 1e-2 1e-2"),
        write.joint("cart", "prismatic", "base_link", "cart_link", "1 0 0"),
        write.link("rod_link", m, f"0 0 {-length}", "0 0 0"),
        write.joint("pivot", "revolute", "cart_link", "rod_link", "0 1 0"),
        write.drive("cart"),
    )
    near = FlexibleModel(load_robot_from_urdf(write.text("p", *parts, spring("pivot", k)), "p")).at(
        [0.0], tool="rod_link"
    )
    expected = np.sqrt((k + m * 9.81 * length) / (m * length**2)) / (2 * np.pi)
    assert near.natural_frequencies() == pytest.approx(expected, rel=1e-7)


def test_springs_sag_under_the_weight_they_carry(write: SimpleNamespace) -> None:
    """In a vertical chain the upper spring carries both masses, the lower one its own."""
    upright = chain(write, axis="0 0 1")
    near = upright.at([0.0])
    assert near.deflection == pytest.approx([-2 * MASS * 9.81 / STIFF, -MASS * 9.81 / STIFF], rel=1e-9)
    assert near.tool_position == pytest.approx([0, 0, -3 * MASS * 9.81 / STIFF], rel=1e-9)
    assert not upright.at([0.0], sag=False).deflection.any()


def test_the_mass_matrix_is_the_mechanisms(rng: np.random.Generator) -> None:
    """Kinetic energy by Pinocchio, the rigid robot's inertia, and the inverse dynamics at unit accelerations agree with M."""
    model = l1("serial2")
    near = model.at(sag=False)
    rigid = TreeMechanism(model.robot).inertia(near.q[None])[0]
    np.testing.assert_allclose(near.M[:3, :3], rigid, rtol=1e-9)
    order = [model.freed.actuated.index(j) for j in (*model.robot.actuated, *near.springs)]
    mechanism, z = model.mechanism, np.zeros(len(near.M))
    z[order] = np.concatenate([near.q, near.deflection])
    np.testing.assert_allclose(near.M, mechanism.inertia(z[None])[0][np.ix_(order, order)], rtol=1e-8, atol=1e-9)
    rates = rng.standard_normal(len(z))
    theirs = np.zeros(len(z))
    theirs[order] = rates
    state = mechanism.solver.state(z, theirs, 0 * z)
    energy = pin.computeKineticEnergy(mechanism.model, mechanism.model.createData(), state.q, state.v)
    assert 0.5 * rates @ near.M @ rates == pytest.approx(energy, rel=1e-9)


def test_compliance_is_how_far_a_weight_moves_the_tool() -> None:
    """Another 0.1 kg felt by gravity at the plate lets the tool sink by compliance times its weight."""
    places = [l1("none", gravity_mass=f"{x}").at().tool_position for x in (11.53, 11.63)]
    near = l1("none", gravity_mass="11.58").at()
    np.testing.assert_allclose(places[1] - places[0], near.compliance()[:, 2] * -0.1 * 9.81, rtol=1e-5)


def test_compliance_is_symmetric_positive_and_the_state_spaces_at_rest() -> None:
    """Virtual work: a collocated compliance is symmetric and positive; it is the response at zero frequency."""
    near = l1("none").at()
    C = near.compliance()
    np.testing.assert_allclose(C, C.T, atol=1e-6 * np.abs(C).max())
    assert np.linalg.eigvalsh(C)[0] > 0
    forces, tool = ["fx_tool", "fy_tool", "fz_tool"], ["x_tool", "y_tool", "z_tool"]
    at_rest = near.state_space().select(forces, tool).frequency_response(np.zeros(1))[0].real
    np.testing.assert_allclose(at_rest, C, rtol=1e-6, atol=1e-6 * np.abs(C).max())


@pytest.mark.parametrize(
    ("wrist", "resonances"), [("none", (14.0, 103.0)), ("serial2", (7.4, 11.45))], ids=["no wrist", "wrist"]
)
def test_the_same_springs_give_the_resonances_with_and_without_wrist(
    wrist: str, resonances: tuple[float, float]
) -> None:
    """Thesis 6.3: 14 and 103 Hz before the wrist was mounted, 7.4 Hz and 11.4 to 11.5 Hz (Table 6.4) after; all within 0.5 %."""
    found = l1_at_home(wrist).natural_frequencies()
    for frequency in resonances:
        assert np.abs(found / frequency - 1).min() < 5e-3
    assert found[0] == pytest.approx(resonances[0], rel=5e-3)


def test_y_answers_more_than_x_near_11_5_hz() -> None:
    """Thesis 7.2: the robot is stiffer along x than along y near its dominant resonance."""
    forces, tool = ["fx_tool", "fy_tool"], ["x_tool", "y_tool"]
    model = l1_at_home("serial2").state_space().select(forces, tool)
    response = np.abs(model.frequency_response(np.array([7.4, 11.45])))
    assert response[1, 1, 1] > response[1, 0, 1]  # pushed along y
    assert response[1, 1, 0] > response[1, 0, 0]  # pushed along x
    assert response[0, 0, 0] > response[1, 0, 0]  # along x, 7.4 Hz is the stronger
    assert response[1, 1, 1] > response[0, 1, 1]  # along y, 11.45 Hz
    carts = l1_at_home("serial2").state_space().select([f"q_cart{i}" for i in (1, 2, 3)], tool)
    moved = np.linalg.norm(carts.frequency_response(np.array([11.45]))[0], axis=1)
    assert moved[1] > moved[0]  # and when the carts shake it


def test_the_state_space_is_the_second_order_system(write: SimpleNamespace) -> None:
    """From motion and force to the tool, (M s^2 + D s + K)^-1 written out gives the same response."""
    near = chain(write).at([0.1])
    f = np.array([0.0, 1.0, 4.9, 12.83, 60.0])
    a = near.na
    for k, s in enumerate(2j * np.pi * f):
        stiff = near.M * s**2 + near.D * s + near.K
        inverse = np.linalg.inv(stiff[a:, a:])
        by_motion = near.tool[:, :a] - near.tool[:, a:] @ inverse @ stiff[a:, :a]
        by_force = near.tool[:, a:] @ inverse @ near.pushed[:, a:].T
        response = near.state_space().frequency_response(f)[k, a:]
        np.testing.assert_allclose(response, np.hstack([by_motion, by_force]), rtol=1e-9, atol=1e-12)


def test_drives_and_accelerometer_stand_in_series(write: SimpleNamespace) -> None:
    """Reference to acceleration is lag times structure times s^2 times a Butterworth low-pass."""
    near, f = chain(write).at([0.0]), np.array([0.7, 4.0, 30.0, 250.0])
    s, w = 2j * np.pi * f, 2 * np.pi * 200.0
    tool = near.state_space().select(["q_cart"], ["x_tool"]).frequency_response(f)[:, 0, 0]
    drives = PositionDrives((0.05,), 0.01)
    model = near.state_space(drives, acceleration=True, accelerometer_hz=200.0)
    got = model.select(["q_ref_cart"], ["q_cart", "x_tool", "ax_tool"]).frequency_response(f)[:, :, 0].T
    lag = np.exp(-0.01 * s) / (0.05 * s + 1)
    sensed = w**2 * s**2 / (s**2 + np.sqrt(2) * w * s + w**2)
    np.testing.assert_allclose(got, [lag, lag * tool, lag * tool * sensed], rtol=1e-9)


def test_slow_motion_carries_the_tool_as_if_rigid() -> None:
    """Well below the resonances the tool follows the rigid robot's Jacobian."""
    near = l1_at_home("none")
    rigid = TreeMechanism(l1("none").robot).tool_jacobian(near.q[None])[0]
    names = list(l1("none").robot.actuated)
    slow = near.state_space().select([f"q_{j}" for j in names], ["x_tool", "y_tool", "z_tool"])
    np.testing.assert_allclose(slow.frequency_response(np.array([0.1]))[0].real, rigid, atol=3e-3)
    driven = near.state_space(L1_DRIVES)
    assert np.all(driven.poles().real < 0)


def test_springs_that_mean_nothing_are_refused(write: SimpleNamespace) -> None:
    """No springs, no mass behind a spring, weight that tips over, other masses than the file's, a strange pose or frame."""
    with raises_code("unsupported", "<tau_dyn:spring>"):
        FlexibleModel(load_robot_from_urdf(write.block(), "block"))
    empty = write.link("end_link") + write.joint("end", "prismatic", "two_link", "end_link", "1 0 0")
    with raises_code("robot_structure"):
        chain(write, empty, spring("end")).at([0.0])
    parts = (
        write.link("cart_link", 1.0, "0 0 0", "1e-2 1e-2 1e-2"),
        write.joint("cart", "prismatic", "base_link", "cart_link", "1 0 0"),
        write.link("rod_link", 2.0, "0 0 0.5", "0 0 0"),
        write.joint("pivot", "revolute", "cart_link", "rod_link", "0 1 0"),
        write.drive("cart"),
    )
    soft = FlexibleModel(load_robot_from_urdf(write.text("p", *parts, spring("pivot", 3.0)), "p"))
    with raises_code("robot_structure"):
        soft.at([0.0], tool="rod_link")
    good = chain(write)
    with raises_code("unsupported"):
        FlexibleModel(good.robot.with_parameters(good.robot.parameters.with_values(2 * good.robot.parameters.values)))
    with raises_code("wrong_shape"):
        good.at([0.0, 1.0])
    with raises_code("unknown_name", "nowhere"):
        good.at([0.0], tool="nowhere")
    with raises_code("mismatch"):
        good.at([0.0]).state_space(L1_DRIVES)
    with raises_code("invalid_value", "bandwidth"):
        good.at([0.0]).state_space(acceleration=True, accelerometer_hz=0.0)
