"""Does identification of a walking robot find the masses and the friction that MuJoCo simulated?

    python experiments/legged.py [--what identify payload friction imu clean] [--robots solo12 go2] [--seeds 5] [--first 0]
        [--noise 1] [--seconds S] [--out DIR]

In: quadrupeds of example-robot-data. MuJoCo is the witness: it gets the robot file with other masses (each body's by up to 10 %,
the trunk's centre by up to 15 mm), Coulomb and viscous friction, rotor inertia and round feet on a floor, and a controller that
follows joint targets. Three logs of 20 s, or 120 s for a diagnosis, are trained on together: swaying on four feet, a trot, and a
crawl; another trot of 10 s is held out. Sensors: encoders, torques, contact flags, and the base's pose as motion capture
measures it, with white noise of `--noise` times the sizes in `Quadruped`. tau_dyn sees the logs and the robot file.
Out: `legged.csv`, one row a robot and seed: errors of the total mass, of the trunk's centre (its first moment with the weights
that hang on it, over its mass), of the friction of the legs' joints, also at 1 rad/s, the share of the base parameters within
their 95 % intervals, and the held-out error. One run takes about a minute, a diagnosis ten.

`--what payload` puts a box of 5 % of the robot's mass on the trunk for a second set of logs, and compares it with what `payload`
finds. `friction` adds Stribeck friction of half of the Coulomb friction to one joint, `imu` turns the logged orientation by 20
and -15 mrad about the base's axes, `clean` does neither; the row lists what `diagnose` confirms.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from importlib.metadata import files
from itertools import product
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring, tostring

import mujoco
import numpy as np
import pandas as pd
import pinocchio as pin
from scipy.spatial.transform import Rotation

from tau_dyn.diagnose import diagnose
from tau_dyn.identify import Identification, identify
from tau_dyn.log import Log
from tau_dyn.monitor import identify_payload
from tau_dyn.robot import Robot, load_robot

STEP_S = 2e-4  # [s] of MuJoCo and of the controller
LOG_HZ = 500.0
MASS_ERROR, CENTRE_ERROR_M, INERTIA_ERROR = 0.1, 0.015, 0.1


@dataclass(frozen=True)
class Quadruped:
    """A robot, how it stands and moves, and its sensors.

    Attributes:
        file: End of its file's path in example-robot-data.
        feet: Links that are its feet.
        radius: Of a foot [m].
        stance: Positions of a leg's three joints [rad], by the beginning of the leg's name.
        gains: Proportional [N m/rad] and derivative [N m s/rad].
        sway: Amplitudes of the base's motion [m, rad].
        lift: Height of a step [m].
        coulomb: Friction of each joint of a leg [N m].
        viscous: [N m s/rad].
        armature: Rotor inertia [kg m^2].
        encoder: Noise of the joints' positions [rad].
        torque: Noise of the torques [N m].
        position: Noise of the base's position [m].
        angle: Noise of the base's orientation [rad].
    """

    file: str
    feet: tuple[str, ...]
    radius: float
    stance: dict[str, tuple[float, float, float]]
    gains: tuple[float, float]
    sway: tuple[float, float]
    lift: float
    coulomb: float
    viscous: float
    armature: float
    encoder: float = 1e-4
    torque: float = 0.01
    position: float = 3e-4
    angle: float = 5e-4


SOLO12 = Quadruped(
    "solo_description/robots/solo12.urdf",
    ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"),
    0.016,
    {"F": (0.0, 0.7, -1.4), "H": (0.0, -0.7, 1.4)},
    (8.0, 0.15),
    (0.025, 0.12),
    0.04,
    0.05,
    0.02,
    5e-4,
    encoder=4e-5,
)
GO2 = Quadruped(
    "go2_description/urdf/go2.urdf",
    ("FL_foot", "FR_foot", "RL_foot", "RR_foot"),
    0.022,
    {"F": (0.0, 0.8, -1.6), "R": (0.0, 0.8, -1.6)},
    (120.0, 2.5),
    (0.04, 0.12),
    0.06,
    0.5,
    0.1,
    1e-2,
    torque=0.1,
)
ROBOTS = {"solo12": SOLO12, "go2": GO2}
WHAT = ("identify", "payload", "friction", "imu", "clean")
SECONDS = dict.fromkeys(("friction", "imu", "clean"), 120.0)  # length of each log for a diagnosis; 20 s otherwise


def find_file(robot: Quadruped) -> Path:
    """Return the robot's file."""
    return next(Path(str(f.locate())) for f in files("example-robot-data") or () if str(f).endswith(robot.file))


