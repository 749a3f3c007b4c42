"""A payload that two recordings tell, a change that a running log tells, and nothing where nothing changed."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.signal import lfilter

from tau_dyn.cli import main
from tau_dyn.identify import build_model
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.monitor import BlockScore, ChangeDetector, identify_payload, watch_logs
from tau_dyn.robot import load_robot
from tau_dyn.simulate import build_fourier_motion

RATE_HZ = 250.0
PAYLOAD_KG = 0.5


@pytest.fixture(scope="module")
def gantry() -> Model:
    """The L1 Gantry-Tau with friction of some ten newtons."""
    robot = load_robot("gantry_tau")
    model = build_model(robot, "asymmetric")
    sizes = {"coulomb": 30.0, "viscous": 60.0}
    return model.with_values({n: sizes[n.split(".")[1].split("_")[0]] for n in model.effect_parameters.names})


def make_log(model: Model, seconds: float, seed: int, name: str) -> Log:
    """Return a log along a Fourier motion, with coloured noise of 1 % of the forces."""
    rng, motion = np.random.default_rng(seed), build_fourier_motion(model.steady(), seconds, seed).resampled(RATE_HZ)
    tau = model.torque(motion.q, motion.v, motion.a)
    noise = lfilter([np.sqrt(1 - 0.9**2)], [1, -0.9], rng.standard_normal(tau.shape), axis=0)
    tau = tau + 0.01 * np.sqrt(np.mean(tau**2, axis=0)) * noise
    q = motion.q + 1e-5 * rng.standard_normal(tau.shape)
    signals = {"q": q, "tau": tau}
    return Log(
        motion.t,
        {f"{key}_{j}": x[:, k] for key, x in signals.items() for k, j in enumerate(model.robot.actuated)},
        name,
    )


def test_half_a_kilogram_is_weighed_by_the_drives(gantry):
    """A plate that is 0.5 kg heavier weighs so much more within 3 % and three standard errors, at 20 s of motion each."""
    heavy = gantry.robot.parameters["plate_link.mass"].value + PAYLOAD_KG
    loaded = gantry.with_values({"plate_link.mass": heavy})
    found = identify_payload(gantry.robot, [make_log(gantry, 20, 1, "empty")], [make_log(loaded, 20, 2, "loaded")])
    value, stderr = float(found.mass.values[0]), float(found.mass.stderr[0])
    assert found.differs and found.link == "plate_link" and found.mass.determined
    assert abs(value - PAYLOAD_KG) < min(0.03 * PAYLOAD_KG, 3 * stderr)


def test_equal_recordings_carry_nothing(gantry):
    """Two motions of the same robot differ by no payload, and the interval says how much could hide."""
    found = identify_payload(gantry.robot, [make_log(gantry, 20, 3, "a")], [make_log(gantry, 20, 4, "b")])
    assert not found.differs and found.p_value > 0.01
    assert 0 < found.largest_mass < 0.2


def test_a_friction_that_rises_is_named_with_its_time(gantry):
    """10 % more friction of one drive from the second log on: named within a minute, its size in the interval, none before."""
    names = gantry.effect_parameters.names
    mine = [name for name in names if name.startswith(f"{gantry.robot.actuated[1]}.")]
    worn = {name: 1.1 * gantry.effect_parameters[name].value for name in mine}
    logs = [make_log(gantry, 90, 5, "before"), make_log(gantry.with_values(worn), 75, 6, "after")]
    (row,) = watch_logs(gantry, logs).rows()
    assert (row["what"], row["joint"], row["unit"]) == ("friction", gantry.robot.actuated[1], "1")
    assert row["log"] == "after" and row["detected_t"] < 60
    assert row["ci95"][0] < 0.1 < row["ci95"][1]
    assert row["since_log"] == "after" and row["since_t"] < 6


def test_normal_scores_raise_no_alarm_and_a_shift_does():
    """Thirty hours of scores that scatter as the reference's do raise none; ten standard errors a block raise one at once."""
    rng, detector = np.random.default_rng(0), ChangeDetector(np.full(5, 1e3), 30)
    for k in range(30 + 30 * 1800):
        detector.add(BlockScore((2.0 * k, 2.0 * k + 2), "made", 15 * rng.standard_normal(5), 100 * np.eye(5)))
    assert not detector.changes and max(x[2] for x in detector.trace) > 0.3
    for j in range(1, 12):
        shift = np.array([0, 0, 100.0, 0, 0]) + 15 * rng.standard_normal(5)
        detector.add(BlockScore((2.0 * (k + j), 2.0 * (k + j) + 2), "made", shift, 100 * np.eye(5)))
    detector.settle()
    (change,) = detector.changes
    assert change.direction == 2 and change.detected_t - change.since_t <= 6
    assert change.ci95[0] < 1.0 < change.ci95[1]


def test_commands_write_results_and_say_what_is_missing(gantry, tmp_path, capsys):
    """`payload` and `watch` write the contract's keys; without loaded logs it is the input (2), a short log cannot answer (3)."""
    empty, loaded, model = tmp_path / "empty.csv", tmp_path / "loaded.csv", tmp_path / "model.yaml"
    make_log(gantry, 20, 7, "empty").to_csv(empty)
    heavy = gantry.with_values({"plate_link.mass": gantry.robot.parameters["plate_link.mass"].value + PAYLOAD_KG})
    make_log(heavy, 20, 8, "loaded").to_csv(loaded)
    gantry.save(model)
    assert (
        main(
            [
                "payload",
                "gantry_tau",
                str(empty),
                "--loaded",
                str(loaded),
                "--json",
                "-",
                "--report",
                str(tmp_path / "p.html"),
                "--quiet",
            ]
        )
        == 0
    )
    result = json.loads(capsys.readouterr().out)
    assert result["payload"]["mass"]["ci95"][0] < PAYLOAD_KG < result["payload"]["mass"]["ci95"][1] and result["differ"]
    assert "Payload" in (tmp_path / "p.html").read_text()
    assert main(["payload", "gantry_tau", str(empty), "--quiet"]) == 2
    assert main(["watch", str(model), str(empty), "--json", str(tmp_path / "w.json"), "--quiet"]) == 3
    assert json.loads((tmp_path / "w.json").read_text())["status"] == "cannot_answer"
    assert "record the robot's daily motion" in capsys.readouterr().err
    assert main(["watch", str(model), str(empty), str(loaded), "--reference", "40", "--json", "-", "--quiet"]) in (0, 3)


def test_a_growing_log_is_watched_to_its_end(gantry, tmp_path, capsys):
    """With --follow the samples that a log holds are taken in; the command ends once it has not grown for so long."""
    path, model = tmp_path / "growing.csv", tmp_path / "model.yaml"
    make_log(gantry, 150, 9, "growing").to_csv(path)
    gantry.save(model)
    assert main(["watch", str(model), str(path), "--follow", "0.2", "--json", "-", "--quiet"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["alarms"] == [] and result["watched_s"] > 40
