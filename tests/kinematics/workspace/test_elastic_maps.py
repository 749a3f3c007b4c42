"""Maps of springs: against equilibria solved here, formulas of one spring, the robot file's own springs, unknown ones."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from raising import raises_code
from scipy.optimize import root

from tau_dyn.kinematics.workspace import Elasticity, Quality, build_elasticity, build_machine, compute_elastic_values
from tau_dyn.mechanism import FlexibleModel, state_springs
from tau_dyn.message_codes import get_code
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

G = 9.81
MASS, STIFF = 2.0, 5000.0
ARM_DRIVES = np.array([2e4, 1.5e4, 1e4, 6e3, 5e3, 4e3])
ARM_POSTURE = np.array([0.3, -1.0, 1.3, -0.4, 1.2, 0.2])


def elasticity_of(robot: Robot, **stated) -> Elasticity:
    return build_elasticity(build_machine(robot), **stated)


def differentiate_compliance(solve) -> np.ndarray:
    """Return the displacement per force (3, 3) of a tool whose place at equilibrium `solve(force)` returns."""
    h = 0.1  # [N] by central differences
    return np.column_stack([(solve(h * e) - solve(-h * e)) / (2 * h) for e in np.eye(3)])


def solve_equilibrium(balance, start: np.ndarray) -> np.ndarray:
    """Return the root of a balance of forces, by Newton to rounding."""
    found = root(balance, start, method="hybr", options={"xtol": 1e-15}).x
    for _ in range(3):
        h = 1e-6
        slope = np.column_stack(
            [(balance(found + h * e) - balance(found - h * e)) / (2 * h) for e in np.eye(len(found))]
        )
        found = found - np.linalg.solve(slope, balance(found))
    return found


def test_an_arms_compliance_is_that_of_its_loaded_joint_springs() -> None:
    """K s + g(q + s) = J' f solved for small forces gives the map's stiffness to 1e-6, and its sag."""
    robot = load_robot("ur5")
    drives = dict(zip(robot.actuated, ARM_DRIVES, strict=True))
    model, data, tool = robot.model, robot.model.createData(), robot.model.getFrameId(robot.tool)

    def place(s: np.ndarray) -> np.ndarray:
        pin.framesForwardKinematics(model, data, ARM_POSTURE + s)
        return data.oMf[tool].translation.copy()

    def solve(force: np.ndarray) -> np.ndarray:
        def balance(s: np.ndarray) -> np.ndarray:
            q = ARM_POSTURE + s
            J = pin.computeFrameJacobian(model, data, q, tool, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            return ARM_DRIVES * s + pin.computeGeneralizedGravity(model, data, q) - J[:3].T @ force

        return place(solve_equilibrium(balance, np.zeros(6)))

    C = differentiate_compliance(solve)
    found = elasticity_of(robot, actuators=drives).compute_maps(ARM_POSTURE[None])
    assert found["stiffness"][0] == pytest.approx(1 / np.linalg.eigvalsh((C + C.T) / 2)[-1], rel=1e-6)
    for k, axis in enumerate("xyz"):
        assert found[f"stiffness_{axis}"][0] == pytest.approx(1 / C[k, k], rel=1e-6)
    sag = np.linalg.norm(solve(np.zeros(3)) - place(np.zeros(6)))
    assert found["sag"][0] == pytest.approx(sag, rel=1e-8)


def test_the_l1s_compliance_is_that_of_its_loaded_rods_and_drives() -> None:
    """Plate and carts balance the pull of elastic rods and drives, rods' weight included: the map to 1e-6."""
    k_rod, k_drives = 2e6, np.array([3e6, 2e6, 4e6])
    robot = load_robot("gantry_tau")
    q = robot.home + np.array([0.1, -0.05, 0.08])
    origin = np.array([[0.04, 0, 1.44], [0.25, -1.31, 1.46], [0, 0, 0.0]])
    length, rod_mass, plate_mass = np.array([2.05, 1.82, 1.81]), np.array([0.8, 1.6, 2.4]), 9.13

    def energy_gradient(x: np.ndarray, force: np.ndarray) -> np.ndarray:
        tool, yielded = x[:3], x[3:]
        A = origin + np.outer(q + yielded, [1.0, 0, 0])
        D = tool - A  # the simplified rods meet in the plate's origin
        far = np.linalg.norm(D, axis=1)
        u = D / far[:, None]
        pull = k_rod * (far - length)
        # a rod's centre is half its length from the cart along u: height A_z + L/2 u_z, which turns with its direction
        turning = (np.array([0, 0, 1.0]) - u[:, 2:] * u) / far[:, None] * (rod_mass * G * length / 2)[:, None]
        on_tool = (pull[:, None] * u + turning).sum(axis=0) + [0, 0, plate_mass * G] - force
        on_drives = k_drives * yielded - pull * u[:, 0] - turning[:, 0]
        return np.concatenate([on_tool, on_drives])

    found = elasticity_of(robot, rod=k_rod, actuators=dict(zip(robot.actuated, k_drives, strict=True)))
    near = found.linearise(q)
    assert near is not None
    start = np.concatenate([near.unloaded_position, np.zeros(3)])

    def solve(force: np.ndarray) -> np.ndarray:
        return solve_equilibrium(lambda x: energy_gradient(x, force), start)[:3]

    C = differentiate_compliance(solve)
    values = found.compute_maps(q[None])
    assert values["stiffness"][0] == pytest.approx(1 / np.linalg.eigvalsh((C + C.T) / 2)[-1], rel=1e-6)
    for k, axis in enumerate("xyz"):
        assert values[f"stiffness_{axis}"][0] == pytest.approx(1 / C[k, k], rel=1e-6)
    assert values["sag"][0] == pytest.approx(np.linalg.norm(solve(np.zeros(3)) - near.unloaded_position), rel=1e-6)


