"""Commands `actuators`, `learn`, `observe` and `lead-through`, from a user's CSV to files and pages."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
import yaml

from tau_dyn.cli import main
from tau_dyn.control import read_correction, read_reference, write_reference
from tau_dyn.control.iterative import read_actuators
from tau_dyn.control.lead_through import ForceLoop
from tau_dyn.model import Model
from tau_dyn.modes import Actuator, ModelFile, StateSpace, save_state_space
from tau_dyn.robot import load_robot
from tau_dyn.simulate import move

DT = 0.004
ROBOT = load_robot("gantry_tau")
DRIVES = {
    "cart1": Actuator(1.0, 0.006, 0.0085),
    "cart2": Actuator(0.99, 0.008, 0.012),
    "cart3": Actuator(1.0, 0.007, 0.0101),
}
"""Drives with delays that differ and are no whole samples."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a log of steps, a reference, and what the carts make of it."""
    folder, rng = tmp_path_factory.mktemp("control"), np.random.default_rng(0)
    t = np.arange(1000) * DT
    steps = {f"q_ref_{j}": 0.01 * (np.sin(2 * np.pi * 0.4 * t + k) > 0) for k, j in enumerate(DRIVES)}
    table = {"t": t, **steps}
    for j, drive in DRIVES.items():
        table[f"q_{j}"] = drive.simulate(steps[f"q_ref_{j}"], DT) + 1e-6 * rng.standard_normal(len(t))
    pd.DataFrame(table).to_csv(folder / "steps.csv", index=False)
    motion = move(ROBOT.actuated, ROBOT.home, ROBOT.home + np.array([0.03, -0.02, 0.01]), 1.6, rate_hz=250)
    write_reference(folder / "ref.csv", Model.of(ROBOT, []), motion)
    assert main(["actuators", str(folder / "steps.csv"), "--out", str(folder / "a.yaml"), "--quiet"]) == 0
    return folder


def run_trial(folder, name: str, correction=None) -> float:
    """Write what the carts make of the reference and a correction; return the largest error [m]."""
    motion = read_reference(folder / "ref.csv", ROBOT.actuated)
    sent = motion.q if correction is None else motion.q + read_correction(folder / correction, ROBOT.actuated).dq
    q = np.column_stack([d.simulate(sent[:, k], DT) for k, d in enumerate(DRIVES.values())])
    pd.DataFrame({"t": motion.t} | {f"q_{j}": q[:, k] for k, j in enumerate(DRIVES)}).to_csv(folder / name, index=False)
    return float(np.abs(q - motion.q)[60:-60].max())


def test_actuators_are_fitted_and_kept(folder, capsys) -> None:
    """Fractional delays and time constants come back within their intervals; the file and the page hold them."""
    out, page = folder / "r.json", folder / "a.html"
    assert main(["actuators", str(folder / "steps.csv"), "--json", str(out), "--report", str(page)]) == 0
    rows = json.loads(out.read_text())["axes"]
    for row, true, kept in zip(rows, DRIVES.values(), read_actuators(folder / "a.yaml", ROBOT.actuated), strict=True):
        for name, stderr, wanted, got in (
            ("delay_s", "delay_stderr_s", true.delay, kept.delay),
            ("time_constant_s", "time_constant_stderr_s", true.time_constant, kept.time_constant),
        ):
            assert abs(row[name] - wanted) < 4 * row[stderr] + 1e-9 and got == pytest.approx(row[name])
    assert "q_cart2" in page.read_text() and "bandwidth" in capsys.readouterr().out


