"""One estimate of several logs in which a parameter has a value per log, and a test of whether the logs differ."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from tau_dyn.cli import main
from tau_dyn.effects import build_friction_model
from tau_dyn.estimate import Regression, RegressionRun, solve_least_squares
from tau_dyn.estimate.covariance import BLOCK_S
from tau_dyn.exceptions import InputError, UnknownName
from tau_dyn.identify import identify
from tau_dyn.identify.per_log import compare_logs, compute_contrast_p_value, split_by_log
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import load_robot
from tau_dyn.simulate import build_fourier_motion

ROBOT = load_robot("gantry_tau")
FRICTION = build_friction_model("asymmetric", ROBOT.actuated, ROBOT.force_units)


def record(seed: int, name: str, **changes: float) -> Log:
    """Return 12 s of the L1's forces with white noise of 2 N; 20 N of Coulomb friction, 40 N/(m/s) of viscous."""
    model = Model.of(ROBOT, FRICTION)
    values = {p.name: 20.0 if "coulomb" in p.name else 40.0 for p in model.effect_parameters}
    model = model.with_values(values | {name.replace("__", "."): x for name, x in changes.items()})
    motion = build_fourier_motion(model, 12.0, seed).every(4)
    noise = 2.0 * np.random.default_rng(seed).standard_normal(motion.q.shape)
    tau = model.torque(motion.q, motion.v, motion.a) + noise
    columns = {f"q_{j}": motion.q[:, k] for k, j in enumerate(ROBOT.actuated)}
    return Log(motion.t, columns | {f"tau_{j}": tau[:, k] for k, j in enumerate(ROBOT.actuated)}, name)


def test_a_heavier_plate_is_told_by_log_and_friction_is_not() -> None:
    """Half a kilogram on the plate shows in its log alone; the friction of an axis is the same in both."""
    logs = [record(1, "empty.csv"), record(2, "loaded.csv", plate_link__mass=9.63)]
    found = identify(ROBOT, logs, per_log=["plate_link.mass", "cart2.coulomb_*"])
    mass, forward, backward = found.per_log
    for value, true in zip(mass.values, (9.13, 9.63), strict=True):
        assert value.stderr is not None and abs(value.value - true) < 4 * value.stderr < 0.2
    assert mass.differ and not forward.differ and not backward.differ
    row = next(row for row in found.rows() if row["name"] == "plate_link.mass")
    assert row["value"] == pytest.approx(np.mean([v.value for v in mass.values])) and row["identifiable"]
    assert found.model.parameters["plate_link.mass"].value == row["value"]
    assert found.train.relative_error_percent < 2.5


def test_two_logs_of_one_name_are_two_logs() -> None:
    """Files of one name come from two folders, and each has its own value."""
    found = identify(ROBOT, [record(3, "run.csv"), record(4, "run.csv")], per_log=["plate_link.mass"])
    assert [value.log for value in found.per_log[0].values] == ["run.csv", "run.csv (2)"]
    assert not found.per_log[0].differ


def make_regression(rng: np.random.Generator, change: float) -> Regression:
    """Return two logs of one output whose first parameter differs by a change and is only told in a sum with the second."""
    names = ("a_link.mass", "b_link.mass", "c_link.mass")
    runs, n = [], 2000
    for k, name in enumerate(("one", "two")):
        x, z = rng.standard_normal((2, n))
        W = np.column_stack([x, 0.5 * x, z])[:, None]
        y = W @ np.array([1.0 + k * change, 2.0, 3.0]) + 0.1 * rng.standard_normal((n, 1))
        runs.append(RegressionRun(name, 0.01 * np.arange(n), W, y, np.ones((n, 1), bool), W, y))
    return Regression(Parameters([Parameter(name, 1.0, "kg") for name in names]), ("joint",), ("N",), tuple(runs))


def test_a_difference_is_told_where_no_value_is() -> None:
    """Of a mass that only shows in a sum with another no value is told, but a change between two logs is."""
    rng, names = np.random.default_rng(0), ["a_link.mass", "c_link.mass"]
    regression = make_regression(rng, 0.05)
    summed, alone = compare_logs(solve_least_squares(split_by_log(regression, names)), names, regression.parameters)
    assert summed.differ and all(value.stderr is None and value.value == 1.0 for value in summed.values)
    assert not alone.differ and all(value.stderr is not None for value in alone.values)


