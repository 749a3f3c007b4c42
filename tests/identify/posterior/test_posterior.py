"""Samples of what logs and robot file leave open, and bands around predictions: each robot may exist, and shares are kept."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from tau_dyn.cli import main
from tau_dyn.effects import build_friction_model
from tau_dyn.estimate import ConvexSet, pseudo_inertia, sample_truncated_normal
from tau_dyn.exceptions import InputError
from tau_dyn.identify import Identification, compute_data_covariance, identify
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import load_robot_from_urdf
from tau_dyn.simulate import build_fourier_motion

ARM = load_robot_from_urdf(
    '<robot name="arm"><link name="base_link"/>'
    + "".join(
        f'<link name="l{k}_link"><inertial><origin xyz="0.2 0 0"/><mass value="{m}"/>'
        f'<inertia ixx="0.01" iyy="0.06" izz="0.06" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        f'<joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="l{k}_link"/><origin xyz="{x} 0 0"/>'
        '<axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="4" effort="200"/></joint>'
        f'<transmission name="t{k}"><type>x</type><joint name="j{k}"/><actuator name="m{k}"/></transmission>'
        for k, m, parent, x in ((1, 4.0, "base_link", 0.0), (2, 2.0, "l1_link", 0.4))
    )
    + "</robot>",
    "arm",
)


def record(robot=ARM, seconds: float = 12.0, seed: int = 0, noise: float = 0.02) -> Log:
    """Return a log with white noise of a share of each joint's rms force."""
    model = Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))
    model = model.with_values({p.name: 2.0 if "coulomb" in p.name else 1.0 for p in model.effect_parameters})
    motion = build_fourier_motion(model, seconds, seed).every(4)
    tau = model.torque(motion.q, motion.v, motion.a)
    rng = np.random.default_rng(seed)
    tau += noise * np.sqrt(np.mean(tau**2, axis=0)) * rng.standard_normal(tau.shape)
    columns = {f"q_{j}": motion.q[:, k] for k, j in enumerate(robot.actuated)}
    return Log(motion.t, columns | {f"tau_{j}": tau[:, k] for k, j in enumerate(robot.actuated)}, f"log{seed}")


@pytest.fixture(scope="module")
def found() -> Identification:
    """Two links that turn about parallel axes: seven of the twenty inertial numbers' combinations show."""
    return identify(ARM, record(), estimator="wls")


def compute_least_eigenvalues(found: Identification, values: np.ndarray) -> list[float]:
    """Return the smallest eigenvalue of each body of each draw."""
    names = found.parameters.names
    return [
        float(np.linalg.eigvalsh(pseudo_inertia(link.map @ row[[names.index(n) for n in link.names]]))[0])
        for link in found.model.robot.links
        for row in values
    ]


def test_half_of_a_normal_distribution_beyond_a_wall_has_its_own_tail() -> None:
    """Beyond two deviations a normal variable has the distribution of its tail, and another one stays normal."""
    wall = ConvexSet(np.array([-2.0]), np.array([[1.0, 0.0]]), np.zeros((0, 4, 4)), np.zeros((2, 0, 4, 4)))
    drawn = sample_truncated_normal(wall, np.array([2.1, 0.0]), 4000, np.random.default_rng(1))
    assert drawn.converged
    assert drawn.z[:, 0].min() >= 2
    assert stats.kstest(stats.norm.sf(drawn.z[:, 0]) / stats.norm.sf(2), "uniform").pvalue > 0.001
    assert stats.kstest(drawn.z[:, 1], "norm").pvalue > 0.001


def test_a_matrix_that_must_be_positive_definite_restricts_as_rejection_does() -> None:
    """Draws with a positive definite matrix have the moments of plain draws of which the others are thrown away."""
    J = np.zeros((3, 1, 4, 4))
    for k, (i, j) in enumerate(((0, 1), (1, 2), (2, 3))):
        J[k, 0, i, j] = J[k, 0, j, i] = 1.0
    matrix = ConvexSet(np.zeros(0), np.zeros((0, 3)), np.eye(4)[None], J)
    drawn = sample_truncated_normal(matrix, np.zeros(3), 4000, np.random.default_rng(0)).z
    plain = np.random.default_rng(1).standard_normal((200_000, 3))
    inside = np.linalg.eigvalsh(np.eye(4) + np.tensordot(plain, J[:, 0], axes=1))[:, 0] > 0
    kept = plain[inside]
    assert 0.02 < len(kept) / len(plain) < 0.5
    assert stats.ks_2samp(drawn[:, 0], kept[:, 0]).pvalue > 0.001
    assert stats.ks_2samp(drawn[:, 1] ** 2, kept[:, 1] ** 2).pvalue > 0.001
    assert np.cov(drawn.T) == pytest.approx(np.cov(kept.T), abs=0.03)


