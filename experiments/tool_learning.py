"""Cases 1, 2A, 2B and 3 of Dressler 2012, chapter 7, by commands alone, on a nonlinear flexible L1 with friction.

    python experiments/tool_learning.py [OUT_DIR] [--seed 7] [--trials 10] [--figure docs/figures/tool_learning.svg]

The 10 mm square. Every trial is a CSV; `learn` reads the trials of its case and writes the next correction: of the drives (case
1), or of the tool that `observe` estimates with a complementary filter (2A) or a Kalman filter (2B), or that gauges measure (3).
The Kalman filter's model, and that of the resonances which the tool's cases invert, come from `modes` on a log of binary
sequences. Out, in OUT_DIR (default out/tool_learning): a page a
case, `cases.csv`, and the figure. (7.28) is that of the thesis' law, by `learn --gain 0.9 --shift 5 --cutoff 10`; where `learn`
chooses, the largest growth that its trials do not exclude is next to it. Ten minutes on one core. Needs matplotlib.
"""

import argparse
import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pandas as pd
from ilc_parts.flexible_l1 import DT, FlexibleL1, Run
from ilc_parts.learning_plant import square_path
from scipy.signal import max_len_seq

from tau_dyn.cli import main as tau_dyn
from tau_dyn.control import read_correction, write_reference
from tau_dyn.mechanism import forward_kinematics, inverse_kinematics
from tau_dyn.model import Model
from tau_dyn.robot import load_robot
from tau_dyn.simulate import Trajectory

ROBOT = load_robot("gantry_tau")
CASES = ("1", "2A", "2B", "3")
THESIS = {
    "1": ("0.90, 0.91, 0.93", 13.3, 36.1),
    "2A": ("0.86", 12.6, 23.9),
    "2B": ("0.93", 13.3, 25.2),
    "3": ("0.95", 10.3, 24.9),
}
N, START, JERK_TIME, PAUSE, LEAD = 1400, 1.2, 0.06, 0.15, 0.6  # samples, s; two rounds of the square
CUTOFFS = ("4.5", "2.63")  # Hz, (7.18)
AXES = ("x", "y")


def call(*words: object) -> None:
    """Run a command; its output is dropped.

    Raises:
        SystemExit: The command did not end with status 0.
    """
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
        status = tau_dyn([str(w) for w in words])
    if status:
        raise SystemExit(f"{' '.join(map(str, words))}: status {status}: {said.getvalue()}")


def write_log(path: Path, run: Run, k: int, sent: np.ndarray) -> Path:
    """Write one robot's trial as a user's controller would."""
    columns = {"t": np.arange(len(sent)) * DT}
    columns |= {f"q_ref_{j}": sent[:, i] for i, j in enumerate(ROBOT.actuated)}
    columns |= {f"q_{j}": run.q[:, k, i] for i, j in enumerate(ROBOT.actuated)}
    columns |= {f"{axis}_tool": run.tool[:, k, i] for i, axis in enumerate(AXES)}
    columns |= {f"a{axis}_tool": run.acceleration[:, k, i] for i, axis in enumerate(AXES)}
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


def identify_tool(plant: FlexibleL1, home: np.ndarray, folder: Path) -> tuple[Path, Path]:
    """Return models that `modes` finds: from computed to true tool, (6.13), and from commanded to true tool, (6.12)."""
    n, bits = 10_000, 2.0 * max_len_seq(12)[0] - 1
    tool = np.tile(home, (n, 1))
    for k in range(2):
        moved = 5e-4 * np.repeat(np.roll(bits, 1000 * k), 4)[: n - 200]
        tool[100:-100, k] += np.resize(moved, n - 200)
    sent = inverse_kinematics(ROBOT, tool).q
    run = plant.run(sent[:, None, :], 9_999)
    seen = forward_kinematics(ROBOT, run.q[:, 0]).poses.position
    columns = {"t": np.arange(n) * DT} | {f"{a}_c": seen[:, i] for i, a in enumerate(AXES)}
    columns |= {f"{a}_ref": tool[:, i] for i, a in enumerate(AXES)}
    columns |= {f"{a}_gauge": run.tool[:, 0, i] for i, a in enumerate(AXES)}
    pd.DataFrame(columns).to_csv(folder / "excited.csv", index=False)
    found = []
    for name, order in (("c", "6"), ("ref", "8")):
        out = folder / f"from_{name}.yaml"
        inputs, outputs = [f"{a}_{name}" for a in AXES], [f"{a}_gauge" for a in AXES]
        words = ["modes", folder / "excited.csv", "--inputs", *inputs, "--outputs", *outputs, "--order", order]
        call(*words, "--out", out, "--quiet")
        found.append(out)
    return found[0], found[1]


def learn_case(
    case: str, folder: Path, reference: Path, logs: list[Path], models: tuple[Path, Path]
) -> tuple[Path, dict]:
    """Return the correction after the trials of a case, and the result."""
    out, result = folder / f"correction_{case}.csv", folder / f"case_{case}.json"
    words: list[object] = ["learn", reference, "--history", *logs, "--lead", LEAD, "--out", out, "--json", result]
    words += ["--report", folder / f"case_{case}.html", "--quiet"]
    if case != "1":
        words += ["--robot", "gantry_tau", "--measured", "x_tool", "y_tool", "--model", models[1]]
    if case in ("2A", "2B"):
        words += ["--observed", *(observe(case, log, models[0]) for log in logs)]
    call(*words)
    return out, json.loads(result.read_text())


