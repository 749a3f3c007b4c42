"""Does `calibrate` find drives that yield, with the right size, by gravity alone and by known loads at the tool?

    python experiments/loaded_poses.py [--what delta clean springs] [--seeds 30] [--seed 0] [--robots NAME...] [--out DIR]

Machines, device, target and noise are those of `pose_files.py`: three dimensions off by 0.3 to 1 mm (mrad), a tracker of 20 um
and 40 urad. `delta`: a Delta whose three drives yield by 3e-4 to 2e-3 rad/(N m) under gravity, masses as in the file, 80 poses
with orientations within 0.5 rad and 60 held out, default options. `clean`: the same without springs, and a UR5 and an L1.
`springs`: L1, UR5 and Delta with masses 10 % off (one standard deviation), 40 poses, every other one with a known weight at the
tool, 60 held out, half of them loaded, model `nonparallel+elastic` or `complete+elastic`; 95 % intervals of all springs that are
determined are counted.

Truth: the joints stand where springs and the gradient of the potential energy balance, `k (x - q) = -dV/dx`, found by iteration;
`V` is Pinocchio's potential energy of the closed robot, less the work of the weight at the tool, and its gradient a difference
quotient. Out: `loaded_poses_WHAT.csv`, a row a machine, and the counts.
"""

from __future__ import annotations

import argparse
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pinocchio as pin
from pose_files import (
    DIMENSIONS,
    N_HELD,
    N_TRAIN,
    NOISE,
    Drawn,
    StudiedRobot,
    build_machine,
    draw,
    list_confirmed,
    measure_ratio,
)

from tau_dyn.calibrate import GeometryFit, PoseSet, calibrate
from tau_dyn.calibrate.model_selection import Options, fit_spec
from tau_dyn.calibrate.models import get_family
from tau_dyn.calibrate.simulated import simulate_poses
from tau_dyn.files import write_whole
from tau_dyn.mechanism import build_kinematics

N_LOADED = 40
COMPLIANCES = {"delta": (3e-4, 2e-3), "ur5": (1e-5, 1e-4), "l1": (1e-7, 1e-6)}
"""Range of the drives' compliances [rad/(N m) or m/N], drawn evenly in their logarithm."""
WEIGHTS = {"delta": (1.0, 2.0), "ur5": (2.5, 5.0), "l1": (15.0, 30.0)}
"""Known weights at the tool [kg]."""
MODELS = {"delta": "complete+elastic", "ur5": "complete+elastic", "l1": "nonparallel+elastic"}
MASS_ERROR = 0.1
DELTA_REACH = 0.5
"""[rad] from home; within 0.3, or without orientations, free dimensions explain what gravity does to 2 um."""
_STEP = 1e-4  # [rad or m] of difference quotients
_AT_REST = 1e-9  # [rad or m] of the last correction


