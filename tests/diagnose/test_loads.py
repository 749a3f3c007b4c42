"""A body that one log carries at the tool and the others do not, by torques of Pinocchio and by columns given outright."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from tau_dyn.diagnose import diagnose
from tau_dyn.diagnose.force_baseline import fit_baseline
from tau_dyn.diagnose.loads import Load, LoadReport, find_loads
from tau_dyn.estimate import Autoregression, RegressionRun
from tau_dyn.evidence import (
    TEST,
    TRAIN,
    CampaignChange,
    CampaignChannel,
    Diagnosis,
    Finding,
    Gain,
    OutputErrors,
    Step,
    divide_every_log,
    explain_misfit,
    select_campaign_changes,
)
from tau_dyn.identify import build_model, identify
from tau_dyn.log import Log
from tau_dyn.message_codes import get_code
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import Robot, load_robot

LOAD_KG, CENTRE_M = 0.6, np.array([0.3, 0.02, 0.0])
JOINTS = ("shoulder", "elbow")
WHITE = (Autoregression(np.zeros(0), 1.0),)
N = 1500


def build_campaigns(load: float = 0.0, friction: float = 0.0, scale: float = 0.0, seed: int = 0) -> tuple:
    """Return a channel of three logs of a lever with gravity, inertia and friction, and its kinds; the third log differs."""
    rng = np.random.default_rng(seed)
    runs, bodies, drags, forces = [], [], [], []
    t = np.arange(N) / 50.0
    for k in range(3):
        phase = rng.uniform(0, 6, 5)
        w = 2 * np.pi * np.array([0.1, 0.23, 0.4, 0.61, 0.9])
        q, v, a = (
            f(np.outer(t, w) + phase) @ (w**n / w) * s for f, n, s in ((np.sin, 0, 1), (np.cos, 1, 1), (np.sin, 2, -1))
        )
        q = 3 * q
        body = np.column_stack([np.cos(q), np.sin(q), a])
        W = np.column_stack([body, np.sign(v), v])
        own = 5.0 * body @ np.array([4.0, 0.5, 1.0])
        y = own + 3.0 * np.sign(v) + 2.0 * v + rng.standard_normal(N)
        if k == 2:
            y = y + load * body @ np.array([1.0, 0.1, 0.3]) + friction * np.sign(v) + scale * own
        columns, y = W[:, None, :], y[:, None]
        runs.append(RegressionRun(f"log{k}", t, columns, y, np.ones((N, 1), bool), columns, y))
        bodies.append(body[:, None, :])
        drags.append(columns[:, :, 3:])
        forces.append(own[:, None, None])
    parameters = Parameters(Parameter(name, 0.0, "1") for name in ("c", "s", "a", "coulomb", "viscous"))
    parts = tuple(np.where(np.arange(N) // 150 % 4 == 3, TEST, TRAIN) for _ in runs)
    channel = CampaignChannel("force", ("lever",), ("N m",), parameters, tuple(runs), parts)
    return channel, {"payload": bodies, "friction": drags, "force": forces, "bodies": bodies}


def select(seed: int = 0, **differences: float) -> list[CampaignChange]:
    """Return the changes between the three logs."""
    channel, kinds = build_campaigns(**differences, seed=seed)
    logs = [run.name for run in channel.runs]
    return select_campaign_changes(channel, WHITE, kinds, logs, likelier="payload", companions=["friction"])


def test_a_load_of_one_log_is_found_in_that_log_alone() -> None:
    """Gravity, inertia and their phase change together as one body makes them."""
    (found,) = select(load=1.0)
    assert (found.kind, found.log, found.explains) == ("payload", "log2", True)
    assert found.p_value < 1e-6


def test_equal_logs_carry_nothing() -> None:
    """Noise alone makes a difference between twenty triples of logs less than once in a hundred of them."""
    assert sum(bool(select(seed=seed)) for seed in range(20)) <= 1


def test_friction_that_changes_with_the_load_does_not_count_against_it() -> None:
    """Gears under load rub more; both changes are in the same log, and friction alone is no load."""
    found = {one.kind: one for one in select(load=1.0, friction=1.0)}
    assert set(found) == {"payload", "friction"} and found["payload"].explains
    assert [one.kind for one in select(friction=1.0)] == ["friction"]


def test_a_part_of_every_log_is_set_aside() -> None:
    """A load of a training log is confirmed on that log, whatever is held out."""
    channel, _ = build_campaigns()
    whole = tuple(np.full(N, part) for part in (TRAIN, TRAIN, TEST))
    parts = divide_every_log(CampaignChannel(**{**vars(channel), "parts": whole}), 0.1)
    for part in parts[:2]:
        assert 0.15 < np.mean(part == TEST) < 0.3 and np.any(part == TRAIN)


@pytest.mark.parametrize(
    ("missed", "taken_off", "is_doubted"), [(0.95, 0.06, True), (0.95, 0.97, False), (0.1, 0.06, False)]
)
def test_a_model_that_misses_the_force_claims_no_small_load(missed: float, taken_off: float, is_doubted: bool) -> None:
    """6 % of the force beside 95 % that is missed is chance; beside 10 %, or if it is as large, it counts."""
    channel, _ = build_campaigns()
    y = np.concatenate([run.y[part == TEST] for run, part in zip(channel.runs, channel.parts, strict=True)])
    after = missed * float(np.sqrt(np.mean(y**2)))
    before = float(np.hypot(after, taken_off * after / missed))
    why = explain_misfit(channel, [run.name for run in channel.runs], Gain(before, after, 0.0, (0.0, 0.0)))
    assert bool(why) is is_doubted
    assert not why or f"misses {100 * missed:.0f} %" in why


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> Robot:
    """An arm of two hinges in a vertical plane."""
    parts, parent = ['<robot name="arm"><link name="base_link"/>'], "base_link"
    for joint, place, mass in zip(JOINTS, ("0 0 0.5", "0.4 0 0"), (3.0, 2.0), strict=True):
        parts.append(
            f'<link name="{joint}_link"><inertial><origin xyz="0.2 0 0"/><mass value="{mass}"/>'
            '<inertia ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.03"/></inertial></link>'
            f'<joint name="{joint}" type="revolute"><parent link="{parent}"/><child link="{joint}_link"/>'
            f'<axis xyz="0 1 0"/><origin xyz="{place}"/><limit lower="-3" upper="3" velocity="9" effort="900"/></joint>'
            f'<transmission name="{joint}_drive"><type>transmission_interface/SimpleTransmission</type>'
            f'<joint name="{joint}"/><actuator name="{joint}_motor"/></transmission>'
        )
        parent = f"{joint}_link"
    path: Path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text("\n".join([*parts, "</robot>"]))
    return load_robot(path)


def record(robot: Robot, seed: int, load: float = 0.0, cable: float = 0.0) -> Log:
    """Return 20 s with Pinocchio's torques, friction and noise; a load [kg] is at the tool, a cable [kg] on the first link."""
    rng, model = np.random.default_rng(seed), pin.Model(robot.model)
    if cable:
        model.inertias[1] = model.inertias[1] + pin.Inertia(cable, np.array([0.2, 0.0, 0.0]), 1e-5 * np.eye(3))
    if load:
        model.inertias[2] = model.inertias[2] + pin.Inertia(load, CENTRE_M, 1e-3 * load * np.eye(3))
    t = np.arange(0, 20, 0.01)
    w = 2 * np.pi * np.array([0.11, 0.2, 0.37, 0.53, 0.8])
    q, v, a = np.zeros((3, len(t), 2))
    for k in range(2):
        phase, size = np.outer(t, w) + rng.uniform(0, 6, 5), rng.uniform(0.3, 0.8, 5) / w
        q[:, k], v[:, k], a[:, k] = np.sin(phase) @ size, np.cos(phase) @ (size * w), -np.sin(phase) @ (size * w**2)
    data = model.createData()
    tau = np.array([pin.rnea(model, data, *row).copy() for row in zip(q, v, a, strict=True)])
    tau += np.sign(v) + 0.5 * v + 0.05 * rng.standard_normal(q.shape)
    columns = {f"q_{j}": q[:, k] + 2e-6 * rng.standard_normal(len(t)) for k, j in enumerate(JOINTS)}
    return Log(t, columns | {f"tau_{j}": tau[:, k] for k, j in enumerate(JOINTS)}, f"log{seed}.csv")


