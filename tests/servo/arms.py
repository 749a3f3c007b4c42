"""Small servo arms and their logs, for the tests of loops."""

import numpy as np

from tau_dyn.effects import build_friction_model
from tau_dyn.model import Model
from tau_dyn.robot import load_robot_from_urdf
from tau_dyn.servo import simulate_loop_log
from tau_dyn.simulate import ServoLaw, Trajectory

_LINK = """<link name="{name}_link"><inertial><origin xyz="{x} 0 0"/><mass value="{m}"/>
<inertia ixx="1e-5" ixy="0" ixz="0" iyy="{i}" iyz="0" izz="{i}"/></inertial></link>"""
_JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{name}_link"/><origin xyz="{at} 0 0"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="5" velocity="10"/></joint>
<transmission name="{name}_t"><type>transmission_interface/SimpleTransmission</type><joint name="{name}"/>
<actuator name="{name}_m"/></transmission>"""


def build_arm(n: int = 2, mass: float = 0.15):
    """Return an arm of n links in a vertical plane, lengths 0.12 m, of one mass [kg]."""
    names = [f"j{k + 1}" for k in range(n)]
    links = [_LINK.format(name=j, x=0.07, m=mass, i=2e-4) for j in names]
    parents = ["base_link", *(f"{j}_link" for j in names[:-1])]
    joints = [
        _JOINT.format(name=j, parent=p, at=0 if k == 0 else 0.12)
        for k, (j, p) in enumerate(zip(names, parents, strict=True))
    ]
    return load_robot_from_urdf(
        f'<robot name="arm"><link name="base_link"/>{"".join(links + joints)}</robot>', "arm.urdf"
    )


def build_link(inertia: float):
    """Return one link of 1 kg that swings about a vertical axis, with an inertia about it [kg m^2]."""
    own = inertia - 0.1**2
    link = _LINK.format(name="j1", x=0.1, m=1.0, i=own)
    joint = _JOINT.format(name="j1", parent="base_link", at=0).replace('xyz="0 1 0"', 'xyz="0 0 1"')
    return load_robot_from_urdf(f'<robot name="joint"><link name="base_link"/>{link}{joint}</robot>', "joint.urdf")


def build_law(robot, gain: float = 2.65, **entries) -> ServoLaw:
    """Return a hobby servo's law."""
    known = {
        "position_gain": gain,
        "force_per_unit": 2.9,
        "back_emf": 0.17,
        "command_delay": 0.012,
        "load_friction": 0.2,
    }
    if entries.get("command", "position") != "position":
        del known["position_gain"]
    return ServoLaw.of(robot.actuated, **(known | {"stiction": 0.01} | entries))


def build_truth(robot) -> Model:
    """Return the arm with friction and drive inertias."""
    model = Model.of(robot, build_friction_model("symmetric", robot.actuated, robot.force_units))
    values = {}
    for joint in robot.actuated:
        values |= {f"{joint}.coulomb": 0.06, f"{joint}.viscous": 0.02, f"{joint}.armature": 0.012}
    return model.with_values(values)


def build_commands(robot, seed: int, duration: float = 40.0) -> Trajectory:
    """Return sums of sines and steps at every joint."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, duration, 0.02)
    q = np.zeros((len(t), robot.na))
    for j in range(robot.na):
        for f in rng.uniform(0.05, 0.9, 4):
            q[:, j] += rng.uniform(0.05, 0.25) * np.sin(2 * np.pi * f * t + rng.uniform(0, 6))
        steps = np.repeat(rng.choice([-0.15, 0.15], len(t) // 60 + 1), 60)[: len(t)]
        q[:, j] += np.where(t > duration / 2, steps, 0.0)
    v = np.gradient(q, t, axis=0)
    return Trajectory(robot.actuated, t, q, v, np.gradient(v, t, axis=0))


def record(robot, model, law, seed: int, duration: float = 40.0, clean: bool = False, **sensors):
    """Return a log of commands and positions as a 12 bit encoder shows them, or, clean, as they are."""
    return simulate_loop_log(
        model,
        law,
        build_commands(robot, seed, duration),
        seed=seed,
        encoder_resolution=0.0 if clean else 2 * np.pi / 4096,
        encoder_noise=0.0 if clean else 3e-4,
        **sensors,
    )
