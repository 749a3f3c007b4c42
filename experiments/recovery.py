"""Are the standard errors honest: does identification of simulated logs recover the truth as often as it says?

    python experiments/recovery.py [--seeds 50] [--all] [--jobs 2] [--cluster tcp://...] [--out DIR]

In: nothing; logs are simulated. Five plants of a robot (masses off by up to 10 %, motions of their own) are driven once, with
the controller fed true positions, and measured with as many noise seeds as asked for: 100 s of `fourier` or `prbs` to train
on, 20 s of `prbs` held out. Out: `recovery.csv`, one row a seed and base parameter with `z = (estimate - truth) / stderr`, and
`recovery.yaml`, a summary a scenario: largest |z|, rms of z, coverage of the 95 % intervals pooled and by kind of
parameter, the largest mean z of a parameter of one plant in multiples of its own error (chance gives 2.6 to 3), and the
residual on held-out logs over that of the noise alone, put through the same filters and masks. The plain run answers for
L1 at 500 Hz, in about 2 minutes on one core; `--all` adds other log rates, encoders, colours, motions and robots, 25 minutes.
Interrupted, it goes on where it stopped (`recovery.jsonl`).
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from tau_dyn.cli.demo import build_true_model
from tau_dyn.effects import build_friction_model
from tau_dyn.files import write_whole
from tau_dyn.identify import Identification, build_regression, identify
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot
from tau_dyn.scale import run_journaled
from tau_dyn.simulate import (
    CascadeController,
    CascadeLaw,
    PlantRun,
    Sensors,
    build_named_motion,
    measure,
    simulate_drive,
)
from tau_dyn.version import __version__

PLANTS = 5
HELD_OUT_S = 20.0
ROBOTS: dict[str, Callable[[], Robot]] = {
    "l1": lambda: load_robot("gantry_tau", prototype="l1"),
    "l1_complete": lambda: load_robot("gantry_tau", prototype="l1", arms="complete"),
    "linear_axis": lambda: load_robot("linear_axis"),
}


@dataclass(frozen=True)
class Scenario:
    """What is simulated and how it is measured."""

    name: str
    robot: str = "l1"
    motion: str = "fourier"
    duration: float = 100.0
    log_rate_hz: float = 500.0
    encoder_noise: float = 5e-6  # m
    force_noise: float = 5.0  # N
    force_ar: tuple[float, ...] = ()
    feedback: str = "ideal"

    @property
    def sensors(self) -> Sensors:
        """Sensors of this scenario."""
        colour = {"force_ar": self.force_ar, "log_rate_hz": self.log_rate_hz}
        return Sensors(encoder_noise=self.encoder_noise, force_noise=self.force_noise, tool=False, **colour)


STANDARD = Scenario("L1, 500 Hz")
OTHERS = (
    replace(STANDARD, name="L1, 1 kHz", log_rate_hz=1000.0),
    replace(STANDARD, name="L1, 250 Hz", log_rate_hz=250.0),
    replace(STANDARD, name="L1, 500 Hz, AR(1) 0.9", force_ar=(0.9,)),
    replace(STANDARD, name="L1, 500 Hz, 20 um", encoder_noise=20e-6),
    replace(STANDARD, name="L1, 250 Hz, 20 um, AR(1) 0.9", log_rate_hz=250.0, encoder_noise=20e-6, force_ar=(0.9,)),
    replace(STANDARD, name="L1, prbs", motion="prbs"),
    replace(STANDARD, name="L1, prbs, 250 Hz, 20 um", motion="prbs", log_rate_hz=250.0, encoder_noise=20e-6),
    replace(STANDARD, name="L1, 1 N", force_noise=1.0),
    replace(STANDARD, name="linear axis, strokes", robot="linear_axis", motion="strokes"),
    replace(STANDARD, name="linear axis, fourier, AR(1) 0.9", robot="linear_axis", force_ar=(0.9,)),
    replace(STANDARD, name="L1 complete arms, 30 s", robot="l1_complete", duration=30.0),
    replace(STANDARD, name="L1, encoders in the feedback", feedback="encoder", duration=60.0),
)


@cache
def plant(robot: str, motion: str, duration: float, number: int, feedback_seed: int | None, encoder: float) -> PlantRun:
    """Return what happened on one plant; `feedback_seed` is None where the controller knows true positions."""
    truth = true_plant(robot, number)
    controller = CascadeController(CascadeLaw.emps()) if robot == "linear_axis" else None
    path = build_named_motion(motion, truth, duration, 100 + number)
    feedback = "ideal" if feedback_seed is None else "encoder"
    rate = (
        4000.0 if robot == "linear_axis" else 1000.0
    )  # Hz; steps of 1 ms would cost the stiff drive 0.02 % of its mass
    rng = np.random.default_rng([feedback_seed or 0, number])
    return simulate_drive(truth, path, controller, Sensors(encoder_noise=encoder), rng, rate_hz=rate, feedback=feedback)


@cache
def true_plant(robot: str, number: int) -> Model:
    nominal = ROBOTS[robot]()
    if robot != "linear_axis":
        return build_true_model(nominal, number)
    model = Model.of(nominal, build_friction_model("asymmetric", nominal.actuated, nominal.force_units))
    friction = {"coulomb_pos": 20.1, "coulomb_neg": 20.6, "viscous_pos": 167.0, "viscous_neg": 240.0}
    return model.with_values({f"axis.{k}": x for k, x in friction.items()} | {"carriage_link.mass": 90.0 + 3 * number})


def logs_of(scenario: Scenario, seed: int) -> tuple[Log, Log]:
    """Return a training and a held-out log of this seed."""
    number, rng = seed % PLANTS, np.random.default_rng([20, seed])
    own = seed if scenario.feedback == "encoder" else None
    parts = ((scenario.motion, scenario.duration), ("prbs", HELD_OUT_S))
    runs = [plant(scenario.robot, motion, s, number, own, scenario.encoder_noise) for motion, s in parts]
    train, held = (measure(run, scenario.sensors, rng, name) for run, name in zip(runs, ("train", "held"), strict=True))
    if own is not None:
        plant.cache_clear()
    return train, held


def floor_ratio(found: Identification, held: Log, scenario: Scenario, rng: np.random.Generator) -> float:
    """Return the held-out residual over that of the noise alone, through the same filters and masks; all joints, rms."""
    joints = found.model.robot.actuated
    noise = scenario.sensors.read_forces(np.zeros((held.n_samples, len(joints))), rng)
    blank = replace(held, channels=dict(held.channels) | {f"tau_{j}": noise[:, k] for k, j in enumerate(joints)})
    preparation = found.estimate.regression.preparation
    alone = build_regression(found.model, [blank], preparation=preparation).stacked()[1]
    W, y, _ = found.held.stacked()
    return float(np.sqrt(np.mean((y - W @ found.estimate.theta) ** 2) / np.mean(alone**2)))


def kind_of(name: str) -> str:
    """Return what sort of parameter it is: `rod mass`, `coulomb`, ..."""
    owner, quantity = name.split(".")
    return f"{owner.removesuffix('_link').rstrip('123abc')} mass" if quantity == "mass" else quantity.split("_")[0]


def trial(item: tuple[Scenario, int]) -> list[dict]:
    """Return one row a base parameter of one seed; depends on the item alone, so any process may do it."""
    scenario, seed = item
    nominal, truth, rows = ROBOTS[scenario.robot](), true_plant(scenario.robot, seed % PLANTS), []
    train, held = logs_of(scenario, seed)
    found = identify(nominal, train, holdout=held, seed=seed)
    e = found.estimate
    true = e.base.combine(truth.parameters.select(e.base.names).values)
    ratio = floor_ratio(found, held, scenario, np.random.default_rng([21, seed]))
    for k, (value, stderr) in enumerate(zip(e.beta, e.stderr, strict=True)):
        name = e.base.names[e.base.kept[k]]
        row = {"scenario": scenario.name, "seed": seed, "plant": seed % PLANTS, "parameter": name}
        row |= {"kind": kind_of(name), "truth": true[k], "value": value, "stderr": stderr}
        rows.append(row | {"z": (value - true[k]) / stderr, "held_over_floor": ratio})
    return rows


def summary(table: pd.DataFrame) -> dict:
    """Return what one scenario's rows say."""
    z, inside = table["z"], table["z"].abs() < 1.959964
    bias = table.groupby(["plant", "parameter"])["z"].agg(lambda x: x.mean() * np.sqrt(len(x)))
    ratio = table.groupby("seed")["held_over_floor"].first()
    return {
        "seeds": int(table["seed"].nunique()),
        "max_abs_z": float(z.abs().max()),
        "rms_z": float(np.sqrt(np.mean(z**2))),
        "coverage_percent": float(100 * inside.mean()),
        "coverage_percent_by_kind": {k: float(100 * x.mean()) for k, x in inside.groupby(table["kind"])},
        "mean_z_by_parameter": {k: float(x.mean()) for k, x in z.groupby(table["parameter"], sort=False)},
        "largest_bias_in_its_errors": float(bias.abs().max()),
        "largest_bias_of": " of plant ".join(map(str, bias.abs().idxmax()[::-1])),
        "held_over_floor": {"mean": float(ratio.mean()), "max": float(ratio.max())},
    }