def test_learning_goes_on_from_file_to_file(folder, capsys) -> None:
    """Trial, correction, trial: the error falls below a tenth in three steps, with drives of unequal, fractional delays."""
    first = run_trial(folder, "trial0.csv")
    for k in range(3):
        before = ["--correction", str(folder / f"c{k}.csv")] if k else []
        command = [
            "learn",
            str(folder / "ref.csv"),
            str(folder / f"trial{k}.csv"),
            "--actuators",
            str(folder / "a.yaml"),
        ]
        more = ["--json", str(folder / "l.json"), "--report", str(folder / "l.html")]
        assert main([*command, *before, "--out", str(folder / f"c{k + 1}.csv"), *more]) == 0
        last = run_trial(folder, f"trial{k + 1}.csv", f"c{k + 1}.csv")
    found = json.loads((folder / "l.json").read_text())
    assert found["convergence"]["monotone"] and found["convergence"]["largest_singular_value"] < 1
    assert last < 0.1 * first and "By frequency" in (folder / "l.html").read_text()
    assert main(["export", "gantry_tau", "--to", "reference", "--motion", str(folder / "ref.csv"), "--correction",
                 str(folder / "c3.csv"), "--out", str(folder / "sent.csv")]) == 0  # fmt: skip


def write_told(folder, name: str, correction: str | None = None) -> str:
    """Write a trial with its command as q_ref_J and encoder noise of 1 um; return its path."""
    motion = read_reference(folder / "ref.csv", ROBOT.actuated)
    sent = motion.q if correction is None else motion.q + read_correction(folder / correction, ROBOT.actuated).dq
    noise = 1e-6 * np.random.default_rng(len(name)).standard_normal(sent.shape)
    table = {"t": motion.t}
    for k, (j, drive) in enumerate(DRIVES.items()):
        table |= {f"q_ref_{j}": sent[:, k], f"q_{j}": drive.simulate(sent[:, k], DT) + noise[:, k]}
    pd.DataFrame(table).to_csv(folder / name, index=False)
    return str(folder / name)


def test_a_history_of_trials_is_learnt_in_one_command(folder, capsys) -> None:
    """Without a model of the drives the error falls below a tenth in two corrections; every prediction is compared."""
    history = [write_told(folder, "h0.csv")]
    for k in (1, 2):
        command = ["learn", str(folder / "ref.csv"), "--history", *history, "--out", str(folder / f"hc{k}.csv")]
        assert main([*command, "--quiet"]) == 0
        history.append(write_told(folder, f"h{k}.csv", f"hc{k}.csv"))
    out, page = folder / "h.json", folder / "h.html"
    command = ["learn", str(folder / "ref.csv"), "--history", *history, "--out", str(folder / "hc3.csv")]
    assert main([*command, "--json", str(out), "--report", str(page)]) == 0
    found = json.loads(out.read_text())
    trials = pd.DataFrame(found["trials"])
    assert len(trials) == 9 and trials["predicted_rms"].notna().sum() == 6
    last, first = (trials[trials["trial"] == k].set_index("joint")["error_rms"] for k in (3, 1))
    assert (last < 0.1 * first).all()
    low, high = np.array(found["joints"][0]["expected_error_rms_ci95"])
    assert 0 < low < found["joints"][0]["expected_error_rms"] < high
    assert {row["joint"] for row in found["frequencies"]} == set(DRIVES)
    assert "Trial by trial" in page.read_text() and "within the predicted interval" in capsys.readouterr().out


def test_the_last_trial_with_its_correction_is_the_last_of_a_history(folder) -> None:
    """The command is the reference plus the correction, from the log's columns or from the correction's file."""
    first = write_told(folder, "g0.csv")
    base = ["learn", str(folder / "ref.csv")]
    assert main([*base, "--history", first, "--out", str(folder / "g1.csv"), "--quiet"]) == 0
    second = write_told(folder, "g1trial.csv", "g1.csv")
    ways = {
        "a.csv": ["--history", first, second],
        "b.csv": [second, "--history", first, "--correction", str(folder / "g1.csv")],
    }
    for name, way in ways.items():
        assert main([*base, *way, "--out", str(folder / name), "--quiet"]) == 0
    one, other = (read_correction(folder / name, ROBOT.actuated).dq for name in ways)
    np.testing.assert_allclose(one, other, atol=1e-9)


