r"""Robots that nobody here made: what of them loads, moves, is identified, exported and read again.

Each is a name that `tau-dyn robots` lists, a file with xacro arguments, or a folder, of which every URDF, top-level xacro and
MJCF is taken. For each of them:

    load       the file as it is, meshes or not
    fk         the tool, or the first leaf, against Pinocchio's own reading of the URDF or MuJoCo's of the MJCF
    regressor  against Pinocchio's, or times the parameters against `mj_inverse`; relative, contacts and passive forces off
    identify   from a log that MuJoCo makes with viscous friction, 10 s of four sines a joint; what is left of the force
    export     URDF and MJCF, both read again, forces compared

A robot that is refused is listed with its sentence. `--out` writes the table, as docs/results/data/foreign_robots.csv is.

    python experiments/foreign_robots.py ur5 panda /ROS/ur.urdf.xacro,name=ur,ur_type=ur5e /MENAGERIE/unitree_go1 --out TABLE.csv
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import mujoco
import numpy as np
import pandas as pd
import pinocchio as pin

from tau_dyn.exceptions import TauDynError
from tau_dyn.exchange import build_mjcf, build_urdf
from tau_dyn.identify import identify
from tau_dyn.log import Log
from tau_dyn.mechanism import build_kinematics, build_mechanism
from tau_dyn.model import Model
from tau_dyn.robot import Robot, find_robot, load_robot, load_robot_from_urdf, read_annotations

EXACT = 1e-9  # relative, of forces and regressors [and m]
ROUNDED = 1e-6  # relative; an estimate on the edge of what bodies have is moved by so much where MuJoCo takes no other
LEFT_PERCENT = 1.0  # of the force, after identification from filtered positions
DAMPING = 0.7  # [N m s/rad or N s/m] in MuJoCo's log
NOISE = 1e-3  # of each force's root mean square
N_STATES = 30
RATE_HZ, DURATION_S, HARMONICS = 200.0, 10.0, 4
DISABLED = ("CONTACT", "SPRING", "LIMIT", "FRICTIONLOSS", "EQUALITY")


class Case(NamedTuple):
    """A robot's file and xacro arguments."""

    name: str
    arguments: dict[str, str]


def list_cases(texts: list[str]) -> list[Case]:
    """Return what the command line names, folders searched."""
    cases = []
    for text in texts:
        path, *pairs = text.split(",")
        if Path(path).is_dir():
            found = sorted(
                p for p in Path(path).rglob("*") if p.suffix in (".urdf", ".xml") or p.name.endswith(".urdf.xacro")
            )
            cases += [Case(str(p), {}) for p in found if is_robot(p)]
        else:
            cases.append(Case(path, dict(pair.split("=", 1) for pair in pairs)))
    return cases


def is_robot(path: Path) -> bool:
    """Tell whether a file is a robot: a scene only puts one on a floor."""
    head = path.read_text(encoding="utf-8", errors="replace")
    return path.suffix != ".xml" or ("<mujoco" in head and "<joint" in head and "scene" not in path.name)


def is_mjcf(case: Case) -> bool:
    """Tell whether a case is MJCF."""
    return find_robot(case.name).suffix == ".xml"


def load_in_mujoco(case: Case, robot: Robot) -> mujoco.MjModel:
    """Return MuJoCo's own reading of the file, without meshes, equations and a free base."""
    if is_mjcf(case):
        spec = mujoco.MjSpec.from_file(str(find_robot(case.name)))
    else:
        root = ElementTree.fromstring(robot.urdf)
        for link in root.findall("link"):
            for tag in ("visual", "collision"):
                for element in link.findall(tag):
                    link.remove(element)
        for joint in root.findall("joint"):
            for element in joint.findall("mimic"):
                joint.remove(element)
        extra = ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler")
        extra.attrib.update(fusestatic="false", boundmass="1e-12", boundinertia="1e-14", strippath="false")
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    for geom in list(spec.geoms):
        if geom.meshname:
            spec.delete(geom)
        else:
            geom.material = ""
    for part in (*spec.sites, *spec.tendons):
        part.material = ""
    for kind in ("meshes", "textures", "hfields", "skins", "materials", "equalities", "keys", "sensors"):
        for item in list(getattr(spec, kind)):
            spec.delete(item)
    for joint in list(spec.joints):
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
    model = spec.compile()
    for name in DISABLED:
        model.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")
    model.body_gravcomp[:] = model.opt.viscosity = model.opt.density = 0
    return model