def perturb(robot: Quadruped, rng: np.random.Generator) -> str:
    """Return the robot file's text with other masses, centres and inertias of bodies that exist, and without shapes."""
    root = fromstring(find_file(robot).read_text())
    for link in root.findall("link"):
        for tag in ("visual", "collision", "contact"):
            for element in link.findall(tag):
                link.remove(element)
        inertial = link.find("inertial")
        if inertial is not None:
            _change(inertial, rng)
    return tostring(root, encoding="unicode")


def _change(inertial: Element, rng: np.random.Generator) -> None:
    mass, inertia, origin = (inertial.find(tag) for tag in ("mass", "inertia", "origin"))
    if mass is None or inertia is None or origin is None:
        raise ValueError("an inertial of the robot file lacks mass, inertia or origin")
    factor = rng.uniform(1 - MASS_ERROR, 1 + MASS_ERROR)
    size = 0.3 if float(mass.get("value", "0")) < 0.5 else 1.0  # small bodies are small
    mass.set("value", repr(factor * float(mass.get("value", "0"))))
    turning = factor * rng.uniform(1 - INERTIA_ERROR, 1 + INERTIA_ERROR)
    for key, value in inertia.attrib.items():
        inertia.set(key, repr(turning * float(value)))
    centre = np.array([float(x) for x in origin.get("xyz", "0 0 0").split()])
    moved = centre + size * rng.uniform(-CENTRE_ERROR_M, CENTRE_ERROR_M, 3)
    origin.set("xyz", " ".join(map(repr, moved.tolist())))


@dataclass(frozen=True)
class Fault:
    """Hidden effects of a log.

    Attributes:
        joint: Joint with Stribeck friction; empty for none.
        turn: Turn of the base against its logged axes (3,) [rad].
    """

    joint: str = ""
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)


PEAK_SHARE, PEAK_SPEED = 0.5, 0.5  # of Coulomb friction, and [rad/s]
PAYLOAD_SHARE = 0.05  # of the robot's mass


def add_box(urdf: str, link: str, mass: float, place: np.ndarray) -> str:
    """Return a robot file's text with a box of 10 cm fixed to a link at a place (3,) [m]."""
    inertia = mass * 0.1**2 / 6
    numbers = f'ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"'
    box = (
        f'<link name="box"><inertial><mass value="{mass}"/><origin xyz="0 0 0"/><inertia {numbers}/></inertial></link>'
    )
    mount = f'<joint name="box_mount" type="fixed"><parent link="{link}"/><child link="box"/>'
    return urdf.replace(
        "</robot>", f'{box}{mount}<origin xyz="{" ".join(map(repr, place.tolist()))}"/></joint></robot>'
    )


def build_plant(robot: Quadruped, urdf: str) -> mujoco.MjModel:
    """Return MuJoCo's model: the robot on a floor, with friction in its joints and torques on them."""
    stripped = urdf.replace("</robot>", '<mujoco><compiler fusestatic="false" discardvisual="true"/></mujoco></robot>')
    spec = mujoco.MjSpec.from_string(stripped)
    spec.option.timestep = STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.worldbody.first_body().add_freejoint()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1], friction=[0.9, 0, 0])
    for foot in robot.feet:
        spec.body(foot).add_geom(
            name=foot, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[robot.radius, 0, 0], mass=0.0, friction=[0.9, 0, 0],
            solref=[0.01, 1.0],
        )  # fmt: skip
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            joint.frictionloss, joint.damping[0], joint.armature = robot.coulomb, robot.viscous, robot.armature
            joint.solref_friction, joint.solimp_friction[:2] = [-1.0, -0.9 / STEP_S], [0.99, 0.99]  # sharp at rest
            actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.gainprm[0] = 1.0
    return spec.compile()