def find(robot: Robot, train: Sequence[Log], held: Sequence[Log] = ()) -> dict[tuple[str, ...], float]:
    """Return the mass that each group of logs carries, all of them confirmed."""
    case = fit_baseline(build_model(robot, "asymmetric"), list(train), list(held), None, (), lambda step: None)
    found = find_loads(case, case.channel, (), np.random.default_rng(0))
    assert all(one.is_confirmed for one in found)
    return {one.logs: one.finding.parameters[0].value for one in found}


def test_the_lightest_logs_are_the_reference(robot) -> None:
    """Nothing fixes the absolute load, so the body is where more is carried, in whichever log that is."""
    assert find(robot, [record(robot, 0, LOAD_KG), record(robot, 1)]) == {("log0.csv",): approx(LOAD_KG)}
    both = find(robot, [record(robot, 0, LOAD_KG), record(robot, 1), record(robot, 2, LOAD_KG)])
    assert both == {("log0.csv", "log2.csv"): approx(LOAD_KG)}


def test_a_held_out_log_may_carry_the_load(robot) -> None:
    """Held-out logs are campaigns as training logs are."""
    logs = [record(robot, 0), record(robot, 1), record(robot, 2, LOAD_KG)]
    assert find(robot, logs[:2], logs[2:]) == {("log2.csv",): approx(LOAD_KG)}


