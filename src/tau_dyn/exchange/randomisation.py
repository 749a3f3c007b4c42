"""Samples of a model for domain randomisation: a table of bodies and joints, and a module that puts its rows into simulations.

    OUT.npz   n samples of the robot that `export --to mjcf` or `--to urdf` writes, in SI units:
              bodies (b,), mass (n, b), centre (n, b, 3) in the body's frame, moments (n, b, 3), axes (n, b, 4) w x y z;
              joints (j,), armature, damping, frictionloss, offset, gain (n, j) as in robot files (`content.py`)
    OUT.py    mjlab 1.6, Isaac Lab 2.3 or MuJoCo Playground: `set_sample(model, k)` for MuJoCo, and the trainer's own event

Each row is one robot: masses, inertias and friction belong together, so a trainer draws rows, not numbers.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
import pinocchio as pin

from tau_dyn.exceptions import InputError
from tau_dyn.exchange.content import build_carried_model, list_omissions, raise_moments, read_joint_law
from tau_dyn.model import Model
from tau_dyn.robot import compute_inertia_matrix
from tau_dyn.version import __version__

TrainerTarget = Literal["mjlab", "isaaclab", "playground"]


@dataclass(frozen=True)
class RandomisationFiles:
    """The files that a trainer loads.

    Attributes:
        module: Text of OUT.py.
        table: Content of OUT.npz.
        left_out: Parts of the model that the simulations cannot carry, one sentence each.
        n_samples: Number of samples.
    """

    module: str
    table: bytes
    left_out: tuple[str, ...]
    n_samples: int


def read_samples(path: Path, model: Model) -> np.ndarray:
    """Return a table of samples (n, p) in the order of a model's parameters.

    Raises:
        InputError: The file is not such a table, or belongs to another model.
    """
    if not path.is_file():
        raise InputError(
            "file_not_found", f"{path} does not exist or is a folder; identify --samples N --out writes the samples"
        )
    try:
        frame = pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path)
        odd = min(set(frame.columns) ^ set(model.parameters.names), default="")
        values = frame[list(model.parameters.names)].to_numpy(float) if not odd else np.zeros((0, 0))
    except (ValueError, OSError) as fault:
        raise InputError(
            "file_format", f"{path} is no table of samples; identify --samples N --out writes one (.parquet or .csv)"
        ) from fault
    if odd:
        raise InputError("mismatch", f"{path}: parameter '{odd}' is of the samples or of the model, but not of both")
    if not len(values) or not np.all(np.isfinite(values)):
        raise InputError("invalid_value", f"{path}: samples must be one row or more of finite numbers")
    return values


def build_randomisation(
    model: Model, samples: np.ndarray, target: TrainerTarget, table_name: str
) -> RandomisationFiles:
    """Return a trainer's files of samples (n, p) of a model's parameters.

    Args:
        model: The model.
        samples: Values in the order of its parameters.
        target: The trainer.
        table_name: File name of the table, which is in the folder of the module.
    """
    model.robot.require_unscaled_drives("a trainer's file")
    arrays = {**_collect_bodies(model, samples), **_collect_joints(model, samples)}
    packed = io.BytesIO()
    np.savez_compressed(packed, allow_pickle=False, **arrays)
    about = f"Written by tau_dyn {__version__}: {len(samples)} samples."
    text = _HEAD.format(about=about, file=table_name) + _EVENTS[target]
    return RandomisationFiles(text, packed.getvalue(), list_omissions(model, drives=True), len(samples))


def _collect_bodies(model: Model, samples: np.ndarray) -> dict[str, np.ndarray]:
    """Return each link's mass, centre, moments and axes in each sample, by the names of MJCF bodies and URDF links."""
    robot, names = model.robot, model.parameters.names
    bodies = {f.parentJoint: f.name for f in reversed(robot.model.frames.tolist()) if f.type == pin.FrameType.BODY}
    n, b = len(samples), len(robot.links)
    mass, centre, moments, axes = np.zeros((n, b)), np.zeros((n, b, 3)), np.zeros((n, b, 3)), np.zeros((n, b, 4))
    for k, link in enumerate(robot.links):
        for i, pi in enumerate(samples[:, [names.index(name) for name in link.names]] @ link.map.T):
            c = pi[1:4] / pi[0] if pi[0] > 0 else np.zeros(3)
            inertia = compute_inertia_matrix(pi) - pi[0] * (c @ c * np.eye(3) - np.outer(c, c))
            principal, R = raise_moments(inertia) or np.linalg.eigh(inertia)
            turn = pin.Quaternion(R * np.array([1.0, 1.0, np.sign(np.linalg.det(R))]))
            mass[i, k], centre[i, k], moments[i, k] = pi[0], c, principal
            axes[i, k] = turn.w, turn.x, turn.y, turn.z
    return {"bodies": np.array([bodies[link.joint_id] for link in robot.links]), "mass": mass, "centre": centre,
            "moments": moments, "axes": axes}  # fmt: skip