def plan(robot: Quadruped, model: Robot, t: np.ndarray, gait: str, rng: np.random.Generator) -> np.ndarray:
    """Return joint targets (N, 12) [rad]: inverse kinematics of a base that sways over feet that stand or step."""
    legs = [joint for joint in model.driven]
    stance = np.array([robot.stance[name[0]][k % 3] for k, name in enumerate(legs)])
    tree, data = model.model, model.model.createData()
    frames = [tree.getFrameId(foot) for foot in robot.feet]
    q = pin.neutral(tree)
    start = tree.nq - len(legs)
    q[start:] = stance
    pin.framesForwardKinematics(tree, data, q)
    feet = np.array([data.oMf[k].translation for k in frames])
    size = np.repeat(robot.sway, 3) * (1.0 if gait == "sway" else 0.4) * [1, 1, 0.8, 1, 0.8, 0.8]
    w = 2 * np.pi * rng.uniform(0.2, 1.1 if gait == "sway" else 0.7, (3, 6))
    share, phase = size * rng.dirichlet(np.ones(3), 6).T, rng.uniform(0, 6, (3, 6))
    soft = np.clip(t / 1.0, 0, 1)[:, None]
    base = soft * (share * np.sin(w * t[:, None, None] + phase)).sum(axis=1)
    turn = Rotation.from_euler("ZYX", base[:, 3:]).as_matrix()
    wanted = feet + _step(t, gait, rng) * [robot.lift * 0.8, robot.lift * 0.4, robot.lift]
    local = (wanted - base[:, None, :3]) @ turn
    out = np.empty((len(t), len(legs)))
    guess = stance.copy()
    for n in range(len(t)):
        guess = out[n] = _reach(tree, data, frames, q, start, guess, local[n])
    return out


def _step(t: np.ndarray, gait: str, rng: np.random.Generator) -> np.ndarray:
    """Return each foot's displacement (N, 4, 3) in units of a step: forward and back, sideways, up."""
    out = np.zeros((len(t), 4, 3))
    if gait == "sway":
        return out
    pairs, period, air = ([(0, 3), (1, 2)], 0.7, 0.24) if gait == "trot" else ([(0,), (3,), (1,), (2,)], 2.4, 0.35)
    for number, group in enumerate(pairs):
        shifted = t - 1.0 - period * number / len(pairs)
        cycle, within = np.floor(shifted / period), shifted % period
        flying = (within < air) & (cycle >= 0)
        lift = np.where(flying, np.sin(np.pi * within / air) ** 2, 0.0)
        for foot in group:
            size = rng.uniform(-1, 1, (int(t[-1] / period) + 3, 2))[cycle.astype(int)]
            out[:, foot, :2] = size * lift[:, None]  # out and back: feet land where they stood
            out[:, foot, 2] = lift
    return out


def _reach(tree, data, frames, q, start, guess, wanted) -> np.ndarray:
    """Return joint positions (12,) that put the feet at places (4, 3) in the base's frame, by Newton's method."""
    for _ in range(8):
        q[start:] = guess
        pin.computeJointJacobians(tree, data, q)
        pin.updateFramePlacements(tree, data)
        off = (np.array([data.oMf[k].translation for k in frames]) - wanted).ravel()
        if np.abs(off).max() < 1e-9:
            break
        J = np.concatenate(
            [pin.getFrameJacobian(tree, data, k, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:3] for k in frames]
        )
        guess = guess - np.linalg.lstsq(J[:, -12:], off, rcond=1e-6)[0]
    return guess


