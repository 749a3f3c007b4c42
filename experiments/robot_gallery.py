"""What the gallery of docs/reference/robots.md says of every robot of `urdf/`: drives, loops, workspace at a coarse resolution.

    python experiments/robot_gallery.py [--only delta h4] [--seed 0] [--out FILE.json]

Each workspace is `tau-dyn workspace ROBOT --resolution R`, with R such that about 50 points lie along the reach; one that takes
more than 60 s of CPU time is left out.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from draw_robots import VARIANTS

from tau_dyn.files import write_whole
from tau_dyn.kinematics.workspace import build_machine
from tau_dyn.robot import Robot, list_robot_names, load_robot

_SECONDS = 60
_ACROSS = 50


def facts(name: str, arguments: dict[str, str], seed: int) -> dict[str, Any]:
    """Return what is known of a robot."""
    robot = load_robot(name, **arguments)
    kinds = [kind for kind in ("prismatic", "revolute") for j in robot.joint_kinds if j == kind]
    found = {"name": name, "arguments": arguments, "driven": robot.na, "kinds": kinds, "loops": len(robot.loops)}
    return found | {"resolution_m": (step := coarse(robot)), "workspace": workspace(name, arguments, step, seed)}


def coarse(robot: Robot) -> float:
    """Return a resolution [m] of about 50 points along the reach, in one digit."""
    low, high = build_machine(robot).reach()
    step = float((high - low).max()) / _ACROSS
    digit = 10.0 ** np.floor(np.log10(step))
    return float(np.round(step / digit) * digit)


def workspace(name: str, arguments: dict[str, str], step: float, seed: int) -> dict[str, Any]:
    """Return size and bounding box from the command, or why there are none."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "found.json"
        words = [w for k, v in arguments.items() for w in ("--set", f"{k}={v}")]
        words += ["--resolution", f"{step:g}", "--map", "condition", "--json", str(out), "--seed", str(seed), "--quiet"]
        command = [sys.executable, "-m", "tau_dyn.cli", "workspace", name, *words]
        done = subprocess.run(command, capture_output=True, preexec_fn=_limit, check=False)
        if done.returncode < 0:
            return {"why": f"not within {_SECONDS} s of CPU time at {step:g} m"}
        if done.returncode:
            return {"why": done.stderr.decode().strip().splitlines()[-1]}
        result = json.loads(out.read_text())
    box = np.array(result["bounding_box"]["upper"]) - np.array(result["bounding_box"]["lower"])
    return {"size": result["size"], "box_m": box.tolist()}


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (_SECONDS, _SECONDS))


def said(row: dict[str, Any]) -> str:
    """Return a robot's workspace as the page has it."""
    found = row["workspace"]
    if "why" in found:
        return f"{row['name']}: {found['why']}"
    size, unit = found["size"], {"m3": "m³", "m2": "m²"}.get(found["size"]["unit"], found["size"]["unit"])
    sides = " x ".join(f"{x:.2g}" for x in found["box_m"] if x > 1e-6)
    bounds = f"({size['low']:.2g} to {size['high']:.2g})"
    return f"{row['name']}: {size['value']:.2g} {unit} {bounds}, box {sides} m, at {row['resolution_m']:g} m"


def main() -> None:
    """Print and write them all."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--only", nargs="*", help="short names; all without it")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    rows = []
    for name in given.only or list_robot_names():
        rows.append(facts(name, VARIANTS.get(name, {}), given.seed))
        print(said(rows[-1]), flush=True)
    if given.out:
        write_whole(given.out, json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