def write_axis(write: SimpleNamespace, more: str = "") -> Robot:
    """A mass on an upright slide with a drive."""
    parts = [
        write.link("mass_link", MASS, "0 0 0", "0.01 0.01 0.01"),
        write.joint("lift", "prismatic", "base_link", "mass_link", "0 0 1"),
        '<link name="tool_link"/><joint name="tool" type="fixed"><parent link="mass_link"/><child link="tool_link"/></joint>',
        write.drive("lift"),
        more,
    ]
    return load_robot_from_urdf(write.text("axis", *parts), "axis")


def drive_spring(stderr: str = "") -> str:
    return f'<tau_dyn:drive_spring joint="lift" stiffness="{STIFF}" {stderr}/>'


def evaluate_axis(robot: Robot, load: np.ndarray | None = None, stderr: np.ndarray | None = None) -> dict[str, float]:
    return compute_elastic_values(FlexibleModel(robot).at([0.1], tool="tool"), load, stderr)


def test_a_mass_on_one_spring_sags_and_swings(write: SimpleNamespace) -> None:
    """Sag m g / k, under a load F / k, stiffness k, resonance sqrt(k / m) / 2 pi; across the slide it is rigid."""
    found = evaluate_axis(write_axis(write, drive_spring()), np.array([0, 0, -30.0]))
    assert found["sag"] == pytest.approx(MASS * G / STIFF, rel=1e-9)
    assert found["sag_load"] == pytest.approx(30 / STIFF, rel=1e-9)
    assert found["stiffness"] == pytest.approx(STIFF, rel=1e-9) and found["stiffness_z"] == pytest.approx(
        STIFF, rel=1e-9
    )
    assert np.isinf([found["stiffness_x"], found["stiffness_y"]]).all()
    assert found["resonance"] == pytest.approx(np.sqrt(STIFF / MASS) / (2 * np.pi), rel=1e-9)
    assert np.isnan(found["resonance_2"])


def test_a_held_drives_inertia_does_not_swing(write: SimpleNamespace) -> None:
    """Rotor inertia is on the drive's side of its spring: the resonance is that of the load alone; M has both."""
    rotor = write.drive("lift", '<drake:rotor_inertia value="3"/><drake:gear_ratio value="1"/>')
    text = write_axis(write, drive_spring()).urdf.replace(write.drive("lift"), rotor)
    robot = load_robot_from_urdf(text, "axis")
    near = FlexibleModel(robot).at([0.1], tool="tool")
    armature = robot.parameters["lift.armature"].value
    assert armature == pytest.approx(3.0)
    np.testing.assert_allclose(near.M, [[MASS + armature, MASS], [MASS, MASS]], rtol=1e-12)
    assert near.natural_frequencies()[0] == pytest.approx(np.sqrt(STIFF / MASS) / (2 * np.pi), rel=1e-9)


def test_standard_errors_are_those_of_the_spring(write: SimpleNamespace) -> None:
    """Dk = 100 N/m moves the sag by m g dk / k^2, the stiffness by dk, the resonance by f dk / 2 k."""
    robot = write_axis(write, drive_spring('stiffness_stderr="100"'))
    assert robot.drive_springs[0].stiffness_stderr == 100.0
    found = evaluate_axis(robot, np.array([0, 0, -30.0]), np.array([100.0]))
    assert found["stiffness_stderr"] == pytest.approx(100.0, rel=1e-9)
    assert found["sag_stderr"] == pytest.approx(MASS * G * 100 / STIFF**2, rel=1e-9)
    assert found["sag_load_stderr"] == pytest.approx(30 * 100 / STIFF**2, rel=1e-9)
    assert found["resonance_stderr"] == pytest.approx(found["resonance"] * 100 / (2 * STIFF), rel=1e-9)


