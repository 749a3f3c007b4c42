"""A payload that Pinocchio puts on an arm, or a mass on a plate, comes back; two equal runs carry nothing."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
import pytest
from rich.console import Console

from tau_dyn.cli import main
from tau_dyn.effects import build_friction_model
from tau_dyn.exceptions import CannotAnswer, InputError, TauDynError, UnknownName
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.monitor import identify_payload
from tau_dyn.monitor.drive_gains import _find_basis, compare_drives
from tau_dyn.render import build_page, print_result
from tau_dyn.robot import INERTIAL, Robot, load_robot
from tau_dyn.simulate import build_fourier_motion

GANTRY = load_robot("gantry_tau")
MASS, CENTRE = 0.8, np.array([0.03, -0.02, 0.08])  # [kg], [m] in the last joint's frame
LINKS = (("turn", "0 0 1", "0 0 0.3", 4.0), ("lift", "0 1 0", "0 0.1 0.1", 3.0), ("roll", "1 0 0", "0.4 0 0", 1.5))


def build(robot: Robot) -> Model:
    """Return a robot with friction of 2 N m, 1 N m/(rad/s); ten times as much where it slides."""
    model = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    size = 10.0 if robot.force_units[0] == "N" else 1.0
    return model.with_values({p.name: size * (2.0 if "coulomb" in p.name else 1.0) for p in model.effect_parameters})


def record(model: Model, tau_of, seed: int, name: str, seconds: float = 20.0, noise: float = 0.1) -> Log:
    """Return a log along a Fourier motion, with forces from a function of it and white noise."""
    motion = build_fourier_motion(model, seconds, seed).every(4)
    tau = tau_of(motion) + noise * np.random.default_rng(seed).standard_normal(motion.q.shape)
    joints = model.robot.actuated
    columns = {f"q_{j}": motion.q[:, k] for k, j in enumerate(joints)} | {
        f"tau_{j}": tau[:, k] for k, j in enumerate(joints)
    }
    return Log(motion.t, columns, name)


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> Model:
    """An arm of three hinges whose tool is turned and shifted against the last joint."""
    parts, parent = ['<robot name="arm" xmlns:drake="http://drake.mit.edu"><link name="base_link"/>'], "base_link"
    for joint, axis, place, mass in LINKS:
        parts.append(
            f'<link name="{joint}_link"><inertial><origin xyz="0.1 0.02 0.03"/><mass value="{mass}"/>'
            '<inertia ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.03"/></inertial></link>'
            f'<joint name="{joint}" type="revolute"><parent link="{parent}"/><child link="{joint}_link"/>'
            f'<axis xyz="{axis}"/><origin xyz="{place}"/><limit lower="-3" upper="3" velocity="4" effort="900"/></joint>'
            f'<transmission name="{joint}_drive"><type>transmission_interface/SimpleTransmission</type>'
            f'<joint name="{joint}"/><actuator name="{joint}_motor"/></transmission>'
        )
        parent = f"{joint}_link"
    parts.append(
        '<link name="tool"/><joint name="tool_mount" type="fixed"><parent link="roll_link"/><child link="tool"/>'
        '<origin xyz="0.1 0 0.05" rpy="0 0 1.5707963267948966"/></joint></robot>'
    )
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text("\n".join(parts))
    return build(load_robot(path))


def carry(model: Model, mass: float):
    """Return the forces of an arm with a payload, by Pinocchio's recursive Newton-Euler."""
    tree = pin.Model(model.robot.model)
    if mass:
        tree.inertias[3] = tree.inertias[3] + pin.Inertia(mass, CENTRE, 4e-3 * mass * np.eye(3))
    data = tree.createData()

    def tau_of(motion):
        rigid = [pin.rnea(tree, data, *row) for row in zip(motion.q, motion.v, motion.a, strict=True)]
        return np.array(rigid) + model.effect_force(model.motion(motion.q, motion.v, motion.a))

    return tau_of