class ElasticTruth:
    """A machine whose drives yield: where its joints really stand."""

    def __init__(self, drawn: Drawn, compliance: np.ndarray, mass_errors: np.ndarray) -> None:
        """Scale the bodies' masses (b,) of a machine with compliances (na,)."""
        self.drawn, self.compliance = drawn, compliance
        self.kinematics = build_kinematics(drawn.machine.robot)
        self.model = pin.Model(drawn.machine.robot.model)
        for k, error in enumerate(mass_errors, start=1):
            body = self.model.inertias[k]
            self.model.inertias[k] = pin.Inertia(body.mass * (1 + error), body.lever, body.inertia)
        self.data = self.model.createData()

    def compute_energy(self, q: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the potential energy (N,) [J] at real positions (N, na) with weights at the tool (N,) [kg]."""
        full = self.kinematics.full_positions(q)
        own = np.array([pin.computePotentialEnergy(self.model, self.data, x) for x in full])
        tool = self.drawn.machine.geometry.forward(self.drawn.theta, q).poses.position
        return own - weights * (tool @ self.model.gravity.linear)

    def settle(self, q: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return where the joints stand (N, na) when their encoders say `q` (N, na)."""
        real = q.copy()
        for _ in range(20):
            slopes = [
                (self.compute_energy(real + step, weights) - self.compute_energy(real - step, weights)) / (2 * _STEP)
                for step in _STEP * np.eye(q.shape[1])
            ]
            new = q - self.compliance * np.column_stack(slopes)
            change, real = np.abs(new - real).max(), new
            if change < _AT_REST:
                break
        return real

    def measure(self, q: np.ndarray, weights: np.ndarray) -> PoseSet:
        """Return measured poses at encoders' positions (N, na) with weights at the tool (N,) [kg]."""
        drawn = self.drawn
        seen = simulate_poses(drawn.machine.geometry, drawn.theta, self.settle(q, weights), drawn.rng, frames=drawn.frames,
                              noise=NOISE, turned=drawn.machine.turns)  # fmt: skip
        loads = np.zeros((len(q), 7))
        loads[:, 0] = weights
        step = np.sign(np.diff(q, axis=0, prepend=q[:1]))
        return replace(seen, q=q, loads=loads, approach=step)


def draw_truth(name: str, rng: np.random.Generator, elastic: bool, mass_error: float) -> ElasticTruth:
    """Return a machine with or without springs, masses off by a standard deviation."""
    machine = build_machine(name)
    drawn = draw(machine._replace(reach=DELTA_REACH, turns=True) if name == "delta" else machine, rng)
    low, high = np.log(COMPLIANCES[name])
    compliance = np.exp(rng.uniform(low, high, machine.robot.na)) * elastic
    errors = np.clip(mass_error * rng.standard_normal(len(machine.robot.model.inertias) - 1), -0.5, 0.5)
    return ElasticTruth(drawn, compliance, errors)


def study_gravity(name: str, number: int, seed: int, elastic: bool) -> dict[str, object]:
    """Return the row of one file without known loads."""
    rng = np.random.default_rng([seed, number, list(MODELS).index(name), int(elastic)])
    truth = draw_truth(name, rng, elastic, 0.0)
    train, held = (truth.measure(truth.drawn.positions(n), np.zeros(n)) for n in (N_TRAIN, N_HELD))
    found = calibrate(truth.drawn.machine.robot, train, held)
    confirmed = [x for x in list_confirmed(found) if x.split("@")[0] not in DIMENSIONS]
    named = [x for x in confirmed if x.startswith("drive_compliance@")]
    return {
        "robot": name, "number": number, "named": "; ".join(named), "others": "; ".join(x for x in confirmed if x not in named),
        "error_over_noise": measure_ratio(found), **_count(found.fit, truth.drawn.machine, truth.compliance),
        "model": found.chosen.name,
    }  # fmt: skip


def study_springs(name: str, number: int, seed: int) -> dict[str, object]:
    """Return the row of one file with known weights at every other pose."""
    rng = np.random.default_rng([seed, number, list(MODELS).index(name), 2])
    truth = draw_truth(name, rng, True, MASS_ERROR)
    train, held = (
        truth.measure(truth.drawn.positions(n), rng.choice(WEIGHTS[name], n) * (np.arange(n) % 2))
        for n in (N_LOADED, N_HELD)
    )
    family = get_family(truth.drawn.machine.robot, train)
    fitted = fit_spec(family, family.spec(MODELS[name]), train, Options())
    predicted = np.sqrt(np.mean(fitted.model_error(held.q, held.loads) ** 2) + 3 * NOISE[0] ** 2)
    error = fitted.errors(held).position_size.rms
    return {
        "robot": name, "number": number, "error_over_noise": error / (np.sqrt(3) * NOISE[0]),
        "error_over_predicted": error / predicted,
        **_count(fitted, truth.drawn.machine, truth.compliance),
    }  # fmt: skip


def _count(fitted: GeometryFit, machine: StudiedRobot, compliance: np.ndarray) -> dict[str, object]:
    """Return how many intervals of springs hold the truth, how many there are, and their median relative standard error."""
    inside, errors = [], []
    for joint, true in zip(machine.robot.actuated, compliance, strict=True):
        name = f"{joint}.drive_compliance"
        p = fitted.parameters[name] if name in fitted.parameters else None
        interval = None if p is None else fitted.interval(p)
        if interval is not None and p is not None and p.stderr is not None:
            inside.append(interval[0] <= true <= interval[1])
            errors.append(p.stderr / true if true else np.nan)
    return {
        "inside": sum(inside),
        "total": len(inside),
        "relative_stderr": float(np.median(errors)) if errors else np.nan,
    }


STUDIES: dict[str, tuple[tuple[str, ...], Callable[[str, int, int], dict[str, object]]]] = {
    "delta": (("delta",), lambda name, number, seed: study_gravity(name, number, seed, True)),
    "clean": (("delta", "ur5", "l1"), lambda name, number, seed: study_gravity(name, number, seed, False)),
    "springs": (tuple(MODELS), study_springs),
}


def summarise(what: str, table: pd.DataFrame) -> str:
    """Return the counts of a study of one robot in a line."""
    whole = table[table.fault == ""]
    total = int(whole.total.sum())
    text = (
        f"{what} {table.robot.iloc[0]}: error over noise median {whole.error_over_noise.median():.3f}, most "
        f"{whole.error_over_noise.max():.3f}"
    )
    if what == "springs":
        predicted = whole.error_over_predicted
        text += f"; over predicted {predicted.median():.3f}, {predicted.max():.3f}"
    else:
        text += f"; drive_compliance named in {int((whole.named != '').sum())} of {len(table)}"
        text += f"; another cause in {int((whole.others != '').sum())}"
    if total:
        text += f"; intervals hold {int(whole.inside.sum())} of {total} ({100 * whole.inside.sum() / total:.1f} %)"
        text += f", median standard error {100 * whole.relative_stderr.median():.2g} %"
    return text + f"; {len(table) - len(whole)} failed"


def main(kinds: list[str], seeds: int, seed: int, robots: list[str], out: Path) -> None:
    """Run the studies."""
    out.mkdir(parents=True, exist_ok=True)
    for what in kinds:
        rows: list[dict[str, object]] = []
        names, study = STUDIES[what]
        for name in (name for name in names if name in robots):
            for number in range(seeds):
                start = time.process_time()
                try:
                    row = study(name, number, seed)
                except Exception as fault:  # a study goes on after a machine that fails
                    traceback.print_exc()
                    row = {"robot": name, "number": number, "fault": f"{type(fault).__name__}: {fault}"[:200]}
                rows.append({"fault": ""} | row | {"seconds": round(time.process_time() - start, 1)})
                print(what, *rows[-1].values(), flush=True)
                write_whole(out / f"loaded_poses_{what}.csv", pd.DataFrame(rows).to_csv(index=False))
            table = pd.DataFrame([row for row in rows if row["robot"] == name])
            print(summarise(what, table.fillna({"fault": "", "others": "", "named": ""})), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robots", nargs="+", choices=MODELS, default=list(MODELS))
    parser.add_argument("--out", type=Path, default=Path("out"))
    args = parser.parse_args()
    main(args.what, args.seeds, args.seed, args.robots, args.out)
