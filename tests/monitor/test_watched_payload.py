"""A body that is gripped beside the tool frame is a payload, and no joint's encoder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tau_dyn.effects import build_friction_model
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.monitor import WatchResult, watch_logs
from tau_dyn.robot import load_robot
from tau_dyn.simulate import build_fourier_motion

JOINTS = ("shoulder", "elbow", "wrist")
AT = 85.0  # [s] of the change
LOAD_KG = 1.0
BESIDE_M = np.array([-0.2, 0.2, 0.1])


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Model:
    """An arm of three hinges about different axes, with friction."""
    parts, parent = ['<robot name="arm"><link name="base_link"/>'], "base_link"
    axes, masses = ("0 1 0", "0 1 0", "1 0 0"), (4.0, 3.0, 1.0)
    for joint, axis, mass in zip(JOINTS, axes, masses, strict=True):
        parts.append(
            f'<link name="{joint}_link"><inertial><origin xyz="0.2 0 0"/><mass value="{mass}"/>'
            '<inertia ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.03"/></inertial></link>'
            f'<joint name="{joint}" type="revolute"><parent link="{parent}"/><child link="{joint}_link"/>'
            f'<axis xyz="{axis}"/><origin xyz="0.4 0 0"/><limit lower="-2" upper="2" velocity="1" effort="900"/></joint>'
            f'<transmission name="{joint}_drive"><type>transmission_interface/SimpleTransmission</type>'
            f'<joint name="{joint}"/><actuator name="{joint}_motor"/></transmission>'
        )
        parent = f"{joint}_link"
    path: Path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text("\n".join([*parts, "</robot>"]))
    robot = load_robot(path)
    plain = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    return plain.with_values({p.name: 1.5 if "coulomb" in p.name else 1.0 for p in plain.effect_parameters})


def watch(model: Model, place: np.ndarray, zero: dict[str, float]) -> WatchResult:
    """Watch 130 s in which, after 85 s, a body of 1 kg is gripped at a place of the wrist's frame, and encoders are turned."""
    robot = model.robot
    motion = build_fourier_motion(model, 130.0, 7).every(8)
    added = LOAD_KG * np.array([1.0, *place])
    x, y, z = place
    inertia = {
        "ixx": y * y + z * z,
        "iyy": x * x + z * z,
        "izz": x * x + y * y,
        "ixy": -x * y,
        "ixz": -x * z,
        "iyz": -y * z,
    }
    names = [f"wrist_link.{part}" for part in ("mass", "mx", "my", "mz")]
    values = {n: robot.parameters[n].value + float(d) for n, d in zip(names, added, strict=True)}
    values |= {f"wrist_link.{k}": robot.parameters[f"wrist_link.{k}"].value + LOAD_KG * v for k, v in inertia.items()}
    normal, loaded = (m.torque(motion.q, motion.v, motion.a) for m in (model, model.with_values(values)))
    later = (motion.t >= AT)[:, None]
    tau = np.where(later, loaded, normal)
    tau = tau + 0.05 * np.random.default_rng(0).standard_normal(tau.shape)
    q = motion.q + later * [zero.get(j, 0.0) for j in JOINTS]
    columns = {f"q_{j}": q[:, k] for k, j in enumerate(JOINTS)} | {f"tau_{j}": tau[:, k] for k, j in enumerate(JOINTS)}
    return watch_logs(model, [Log(motion.t, columns, "log.csv")])


def test_a_body_beside_the_tool_is_a_payload_of_its_mass(model: Model) -> None:
    """Its force along the motion looks more like a turned wrist than like a point mass at the tool frame."""
    found = watch(model, BESIDE_M, {})
    (row,) = found.rows()
    assert (row["what"], row["unit"]) == ("payload", "kg")
    assert row["size"] == pytest.approx(LOAD_KG, rel=0.02), "0.67 kg by its force at the tool frame alone"
    assert row["ci95"][0] < LOAD_KG < row["ci95"][1]
    assert [d["what"] for d in found.to_dict()["watched_for"]].count("payload") == 1


def test_a_tool_and_an_encoder_that_change_at_once_are_both_named(model: Model) -> None:
    """A tool change in which the elbow's encoder is turned by 20 mrad: logged positions are 20 mrad larger.

    The turned elbow's force is that of the loaded arm, 1.4 times the unloaded arm's, so the zero is suspected and its size rough.
    """
    found = watch(model, np.zeros(3), {"elbow": 0.02})
    rows = {(row["what"], row["joint"]): row for row in found.rows()}
    assert set(rows) == {("payload", None), ("encoder_offset", "elbow")}
    assert rows["payload", None]["size"] == pytest.approx(LOAD_KG, rel=0.03)
    assert rows["encoder_offset", "elbow"]["size"] == pytest.approx(-0.02, rel=0.5)
    assert {f.cause: f.status for f in found.findings} == {"payload": "parameter", "joint_zero": "suspected"}