def test_standard_errors_are_slopes_by_every_spring() -> None:
    """On an arm, differences over each spring's stiffness give the same standard errors to first order."""
    robot = load_robot("ur5")
    stderr = 0.01 * ARM_DRIVES

    def values(stiffness: np.ndarray, errors: np.ndarray | None = None) -> dict[str, float]:
        stated = state_springs(robot, drives=dict(zip(robot.actuated, stiffness, strict=True)))
        near = FlexibleModel(stated).at(ARM_POSTURE, tool=robot.tool)
        return compute_elastic_values(near, np.array([0, 0, -50.0]), errors)

    found = values(ARM_DRIVES, stderr)
    for name in ("stiffness", "stiffness_y", "sag", "sag_load", "resonance", "resonance_2"):
        slopes = []
        for k, e in enumerate(np.eye(6)):
            h = 1e-3 * ARM_DRIVES[k]
            slopes.append((values(ARM_DRIVES + h * e)[name] - values(ARM_DRIVES - h * e)[name]) / (2 * h))
        assert found[f"{name}_stderr"] == pytest.approx(np.linalg.norm(np.array(slopes) * stderr), rel=0.02)


def test_the_map_is_the_robot_files_own_springs() -> None:
    """The flexible L1 has one stiffness at home: the softest direction of the static compliance of its 27 springs."""
    robot = load_robot("gantry_tau", arms="complete", flexible="true")
    found = elasticity_of(robot)
    near = FlexibleModel(robot).at()
    values = found.compute_maps(robot.home[None])
    C = near.compliance()
    assert values["stiffness"][0] == pytest.approx(1 / np.linalg.eigvalsh((C + C.T) / 2)[-1], rel=1e-9)
    assert values["stiffness"][0] == pytest.approx(0.10378e6, rel=1e-3)
    np.testing.assert_allclose(values["resonance"][0], near.natural_frequencies()[0], rtol=1e-9)
    (warning,) = found.warnings()
    assert get_code(warning) == "drives_held" and "cart1, cart2, cart3" in warning
    softer = elasticity_of(robot, actuators={"": 1e6}).compute_maps(robot.home[None])
    assert softer["stiffness"][0] < values["stiffness"][0] and softer["resonance"][0] < values["resonance"][0]
    other = elasticity_of(robot, rod=1e6).compute_maps(robot.home[None])
    assert other["stiffness"][0] < values["stiffness"][0]  # rods as given, the other springs stay


@pytest.mark.parametrize(
    ("name", "stated", "missing"),
    [
        ("gantry_tau", {}, ("rod1", "rod2", "rod3", "cart1", "cart2", "cart3")),
        ("gantry_tau", {"actuators": {"": 1e6}}, ("rod1", "rod2", "rod3")),
        ("gantry_tau", {"rod": 1e6, "actuators": {"cart1": 1e6}}, ("cart2", "cart3")),
        ("linear_axis", {}, ("axis",)),
    ],
)
def test_unknown_springs_give_no_number(name: str, stated: dict, missing: tuple[str, ...]) -> None:
    """A spring that nobody states leaves all maps unknown; the warning names it."""
    machine = build_machine(load_robot(name))
    found = build_elasticity(machine, **stated)
    assert not found.known and found.not_stated == missing
    (warning,) = found.warnings()
    assert get_code(warning) == "stiffness_unknown" and ", ".join(missing) in warning
    values = found.compute_maps(machine.robot.home[None])
    assert values and all(np.isnan(value).all() for value in values.values())
    quality = Quality(machine, found)
    assert "stiffness" not in quality.available() and "resonance_2" in quality.expand(["resonance"])


def test_rods_alone_are_enough_where_drives_are_held() -> None:
    """Rods as stated, drives held: a number with a warning; drives stated as rigid: the same number without one."""
    robot = load_robot("gantry_tau")
    held, rigid = elasticity_of(robot, rod=1e7), elasticity_of(robot, rod=1e7, actuators={"": np.inf})
    assert held.not_stated == robot.actuated and rigid.warnings() == []
    one, other = (x.compute_maps(robot.home[None])["stiffness"][0] for x in (held, rigid))
    assert one == pytest.approx(other, rel=1e-12) and np.isfinite(one)


def test_springs_at_fault_are_refused(write: SimpleNamespace) -> None:
    """A drive's spring on a passive joint, two on one, a load below zero."""
    with raises_code("robot_structure", "two springs"):
        write_axis(write, drive_spring() * 2)
    with raises_code("robot_structure", "below zero"):
        write_axis(write, drive_spring('stiffness_stderr="-1"'))
    with raises_code("invalid_value", "load"):
        elasticity_of(load_robot("gantry_tau"), load=-1.0)
    with raises_code("unsupported", "no rods"):
        state_springs(load_robot("ur5"), rods=1e6)
