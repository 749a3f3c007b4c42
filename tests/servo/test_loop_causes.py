"""Springs, delays and plays in a servo's loop are named with their numbers, and what is none is not called so."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import tau_dyn as td
from tau_dyn.effects import LOOP_CAUSES, build_friction_model, list_causes
from tau_dyn.evidence import Diagnosis
from tau_dyn.model import Model
from tau_dyn.servo import LoopIdentification, diagnose_loop, diagnosis, identify_loop, simulate_loop_log
from tau_dyn.simulate import SERVO_ENTRIES, ServoLaw, Trajectory

from .arms import build_arm, build_law, build_link, build_truth, record

ARM = build_arm(1)
TRUTH = build_truth(ARM)
NOTHING = {"load_friction": 0.0, "stiction": 0.0, "command_delay": 0.0}
LINK, RESONANCE_HZ = 0.06, 5.0
GAINS = {"position_gain": 1.0, "force_per_unit": 60.0, "derivative_gain": 0.03}


def record_chirp(**entries) -> td.Log:
    """Return a chirp of a joint at 500 Hz, 0.1 to 8 Hz over 20 s, its encoder on the motor."""
    robot = build_link(LINK)
    model = Model.of(robot, build_friction_model("symmetric", robot.actuated, robot.force_units))
    model = model.with_values({"j1.armature": 0.02, "j1.coulomb": 0.1, "j1.viscous": 0.05})
    t = np.arange(0, 20, 0.002)
    q = 0.3 * np.sin(2 * np.pi * (0.1 * t + 7.9 * t**2 / 40))
    v = np.gradient(q, t)
    motion = Trajectory(robot.actuated, t, q[:, None], v[:, None], np.gradient(v, t)[:, None])
    law = ServoLaw.of(robot.actuated, encoder="motor", **(GAINS | entries))
    return simulate_loop_log(model, law, motion, rate_hz=500.0, encoder_noise=1e-4, encoder_resolution=4e-4, seed=3)


@pytest.fixture(scope="module")
def spring():
    """Return the diagnosis of a joint behind a spring, whose torque is 6 ms late; neither is known."""
    turn = 2 * np.pi * RESONANCE_HZ
    log = record_chirp(joint_compliance=1 / (LINK * turn**2), joint_damping=0.06 * LINK * turn, torque_delay=0.006)
    robot = build_link(LINK)
    return diagnose_loop(robot, log, law=ServoLaw.of(robot.actuated, encoder="motor", **GAINS))


def test_a_spring_and_a_delay_are_told_apart(spring):
    """Both are confirmed, nothing else is, and the model with them is down to the encoder."""
    assert {f.cause for f in spring.findings if f.status == "confirmed"} == {"joint_compliance", "delay"}
    assert spring.extended.rms[0] < 1.3 * spring.noise_floor.rms[0] < 0.1 * spring.baseline.rms[0]
    assert spring.recommendation == "extended"
    assert len(spring.extended_model.provenance["trained_on"]) == 1


def test_a_resonance_and_a_delay_are_known(spring):
    """The resonance of the link on its spring is known to 1 %, the delay to 0.3 ms."""
    law = spring.extended_model.controller
    resonance = np.sqrt(1 / (law["joint_compliance"] * LINK)) / (2 * np.pi)
    assert resonance == pytest.approx(RESONANCE_HZ, rel=0.01)
    assert law["torque_delay"] == pytest.approx(0.006, abs=3e-4)


def test_a_delay_alone_is_no_spring():
    """A late torque is named as such, with its amount."""
    robot = build_link(LINK)
    answer = diagnose_loop(
        robot, record_chirp(torque_delay=0.006), law=ServoLaw.of(robot.actuated, encoder="motor", **GAINS)
    )
    assert [f.cause for f in answer.findings if f.status == "confirmed"] == ["delay"]


def test_a_play_is_named_with_its_width():
    """A motor that moves in a play of 30 mrad before its link does is told from a spring."""
    robot = build_link(LINK)
    answer = diagnose_loop(
        robot, record_chirp(backlash=0.03), law=ServoLaw.of(robot.actuated, encoder="motor", **GAINS)
    )
    best = answer.findings[0]
    assert (best.cause, best.status) == ("backlash", "confirmed")
    assert best.parameters[0].value == pytest.approx(0.03, rel=0.05)


def test_a_large_dead_band_is_told_from_coulomb_friction():
    """Errors up to 32 mrad without torque hold a resting joint as 0.25 N m of friction would, and do not brake a moving one."""
    arm = build_arm(1, mass=0.1)
    truth = build_truth(arm).with_values({"j1.armature": 0.006, "j1.coulomb": 0.04})
    laws = [build_law(arm, **(NOTHING | more)) for more in ({"dead_band": 0.032}, {})]
    answer = diagnose_loop(arm, [record(arm, truth, laws[0], seed, 30.0) for seed in (1, 2)], law=laws[1])
    (finding,) = answer.findings
    assert (finding.cause, finding.status) == ("dead_band", "confirmed")
    assert finding.parameters[0].value == pytest.approx(0.032, abs=1e-3)


@pytest.mark.parametrize("cause", ["carried_friction", "load_friction"])
def test_friction_by_the_load_is_told_from_friction_by_the_torque(cause):
    """A gear that rubs by what it carries, and one that rubs by the motor's torque, are named apart, each with its share."""
    arm = build_arm(1, mass=0.6)
    laws = [build_law(arm, **(NOTHING | more)) for more in ({cause: 0.4}, {})]
    answer = diagnose_loop(arm, [record(arm, build_truth(arm), laws[0], s, 30.0) for s in (1, 2)], law=laws[1])
    (finding,) = answer.findings
    assert (finding.cause, finding.status, finding.indistinguishable_from) == (cause, "confirmed", ())
    (share,) = finding.parameters
    assert abs(share.value - 0.4) < 3 * share.stderr < 0.08


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_droop_is_no_backlash(seed):
    """A proportional servo that yields to gravity and sticks, told 80 mrad and moved half of it, has no play."""
    weak = build_law(ARM, 0.5, **NOTHING)
    sticky = TRUTH.with_values({"j1.coulomb": 0.04})
    answer = diagnose_loop(ARM, [record(ARM, sticky, weak, 20 + 2 * seed + k, 16.0) for k in (0, 1)], law=weak)
    assert not any(f.cause in ("backlash", "joint_compliance") for f in answer.findings)


