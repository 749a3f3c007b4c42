"""`learn --robot`: the tool is learnt, measured by a device or estimated by `observe`; the correction is one of the drives."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tau_dyn.cli import main
from tau_dyn.control import read_correction, write_reference
from tau_dyn.mechanism import forward_kinematics
from tau_dyn.model import Model
from tau_dyn.modes import ModelFile, StateSpace, save_state_space
from tau_dyn.robot import load_robot
from tau_dyn.simulate import Trajectory, move

DT = 0.004
ROBOT = load_robot("gantry_tau")
SPRING_HZ = 9.0
REST = 125  # samples before and after the move


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with a reference: 40 mm of the tool in x and -30 mm in y within 0.5 s, from rest to rest."""
    folder = tmp_path_factory.mktemp("tool")
    step = np.linalg.lstsq(_tool_jacobian(), np.array([0.04, -0.03, 0.0]), rcond=None)[0]
    way = move(ROBOT.actuated, ROBOT.home, ROBOT.home + step, 0.5, rate_hz=250).q
    q = np.vstack([np.repeat(way[:1], REST, axis=0), way, np.repeat(way[-1:], 2 * REST, axis=0)])
    motion = Trajectory.through(ROBOT.actuated, np.arange(len(q)) * DT, q)
    write_reference(folder / "ref.csv", Model.of(ROBOT, []), motion)
    A, B = _spring()
    blocks = np.kron(np.eye(2), A), np.kron(np.eye(2), B[:, None]), np.kron(np.eye(2), np.array([[1.0, 0.0]]))
    model = StateSpace(*blocks, np.zeros((2, 2)), np.zeros((4, 2)), DT)
    save_state_space(folder / "model.yaml", ModelFile(model, ("x_c", "y_c"), ("x_tool", "y_tool"), {}))
    return folder


def _tool_jacobian() -> np.ndarray:
    """Return the tool's position by the drives (3, 3)."""
    steps = ROBOT.home + 1e-4 * np.vstack([np.eye(3), -np.eye(3)])
    p = forward_kinematics(ROBOT, steps).poses.position
    return (p[:3] - p[3:]).T / 2e-4


def _spring() -> tuple[np.ndarray, np.ndarray]:
    """Return A (2, 2) and B (2,) of a mass on a spring damped by 5 %, behind a held input."""
    from scipy.linalg import expm

    w = 2 * np.pi * SPRING_HZ
    whole = expm(DT * np.array([[0, 1, 0], [-(w**2), -0.1 * w, w**2], [0, 0, 0]]))
    return whole[:2, :2], whole[:2, 2]


def run_trial(folder: Path, name: str, correction: str | None = None) -> tuple[str, np.ndarray]:
    """Write a trial of drives two samples late and a tool on springs behind them; return its path and the tool's error (2,)."""
    reference = pd.read_csv(folder / "ref.csv", comment="#")[[f"q_ref_{j}" for j in ROBOT.actuated]].to_numpy()
    sent = reference if correction is None else reference + read_correction(folder / correction, ROBOT.actuated).dq
    q = np.vstack([np.repeat(sent[:1], 2, axis=0), sent[:-2]])
    wanted, computed = (forward_kinematics(ROBOT, x).poses.position for x in (reference, q))
    A, B = _spring()
    state, tool = np.zeros((2, 3)), np.empty_like(computed)
    for k, u in enumerate(computed - computed[0]):
        tool[k] = state[0]
        state = A @ state + np.outer(B, u)
    rng = np.random.default_rng(len(name))
    a = np.diff(tool, 2, axis=0, prepend=tool[:1], append=tool[-1:]) / DT**2 + 0.02 * rng.standard_normal(tool.shape)
    seen = computed[0] + tool + 1e-6 * rng.standard_normal(tool.shape)
    table = {"t": np.arange(len(q)) * DT}
    table |= {f"q_ref_{j}": sent[:, k] for k, j in enumerate(ROBOT.actuated)}
    table |= {f"q_{j}": q[:, k] + 1e-6 * rng.standard_normal(len(q)) for k, j in enumerate(ROBOT.actuated)}
    table |= {f"{x}_tool": seen[:, k] for k, x in enumerate("xy")} | {f"a{x}_tool": a[:, k] for k, x in enumerate("xy")}
    pd.DataFrame(table).to_csv(folder / name, index=False)
    return str(folder / name), np.sqrt(np.mean((computed[0] + tool - wanted)[60:-60, :2] ** 2, axis=0))