def simulate(
    robot: Quadruped,
    model: Robot,
    plant: mujoco.MjModel,
    gait: str,
    seconds: float,
    rng: np.random.Generator,
    noise: float,
    fault: Fault = Fault(),
) -> Log:
    """Return the log of a motion in MuJoCo."""
    every = round(1 / (LOG_HZ * STEP_S))
    t = np.arange(0, seconds, 1 / LOG_HZ)
    targets = plan(robot, model, t, gait, rng)
    data = mujoco.MjData(plant)
    joints = [plant.joint(name) for name in model.driven]
    at_q = np.array([int(j.qposadr[0]) for j in joints])
    at_v = np.array([int(j.dofadr[0]) for j in joints])
    motors = np.array([plant.actuator(name).id for name in model.driven])
    feet = [plant.geom(foot).id for foot in robot.feet]
    data.qpos[at_q] = targets[0]
    mujoco.mj_kinematics(plant, data)
    data.qpos[2] -= min(data.geom_xpos[k][2] for k in feet) - robot.radius
    fine = np.arange(round(seconds / STEP_S)) * STEP_S
    wanted = np.column_stack([np.interp(fine, t, x) for x in targets.T])
    rate = np.gradient(wanted, STEP_S, axis=0)
    rows = []
    for n in range(len(fine)):
        tau = robot.gains[0] * (wanted[n] - data.qpos[at_q]) + robot.gains[1] * (rate[n] - data.qvel[at_v])
        data.ctrl[motors] = tau
        if fault.joint:
            k = model.driven.index(fault.joint)
            v = data.qvel[at_v[k]]
            data.ctrl[motors[k]] -= PEAK_SHARE * robot.coulomb * np.sign(v) * np.exp(-abs(v) / PEAK_SPEED)
        if n % every == 0:
            mujoco.mj_forward(plant, data)
            loads = _read_loads(plant, data, feet)
            rows.append(
                np.concatenate([[fine[n]], data.qpos[:3], data.qpos[[4, 5, 6, 3]], data.qpos[at_q], tau, loads])
            )
        mujoco.mj_step(plant, data)
    read = np.array(rows)
    read[:, 4:8] = (Rotation.from_quat(read[:, 4:8]) * Rotation.from_rotvec(np.negative(fault.turn))).as_quat()
    return _measure(robot, model, read, gait, rng, noise)


def _read_loads(plant: mujoco.MjModel, data: mujoco.MjData, feet: list[int]) -> np.ndarray:
    """Return the normal force on each foot (4,) [N]."""
    found, force = np.zeros(4), np.zeros(6)
    for k in range(data.ncon):
        for geom in data.contact[k].geom:
            if geom in feet:
                mujoco.mj_contactForce(plant, data, k, force)
                found[feet.index(geom)] += force[0]
    return found


def _measure(
    robot: Quadruped, model: Robot, rows: np.ndarray, gait: str, rng: np.random.Generator, noise: float
) -> Log:
    """Return a log with noise; the first second, in which the robot settles, is left out."""
    rows = rows[rows[:, 0] >= 1.0]
    n = len(rows)
    turn = Rotation.from_rotvec(noise * robot.angle * rng.standard_normal((n, 3))) * Rotation.from_quat(rows[:, 4:8])
    position = rows[:, 1:4] + noise * robot.position * rng.standard_normal((n, 3))
    q = rows[:, 8:20] + noise * robot.encoder * rng.standard_normal((n, 12))
    tau = rows[:, 20:32] + noise * robot.torque * rng.standard_normal((n, 12))
    columns = {f"q_base_{x}": position[:, k] for k, x in enumerate("xyz")}
    columns |= {f"q_base_q{x}": y for x, y in zip("xyzw", turn.as_quat().T, strict=True)}
    columns |= {f"q_{joint}": q[:, k] for k, joint in enumerate(model.driven)}
    columns |= {f"tau_{joint}": tau[:, k] for k, joint in enumerate(model.driven)}
    columns |= {f"contact_{foot}": (rows[:, 32 + k] > 0).astype(float) for k, foot in enumerate(robot.feet)}
    return Log(rows[:, 0], columns, gait)


