"""Samples in a trainer's files: each row, put into MuJoCo, has the forces of its own model."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from tau_dyn.cli import main
from tau_dyn.effects import build_friction_model
from tau_dyn.exceptions import InputError
from tau_dyn.exchange import build_randomisation, read_samples
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

mujoco = pytest.importorskip("mujoco", reason="the files' values are read back with MuJoCo (pip install mujoco)")


@pytest.fixture(scope="module")
def model() -> Model:
    """A six-axis arm whose friction differs by direction."""
    robot = load_robot("ur5")
    made = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    return made.with_values({p.name: 3.0 + (p.name.endswith("_pos")) for p in made.effect_parameters})


@pytest.fixture(scope="module")
def samples(model) -> np.ndarray:
    """Three robots: bodies scaled as wholes, which stay consistent, and other friction."""
    rows, rng = [], np.random.default_rng(0)
    for _ in range(3):
        values = {name: p * x for link in model.robot.links for x in [rng.uniform(0.8, 1.2)]
                  for name, p in zip(link.names, model.parameters.select(link.names).values, strict=True)}  # fmt: skip
        values |= {p.name: p.value * rng.uniform(0.5, 1.5) for p in model.effect_parameters}
        values |= {f"{j}.armature": rng.uniform(0.1, 0.2) for j in model.robot.actuated}
        rows.append(model.parameters.with_values(values).values)
    return np.array(rows)


def load(folder: Path, name: str):
    """Return a written module."""
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def written(model, samples, tmp_path_factory) -> Path:
    """The folder with model, samples, MJCF and a trainer's files, as the command line writes them."""
    folder = tmp_path_factory.mktemp("trainer")
    model.save(folder / "m.yaml")
    import pandas as pd

    pd.DataFrame(samples, columns=list(model.parameters.names)).to_parquet(folder / "s.parquet")
    assert main(["export", str(folder / "m.yaml"), "--to", "mjcf", "--out", str(folder / "arm.xml"), "--quiet"]) == 0
    words = ["--samples", str(folder / "s.parquet"), "--out", str(folder / "arm.py"), "--quiet"]
    assert main(["export", str(folder / "m.yaml"), "--to", "playground", *words]) == 0
    return folder


def test_a_row_in_mujoco_has_the_forces_of_its_own_model(written, model, samples) -> None:
    """Inverse dynamics of MuJoCo at rest friction apart agrees with the sample's rigid body to 1e-9, for each row."""
    module = load(written, "arm")
    plant = mujoco.MjModel.from_xml_path(str(written / "arm.xml"))
    rng = np.random.default_rng(1)
    for k, row in enumerate(samples):
        module.set_sample(plant, k)
        one = model.with_parameters(model.parameters.with_values(row))
        q, v, a = rng.normal(size=(3, 1, 6))
        data = mujoco.MjData(plant)
        data.qpos[:], data.qvel[:], data.qacc[:] = q[0], v[0], a[0]
        plant.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        mujoco.mj_inverse(plant, data)
        viscous = np.mean(
            [[one.parameters[f"{j}.viscous_{s}"].value for j in model.robot.actuated] for s in ("pos", "neg")], axis=0
        )
        wanted = one.mechanism.inverse_dynamics(q, v, a)[0] + viscous * v[0]
        assert data.qfrc_inverse == pytest.approx(wanted, rel=1e-9, abs=1e-9)


def test_friction_of_a_row_stands_at_its_joint_and_motor(written, model, samples) -> None:
    """Coulomb friction is the mean of both directions, half their difference the motor's constant force."""
    module = load(written, "arm")
    plant = mujoco.MjModel.from_xml_path(str(written / "arm.xml"))
    module.set_sample(plant, 2)
    values = dict(zip(model.parameters.names, samples[2], strict=True))
    for joint in model.robot.actuated:
        pos, neg = values[f"{joint}.coulomb_pos"], values[f"{joint}.coulomb_neg"]
        dof = int(plant.joint(joint).dofadr[0])
        assert plant.dof_frictionloss[dof] == pytest.approx((pos + neg) / 2)
        assert plant.actuator(f"{joint}_motor").biasprm[0] == pytest.approx(-(pos - neg) / 2)


@pytest.mark.parametrize("target", ["mjlab", "isaaclab", "playground"])
def test_every_trainers_module_is_python(model, samples, target) -> None:
    """Each target's module compiles; its table has a row a sample."""
    made = build_randomisation(model, samples, target, "t.npz")
    compile(made.module, "made.py", "exec")
    assert made.n_samples == 3


def test_samples_of_another_model_are_refused(model, written, tmp_path, capsys) -> None:
    """A table with other columns, one that is missing, and a target without samples are the input's fault."""
    (tmp_path / "s.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="but not of both"):
        read_samples(tmp_path / "s.csv", model)
    with pytest.raises(InputError, match="does not exist"):
        read_samples(tmp_path / "none.csv", model)
    assert main(["export", str(written / "m.yaml"), "--to", "playground", "--out", str(tmp_path / "x.py")]) == 2
    assert "--samples" in capsys.readouterr().err
    words = ["--to", "urdf", "--samples", str(written / "s.parquet"), "--out", str(tmp_path / "x.urdf")]
    assert main(["export", str(written / "m.yaml"), *words]) == 2