def test_a_model_of_modes_lets_a_resonance_be_learnt(tmp_path, capsys) -> None:
    """A drive that swings at 3 Hz: `modes` on a binary sequence, `learn --model` on two trials, a fifth is left."""
    A, B = spring(2 * np.pi * 3.0)

    def run(command: np.ndarray, name: str) -> float:
        q, x = np.empty(len(command)), np.zeros(2)
        for k, u in enumerate(command):
            q[k], x = x[0], A @ x + B * u
        q = q + 1e-6 * np.random.default_rng(0).standard_normal(len(q))
        table = {"t": np.arange(len(q)) * DT, "q_ref_axis": command, "q_axis": q}
        pd.DataFrame(table).to_csv(tmp_path / name, index=False)
        return float(np.std(command - q))

    run(0.01 * np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 150), 10), "noise.csv")
    t = np.arange(700) * DT
    wanted = 0.02 * (1 - np.cos(np.pi * np.clip((t - 0.7) / 0.6, 0, 1)))
    pd.DataFrame({"t": t, "q_ref_axis": wanted}).to_csv(tmp_path / "ref.csv", index=False)
    model, correction = tmp_path / "m.yaml", tmp_path / "c.csv"
    command = ["modes", str(tmp_path / "noise.csv"), "--inputs", "q_ref_axis", "--outputs", "q_axis", "--order", "2"]
    assert main([*command, "--out", str(model), "--quiet"]) == 0
    errors, trials, sent = [], [], wanted
    for name in ("t1.csv", "t2.csv", "t3.csv"):
        run(sent, name)
        errors.append(float(np.std(wanted - pd.read_csv(tmp_path / name)["q_axis"])))
        trials.append(str(tmp_path / name))
        step = [
            "learn",
            str(tmp_path / "ref.csv"),
            "--history",
            *trials,
            "--model",
            str(model),
            "--out",
            str(correction),
        ]
        assert main([*step, "--json", str(tmp_path / "r.json")]) == 0
        sent = wanted + pd.read_csv(correction, comment="#")["dq_axis"].to_numpy()
    assert errors[2] < 0.2 * errors[0] and "inverse of the model" in capsys.readouterr().out
    assert json.loads((tmp_path / "r.json").read_text())["joints"][0]["inverts"]
    assert main([*step, "--actuators", str(model)]) == 2 and "not both" in capsys.readouterr().err


def test_a_history_without_commands_or_of_another_motion_is_refused(folder, capsys) -> None:
    """Status 2: a log that holds no command, a command that is far from the reference, and no trial at all."""
    command = ["learn", str(folder / "ref.csv"), "--out", str(folder / "no.csv"), "--quiet"]
    run_trial(folder, "bare.csv")
    assert main([*command, "--history", str(folder / "bare.csv")]) == 2
    assert "q_ref_cart1" in capsys.readouterr().err
    far = pd.read_csv(write_told(folder, "far.csv"))
    far["q_ref_cart1"] += 0.5
    far.to_csv(folder / "far.csv", index=False)
    assert main([*command, "--history", str(folder / "far.csv")]) == 2
    assert "far.csv" in capsys.readouterr().err
    assert main(command) == 2 and "--history" in capsys.readouterr().err
    assert not (folder / "no.csv").exists()


@pytest.mark.parametrize(("scale", "line"), [(1e3, "as if in thousandths"), (-1.0, "runs against q_ref_cart2")])
def test_a_trial_in_another_unit_or_sign_is_refused(folder, scale, line, capsys) -> None:
    """A drive follows its motion: a thousand times its size is mm, the other direction a sign, and nothing is learnt from it."""
    run_trial(folder, "si.csv")
    trial = pd.read_csv(folder / "si.csv")
    trial["q_cart2"] *= scale
    trial.to_csv(folder / "odd.csv", index=False)
    command = ["learn", str(folder / "ref.csv"), str(folder / "odd.csv"), "--out", str(folder / "no.csv"), "--quiet"]
    assert main(command) == 2
    said = capsys.readouterr().err
    assert line in said and "q_cart2: {column: q_cart2, scale:" in said and not (folder / "no.csv").exists()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--gain", "2.5", "--cutoff", "30"], "learning would not converge"),
        (["--shift", "0", "--cutoff", "40"], "grows"),
        (["--largest-correction", "1e-6"], "more than the 1e-06 allowed"),
    ],
)
def test_learning_that_would_do_harm_is_refused(folder, more, said, capsys) -> None:
    """Status 2, the frequency or the size, and no file."""
    run_trial(folder, "t.csv")
    command = ["learn", str(folder / "ref.csv"), str(folder / "t.csv"), "--actuators", str(folder / "a.yaml")]
    assert main([*command, "--out", str(folder / "no.csv"), *more]) == 2
    assert said in capsys.readouterr().err and not (folder / "no.csv").exists()