def read_truth(robot: Quadruped, model: Robot, urdf: str, found: Identification) -> np.ndarray:
    """Return the true value of every parameter of an identification (p,)."""
    true = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
    values = {}
    for link in model.links:
        joint = model.model.names[link.joint_id]
        number = 1 if joint in model.base_coordinates else true.getJointId(joint)
        for name, x in zip(link.names, true.inertias[number].toDynamicParameters(), strict=True):
            values[name] = x
    for name in found.parameters.names:
        if name.endswith(".armature"):
            values[name] = robot.armature if name.split(".")[0] in model.driven else 0.0
        elif ".coulomb" in name or ".viscous" in name:
            values[name] = robot.coulomb if "coulomb" in name else robot.viscous
        elif name not in values:
            values[name] = 0.0
    return np.array([values[name] for name in found.parameters.names])


def judge(robot: Quadruped, model: Robot, urdf: str, found: Identification) -> dict[str, float]:
    """Return the errors against the truth."""
    truth = read_truth(robot, model, urdf, found)
    e = found.estimate
    values = dict(zip(found.parameters.names, truth, strict=True))
    wanted = e.base.combine(np.array([values[name] for name in e.base.names]))
    names = [e.base.names[k] for k in e.base.kept]
    z = (e.beta - wanted) / e.stderr
    root = model.links[0].link
    mass, moments = names.index(f"{root}.mass"), [names.index(f"{root}.m{x}") for x in "xyz"]
    trunk = values[f"{root}.mass"]
    coulomb = [k for k, name in enumerate(names) if ".coulomb" in name]
    viscous = [k for k, name in enumerate(names) if ".viscous" in name]
    at_one = wanted[coulomb] + wanted[viscous]  # friction of each joint at 1 rad/s [N m]
    nominal = e.base.combine(np.array([found.nominal[name].value for name in e.base.names]))
    off = np.linalg.norm(e.beta[moments] - wanted[moments]) / trunk
    return {
        "mass_error_percent": 100 * (e.beta[mass] / wanted[mass] - 1),
        "file_mass_error_percent": 100 * (nominal[mass] / wanted[mass] - 1),
        "centre_error_mm": 1e3 * off,
        "file_centre_error_mm": 1e3 * np.linalg.norm(nominal[moments] - wanted[moments]) / trunk,
        "coulomb_rms_percent": 100 * np.sqrt(np.mean((e.beta[coulomb] / wanted[coulomb] - 1) ** 2)),
        "viscous_rms_percent": 100 * np.sqrt(np.mean((e.beta[viscous] / wanted[viscous] - 1) ** 2)),
        "friction_rms_percent": 100 * np.sqrt(np.mean((sum(e.beta[k] for k in (coulomb, viscous)) / at_one - 1) ** 2)),
        "coverage_percent": 100 * float(np.mean(np.abs(z) < 1.96)),
        "z_rms": float(np.sqrt(np.mean(z**2))),
        "mass_z": z[mass],
        "base_parameters": len(names),
        "held_out_percent": found.holdout.relative_error_percent if found.holdout else np.nan,
    }


def load_model(robot: Quadruped) -> Robot:
    """Return what tau_dyn knows of a robot."""
    contacts = [f"{foot}={robot.radius}" for foot in robot.feet]
    return load_robot(find_file(robot), base="floating", contacts=contacts)