def test_joints_with_two_force_scales_disagree_about_a_payload(arm) -> None:
    """Where one joint's column is 26 % too large, its payload is as much heavier than the others', and that is a warning."""
    logs = [record(arm, carry(arm, m), k, f"{k}.csv") for k, m in enumerate((0.0, MASS))]
    wrong = [log.with_channels(tau_lift=1.26 * log.channels["tau_lift"]) for log in logs]
    found, sound = (identify_payload(arm.robot, pair[:1], pair[1:]) for pair in (wrong, logs))
    gains = compare_drives(found.estimate, tuple(f"payload.{quantity}" for quantity in INERTIAL))
    assert gains is not None
    factor = dict(zip(gains.joints, gains.factors, strict=True))
    assert abs(factor["lift"] / factor["turn"] - 1.26) < 0.1 if "turn" in factor else "lift" in factor
    assert [w.code for w in found.warnings if getattr(w, "code", "") == "scale_wrong"] == ["scale_wrong"]
    assert not [w for w in sound.warnings if getattr(w, "code", "") == "scale_wrong"]
    assert [f.status for one in (found, sound) for f in one.findings] == ["suspected", "parameter"]


def test_mass_and_centre_come_back_in_the_tool_frame(arm) -> None:
    """20 s without and 20 s with a payload tell its mass to 3 % and its centre, seen from the tool."""
    logs = [record(arm, carry(arm, m), k, f"{k}.csv") for k, m in enumerate((0.0, MASS))]
    found = identify_payload(arm.robot, logs[:1], logs[1:])
    assert found.frame == "tool" and found.link == "roll_link"
    assert found.differs and found.p_value < 1e-6 and found.mass.determined
    (finding,) = found.findings
    assert (finding.cause, finding.joints, finding.status) == ("payload", ("roll_link",), "parameter")
    assert finding.parameters[0].value == found.mass.values[0] and finding.logs == ("1.csv",)
    assert abs(found.mass.values[0] - MASS) < min(4 * found.mass.stderr[0], 0.03 * MASS)
    turned = pin.rpy.rpyToMatrix(0, 0, np.pi / 2).T @ (CENTRE - np.array([0.1, 0, 0.05]))
    told = np.isfinite(found.centre.stderr)
    assert told.any() and np.all(np.abs(found.centre.values - turned)[told] < 4 * found.centre.stderr[told])
    stream = io.StringIO()
    print_result(Console(file=stream, width=90), found)
    assert "In the frame of tool; inertia about the centre." in stream.getvalue()
    assert "<span></span>" not in build_page(found)  # no pill without words


def test_two_equal_runs_carry_nothing(arm) -> None:
    """The same arm twice carries nothing, and the answer says how much could hide."""
    found = identify_payload(arm.robot, [record(arm, carry(arm, 0.0), 3, "a")], [record(arm, carry(arm, 0.0), 4, "b")])
    assert (
        not found.differs
        and not found.findings
        and found.largest_mass < MASS / 2
        and not any(row.differs for row in found.friction)
    )


def test_exchanged_runs_give_no_payload(arm) -> None:
    """If the loaded logs weigh less, the answer states by how much and reports no payload as determined."""
    logs = [record(arm, carry(arm, m), k, f"{k}.csv") for k, m in enumerate((0.0, MASS))]
    found = identify_payload(arm.robot, logs[1:], logs[:1])
    stream = io.StringIO()
    print_result(Console(file=stream, width=90), found)
    text = " ".join(stream.getvalue().split())
    assert found.is_lighter and found.findings[0].status == "suspected"
    assert "lighter than the empty ones" in text and "so no payload is determined" in text and "kg more" not in text


def test_a_plate_that_never_turns_tells_the_mass_alone(tmp_path) -> None:
    """The L1's plate only shifts, so no motion tells where a mass sits on it; a model file is a robot, too."""
    model = build(GANTRY)
    heavy = model.with_values({"plate_link.mass": 9.63})
    files = []
    for k, one in enumerate((model, heavy)):
        files.append(str(tmp_path / f"{k}.csv"))
        record(one, lambda m, one=one: one.torque(m.q, m.v, m.a), k + 1, "", noise=1.0).to_csv(files[-1])
    model.save(tmp_path / "model.yaml")
    out, page = tmp_path / "r.json", tmp_path / "r.html"
    for robot in ("gantry_tau", str(tmp_path / "model.yaml")):
        command = ["payload", robot, files[0], "--loaded", files[1], "--json", str(out), "--report", str(page)]
        assert main([*command, "--quiet"]) == 0
        result = json.loads(out.read_text())
        mass = result["payload"]["mass"]
        assert result["status"] == "ok" and result["differ"] and mass["determined"]
        assert mass["ci95"][0] < mass["value"] < mass["ci95"][1] and abs(mass["value"] - 0.5) < 4 * mass["stderr"]
        assert result["payload"]["centre"]["value"] == [None] * 3 and not result["payload"]["inertia"]["determined"]
    assert "carries" in page.read_text()


