"""BAM: `bam.fit` with its largest model (M6) by CMA-ES on the processed training logs, then its own simulator.

It knows the pendulum's mass and arm. Its default of 100 000 trials takes hours here; `TRIALS` is what a comparison can wait for.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from common import DoesNotApply, run

MASS, LENGTH, SUPPLY, DT, MODEL, TRIALS = 0.49, 0.1, 7.4, 0.005, "m6", 1000  # kg, m, V, s


def process(name, x, known):
    t = np.arange(x["t"][0], x["t"][-1], DT)
    held = np.searchsorted(x["t"], t, side="right") - 1
    q = np.interp(t, x["t"], x["target"][:, 0]) if known else np.full(len(t), x["start"][0])
    entries = [{"position": p, "speed": 0.0, "goal_position": c, "torque_enable": bool(on)}
               for p, c, on in zip(q, x["cmd"][held, 0], x["torque_enable"][held] > 0, strict=True)]  # fmt: skip
    about = {
        "mass": MASS,
        "arm_mass": 0.0,
        "length": LENGTH,
        "kp": float(re.search(r"kp(\d+)", name)[1]),
        "vin": SUPPLY,
        "dt": DT,
    }
    return t, about | {"motor": "xl330", "entries": entries}


def predict(case):
    if case.kind != "servo" or len(case.channels) != 1:
        raise DoesNotApply("does not apply: it fits one servo with a pendulum")
    folder, out = case.folder / "bam", []
    folder.mkdir(exist_ok=True)
    for name, x in zip(case.train_names, case.train, strict=True):
        (folder / f"{name}.json").write_text(json.dumps(process(name, x, True)[1]))
    made = Path(case.folder) / "params.json"
    asked = [
        "--logdir",
        str(folder),
        "--output",
        str(made),
        "--actuator",
        "xl330",
        "--model",
        MODEL,
        "--trials",
        str(TRIALS),
    ]
    subprocess.run([sys.executable, "-m", "bam.fit", *asked], check=True, stdout=subprocess.DEVNULL)
    from bam.model import load_model
    from bam.simulate import Simulator

    for name, x in zip(case.held_names, case.held, strict=True):
        t, log = process(name, x, False)
        q = Simulator(load_model(str(made))).rollout_log(log, simulate_control=True)[0]
        out.append(np.interp(x["t"], t, np.ravel(q))[:, None])
    return out, {"note": f"{MODEL.upper()}, {TRIALS} trials"}


if __name__ == "__main__":
    run("better-actuator-models", predict)