def observe(case: str, log: Path, model: Path) -> Path:
    """Return the observed tool of a trial."""
    out = log.with_name(f"{log.stem}_tool.csv")
    if not out.exists():
        how = ("--cutoff", *CUTOFFS) if case == "2A" else ("--model", model)
        call("observe", log, "gantry_tau", "--acceleration", "ax_tool", "ay_tool", *how, "--out", out, "--quiet")
    return out


def judge_thesis_law(folder: Path, reference: Path, log: Path) -> str:
    """Return the largest singular value (7.28) of the thesis' law on the drives that the first trial shows."""
    result = folder / "thesis_law.json"
    law = ("--gain", "0.9", "--shift", "5", "--cutoff", "10", "--lead", LEAD)
    call("learn", reference, "--history", log, *law, "--out", folder / "thesis_law.csv", "--json", result, "--quiet")
    return f"{json.loads(result.read_text())['convergence']['largest_singular_value']:.3f}"


def study(folder: Path, seed: int, trials: int) -> tuple[pd.DataFrame, np.ndarray, np.ndarray]:
    """Return a row a case, tool errors (trials + 1, N, cases, 2) [m], and the tool's reference (N, 2) [m]."""
    home = forward_kinematics(ROBOT, ROBOT.home).poses.position[0]
    tool = home + square_path(N, DT, jerk_time=JERK_TIME, pause=PAUSE, start=START)
    q = inverse_kinematics(ROBOT, tool).q
    plant = FlexibleL1(ROBOT.home, home, seed)
    reference = folder / "reference.csv"
    motion = Trajectory.through(ROBOT.actuated, np.arange(N) * DT, q)
    write_reference(reference, Model.of(ROBOT, []), motion)
    models = identify_tool(plant, home, folder)
    sent = np.repeat(q[:, None, :], len(CASES), axis=1)
    logs: dict[str, list[Path]] = {case: [] for case in CASES}
    errors, found = [], {}
    for trial in range(trials + 1):
        run = plant.run(sent, trial)
        errors.append(tool[:, None, :2] - run.true_tool[..., :2])
        for k, case in enumerate(CASES):
            logs[case].append(write_log(folder / f"case_{case}_{trial}.csv", run, k, sent[:, k]))
            correction, found[case] = learn_case(case, folder, reference, logs[case], models)
            sent[:, k] = q + read_correction(correction, ROBOT.actuated, period=DT).dq
        print(trial, (1e6 * rms(errors[-1])).round(1).tolist(), flush=True)
    table = tabulate(np.array(errors), found, judge_thesis_law(folder, reference, logs["1"][0]))
    return table, np.array(errors), tool[:, :2] - home[:2]


def rms(error: np.ndarray) -> np.ndarray:
    """Return root mean squares over time, where learning acts fully."""
    lead = round(LEAD / DT)
    return np.sqrt(np.mean(error[..., lead:-lead, :, :] ** 2, axis=-3))


def tabulate(errors: np.ndarray, found: dict[str, dict], law: str) -> pd.DataFrame:
    """Return a row a case: growth, errors in percent of the first trial's, and how many predictions held."""
    size = rms(errors)
    late = 100 * np.mean(size[5:] / size[0], axis=0)
    rows = []
    for k, case in enumerate(CASES):
        inside = [row["inside"] for row in found[case]["trials"] if row["inside"] is not None]
        growth = max(row["largest_growth_ci95"][1] for row in found[case]["joints"])
        rows.append({
            "case": case, "(7.28), thesis' law": law if case == "1" else "", "thesis": THESIS[case][0],
            "largest growth (95 %)": round(growth, 3), "x [%]": late[k, 0].round(1), "y [%]": late[k, 1].round(1),
            "thesis x [%]": THESIS[case][1], "thesis y [%]": THESIS[case][2],
            "first x, y [um]": ", ".join(f"{1e6 * s:.0f}" for s in size[0, k]),
            "last x, y [um]": ", ".join(f"{1e6 * s:.0f}" for s in size[-1, k]),
            "largest error over the first": round(float((size[1:, k] / size[0, k]).max()), 3),
            "inside": f"{sum(inside)} of {len(inside)}", "action": ", ".join(r["action"] for r in found[case]["joints"]),
        })  # fmt: skip
    return pd.DataFrame(rows)


def draw(path: Path, errors: np.ndarray, tool: np.ndarray) -> None:
    """Write the figure: the tool's path before and after learning, a panel a case, and errors by trial."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update({"svg.hashsalt": "tau_dyn", "svg.fonttype": "none"})
    import matplotlib.pyplot as plt

    lead = round(LEAD / DT)
    figure, axes = plt.subplots(1, len(CASES), figsize=(9, 2.6), sharex=True, sharey=True)
    for k, (case, axis) in enumerate(zip(CASES, axes, strict=True)):
        for error, colour in ((errors[0], "0.7"), (errors[-1], "tab:red")):
            way = 1e3 * (tool - error[:, k])[lead:-lead:3]
            axis.plot(way[:, 0], way[:, 1], color=colour, lw=0.7)
        axis.plot(*(1e3 * tool[lead:-lead:6].T), "k", lw=0.8)
        axis.set(title=f"case {case}", xlabel="x [mm]", aspect="equal")
    axes[0].set_ylabel("y [mm]")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})


def main(out_dir: Path, seed: int, trials: int, figure: Path | None) -> None:
    out_dir.mkdir(parents=True, exist_ok=True)
    for old in out_dir.glob("case_*_tool.csv"):
        old.unlink()
    table, errors, tool = study(out_dir, seed, trials)
    print(table.to_string(index=False))
    table.to_csv(out_dir / "cases.csv", index=False)
    draw(figure or out_dir / "cases.svg", errors, tool)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out_dir", type=Path, nargs="?", default=Path("out/tool_learning"))
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--figure", type=Path)
    main(**vars(parser.parse_args()))
