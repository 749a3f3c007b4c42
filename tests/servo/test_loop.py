"""Through a servo's loop: what a simulated arm hides is found again from commands and positions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tau_dyn import CannotAnswer, InputError, Log, load_robot, read_log
from tau_dyn.identify import Choices
from tau_dyn.servo import diagnose_loop, identify_loop, is_loop_log
from tau_dyn.simulate import SERVO_ENTRIES, ServoLaw, build_servo_law, read_servo_law

from .arms import build_arm, build_commands, build_law, build_truth, record

ARM = build_arm(1)
TRUTH = build_truth(ARM)
ASKED = ServoLaw.of(ARM.actuated, position_gain=2.65, force_per_unit=2.9, back_emf=0.17)


@pytest.fixture(scope="module")
def found():
    """Return an identification of one joint, and the log it is held to."""
    law = build_law(ARM)
    return identify_loop(ARM, record(ARM, TRUTH, law, 1, 30.0), law=ASKED, holdout=record(ARM, TRUTH, law, 2, 12.0))


def test_a_simulated_arm_is_predicted_down_to_its_encoder(found):
    """Held out, the residual is an encoder's rounding and noise, 0.53 mrad, and little besides."""
    assert found.holdout.rms_per_joint[0] < 0.65e-3
    assert found.holdout.pool(found.holdout.command_rms)[0] > 20e-3


@pytest.mark.parametrize(
    "kind, true", [("armature", 0.012), ("command_delay", 0.012), ("coulomb", 0.06), ("load_friction", 0.2)]
)
def test_what_hides_in_the_loop_is_found_again(found, kind, true):
    """Drive inertia, delay and both frictions come out within 10 %, and their errors are of that size."""
    row = next(p for p in found.parameters if p.name == f"j1.{kind}")
    assert row.value == pytest.approx(true, rel=0.1)
    assert abs(row.value - true) < 4 * row.stderr


def test_no_cause_is_found_where_none_is():
    """A loop that the baseline describes gives no finding."""
    plain = build_law(ARM, load_friction=0.0, stiction=0.0, command_delay=0.0)
    answer = diagnose_loop(ARM, [record(ARM, TRUTH, plain, s, 16.0) for s in (3, 4)], law=plain)
    assert answer.verdict == "nothing_found"


def test_a_late_command_is_named():
    """A delay of 20 ms that the law does not know is named, with its amount."""
    known = build_law(ARM, load_friction=0.0, stiction=0.0, command_delay=0.0)
    late = build_law(ARM, load_friction=0.0, stiction=0.0, command_delay=0.02)
    answer = diagnose_loop(ARM, [record(ARM, TRUTH, late, s, 16.0) for s in (3, 4)], law=known)
    best = answer.findings[0]
    assert (best.cause, best.status) == ("command_delay", "confirmed")
    assert best.parameters[0].value == pytest.approx(0.02, abs=0.002)
    assert answer.recommendation == "extended"


def test_a_gain_that_is_not_known_is_said():
    """Without a law masses are known up to its scale; a weighed link fixes it, and both are said."""
    log = record(ARM, TRUTH, build_law(ARM, load_friction=0.0, stiction=0.0), 1, 10.0)
    free = identify_loop(ARM, log)
    assert any(getattr(w, "code", "") == "gain_unknown" for w in free.warnings)
    fixed = identify_loop(ARM, log, choices=Choices(fix=("j1_link.mass",)))
    assert any("j1_link.mass" in w for w in fixed.warnings)


def test_a_given_gain_that_scales_every_body_is_doubted():
    """A law of twice the torque asks for twice the masses of the file; the right law asks for those of the file."""
    true = build_law(ARM, load_friction=0.0, stiction=0.0)
    log = record(ARM, TRUTH, true, 1, 10.0)
    law = {"position_gain": 2.65, "back_emf": 0.17, "command_delay": 0.012, "load_friction": 0.0, "stiction": 0.0}
    for torque, doubted in ((5.8, True), (2.9, False)):
        found = identify_loop(ARM, log, law=ServoLaw.of(ARM.actuated, **law, force_per_unit=torque))
        said = [w for w in found.warnings if getattr(w, "code", "") == "gain_unknown"]
        assert bool(said) == doubted
        if doubted:
            assert 1.8 < float(said[0].split("come out ")[1].split()[0]) < 2.2