def test_a_springy_law_is_fitted():
    """A spring that the law file asks for is estimated, also from a start that is 60 % off."""
    turn = 2 * np.pi * RESONANCE_HZ
    true = 1 / (LINK * turn**2)
    robot = build_link(LINK)
    law = ServoLaw.of(
        robot.actuated, encoder="motor", joint_compliance=1.6 * true, joint_damping=0.04 * LINK * turn, **GAINS
    )
    asked = replace(law, estimated=frozenset({"joint_compliance", "joint_damping"}))
    log = record_chirp(joint_compliance=true, joint_damping=0.06 * LINK * turn)
    found = identify_loop(robot, log, law=asked, model="symmetric", holdout=log.split(0.9)[1])
    row = next(p for p in found.parameters if p.name == "j1.joint_compliance")
    assert row.value == pytest.approx(true, rel=0.01)


def test_links_that_swing_on_springs_shake_each_other():
    """Springs at both joints of an arm leave what the encoder rounds, loads along filtered accelerations six times that."""
    arm = build_arm(2)
    law = build_law(arm, **NOTHING, joint_compliance=0.1, joint_damping=0.005)
    asked = build_law(arm, **NOTHING, joint_compliance=0.12, joint_damping=0.01)
    asked = replace(asked, estimated=frozenset({"joint_compliance", "joint_damping"}))
    log, held = (record(arm, build_truth(arm), law, seed, duration) for seed, duration in ((11, 8.0), (12, 4.0)))
    found = identify_loop(arm, log, law=asked, holdout=held)
    assert np.all(np.sqrt(np.mean(found.holdout.rms**2, axis=0)) < 0.65e-3)
    for name, true in (("joint_compliance", 0.1), ("joint_damping", 0.005)):
        rows = [p for p in found.parameters if p.name.endswith(name)]
        assert [p.value for p in rows] == pytest.approx([true, true], abs=3.5 * max(p.stderr for p in rows))
        assert max(p.stderr for p in rows) < 0.6 * true


