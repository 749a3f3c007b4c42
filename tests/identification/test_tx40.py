"""TX40, a measured arm with a coupled wrist: our friction and base parameters are the published ones (figaroh)."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from tau_dyn.estimate import pseudo_inertia
from tau_dyn.model import Model


@pytest.fixture(scope="module")
def out(measured, script, tmp_path_factory) -> Path:
    """Return where `identification/tx40.py` left its files."""
    folder = tmp_path_factory.mktemp("tx40")
    script("tx40").main(measured("tx40"), folder)
    return folder


@pytest.fixture(scope="module")
def table(out) -> pd.DataFrame:
    """Return published and our base parameters, by the published name's first symbol."""
    table = pd.read_csv(out / "tx40.csv")
    return table.set_index(table.published_as.str.split().str[0])


def test_friction_is_the_published_one(table):
    """Every viscous coefficient, and the Coulomb ones their data determine, within 5 % of the published least squares."""
    names = [f"fv{k}" for k in range(1, 7)] + [f"fs{k}" for k in range(1, 6)] + ["fvm6", "fsm6"]
    assert_allclose(table.value[names], table.published[names], rtol=0.05)


def test_large_inertias_and_moments_are_the_published_ones(table):
    """What is published to better than 5 % (inertia, mass moments, no friction) is met within 5 %."""
    certain = table[(table.published_sd_percent < 5) & ~table.index.str.startswith("f")]
    assert len(certain) >= 5
    assert_allclose(certain.value, certain.published, rtol=0.05)


def test_all_sixty_published_combinations_agree(table):
    """The same log gives the same base parameters: no combination is refused, and z is well below one."""
    assert len(table) == 60
    z = table.z
    print(f"z rms {np.sqrt(np.mean(z**2)):.2f}, largest {z.abs().max():.2f} ({z.abs().idxmax()})")
    assert np.sqrt(np.mean(z**2)) < 0.6
    assert z.abs().max() < 2


def test_torque_is_explained(out):
    """Relative torque error at most 7 %; 60 published base parameters and the drive inertia of joint 6 make the rank."""
    found = json.loads((out / "tx40.json").read_text())
    assert found["train"]["relative_error_percent"] <= 7
    assert found["rank"] == 61
    assert found["condition_number"] < 50


def test_identified_links_could_exist(out):
    """The saved model's links are physical, and lean on the robot file where the data are blind."""
    model = Model.load(out / "tx40.yaml")
    for link in model.robot.links:
        pi = link.map @ model.robot.parameters.select(link.names).values
        J = pseudo_inertia(pi)
        assert np.linalg.eigvalsh(J)[0] > -1e-6 * np.trace(J)
        assert 0 < pi[0] < 20  # the whole arm weighs 27 kg


def test_doubts_are_few_sentences(out):
    """A page of numbers, not a wall of warnings: the joints taken as actuated, physics, and what is not determined."""
    warnings = json.loads((out / "tx40.json").read_text())["warnings"]
    assert len(warnings) <= 4