def _collect_joints(model: Model, samples: np.ndarray) -> dict[str, np.ndarray]:
    """Return each joint's law in each sample; all of its values are linear in the parameters."""
    robot, names = model.robot, model.parameters.names
    own = [k for k, name in enumerate(names) if name.rpartition(".")[0] in robot.driven]

    def read(values: np.ndarray) -> np.ndarray:
        carried = build_carried_model(model.with_parameters(model.parameters.with_values(values)), drives=True)
        return np.array([read_joint_law(carried, joint) for joint in robot.driven])

    zero = read(np.zeros(len(names)))
    slopes = np.array([read(row) - zero for row in np.eye(len(names))[own]])
    laws = zero + np.tensordot(samples[:, own], slopes, axes=1)
    coulomb, viscous, offset, armature, gain = np.moveaxis(laws, 2, 0)
    return {
        "joints": np.array(robot.driven), "frictionloss": coulomb, "damping": viscous, "offset": offset,
        "armature": armature, "gain": gain,
    }  # fmt: skip


_HEAD = '''\
"""Samples of one robot for training. {about}

Each row of the table is one robot; draw rows, not numbers. Friction and drive inertia below zero count as zero.
"""

from pathlib import Path

import numpy as np

TABLE = dict(np.load(Path(__file__).with_name({file!r}), allow_pickle=False))
BODIES, JOINTS = TABLE["bodies"].tolist(), TABLE["joints"].tolist()
N_SAMPLES = len(TABLE["mass"])
DRIVES = {{name: np.maximum(TABLE[name], 0.0) for name in ("armature", "damping", "frictionloss")}}


def set_sample(model, k):
    """Put sample k into a `mujoco.MjModel` of what `tau-dyn export --to mjcf` wrote."""
    import mujoco

    for i, name in enumerate(BODIES):
        body = model.body(name)
        body.mass[:], body.ipos[:] = TABLE["mass"][k, i], TABLE["centre"][k, i]
        body.inertia[:], body.iquat[:] = TABLE["moments"][k, i], TABLE["axes"][k, i]
    for i, name in enumerate(JOINTS):
        dof = int(model.joint(name).dofadr[0])
        model.dof_armature[dof] = DRIVES["armature"][k, i]
        model.dof_damping.reshape(model.nv, -1)[dof, 0] = DRIVES["damping"][k, i]
        model.dof_frictionloss[dof] = DRIVES["frictionloss"][k, i]
        motor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name + "_motor")
        if motor >= 0:
            model.actuator_biastype[motor] = mujoco.mjtBias.mjBIAS_AFFINE
            model.actuator_gainprm[motor, 0] = 1 / TABLE["gain"][k, i]
            model.actuator_biasprm[motor, 0] = -TABLE["offset"][k, i]
    mujoco.mj_setConst(model, mujoco.MjData(model))
'''

