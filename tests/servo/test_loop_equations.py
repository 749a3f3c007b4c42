"""One joint and its servo against equations of motion that are solved otherwise: by SciPy, in closed form, or at rest."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from tests.servo.arms import build_commands, build_link

from tau_dyn.effects import build_friction_model
from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.robot import load_robot_from_urdf
from tau_dyn.servo import simulate_loop_log
from tau_dyn.servo.fit import count_worth
from tau_dyn.servo.loads import InertialSpace, compute_load_waves
from tau_dyn.servo.preparation import delay_command
from tau_dyn.servo.result import LoopParameter
from tau_dyn.servo.simulation import read_values
from tau_dyn.simulate import ServoLaw, Trajectory, build_servo_law

RATE_HZ = 500.0
INERTIA, MASS, ARM, GRAVITY = 0.05, 2.0, 0.1, 9.81


def build_joint(axis: str = "0 0 1"):
    """Return a link of 0.05 kg m^2 about its axis, with a mass of 2 kg at 0.1 m; about z gravity does not feel it."""
    rest = INERTIA - MASS * ARM**2
    return load_robot_from_urdf(
        '<robot name="joint"><link name="base_link"/><link name="arm_link"><inertial>'
        f'<origin xyz="{ARM} 0 0"/><mass value="{MASS}"/>'
        f'<inertia ixx="{rest}" iyy="{rest}" izz="{rest}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="turn" type="revolute"><parent link="base_link"/><child link="arm_link"/>'
        f'<axis xyz="{axis}"/><limit lower="-30" upper="30" effort="100" velocity="100"/></joint>'
        '<transmission name="t"><joint name="turn"/></transmission></robot>',
        "joint.urdf",
    )


def build_model(robot, **values: float) -> Model:
    """Return the joint with symmetric friction."""
    model = Model.of(robot, build_friction_model("symmetric", robot.actuated, robot.force_units))
    return model.with_values({f"turn.{key}": value for key, value in values.items()})


def run(command: np.ndarray, axis: str = "0 0 1", friction: dict[str, float] | None = None, **entries: float):
    """Return positions (N,) that a servo gives commands (N,), one every 2 ms, from rest at the first."""
    robot = build_joint(axis)
    q = np.asarray(command, float)[:, None]
    motion = Trajectory(robot.actuated, np.arange(len(q)) / RATE_HZ, q, np.zeros_like(q), np.zeros_like(q))
    law = ServoLaw.of(robot.actuated, **({"position_gain": 4.0, "force_per_unit": 3.0, "limit": np.inf} | entries))
    model = build_model(robot, **(friction or {}))
    return simulate_loop_log(model, law, motion, rate_hz=RATE_HZ).channels["q_turn"]


def step(size: float, seconds: float = 2.0) -> np.ndarray:
    """Return a command that jumps after its first sample."""
    return np.r_[0.0, np.full(round(seconds * RATE_HZ), size)]


@pytest.mark.parametrize(("derivative", "atol"), [(0.0, 2e-4), (0.3, 2e-3)])
def test_a_linear_loop_swings_as_another_program_has_it(derivative, atol):
    """Position gain, motor's own voltage, viscous friction: SciPy's answer to 0.2 mrad of half a radian.

    The speed that the controller takes off is that at the beginning of its period, 2 ms of it: 2 mrad.
    """
    found = run(step(0.5), friction={"viscous": 0.2}, back_emf=0.1, derivative_gain=derivative)

    def slope(_, x):
        force = 3.0 * (4.0 * (0.5 - x[0]) - derivative * x[1] - 0.1 * x[1]) - 0.2 * x[1]
        return [x[1], force / INERTIA]

    t = np.arange(len(found)) / RATE_HZ
    expected = solve_ivp(slope, (0, t[-1]), [0, 0], t_eval=t[:-1], rtol=1e-10, atol=1e-12).y[0]
    assert np.ptp(expected) > 0.5
    assert_allclose(found[1:], expected, atol=atol)


def test_a_motor_runs_as_fast_as_its_own_voltage_allows():
    """At the limit of the supply the speed ends where voltage and friction take all: `F limit / (F k_e + b)`."""
    found = run(step(30.0, 1.5), friction={"viscous": 0.2}, back_emf=0.17, limit=0.5)
    assert_allclose(np.diff(found)[-50:] * RATE_HZ, 3.0 * 0.5 / (3.0 * 0.17 + 0.2), rtol=1e-3)


def hold(load: float, **entries: float) -> tuple[float, float]:
    """Return the position error [rad] at rest and the load [N m] there, where gravity pulls with about `load`."""
    angle = np.arccos(load / (MASS * GRAVITY * ARM))
    found = run(np.full(round(4 * RATE_HZ), angle), "0 1 0", **({"back_emf": 0.5} | entries))  # which damps
    return float(abs(found[-1] - angle)), float(MASS * GRAVITY * ARM * np.cos(found[-1]))


def test_an_error_at_rest_is_what_the_load_needs():
    """Load over gain: `L / (F P)`; a dead band adds its width; a supply that sags makes `F u (1 - s u) = L`."""
    error, load = hold(1.0)
    assert_allclose(error, load / 12.0, rtol=1e-3)
    error, load = hold(1.0, dead_band=0.02)
    assert_allclose(error, load / 12.0 + 0.02, rtol=1e-3)
    error, load = hold(1.0, supply_sag=0.4)
    u = 4.0 * error
    assert_allclose(3.0 * u * (1 - 0.4 * u), load, rtol=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_friction_of_rest_holds_and_is_gone_in_motion(sign):
    """0.3 N m of friction and 0.2 more at rest hold 0.45 N m, not 0.55; at speed only the first is left."""
    friction, entries = {"coulomb": 0.3}, {"stiction": 0.2, "stiction_speed": 0.05}
    assert np.ptp(run(step(sign * 0.45 / 12), friction=friction, **entries)) == 0.0
    assert np.ptp(run(step(sign * 0.55 / 12), friction=friction, **entries)) > 0.01
    fast = run(step(sign * 30.0, 1.5), friction=friction, back_emf=0.2, limit=0.5, **entries)
    assert_allclose(np.diff(fast)[-50:] * RATE_HZ, sign * (3.0 * 0.5 - 0.3) / (3.0 * 0.2), rtol=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_friction_grows_with_the_torque_of_either_sign(sign):
    """A quarter of the torque is lost to friction: a constant torque accelerates with three quarters, forward and backward."""
    found = run(step(sign * 30.0, 0.2), limit=0.5, load_friction=0.25)
    speed = np.diff(found)[60:] * RATE_HZ
    assert_allclose(np.diff(speed) * RATE_HZ, sign * 3.0 * 0.5 * 0.75 / INERTIA, rtol=1e-6)


def test_friction_by_the_torque_holds_against_a_load_of_either_side():
    """Held by a quarter of its torque, a joint rests as far below a command left of the top as right of it."""
    left = run(np.full(1500, 1.2), "0 1 0", back_emf=0.5, load_friction=0.25)
    right = run(np.full(1500, np.pi - 1.2), "0 1 0", back_emf=0.5, load_friction=0.25)
    assert abs(left[-1] - 1.2) > 0.01 and np.ptp(left[-200:]) == np.ptp(right[-200:]) == 0.0
    assert_allclose(left - 1.2, -(right - (np.pi - 1.2)), atol=1e-9)


def test_a_profile_speeds_up_and_brakes_alike():
    """With 2 rad/s^2 both ways a step of 0.5 rad takes `2 sqrt(0.5 / 2) = 1 s`, half of it at half the way."""
    found = run(step(0.5, 2.0), position_gain=4000.0, back_emf=40.0, acceleration_limit=2.0, speed_limit=np.inf)
    t = np.arange(len(found)) / RATE_HZ
    assert_allclose(np.interp(0.25, found[:500], t[:500]), 0.5, atol=0.03)
    assert_allclose(t[np.argmax(found > 0.495)], 1.0, atol=0.08)
    assert found.max() < 0.5 + 1e-3


def test_a_late_command_shows_by_parts_of_a_step():
    """Along a ramp a delay of 2.4 steps is a position later by 2.4 steps of it."""
    ramp = np.arange(round(3 * RATE_HZ)) * 1e-3
    prompt, late = (run(ramp, back_emf=0.5, command_delay=d / RATE_HZ) for d in (0.0, 2.4))
    assert_allclose((prompt - late)[-200:], 2.4e-3, atol=1e-8)


@pytest.mark.parametrize("delay", [0.0, 1.3, 4.0])
def test_a_held_command_is_half_a_sample_old(delay):
    """A command holds until the next: about a sample its mean along a ramp is half a step behind, and the delay besides."""
    shown = delay_command(np.arange(60.0)[:, None], 0.02, 0.02 * delay)[:, 0]
    assert_allclose(shown[10:-10], np.arange(60.0)[10:-10] - 0.5 - delay, atol=1e-9)


def test_correlated_residuals_are_worth_fewer(rng):
    """An AR(1) residual with 0.8 from sample to sample: one free sample in `(1 + 0.8) / (1 - 0.8) = 9`."""
    x = np.zeros(60_000)
    for k, e in enumerate(rng.standard_normal(len(x))):
        x[k] = 0.8 * x[k - 1] + e
    used = np.ones((len(x), 1), bool)
    assert_allclose(count_worth(x[:, None], used), 9.0, rtol=0.2)
    assert count_worth(rng.standard_normal((20_000, 1)), used[:20_000]) < 1.3


@pytest.mark.parametrize(
    "entries",
    [
        {"command": "position", "position_gain": 8.0, "speed_gain": 0.3, "speed_integral_gain": 3.0},
        {"command": "speed", "speed_gain": 0.3, "speed_integral_gain": 3.0},
        {"command": "pwm", "back_emf": 0.2},
        {"command": "current"},
    ],
)
def test_a_joint_follows_its_commands_as_its_differential_equation_says(entries):
    """I q'' + b q' = F (u - back_emf q'), u = kv (w - q') + ki int (w - q'), w = kp (command - q) or told; or u is told."""
    robot, inertia, viscous, force = build_link(0.05), 0.05, 0.3, 4.0
    model = Model.of(robot, build_friction_model("symmetric", robot.actuated, robot.force_units))
    model = model.with_values({"j1.viscous": viscous, "j1.coulomb": 0.0, "j1.armature": 0.0})
    law = ServoLaw.of(robot.actuated, force_per_unit=force, **entries)
    log = simulate_loop_log(model, law, build_commands(robot, 3, 3.0))
    p = {"speed_gain": 0.0, "speed_integral_gain": 0.0, "position_gain": 0.0, "back_emf": 0.0} | entries

    def move(command: float, x: np.ndarray) -> np.ndarray:
        w = p["position_gain"] * (command - x[0]) if p["command"] == "position" else command
        u = p["speed_gain"] * (w - x[1]) + x[2] if p["speed_gain"] else command
        most = np.inf if p["command"] == "current" else 1.0
        torque = force * (np.clip(u, -most, most) - p["back_emf"] * x[1])
        return np.array([x[1], (torque - viscous * x[1]) / inertia, p["speed_integral_gain"] * (w - x[1])])

    x, cmd, q = np.array([log.channels["q_j1"][0], 0.0, 0.0]), log.channels["cmd_j1"], []
    for command in cmd:
        q.append(x[0])
        x = solve_ivp(lambda t, x, c=command: move(c, x), (0, 0.02), x, rtol=1e-9, atol=1e-9).y[:, -1]
    assert np.ptp(q) > 0.05
    assert_allclose(log.channels["q_j1"], q, atol=2e-5)
    again = build_servo_law(law.to_dict(), robot, "law.yaml")
    assert again.command == entries["command"]
    assert all(np.array_equal(again.values[key], x) for key, x in law.values.items())


@pytest.mark.parametrize(
    "content", [{"command": "torque"}, {"command": "pwm", "position_gain": 1.0}, {"command": "speed"}]
)
def test_a_law_that_contradicts_its_commands_is_refused(content):
    """A command of no kind that is known, a gain on a position error that nobody forms, and a loop of speed without gain."""
    with pytest.raises(InputError, match="command|position_gain|speed_gain"):
        build_servo_law({"law": "servo", "force_per_unit": 1.0, **content}, build_link(0.05), "law.yaml")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"command_delay": 20}, "command_delay is in seconds"),
        ({"torque_delay": 1e300}, "torque_delay is in seconds"),
        ({"dead_band": "1e-3"}, "only with a point and a sign"),
        ({"supply": {"column": "u", "nominal": float("inf")}}, "nominal: VOLTS"),
        ({"command": "pwm", "logs": {"*": {"position_gain": 2.0}}}, "has no effect"),
    ],
)
def test_a_law_of_numbers_that_cannot_be_is_refused(content, said):
    """Milliseconds for seconds, numbers that YAML takes for words, and what a log's own entries would change of nothing."""
    law = {"law": "servo", "force_per_unit": 1.0} | ({} if "command" in content else {"position_gain": 1.0})
    with pytest.raises(InputError, match=said):
        build_servo_law(law | content, build_link(0.05), "law.yaml")


