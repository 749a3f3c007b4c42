"""What has to hold of any machine and any part of its logs: identities of forces, answers or refusals, no finding of nothing."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from fuzz_parts.machines import build_machine, record, write_machine, write_some

from tau_dyn.cli import main
from tau_dyn.diagnose import diagnose
from tau_dyn.exceptions import InputError


def judge_forces(seed: int) -> str:
    """Return what is wrong with the forces of a machine: `tau = Y pi`, `tau = M a + h`, M symmetric and positive."""
    robot, model = build_machine(seed)
    mechanism, rng = model.mechanism, np.random.default_rng(seed)
    way = rng.uniform(-1, 1, (5, robot.na))
    for reach in (0.05, 0.01, 0.002):  # near home loops are regular, how far is the machine's own matter
        q = robot.home + reach * way
        with suppress(InputError):
            mechanism.condition(q)
            break
    v, a = rng.normal(size=(2, 5, robot.na))
    tau = mechanism.inverse_dynamics(q, v, a)
    size = max(float(np.abs(tau).max()), 1.0)
    wrong = []
    if np.abs(mechanism.regressor(q, v, a) @ robot.parameters.values - tau).max() > 1e-8 * size:
        wrong.append("the regressor is not linear in the parameters")
    for k in range(len(q)):
        M, h = mechanism.mass_and_bias(q[k], v[k])
        if np.abs(M @ a[k] + h - tau[k]).max() > 1e-7 * size:
            wrong.append("mass matrix and bias are not those of the forces")
        if np.abs(M - M.T).max() > 1e-8 * np.abs(M).max() or np.linalg.eigvalsh(M)[0] <= 0:
            wrong.append("the mass matrix is not symmetric and positive")
    return "; ".join(dict.fromkeys(wrong))


def judge_command(seed: int, folder: Path, schema: Any) -> str:
    """Return what is wrong with a command's answer to a random part of a machine's logs, trained and held out at random.

    Status 0 or 3 with a result that agrees with the schema, or 2 without one; anything else leaves as an exception.
    """
    draw = Random(seed)
    robot, model = build_machine(seed, 6)
    (folder / "machine.urdf").write_text(write_machine(seed, 6), encoding="utf-8")
    result, logs = folder / "result.json", []
    for k in range(draw.randint(1, 3)):
        write_some(record(model, seed + k, 4.0, f"log{k}.csv"), folder / f"log{k}.csv", draw)
        logs.append(str(folder / f"log{k}.csv"))
    result.unlink(missing_ok=True)
    command = draw.choice(["check", "columns", "identify", "identify", "identify"])
    if command == "identify":
        held = [x for x in logs if draw.random() < 0.4]
        trained = [x for x in logs if x not in held or draw.random() < 0.1] or logs[:1]
        words = [
            "identify",
            str(folder / "machine.urdf"),
            *trained,
            "--model",
            draw.choice(["rigid", "symmetric", "asymmetric"]),
        ]
        words += ["--holdout", *held] if held else []
    else:
        words = [command, logs[0], str(folder / "machine.urdf")]
    status = main([*words, "--json", str(result), "--quiet"])
    if status == 2:
        return "a file was written after status 2" if result.exists() else ""
    if status not in (0, 3):
        return f"status {status}"
    found = [f"{e.json_path} {e.message}" for e in schema.iter_errors(json.loads(result.read_text()))]
    return "; ".join(found[:3])


def judge_diagnosis(seed: int, most: int) -> str:
    """Return which cause is confirmed in a machine's own data, where nothing hides."""
    robot, model = build_machine(seed, most)
    try:
        logs = [record(model, seed + k, 12.0, f"log{k}.csv") for k in (0, 1)]
    except InputError as fault:
        return "" if fault.code in ("unreachable", "loop_not_closed") else str(fault)  # motions out of its reach
    found = diagnose(robot, logs[0], holdout=logs[1])
    wrong = [f"{f.cause} at {', '.join(f.joints)} is {f.status}" for f in found.findings if f.status != "suspected"]
    wrong += [f"{u.joint} is said to be unexplained" for u in found.unexplained if u.status == "confirmed"]
    return "; ".join(wrong)