_EVENTS = {
    "playground": '''

def domain_randomize(model, rng):
    """Return an `mjx.Model` with a sample a key, and its axes, as `randomization_fn` of MuJoCo Playground is called."""
    import jax
    import jax.numpy as jnp
    import mujoco
    from mujoco import mjx

    bodies = np.array([mjx.name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in BODIES])
    joints = [mjx.name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in JOINTS]
    dofs = np.array([int(model.jnt_dofadr[joint]) for joint in joints])
    rows = jax.vmap(lambda key: jax.random.randint(key, (), 0, N_SAMPLES))(rng)
    places = {
        "body_mass": (bodies, TABLE["mass"]), "body_ipos": (bodies, TABLE["centre"]), "body_inertia": (bodies, TABLE["moments"]),
        "body_iquat": (bodies, TABLE["axes"]), "dof_armature": (dofs, DRIVES["armature"]),
        "dof_damping": (dofs, DRIVES["damping"]), "dof_frictionloss": (dofs, DRIVES["frictionloss"]),
    }
    changed = {
        field: jax.vmap(lambda row, f=field, i=index, x=jnp.asarray(table): getattr(model, f).at[i].set(x[row]))(rows)
        for field, (index, table) in places.items()
    }
    axes = jax.tree_util.tree_map(lambda x: None, model).tree_replace(dict.fromkeys(changed, 0))
    return model.tree_replace(changed), axes
''',
    "mjlab": '''

from mjlab.managers.event_manager import RecomputeLevel, requires_model_fields  # noqa: E402

FIELDS = (
    "body_mass", "body_ipos", "body_inertia", "body_iquat", "dof_armature", "dof_damping", "dof_frictionloss",
)


@requires_model_fields(*FIELDS, recompute=RecomputeLevel.set_const)
def randomize(env, env_ids, prefix="robot/"):
    """Give each world a sample: `EventTermCfg(func=randomize, mode="reset")`; prefix is the entity's name in the scene."""
    import mujoco
    import torch

    device, names = env.device, env.sim.mj_model
    ids = torch.arange(env.num_envs, device=device) if env_ids is None else env_ids
    rows = np.random.default_rng(int(torch.randint(2**31, (1,)))).integers(N_SAMPLES, size=len(ids))
    bodies = [mujoco.mj_name2id(names, mujoco.mjtObj.mjOBJ_BODY, prefix + name) for name in BODIES]
    joints = [mujoco.mj_name2id(names, mujoco.mjtObj.mjOBJ_JOINT, prefix + name) for name in JOINTS]
    dofs = [int(names.jnt_dofadr[joint]) for joint in joints]
    tables = (TABLE["mass"], TABLE["centre"], TABLE["moments"], TABLE["axes"], *(DRIVES[x[4:]] for x in FIELDS[4:]))
    for field, table in zip(FIELDS, tables, strict=True):
        index = torch.tensor(bodies if field.startswith("body") else dofs, device=device)
        values = torch.as_tensor(table[rows], dtype=torch.float32, device=device)
        getattr(env.sim.model, field)[ids[:, None], index] = values
''',
    "isaaclab": '''

def randomize(env, env_ids, asset_name="robot"):
    """Give each environment a sample: `EventTermCfg(func=randomize, mode="reset")`, of an articulation that `--to urdf` wrote."""
    import torch

    asset = env.scene[asset_name]
    ids = torch.arange(env.scene.num_envs) if env_ids is None else env_ids.cpu()
    rows = np.random.default_rng(int(torch.randint(2**31, (1,)))).integers(N_SAMPLES, size=len(ids))
    bodies, joints = torch.tensor([asset.body_names.index(n) for n in BODIES]), [asset.joint_names.index(n) for n in JOINTS]
    view, place = asset.root_physx_view, (ids[:, None], bodies)
    masses, inertias, centres = view.get_masses().clone(), view.get_inertias().clone(), view.get_coms().clone()
    masses[place] = torch.as_tensor(TABLE["mass"][rows], dtype=masses.dtype)
    inertias[place] = torch.diag_embed(torch.as_tensor(TABLE["moments"][rows], dtype=inertias.dtype)).flatten(-2)
    pose = np.concatenate([TABLE["centre"][rows], TABLE["axes"][rows][..., [1, 2, 3, 0]]], axis=-1)  # x y z w
    centres[place] = torch.as_tensor(pose, dtype=centres.dtype)
    view.set_masses(masses, ids)
    view.set_inertias(inertias, ids)
    view.set_coms(centres, ids)
    device = ids.to(asset.device)
    drives = {n: torch.as_tensor(x[rows], dtype=torch.float32, device=asset.device) for n, x in DRIVES.items()}
    asset.write_joint_armature_to_sim(drives["armature"], joint_ids=joints, env_ids=device)
    asset.write_joint_friction_coefficient_to_sim(
        drives["frictionloss"], drives["frictionloss"], drives["damping"], joint_ids=joints, env_ids=device
    )
''',
}