def test_a_model_file_holds_its_law(found, tmp_path: Path):
    """What is saved can be read again, with the law that it was identified through."""
    from tau_dyn import Model

    found.model.save(tmp_path / "model.yaml")
    again = Model.load(tmp_path / "model.yaml")
    law = build_servo_law(dict(again.controller), again.robot, "model.yaml")
    for key in SERVO_ENTRIES:
        np.testing.assert_allclose(law.values[key], found.law.values[key])


def test_a_log_with_torque_is_not_one_of_a_loop():
    """Only commands and positions without a torque go through the loop."""
    log = record(ARM, TRUTH, build_law(ARM), 1, 6.0)
    assert is_loop_log(log, ARM)
    assert not is_loop_log(log.with_channels(tau_j1=np.zeros(log.n_samples)), ARM)


def test_an_arm_at_rest_says_nothing():
    """Without motion there is no answer, and the experiment is named."""
    t = np.arange(0, 10, 0.02)
    with pytest.raises(CannotAnswer, match="no joint moves"):
        identify_loop(ARM, Log(t, {"cmd_j1": np.zeros(len(t)), "q_j1": np.full(len(t), 0.1)}))


@pytest.mark.parametrize(
    "content, said",
    [
        ({"position_gain": 1.0}, "begins with"),
        ({"law": "servo", "position_gain": 1.0}, "force_per_unit"),
        ({"law": "servo", "position_gain": 1.0, "force_per_unit": -1.0}, "above zero"),
        ({"law": "servo", "position_gain": 1.0, "force_per_unit": 1.0, "gain": 2}, "servo entry"),
        ({"law": "servo", "position_gain": {"j9": 1.0}, "force_per_unit": 1.0}, "j9"),
    ],
)
def test_a_law_file_that_cannot_be_is_refused(content, said):
    """A sentence names the entry."""
    with pytest.raises(InputError, match=said):
        build_servo_law(content, ARM, "law.yaml")


@pytest.mark.parametrize("name", ["sts3215.yaml"])
def test_shipped_laws_are_read(name):
    """The laws beside the worked examples belong to their robots."""
    folder = Path(__file__).parents[2] / "identification"
    law = read_servo_law(folder / "controllers" / name, load_robot("so101"))
    assert law.estimated == {"back_emf"}
    pendulum = load_robot(folder / "robots" / "xl330_pendulum.urdf")
    drive = read_servo_law(folder / "controllers" / "xl330.yaml", pendulum)
    assert drive.in_log("kp800_sin_sin.csv")["position_gain"][0] == pytest.approx(
        8 * drive.in_log("kp100_x")["position_gain"][0], rel=1e-3
    )


def test_a_fit_that_friction_holds_starts_again(measured):
    """A pendulum's fast swings at a high gain are followed to 50 mrad; from the screened friction alone the fit ends at 77."""
    folder = Path(__file__).resolve().parents[2] / "identification"
    pendulum = load_robot(folder / "robots" / "xl330_pendulum.urdf")
    drive = read_servo_law(folder / "controllers" / "xl330.yaml", pendulum)
    files = sorted(measured("xl330/kp800_lift_and_drop.csv").parent.glob("kp800_*.csv"))
    logs = [read_log(file, folder / "columns" / "xl330.yaml") for file in files]
    found = identify_loop(pendulum, logs, law=drive, choices=Choices(fix=("arm_link.*",)))
    errors = [np.mean(np.abs(record.measured - q)) for record, q, held in found.shown if not held]
    assert np.mean(errors) < 0.05


def test_friction_that_holds_keeps_a_joint_still():
    """Commands that ask for less torque than friction holds do not move a joint at all."""
    stiff = TRUTH.with_values({"j1.coulomb": 0.5})
    still = record(ARM, stiff, build_law(ARM, load_friction=0.0, stiction=0.0), 5, 6.0)
    motion = build_commands(ARM, 5, 6.0)
    assert np.ptp(still.channels["q_j1"]) < np.ptp(motion.q)
    quiet = replace(motion, q=0.001 * motion.q)
    from tau_dyn.servo import simulate_loop_log

    q = simulate_loop_log(stiff, build_law(ARM), quiet).channels["q_j1"]
    assert np.ptp(q[50:]) < 1e-9