def test_a_load_is_found_in_a_log_in_which_another_body_changes_a_little(robot) -> None:
    """A cable of 120 g that hangs from the first link in the same log does not take up a load of 600 g at the tool."""
    logs = [record(robot, 0), record(robot, 1), record(robot, 2, LOAD_KG, cable=0.12)]
    assert find(robot, logs[:2], logs[2:]) == {("log2.csv",): pytest.approx(LOAD_KG, abs=0.08)}


def test_equal_logs_and_a_wrong_force_scale_are_no_load(robot) -> None:
    """A torque constant that changes at one joint, or at both alike, fits no body at the tool."""
    logs = [record(robot, k) for k in range(3)]
    assert find(robot, logs[:2], logs[2:]) == {}
    for joints in (JOINTS[1:], JOINTS):
        wrong = logs[1].with_channels(**{f"tau_{j}": 1.1 * logs[1].channels[f"tau_{j}"] for j in joints})
        assert find(robot, [logs[0], wrong], logs[2:]) == {}


def approx(mass: float):
    """Return a comparison to 1 %."""
    return pytest.approx(mass, rel=0.01)


def check(found: Diagnosis, log: str) -> None:
    """Check that one finding names the log, the mass and the place, and that no other body changed."""
    (payload,) = [f for f in found.findings if f.cause == "payload"]
    assert (payload.status, payload.logs) == ("confirmed", (log,))
    values = {p.name: p for p in payload.parameters}
    for name, truth in (("mass", LOAD_KG), ("centre_x", CENTRE_M[0])):
        p = values[f"payload.{name}"]
        assert p.stderr is not None and abs(p.value - truth) < 4 * p.stderr < 0.1 * abs(truth)
    assert payload.gain is not None and payload.gain.ci95[0] > 50
    assert not [f for f in found.findings if f.status == "parameter"]
    assert log in found.sentence and "load_changed" in [get_code(w) for w in found.warnings]
    assert found.to_dict()["findings"][0]["logs"] == [log]


def test_a_load_in_one_of_three_logs_is_named_with_its_mass(robot) -> None:
    """The baseline carries it in that log, and no other body changes."""
    logs = [record(robot, 0), record(robot, 1, LOAD_KG), record(robot, 2)]
    check(diagnose(robot, logs[:2], holdout=logs[2:]), "log1.csv")


def test_a_load_against_a_model_file_is_named_and_no_link_changes(robot, tmp_path) -> None:
    """Values that two logs identified are the reference of a third one."""
    path = tmp_path / "model.yaml"
    identify(robot, [record(robot, 0), record(robot, 1)]).model.save(path)
    check(diagnose(robot, [record(robot, 3, LOAD_KG)], model=path), "log3.csv")


def make_load(status: str) -> Load:
    """Return a load of 1 kg in one log."""
    finding = Finding("payload", ("hand",), status, 1.0, 1e-9, (), None, (), "", "", logs=("log2",))  # type: ignore[arg-type]
    return Load(("log2",), np.zeros(10), False, finding)


def test_the_step_of_a_load_is_between_the_refit_without_it_and_the_causes() -> None:
    """A confirmed load has a step of its own; the refit that carries it is the step before the causes."""
    without, carried, extended = (OutputErrors(("lever",), np.array([x]), np.zeros((1, 2)), x) for x in (3.0, 2.0, 1.0))
    steps = [Step("nominal", without), Step("refitted", carried), Step("stribeck lever", extended)]
    found = LoadReport.of([make_load("confirmed"), make_load("suspected")], without)
    assert [f.status for f in found.findings] == ["confirmed", "suspected"]
    assert [(s.step, s.errors) for s in found.insert_step(steps)] == [
        ("nominal", without),
        ("refitted", without),
        ("payload log2", carried),
        ("stribeck lever", extended),
    ]


def test_without_an_accepted_load_all_are_suspected() -> None:
    """A load that no refit carries changes neither the waterfall nor the verdict."""
    found = LoadReport.of([make_load("confirmed")], None)
    assert found.confirmed == () and found.findings[0].status == "suspected"
    assert found.insert_step([]) == ()