def test_friction_that_follows_the_load_is_no_payload() -> None:
    """Coulomb friction 30 % higher in the loaded runs is told as friction, and the mass stays right."""
    model = build(GANTRY)
    rubbing = model.with_values({"cart2.coulomb_pos": 26.0, "cart2.coulomb_neg": 26.0, "plate_link.mass": 9.63})
    logs = [
        record(m, lambda x, m=m: m.torque(x.q, x.v, x.a), k + 1, str(k), noise=1.0)
        for k, m in enumerate((model, rubbing))
    ]
    found = identify_payload(GANTRY, logs[:1], logs[1:])
    assert [row.joint for row in found.friction if row.differs] == ["cart2"]
    assert abs(found.mass.values[0] - 0.5) < 4 * found.mass.stderr[0]
    assert any("friction of cart2" in sentence for sentence in found.warnings)


def test_noise_that_hides_the_mass_ends_with_the_motion_to_make() -> None:
    """Half a second of motion under heavy noise tells nothing; the refusal names joints and a length."""
    model = build(GANTRY)
    logs = [record(model, lambda x: model.torque(x.q, x.v, x.a), k, str(k), 4.0, 2000.0) for k in range(2)]
    with pytest.raises(CannotAnswer) as refused:
        identify_payload(GANTRY, logs[:1], logs[1:])
    assert "cart" in refused.value.experiment and "tau-dyn excite" in refused.value.experiment


@pytest.mark.parametrize(("factor", "code"), [(0.0, "poor_excitation"), (-1.0, "sign_reversed")])
def test_forces_that_were_not_measured_or_point_back_are_no_payload(arm, factor: float, code: str) -> None:
    """Empty logs whose forces are all zero, or all reversed, would make a load of the whole arm or of twice its weight."""
    empty, loaded = (
        record(arm, lambda m: arm.torque(m.q, m.v, m.a), seed, name) for seed, name in ((1, "empty"), (2, "loaded"))
    )
    spoilt = empty.with_channels(**{k: factor * x for k, x in empty.channels.items() if k.startswith("tau")})
    with pytest.raises(TauDynError) as fault:
        identify_payload(arm, [spoilt], [loaded])
    assert fault.value.code == code


def test_forces_of_all_joints_in_another_unit_weigh_nothing(arm) -> None:
    """Motor currents [A] make every mass smaller by the torque constant; one joint alone is compared with the others."""
    logs = [
        record(arm, carry(arm, mass), seed, name, noise=0.01)
        for seed, name, mass in ((1, "empty", 0), (2, "loaded", MASS))
    ]

    def scale(log: Log, factor: float, joints: Sequence[str]) -> Log:
        return log.with_channels(**{f"tau_{j}": factor * log.channels[f"tau_{j}"] for j in joints})

    with pytest.raises(InputError, match="torque constant") as fault:
        identify_payload(arm, *([scale(log, 0.08, arm.robot.actuated)] for log in logs))
    assert fault.value.code == "scale_wrong" and "[N m/A]" in str(fault.value)
    assert identify_payload(arm, *([scale(log, 0.97, ["roll"])] for log in logs)).mass.determined


def test_columns_of_rounding_size_are_no_combinations() -> None:
    """A column of 1e-16 next to one of 1 is the rounding of a dependent column; scaled to one it would look independent."""
    columns = np.random.default_rng(0).normal(size=(12, 3)) * [1.0, 1.0, 1e-16]
    assert _find_basis(columns).shape == (3, 2)


def test_what_is_no_pair_of_recordings_is_refused() -> None:
    """One log cannot be empty and loaded, both kinds are needed, and a link must exist."""
    model = build(GANTRY)
    log = record(model, lambda x: model.torque(x.q, x.v, x.a), 1, "a")
    with pytest.raises(InputError, match="two recordings"):
        identify_payload(GANTRY, [log], [log])
    with pytest.raises(InputError, match="--loaded"):
        identify_payload(GANTRY, [], [log])
    with pytest.raises(UnknownName, match="plate_link"):
        identify_payload(GANTRY, [log], [log], link="plate")