def run_payload(name: str, seed: int, seconds: float, noise: float) -> dict[str, float | str]:
    """Simulate one robot without and with a box, and find the box."""
    robot, rng = ROBOTS[name], np.random.default_rng(seed)
    model, urdf = load_model(robot), perturb(robot, rng)
    total = sum(float(link.nominal[0]) for link in model.links)
    mass, place = PAYLOAD_SHARE * total, rng.uniform([-0.08, -0.04, 0.05], [0.08, 0.04, 0.12])
    sets = []
    for text in (urdf, add_box(urdf, model.links[0].link, mass, place)):
        plant = build_plant(robot, text)
        sets.append([simulate(robot, model, plant, gait, seconds, rng, noise) for gait in ("sway", "trot")])
    found = identify_payload(model, *sets)
    return {
        "payload_kg": mass,
        "payload_error_percent_of_robot": 100 * (float(found.mass.values[0]) - mass) / total,
        "payload_z": float((found.mass.values[0] - mass) / found.mass.stderr[0]),
        "payload_centre_error_mm": 1e3 * float(np.linalg.norm(found.centre.values - place)),
    }


def run_diagnosis(name: str, seed: int, seconds: float, noise: float, what: str) -> dict[str, float | str]:
    """Simulate one robot with a fault, and list the causes that `diagnose` confirms."""
    robot, rng = ROBOTS[name], np.random.default_rng(seed)
    model, urdf = load_model(robot), perturb(robot, rng)
    joint = str(rng.choice(model.driven))
    fault = {"friction": Fault(joint), "imu": Fault(turn=(0.02, -0.015, 0.0)), "clean": Fault()}[what]
    plant = build_plant(robot, urdf)
    logs = [simulate(robot, model, plant, gait, seconds, rng, noise, fault) for gait in ("sway", "trot", "crawl")]
    found = diagnose(model, logs, model="symmetric", seed=seed)
    named = [
        f"{f.cause} ({'+'.join(f.joints) if len(f.joints) < 4 else 'all'}) {f.parameters[0].value:.4g}"
        + "".join(f" = {other}" for other in f.indistinguishable_from)
        for f in found.findings
        if f.status in ("confirmed", "parameter")
    ]
    hidden = {"friction": joint, "imu": "imu", "clean": ""}[what]
    return {"hidden": hidden, "verdict": found.verdict, "confirmed": "; ".join(named)}


def run(name: str, seed: int, seconds: float, noise: float, what: str) -> dict[str, float | str]:
    """Simulate and identify, weigh or diagnose one robot."""
    if what != "identify":
        weigh = what == "payload"
        more = run_payload(name, seed, seconds, noise) if weigh else run_diagnosis(name, seed, seconds, noise, what)
        return {"robot": name, "seed": seed, "noise": noise, "what": what, **more}
    robot, rng = ROBOTS[name], np.random.default_rng(seed)
    model, urdf = load_model(robot), perturb(robot, rng)
    plant = build_plant(robot, urdf)
    logs = [simulate(robot, model, plant, gait, seconds, rng, noise) for gait in ("sway", "trot", "crawl")]
    held = simulate(robot, model, plant, "trot", 10.0, rng, noise)
    found = identify(model, logs, holdout=[held], model="symmetric")
    return {"robot": name, "seed": seed, "noise": noise, "what": what, **judge(robot, model, urdf, found)}


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description="Identification of walking robots that MuJoCo simulated")
    parser.add_argument("--robots", nargs="+", default=list(ROBOTS), choices=list(ROBOTS))
    parser.add_argument("--what", nargs="+", default=["identify"], choices=list(WHAT))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--noise", type=float, default=1.0)
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--out", type=Path, default=Path())
    given = parser.parse_args()
    rows = []
    for name, what in product(given.robots, given.what):
        seconds = given.seconds or SECONDS.get(what, 20.0)
        for seed in range(given.first, given.first + given.seeds):
            rows.append(run(name, seed, seconds, given.noise, what))
            print({key: x if isinstance(x, str) else round(float(x), 3) for key, x in rows[-1].items()}, flush=True)
    pd.DataFrame(rows).to_csv(given.out / "legged.csv", index=False)


if __name__ == "__main__":
    main()