def test_every_sample_is_a_robot_that_may_exist(found) -> None:
    """Each body of each sample has a positive definite pseudo-inertia, and bounds hold."""
    samples = found.sample(500, seed=3)
    assert min(compute_least_eigenvalues(found, samples.values)) > 0
    lower = np.array([p.lower for p in samples.model.parameters])
    assert np.all(samples.values >= lower)
    assert not samples.held


def test_what_the_log_tells_spreads_as_its_standard_error_and_the_rest_as_the_file(found) -> None:
    """A base parameter's draws have the estimate's error; a mass that no force shows has a quarter of its nominal value."""
    samples = found.sample(1000, seed=1)
    base = found.estimate.base
    columns = [found.parameters.names.index(n) for n in base.names]
    told = np.array([base.combine(row) for row in samples.values[:, columns]])
    relative = told.std(axis=0) / np.sqrt(np.diag(compute_data_covariance(found.estimate)))
    assert np.all(relative < 1.1)
    assert np.all(relative[-8:] > 0.75)  # friction has no nominal value; only a bound that it is correlated with helps
    mass = samples.to_frame()["l1_link.mass"]
    assert (
        3.5 < mass.mean() < 5.5
    )  # a thin link with its moment known is consistent with more mass rather than with less
    assert 0.5 < mass.std() < 1.1


def test_one_seed_gives_one_table_and_its_file(found, tmp_path) -> None:
    """Samples repeat with their seed; Parquet and CSV hold the same table, other endings are refused."""
    samples = found.sample(20, seed=5)
    assert np.array_equal(samples.values, found.sample(20, seed=5).values)
    samples.save(tmp_path / "s.parquet")
    samples.save(tmp_path / "s.csv")
    assert pd.read_parquet(tmp_path / "s.parquet").columns.tolist() == list(samples.names)
    assert pd.read_csv(tmp_path / "s.csv").to_numpy() == pytest.approx(samples.values)
    assert samples.build_model(7).parameters.values == pytest.approx(samples.values[7])
    with pytest.raises(InputError, match=r"\.parquet or \.csv"):
        samples.save(tmp_path / "s.txt")


def test_contradicting_inertias_of_the_file_count_for_less() -> None:
    """Where the logs show bodies ten times as heavy as the file says, its errors grow, and the samples say so."""
    log = record(noise=0.01)
    heavy = Log(log.t, {n: x if n.startswith("q") else 10 * x for n, x in log.channels.items()}, "heavy")
    samples = identify(ARM, heavy, estimator="wls").sample(50)
    assert samples.widening.prior > 4
    assert any("contradict the robot file" in text for text in samples.warnings)


def test_bands_hold_ninety_percent_of_a_new_motion(found) -> None:
    """Nine in ten samples of another motion lie within their band when the model is right."""
    held = [record(seed=k) for k in (7, 8, 9)]
    bands = identify(ARM, record(), holdout=held, estimator="wls").bands
    assert bands is not None
    assert 0.86 < bands.share < 0.95
    assert bands.to_dict()["per_joint"]["j1"]["width"] > 0


def test_the_command_writes_model_and_samples(tmp_path, capsys) -> None:
    """`--samples` with a model file writes the samples beside it; a table without their number is refused."""
    record().to_csv(tmp_path / "log.csv")
    (tmp_path / "arm.urdf").write_text(ARM.urdf)
    words = ["identify", str(tmp_path / "arm.urdf"), str(tmp_path / "log.csv"), "--quiet"]
    wanted = ["--samples", "30", "--out", str(tmp_path / "m.yaml"), "--json", str(tmp_path / "r.json")]
    assert main([*words, *wanted]) == 0
    assert len(pd.read_parquet(tmp_path / "m_samples.parquet")) == 30
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["samples"]["n"] == 30
    assert result["predictive_bands"]["level"] == 0.9
    assert main([*words, "--out", str(tmp_path / "s.csv")]) == 2
    assert "--samples N" in capsys.readouterr().err