def test_loads_along_a_motion_are_the_robots(rng):
    """Inertia, load and its growth with the position of a swinging arm are those of its equation `I a + m g r cos q`."""
    robot = build_joint("0 -1 0")
    t = np.arange(0, 4, 0.02)
    q, v, a = (x[:, None] for x in (np.sin(t), np.cos(t), -np.sin(t)))
    space = InertialSpace.of(build_model(robot))
    waves = compute_load_waves(space, q, v, a, 0.02)
    weight = MASS * GRAVITY * ARM
    assert_allclose(waves.inertia[:, 0, 0], INERTIA, rtol=1e-9)
    assert_allclose(waves.load[:, 0, 0], weight * np.cos(q[:, 0]), rtol=1e-6)
    assert_allclose(waves.stiffness[:, 0], -weight * np.sin(q[:, 0]), atol=0.02 * weight)


def test_friction_of_two_directions_is_a_mean_and_an_offset():
    """5 forward and 3 backward oppose motion as 4 both ways with a torque of 1 that pulls backward."""
    robot = build_joint()
    model = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    model = model.with_values(
        {"turn.coulomb_pos": 5.0, "turn.coulomb_neg": 3.0, "turn.viscous_pos": 0.3, "turn.viscous_neg": 0.1}
    )
    values = read_values(model, ServoLaw.of(robot.actuated, position_gain=1.0, force_per_unit=1.0))
    for v in (0.7, -0.7):
        loop = values["coulomb"] * np.sign(v) + values["offset"]
        assert_allclose(
            loop, model.effect_force(model.motion(*np.array([[[0.0]], [[1e-9 * v]], [[0.0]]])))[0], rtol=1e-6
        )
    assert_allclose(values["viscous"], 0.2)


def test_an_interval_is_two_standard_errors_within_the_bounds():
    """1.96 standard errors to both sides, cut where the number cannot be."""
    row = LoopParameter("j.coulomb", 1.0, "N m", 0.1, None, None)
    assert_allclose(row.to_dict()["ci95"], [1 - 0.195996, 1 + 0.195996], rtol=1e-5)
    assert LoopParameter("j.coulomb", 0.1, "N m", 0.1, None, None, lower=0.0).to_dict()["ci95"][0] == 0.0