def learn(folder: Path, logs: list[str], out: str, *more: str) -> dict:
    """Return the result of a learning step that has to succeed."""
    words = [
        "learn",
        str(folder / "ref.csv"),
        "--history",
        *logs,
        "--out",
        str(folder / out),
        "--json",
        str(folder / "r.json"),
    ]
    assert main([*words, *more, "--quiet"]) == 0
    return json.loads((folder / "r.json").read_text())


def observe(folder: Path, log: str) -> str:
    """Return the file of the observed tool of a trial."""
    out = log.replace(".csv", "_observed.csv")
    words = [
        "observe",
        log,
        "gantry_tau",
        "--acceleration",
        "ax_tool",
        "ay_tool",
        "--model",
        str(folder / "model.yaml"),
    ]
    assert main([*words, "--out", out, "--quiet"]) == 0
    return out


@pytest.mark.parametrize("case", ["drives", "measured", "observed"])
def test_only_what_sees_the_tool_learns_its_sway(folder, case) -> None:
    """Drives that are learnt leave the tool's sway on its springs; a measured or an observed tool has half of that left."""
    log, first = run_trial(folder, f"{case}0.csv")
    logs = [log]
    for k in range(1, 4):
        more = [] if case == "drives" else ["--robot", "gantry_tau"]
        if case == "observed":
            more += ["--observed", *(observe(folder, x) for x in logs)]
        found = learn(folder, logs, f"{case}_c{k}.csv", *more)
        log, last = run_trial(folder, f"{case}{k}.csv", f"{case}_c{k}.csv")
        logs.append(log)
    assert [row["joint"] for row in found["joints"]] == (
        list(ROBOT.actuated) if case == "drives" else ["x_tool", "y_tool"]
    )
    share = last / first
    assert share.min() > 0.3 if case == "drives" else share.max() < 0.2, share


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--measured", "x_tool"], "name its robot with --robot"),
        (["--robot", "gantry_tau", "--measured", "x_gauge"], "no column x_gauge"),
        (["--robot", "gantry_tau", "--measured", *4 * ["x_tool"]], "at most x, y and z"),
        (["--robot", "linear_axis"], "the robot has axis"),
        (["--robot", "gantry_tau", "--observed", "LOG", "LOG"], "one file a trial: 1, not 2"),
    ],
)
def test_a_tool_that_cannot_be_learnt_is_refused(folder, more, said, capsys) -> None:
    """Status 2 and one sentence: no robot, no such column, another robot, files that do not belong to the trials."""
    log, _ = run_trial(folder, "bad.csv")
    words = ["learn", str(folder / "ref.csv"), "--history", log, "--out", str(folder / "no.csv")]
    assert main([*words, *(log if x == "LOG" else x for x in more)]) == 2
    assert said in capsys.readouterr().err and not (folder / "no.csv").exists()


def test_an_error_below_the_observers_is_said(folder, capsys) -> None:
    """Where the observed tool is known to 1 mm only, smaller errors are not the tool's: the warning has both numbers."""
    log, _ = run_trial(folder, "wide.csv")
    seen = pd.read_csv(observe(folder, log))
    for axis in ("x_tool", "y_tool"):
        seen[f"{axis}_low"], seen[f"{axis}_high"] = seen[axis] - 0.1, seen[axis] + 0.1
    seen.to_csv(folder / "wide_tool.csv", index=False)
    learn(folder, [log], "wide_c.csv", "--robot", "gantry_tau", "--observed", str(folder / "wide_tool.csv"))
    assert "below the observed tool's standard error, 5.1e+04 um" in capsys.readouterr().err