def main(seeds: int, everything: bool, jobs: int, cluster: str | None, out_dir: Path) -> None:
    scenarios = (STANDARD, *(OTHERS if everything else ()))
    out_dir.mkdir(parents=True, exist_ok=True)
    journal = out_dir / "recovery.jsonl"
    items = [(scenario, seed) for scenario in scenarios for seed in range(seeds)]
    found = run_journaled(trial, items, journal, name=lambda i: f"{i[0]} {i[1]}", cluster=cluster, jobs=jobs)
    tables, summaries = [], {}
    for scenario in scenarios:
        table = pd.DataFrame([row for rows in islice(found, seeds) for row in rows])
        tables.append(table)
        s = summaries[scenario.name] = summary(table)
        kinds = "  ".join(f"{k} {x:.1f}" for k, x in s["coverage_percent_by_kind"].items())
        bias = f"{s['largest_bias_in_its_errors']:.1f} of its errors ({s['largest_bias_of']})"
        print(f"{scenario.name:34s} max |z| {s['max_abs_z']:.2f}  rms z {s['rms_z']:.2f}  95 % intervals cover "
              f"{s['coverage_percent']:.1f} % ({kinds})  held-out / floor {s['held_over_floor']['mean']:.3f}  "
              f"largest bias {bias}", flush=True)  # fmt: skip
    write_whole(out_dir / "recovery.csv", pd.concat(tables).to_csv(index=False))
    content = {"tool_version": __version__, "seeds": f"0 to {seeds - 1}", "scenarios": summaries}
    write_whole(out_dir / "recovery.yaml", yaml.safe_dump(content, sort_keys=False, allow_unicode=True))
    journal.unlink()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--all", action="store_true", dest="everything")
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    parser.add_argument("--jobs", type=int, default=1, help="processes on this machine")
    parser.add_argument(
        "--cluster", metavar="tcp://HOST:PORT", help="a Dask scheduler whose workers can import this file"
    )
    args = parser.parse_args()
    import recovery  # under its own name, so that other processes find its functions

    recovery.main(args.seeds, args.everything, args.jobs, args.cluster, args.out)