def test_limits_say_what_would_have_been_found():
    """A delay above its limit is found in the same motion; causes that were found have no limit."""
    plain = build_law(ARM, **NOTHING)
    answer = diagnose_loop(ARM, [record(ARM, TRUTH, plain, s, 16.0) for s in (3, 4)], law=plain)
    limits = answer.to_dict()["detection_limits"]
    assert 0 < limits["command_delay"]["amplitude"] < 0.005
    assert limits["command_delay"]["per_joint"]["j1"] == limits["command_delay"]["amplitude"]
    late = build_law(ARM, **(NOTHING | {"command_delay": 1.5 * limits["command_delay"]["amplitude"]}))
    again = diagnose_loop(ARM, [record(ARM, TRUTH, late, s, 16.0) for s in (3, 4)], law=plain)
    assert "command_delay" in {f.cause for f in again.findings}
    assert "command_delay" not in again.to_dict()["detection_limits"]


def test_what_no_cause_explains_is_said():
    """A torque that depends on the position is none of the causes: structure is left, and said."""
    plain = build_law(ARM, **NOTHING)
    logs = [record(ARM, TRUTH, plain, s, 16.0) for s in (3, 4)]
    wavy = [x.with_channels(q_j1=x.channels["q_j1"] + 4e-3 * np.sin(9 * x.channels["q_j1"])) for x in logs]
    answer = diagnose_loop(ARM, wavy, law=plain)
    assert answer.unexplained and answer.unexplained[0].joint == "j1"


def test_the_face_sends_logs_where_they_belong():
    """`identify` and `diagnose` take logs of commands, with a law or without; a law beside forces is refused."""
    plain = build_law(ARM, **NOTHING)
    log = record(ARM, TRUTH, plain, 3, 16.0)
    found = td.identify(ARM, log, controller=plain, model="symmetric")
    assert isinstance(found, LoopIdentification)
    assert isinstance(td.diagnose(found, controller=plain), Diagnosis)
    with pytest.raises(td.InputError, match="controller"):
        td.identify(ARM, log.with_channels(tau_j1=np.zeros(log.n_samples)), controller=plain)


def test_every_cause_in_the_loop_is_an_entry_of_the_law():
    """The table of causes names entries that a law has, and lists them among the causes."""
    assert all(entry in SERVO_ENTRIES for row in LOOP_CAUSES.values() for entry in row.entries)
    listed = {row["cause"] for row in list_causes() if row["named_by"] == "diagnose, in the loop"}
    assert listed == set(LOOP_CAUSES)


def test_the_baseline_of_a_diagnosis_is_the_best_of_several_starts(monkeypatch):
    """A joint that friction holds at one start has another: a cause is compared with the best fit without it."""
    data: Any = SimpleNamespace(unknowns=None)
    problem = SimpleNamespace(with_finer_differences=lambda: "fine")
    data.shorten, data.build_problem = lambda: data, lambda: problem
    firsts = []

    def stop(short: Any, base: Any, progress: Any) -> None:
        raise InterruptedError

    monkeypatch.setattr(diagnosis, "fit_from_starts", lambda problem, progress: SimpleNamespace(x="best"))
    monkeypatch.setattr(diagnosis, "fit_loop", lambda problem, progress, first=None: firsts.append((problem, first)))
    monkeypatch.setattr(diagnosis, "search_causes", stop)
    with pytest.raises(InterruptedError):
        diagnosis._search(data, lambda step: None)
    assert firsts == [("fine", "best")]