def write_tool_log(path, scale: float = 1.0, seed: int = 0) -> np.ndarray:
    """Write a cart's motion and a tool on a spring of 8 Hz behind it; return the tool's true positions (N,) [m]."""
    rng, w = np.random.default_rng(seed), 2 * np.pi * 8.0
    n, t = 1200, np.arange(1202) * DT
    u = 0.02 * (1 - np.cos(2 * np.pi * np.clip((t - 1) / 0.6, 0, 1))) / 2
    z, x = np.empty(n + 2), np.zeros(2)
    A, B = spring(w)
    for k in range(n + 2):
        z[k] = x[0]
        x = A @ x + B * u[k]
    a = np.r_[0.0, np.diff(z, 2)[: n - 1]] / DT**2
    table = {"t": t[:n], "x_cart": u[:n], "ax_tool": a + 0.02 * rng.standard_normal(n) + 0.1}
    pd.DataFrame(table).to_csv(path, index=False)
    A, B = spring(scale * w)
    model = StateSpace(A, B[:, None], np.array([[1.0, 0.0]]), np.zeros((1, 1)), np.zeros((2, 1)), DT)
    save_state_space(path.with_suffix(".yaml"), ModelFile(model, ("x_cart",), ("x_tool",), {}))
    return z[:n]


def spring(w: float) -> tuple[np.ndarray, np.ndarray]:
    """Return A (2, 2) and B (2,) of a mass on a spring of a frequency [rad/s] behind a cart, damped by 3 %."""
    from scipy.linalg import expm

    c = np.array([[0, 1, 0], [-(w**2), -0.06 * w, w**2], [0, 0, 0]])
    whole = expm(c * DT)
    return whole[:2, :2], whole[:2, 2]


@pytest.mark.parametrize("scale", [1.0, 1.1])
def test_the_tool_is_observed_with_honest_intervals(tmp_path, scale, capsys) -> None:
    """90 to 98 % of the tool's positions lie within, also with a biased sensor and a model 10 % off, which is said."""
    z = write_tool_log(tmp_path / "log.csv", scale)
    command = ["observe", str(tmp_path / "log.csv"), "--kinematic", "x_cart", "--acceleration", "ax_tool"]
    files = [
        "--out",
        str(tmp_path / "tool.csv"),
        "--json",
        str(tmp_path / "r.json"),
        "--report",
        str(tmp_path / "r.html"),
    ]
    assert main([*command, "--model", str(tmp_path / "log.yaml"), *files]) == 0
    found = pd.read_csv(tmp_path / "tool.csv")
    inside = np.mean((found["x_cart_low"] <= z) & (z <= found["x_cart_high"]))
    result = json.loads((tmp_path / "r.json").read_text())
    assert inside >= 0.9
    assert (
        abs(result["frequency_scale"] * scale - 1) < 0.02 and abs(result["axes"][0]["accelerometer_bias"] - 0.1) < 0.01
    )
    assert ("frequencies are" in capsys.readouterr().err) == (scale != 1.0)


def test_the_tool_is_observed_without_a_model(tmp_path, capsys) -> None:
    """A complementary filter takes cutoffs alone; both, or neither, are refused."""
    write_tool_log(tmp_path / "log.csv")
    command = ["observe", str(tmp_path / "log.csv"), "--kinematic", "x_cart", "--acceleration", "ax_tool"]
    assert main([*command, "--cutoff", "3"]) == 0 and "complementary filter" in capsys.readouterr().out
    assert main(command) == 2 and "--model MODEL.yaml or --cutoff HZ" in capsys.readouterr().err