def compute_mujoco_forces(
    model: mujoco.MjModel, robot: Robot, q: np.ndarray, v: np.ndarray, a: np.ndarray, damping: float = 0.0
) -> np.ndarray:
    """Return `mj_inverse` (N, na), followers added to what they follow."""
    data, (share, offset) = mujoco.MjData(model), robot.coupling
    model.dof_damping[:] = 0.0
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in robot.model.names[1:]]
    rows = [robot.model.joints[k].idx_v for k in range(1, robot.model.njoints)]
    places, dofs = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
    for joint in robot.actuated:
        model.dof_damping[model.jnt_dofadr[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint)]] = damping
    out = np.empty_like(q)
    for k in range(len(q)):
        data.qpos[places] = (share @ q[k] + offset)[rows]
        data.qvel[dofs], data.qacc[dofs] = (share @ v[k])[rows], (share @ a[k])[rows]
        mujoco.mj_inverse(model, data)
        out[k] = share[rows].T @ data.qfrc_inverse[dofs]
    return out


def draw_states(robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return random states near home; loops close only there."""
    rng, reach = np.random.default_rng(0), 0.03 if robot.loops else 1.0
    return (robot.home + reach * rng.uniform(-1, 1, (N_STATES, robot.na)), *rng.normal(size=(2, N_STATES, robot.na)))


def compare_tool(case: Case, robot: Robot, reference: mujoco.MjModel | None) -> float:
    """Return how far the tool lies from where the other program puts it [m]."""
    q = draw_states(robot)[0]
    ours = build_kinematics(robot).forward(q).poses.position
    share, offset = robot.coupling
    theirs = np.empty_like(ours)
    if reference is not None and is_mjcf(case):
        data = mujoco.MjData(reference)
        site = mujoco.mj_name2id(reference, mujoco.mjtObj.mjOBJ_SITE, robot.tool)
        body = mujoco.mj_name2id(reference, mujoco.mjtObj.mjOBJ_BODY, robot.tool)
        for k in range(len(q)):
            for joint in robot.model.names[1:]:
                j = mujoco.mj_name2id(reference, mujoco.mjtObj.mjOBJ_JOINT, joint)
                row = robot.model.joints[robot.model.getJointId(joint)].idx_v
                data.qpos[reference.jnt_qposadr[j]] = share[row] @ q[k] + offset[row]
            mujoco.mj_kinematics(reference, data)
            last = reference.body_jntadr[body] + reference.body_jntnum[body] - 1
            anchored = data.xpos[body].copy()
            if reference.body_jntnum[body]:
                anchored += data.xmat[body].reshape(3, 3) @ reference.jnt_pos[last]
            theirs[k] = data.site_xpos[site] if site >= 0 else anchored
        return float(np.abs(ours - theirs).max())
    model = robot.model if robot.loops else pin.buildModelFromXML(robot.urdf)
    data, full = model.createData(), build_kinematics(robot).full_positions(q)
    for k in range(len(q)):
        pin.framesForwardKinematics(model, data, build_configuration(model, robot, full[k]))
        theirs[k] = data.oMf[model.getFrameId(robot.tool, pin.FrameType.BODY)].translation
    return float(np.abs(ours - theirs).max())


def build_configuration(model: pin.Model, robot: Robot, x: np.ndarray) -> np.ndarray:
    """Return Pinocchio's configuration of one position a joint (nv,)."""
    q = pin.neutral(model)
    for k in range(1, model.njoints):
        item, value = model.joints[k], x[robot.model.joints[robot.model.getJointId(model.names[k])].idx_v]
        q[item.idx_q : item.idx_q + item.nq] = [value] if item.nq == 1 else [np.cos(value), np.sin(value)]
    return q


def compare_regressor(case: Case, robot: Robot, reference: mujoco.MjModel | None) -> float:
    """Return the largest difference from the other program, relative to the largest number."""
    q, v, a = draw_states(robot)
    mechanism = build_mechanism(robot)
    Y = mechanism.regressor(q, v, a)
    share = robot.coupling[0]
    if reference is not None and is_mjcf(case) and not robot.loops:
        theirs = compute_mujoco_forces(reference, robot, q, v, a)
        return float(np.abs(Y @ robot.parameters.values - theirs).max() / np.abs(theirs).max())
    model, worst, size = robot.model, 0.0, 0.0
    data = model.createData()
    for k in range(len(q)):
        state = build_mechanism(robot).solver.state(q[k], v[k], a[k])
        tree = np.asarray(pin.computeJointTorqueRegressor(model, data, state.q, state.v, state.a)).reshape(model.nv, -1)
        column = 0
        for link in robot.links:
            own = tree[:, 10 * (link.joint_id - 1) : 10 * link.joint_id] @ link.map
            wanted = (state.G if robot.loops else share).T @ own
            worst = max(worst, np.abs(Y[k][:, column : column + wanted.shape[1]] - wanted).max())
            size, column = max(size, np.abs(wanted).max()), column + wanted.shape[1]
    return float(worst / size)


def make_log(robot: Robot, reference: mujoco.MjModel | None) -> Log:
    """Return positions and MuJoCo's forces along sines within the limits, with viscous friction."""
    t = np.arange(0, DURATION_S, 1 / RATE_HZ)
    rng = np.random.default_rng(1)
    span = np.where(np.isfinite(robot.upper - robot.lower), robot.upper - robot.lower, 2.0)
    room = (
        np.minimum(robot.home - robot.lower, robot.upper - robot.home) if not robot.loops else np.full(robot.na, 0.05)
    )
    amplitude = np.clip(np.minimum(0.4 * span, 0.9 * room), 0.02, 0.6) / HARMONICS
    q, v, a = (np.zeros((len(t), robot.na)) for _ in range(3))
    for k in range(1, HARMONICS + 1):
        w, phase = 2 * np.pi * k * 0.15 * (1 + 0.03 * np.arange(robot.na)), rng.uniform(0, 2 * np.pi, robot.na)
        angle = w * t[:, None] + phase
        q, v, a = q + amplitude * np.sin(angle), v + amplitude * w * np.cos(angle), a - amplitude * w**2 * np.sin(angle)
    q = q + robot.home
    if reference is None or robot.loops:
        tau = build_mechanism(robot).inverse_dynamics(q, v, a) + DAMPING * v
    else:
        tau = compute_mujoco_forces(reference, robot, q, v, a, DAMPING)
    tau = tau + NOISE * np.sqrt(np.mean(tau**2, axis=0)) * rng.normal(size=tau.shape)
    channels = {f"q_{j}": q[:, k] for k, j in enumerate(robot.actuated)}
    return Log(t, channels | {f"tau_{j}": tau[:, k] for k, j in enumerate(robot.actuated)}, name="mujoco")


def compare_export(model: Model) -> tuple[float, float]:
    """Return how far the forces of the exported URDF and MJCF, read again, lie from the model's, relative."""
    robot = model.robot
    q, v, a = draw_states(robot)
    ours = model.mechanism.inverse_dynamics(q, v, a)
    size = np.abs(ours).max()
    again = load_robot_from_urdf(build_urdf(model).text, "exported", actuated=robot.actuated)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "exported.xml"
        path.write_text(build_mjcf(model).text)
        mujoco.MjModel.from_xml_path(str(path))
        third = load_robot(path, actuated=robot.actuated)
    apart = [np.abs(build_mechanism(x).inverse_dynamics(q, v, a) - ours).max() / size for x in (again, third)]
    return float(apart[0]), float(apart[1])


def study(case: Case) -> dict[str, Any]:
    """Return the row of one robot; its outcome is 'pass', or what is wrong."""
    robot = load_robot(case.name, **case.arguments)
    if not robot.tool:
        leaf = read_annotations(robot.urdf, robot.source).leaves[0]
        robot = load_robot(case.name, tool=leaf, **case.arguments)
    try:
        reference = load_in_mujoco(case, robot)
    except ValueError:
        reference = None
    found: dict[str, float] = {"fk": compare_tool(case, robot, reference)}
    found["regressor"] = compare_regressor(case, robot, reference)
    result = identify(robot, make_log(robot, reference), model="symmetric")
    found["identify"] = float(result.train.relative_error_percent)
    found["urdf"], found["mjcf"] = compare_export(result.model)
    limits = {"fk": EXACT, "regressor": EXACT, "identify": LEFT_PERCENT, "urdf": EXACT, "mjcf": ROUNDED}
    wrong = [name for name, value in found.items() if not value <= limits[name]]
    by = "MuJoCo" if reference is not None and not robot.loops else "ours"
    outcome = "pass" if not wrong else f"wrong: {' '.join(wrong)}"
    return {"outcome": outcome, "joints": robot.na, "tool": robot.tool, "log_by": by, **found}


def main() -> None:
    """Study what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("robots", nargs="+", help="a name, PATH[,NAME=VALUE...] or a folder")
    parser.add_argument("--out", type=Path, help="write the table here (CSV)")
    given = parser.parse_args()
    rows = []
    for case in list_cases(given.robots):
        start, short = time.perf_counter(), "/".join(Path(case.name).parts[-2:])
        try:
            row = study(case)
        except TauDynError as fault:
            sentence = str(fault).replace(str(Path(case.name).parent), "").lstrip("/")
            row = {"outcome": "refused", "sentence": sentence}
        row = {"robot": " ".join([short, *case.arguments.values()]), **row}
        rows.append(row)
        said = ", ".join(f"{k} {x:.2g}" if isinstance(x, float) else f"{k} {x}" for k, x in list(row.items())[2:])
        print(f"{row['robot']:45.45s} {row['outcome']:8s} {time.perf_counter() - start:5.1f} s  {said}", flush=True)
    table = pd.DataFrame(rows)
    print(table["outcome"].value_counts().to_dict())
    if given.out:
        table.to_csv(given.out, index=False, float_format="%.2g")


if __name__ == "__main__":
    main()