def test_equal_logs_are_called_different_as_seldom_as_stated() -> None:
    """Of 200 pairs of equal logs, about one in twenty has a p-value below 5 %."""
    rng, p_values = np.random.default_rng(1), []
    for _ in range(200):
        regression = make_regression(rng, 0.0)
        found = compare_logs(
            solve_least_squares(split_by_log(regression, ["c_link.mass"])), ["c_link.mass"], regression.parameters
        )
        p_values.append(found[0].p_value)
    assert np.sum(np.array(p_values) < 0.05) <= 18  # 10 expected, at most 18 in 99 % of such draws
    assert np.sum(np.array(p_values) < 0.5) > 60


def test_several_names_are_several_chances() -> None:
    """Beside another name under test, the p-value of a difference is twice what it is alone (Bonferroni)."""
    rng, names = np.random.default_rng(2), ["a_link.mass", "c_link.mass"]
    regression = make_regression(rng, 0.005)
    estimate = solve_least_squares(split_by_log(regression, names))
    both = [row.p_value for row in compare_logs(estimate, names, regression.parameters)]
    alone = [compare_logs(estimate, [name], regression.parameters)[0].p_value for name in names]
    assert both == pytest.approx([min(1.0, 2 * p) for p in alone])
    assert min(alone) < 0.5


def test_contrasts_of_few_blocks_have_hotellings_tails() -> None:
    """Three differences whose spread is known from 7 blocks are judged by 4/(3 * 6) T^2 of F(3, 4), not by chi^2."""
    spread = np.diag([4.0, 1.0, 9.0])
    run = SimpleNamespace(t=BLOCK_S * np.arange(7.0), usable=np.ones((7, 1), bool))
    estimate: Any = SimpleNamespace(
        beta_plain=np.array([6.0, 2.0, 3.0]), cov=1e-3 * spread, scatter=spread, regression=SimpleNamespace(runs=[run])
    )
    assert compute_contrast_p_value(estimate, np.eye(3)) == pytest.approx(stats.f.sf(14 * 4 / 18, 3, 4))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"per_log": ["plate_link.masse"]}, "plate_link.mass"),
        ({"per_log": ["cart1.armature"]}, "is fixed"),
        ({"per_log": ["plate_link.mass"], "estimator": "ml"}, "--estimator wls"),
    ],
)
def test_what_cannot_have_a_value_per_log_is_refused(options, said) -> None:
    """Unknown and fixed parameters, and estimators that share all columns, are refused with the remedy."""
    with pytest.raises((InputError, UnknownName), match=said):
        identify(ROBOT, [record(1, "a"), record(2, "b")], **options)


def test_one_log_has_nothing_to_be_compared_with() -> None:
    """Values per log need two logs."""
    with pytest.raises(InputError, match="only a"):
        identify(ROBOT, [record(1, "a")], per_log=["plate_link.mass"])


def test_the_command_writes_values_and_test(tmp_path, capsys) -> None:
    """The command's result has the contract's form, its page and the screen the table."""
    files = []
    for seed, mass in ((1, 9.13), (2, 9.63)):
        files.append(str(tmp_path / f"{seed}.csv"))
        record(seed, "", plate_link__mass=mass).to_csv(files[-1])
    out, page = tmp_path / "r.json", tmp_path / "r.html"
    command = [
        "identify",
        "gantry_tau",
        *files,
        "--per-log",
        "plate_link.mass",
        "--json",
        str(out),
        "--report",
        str(page),
    ]
    assert main(command) == 0
    (row,) = json.loads(out.read_text())["per_log"]
    assert row["name"] == "plate_link.mass" and row["unit"] == "kg" and row["differ"] and row["p_value"] < 1e-6
    assert [set(v) for v in row["values"]] == [{"log", "value", "stderr", "ci95"}] * 2
    assert "logs differ" in page.read_text() and "2.csv" in capsys.readouterr().out