def test_lead_through_knows_its_limit(folder, tmp_path, capsys) -> None:
    """From a touch in a log: stiffness, the gain that oscillates, and half of it as the setting; a gain beyond is refused."""
    x = np.r_[np.zeros(100), np.linspace(0, 2e-4, 200)]
    force = 50e3 * x + 0.05 * np.random.default_rng(0).standard_normal(300)
    pd.DataFrame({"t": np.arange(300) * DT, "position": x, "force": force}).to_csv(tmp_path / "touch.csv", index=False)
    out = tmp_path / "r.json"
    command = ["lead-through", str(tmp_path / "touch.csv")]
    assert main([*command, "--json", str(out), "--report", str(tmp_path / "r.html")]) == 0
    found = {row["name"]: row["value"] for row in json.loads(out.read_text())["settings"]}
    assert found["contact_stiffness"] == pytest.approx(50e3, rel=0.02)
    assert found["force_gain_limit"] == pytest.approx(ForceLoop().limit(found["contact_stiffness"]).gain)
    assert found["force_gain"] == pytest.approx(found["force_gain_limit"] / 2)
    assert main([*command, "--actuators", str(folder / "a.yaml"), "--gain", "1"]) == 2
    assert "oscillates" in capsys.readouterr().err


def test_a_poor_fit_of_an_actuator_carries_a_code(tmp_path) -> None:
    """A drive that swings at 3 Hz is no first-order system: its model is written, with the warning `poor_fit` and its name."""
    t = np.arange(2000) * DT
    command = 0.01 * (np.sin(2 * np.pi * 0.4 * t) > 0)
    q, x = np.empty(len(t)), np.zeros(2)
    A, B = spring(2 * np.pi * 3.0)
    for k, u in enumerate(command):
        q[k] = x[0]
        x = A @ x + B * u
    pd.DataFrame({"t": t, "q_ref_axis": command, "q_axis": q}).to_csv(tmp_path / "s.csv", index=False)
    assert main(["actuators", str(tmp_path / "s.csv"), "--json", str(tmp_path / "r.json"), "--quiet"]) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["axes"][0]["fit_percent"] < 80
    assert result["warning_codes"] == ["poor_fit"] and result["warning_joints"] == {"poor_fit": ["axis"]}


def test_the_force_loop_takes_the_slow_ends_of_measured_delays(tmp_path) -> None:
    """A delay of 9 +- 2 ms may be 12.9 ms, so four samples lie in the loop; a poor fit is named where the file is read."""
    axis = {
        "axis": "z",
        "gain": 1.0,
        "time_constant": 0.002,
        "delay": 0.009,
        "delay_stderr": 0.002,
        "fit_percent": 70.0,
    }
    drives, out = tmp_path / "a.yaml", tmp_path / "r.json"
    drives.write_text(yaml.safe_dump({"tau_dyn_actuators": 1, "axes": [axis]}))
    command = ["lead-through", "--stiffness", "5e4", "--damping", "200", "--actuators", str(drives), "--json", str(out)]
    assert main([*command, "--quiet"]) == 0
    result = json.loads(out.read_text())
    found = {row["name"]: row["value"] for row in result["settings"]}
    assert found["delay"] == 4 and result["warning_codes"] == ["poor_fit"]
    assert found["force_gain_limit"] == pytest.approx(ForceLoop(0.004, 1 / (2 * np.pi * 0.002), 4).limit(5e4).gain)


def test_a_gain_near_oscillation_carries_a_code(tmp_path) -> None:
    """At 80 % of the stability limit a force loop is stable and rings: status 0 with the code `near_limit`."""
    gain, out = 0.8 * ForceLoop().limit(5e4).gain, tmp_path / "r.json"
    assert main(["lead-through", "--stiffness", "5e4", "--gain", f"{gain:.6g}", "--json", str(out), "--quiet"]) == 0
    assert json.loads(out.read_text())["warning_codes"] == ["near_limit"]
