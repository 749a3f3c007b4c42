"""Units of one type: mean and spread with intervals that hold for few units, an outlying unit, a start for a new one."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

from tau_dyn.cli import main
from tau_dyn.effects import build_friction_model
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify import identify
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.monitor import Fleet, estimate_random_effects, identify_fleet
from tau_dyn.robot import load_robot
from tau_dyn.simulate import build_fourier_motion

ROBOT = load_robot("gantry_tau")
FRICTION = build_friction_model("asymmetric", ROBOT.actuated, ROBOT.force_units)


def record(seed: int, mass: float, seconds: float = 12.0, name: str = "") -> Log:
    """Return forces of an L1 with a plate of this mass, 20 N Coulomb and 40 N/(m/s) viscous friction, noise of 2 N."""
    model = Model.of(ROBOT, FRICTION)
    values = {p.name: 20.0 if "coulomb" in p.name else 40.0 for p in model.effect_parameters}
    model = model.with_values(values | {"plate_link.mass": mass})
    motion = build_fourier_motion(model, seconds, seed).every(4)
    tau = model.torque(motion.q, motion.v, motion.a)
    tau += 2.0 * np.random.default_rng([7, seed]).standard_normal(tau.shape)
    columns = {f"q_{j}": motion.q[:, k] for k, j in enumerate(ROBOT.actuated)}
    columns |= {f"tau_{j}": tau[:, k] for k, j in enumerate(ROBOT.actuated)}
    return Log(motion.t, columns, name or f"unit{seed}")


MASSES = (8.6, 9.4, 9.0, 9.7, 8.9)


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    """Five units whose plates differ by half a kilogram and nothing else."""
    return identify_fleet(ROBOT, {f"u{k}": [record(k, mass)] for k, mass in enumerate(MASSES)})


def test_intervals_of_mean_and_spread_hold_for_four_units() -> None:
    """Of 600 fleets of four, 95 % intervals of mean and spread hold 92 to 99 %, with errors as large as the spread."""
    rng, mean, spread = np.random.default_rng(3), 0, 0
    for _ in range(600):
        stderr = rng.uniform(0.5, 1.5, 4)
        found = estimate_random_effects(5 + rng.standard_normal(4) + stderr * rng.standard_normal(4), stderr)
        mean += found.mean_ci95[0] < 5 < found.mean_ci95[1]
        spread += found.spread_ci95[0] <= 1 <= found.spread_ci95[1]
    assert 0.92 < mean / 600
    assert 0.92 < spread / 600 < 0.99


def test_exact_estimates_give_mean_and_standard_deviation() -> None:
    """Units without errors of their own have their sample's mean and standard deviation."""
    values = np.array([1.0, 2.0, 4.0, 7.0])
    found = estimate_random_effects(values, np.full(4, 1e-9))
    assert found.mean == pytest.approx(values.mean())
    assert found.spread == pytest.approx(values.std(ddof=1))


def compute_chance(values: np.ndarray, stderr: np.ndarray) -> float:
    """Return the chance of such differences between equal units (Cochran's Q)."""
    w = stderr**-2.0
    return float(stats.chi2.sf(w @ (values - w @ values / w.sum()) ** 2, len(values) - 1))


def test_what_differs_has_a_spread_and_what_does_not_has_none(fleet) -> None:
    """The plates' spread is that of the masses; the friction of a joint, the same in all units, may have none."""
    rows = {p.name: p for p in fleet.parameters}
    plate = rows["plate_link.mass"]
    assert plate.spread == pytest.approx(np.std(MASSES, ddof=1), rel=0.3)
    assert plate.spread_ci95[0] > 0.1
    assert plate.mean_ci95[0] < np.mean(MASSES) < plate.mean_ci95[1]
    chances = {name: compute_chance(*np.array(list(p.values.values())).T) for name, p in rows.items()}
    assert chances.pop("plate_link.mass") < 1e-6
    assert len(chances) == 18 and min(chances.values()) > 0.01 / 18  # over all of them one in a hundred
    assert not fleet.outlying


def test_a_unit_far_from_the_others_is_said() -> None:
    """A plate that is 4 kg heavier than seven others makes its unit outlying."""
    masses = (8.9, 9.1, 9.0, 9.2, 8.8, 9.05, 8.95, 13.0)
    found = identify_fleet(ROBOT, {f"u{k}": [record(k, mass)] for k, mass in enumerate(masses)})
    assert [row.unit for row in found.outlying] == ["u7"]
    assert found.outlying[0].parameter == "plate_link.mass"
    assert any("u7 is outlying" in text for text in found.warnings)


def test_a_new_unit_takes_from_the_fleet_what_its_short_log_does_not_tell(fleet) -> None:
    """From 5 s, with the fleet's model, rods that are the same in all units are told better than from the log alone."""
    short = record(20, 9.3, 5.0)
    alone, with_fleet = (identify(ROBOT, short, model=m) for m in ("asymmetric", fleet.model))
    rod = "rod1_link.mass"
    assert with_fleet.parameters[rod].stderr < 0.7 * alone.parameters[rod].stderr
    assert (
        abs(with_fleet.parameters["plate_link.mass"].value - 9.3) < 4 * with_fleet.parameters["plate_link.mass"].stderr
    )


def test_two_units_have_no_spread() -> None:
    """Two units are refused with what is missing."""
    with pytest.raises(CannotAnswer, match="2 units"):
        identify_fleet(ROBOT, {"a": [record(1, 9.0)], "b": [record(2, 9.0)]})


def test_a_recording_is_of_one_unit_and_forces_are_measured() -> None:
    """One log under three names has no spread, and forces that are zero throughout are no unit's."""
    one, two, three = (record(seed, 9.0, 6.0) for seed in (1, 2, 3))
    with pytest.raises(InputError, match="one unit"):
        identify_fleet(ROBOT, {"a": [one], "b": [one], "c": [two]})
    still = three.with_channels(**{name: 0 * x for name, x in three.channels.items() if name.startswith("tau")})
    with pytest.raises(CannotAnswer, match="never changes"):
        identify_fleet(ROBOT, {"a": [one], "b": [two], "c": [still]})


def test_the_command_groups_logs_by_unit_and_writes_a_model(tmp_path) -> None:
    """`UNIT=LOG` joins logs of one unit; the model that is written starts `identify`."""
    for k in range(4):
        record(k, MASSES[k], 8.0).to_csv(tmp_path / f"l{k}.csv")
    logs = [f"one={tmp_path / 'l0.csv'}", f"one={tmp_path / 'l1.csv'}", *(str(tmp_path / f"l{k}.csv") for k in (2, 3))]
    words = [
        "--out",
        str(tmp_path / "f.yaml"),
        "--json",
        str(tmp_path / "f.json"),
        "--report",
        str(tmp_path / "f.html"),
    ]
    assert main(["fleet", "gantry_tau", *logs, *words, "--quiet"]) == 0
    result = json.loads((tmp_path / "f.json").read_text())
    assert result["units"] == ["one", "l2", "l3"]
    assert Model.load(tmp_path / "f.yaml").parameters["plate_link.mass"].prior_stderr > 0
    assert "Mean and spread over units" in (tmp_path / "f.html").read_text()
