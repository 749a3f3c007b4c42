"""EMPS, a measured drive: our mass and friction are the published ones (Janot, Gautier & Brunot 2019)."""

import json
from pathlib import Path

import pytest
from numpy.testing import assert_allclose

from tau_dyn.cli import main
from tau_dyn.model import Model

COLUMNS = Path(__file__).resolve().parents[2] / "identification" / "columns" / "emps.yaml"


@pytest.fixture(scope="module")
def out(measured, script, tmp_path_factory) -> Path:
    """Return where `identification/emps.py` left its files."""
    folder = tmp_path_factory.mktemp("emps")
    script("emps").main(measured("emps/DATA_EMPS.csv"), folder)
    return folder


def result(out: Path, model: str) -> tuple[dict[str, float], float]:
    """Return values by parameter name, and the relative error [%]."""
    found = json.loads((out / f"emps_{model}.json").read_text())
    return {row["name"]: row["value"] for row in found["parameters"]}, found["train"]["relative_error_percent"]


def test_asymmetric_friction_and_mass_are_the_published_ones(out):
    """Mass within 0.2 kg (two of the published standard errors), viscous within 1 %, Coulomb within 0.4 N."""
    value, error = result(out, "asymmetric")
    assert_allclose(value["carriage_link.mass"], 95.154, atol=0.2)
    assert_allclose(value["axis.viscous_pos"], 166.71, rtol=0.01)
    assert_allclose(value["axis.viscous_neg"], 240.4, rtol=0.01)
    assert_allclose(value["axis.coulomb_pos"], 20.14, atol=0.4)
    assert_allclose(value["axis.coulomb_neg"], 20.63, atol=0.4)
    assert error <= 3.3


def test_symmetric_friction_with_offset_is_the_published_one(out):
    """Tolerances as above; the symmetric model fits worse, as published (4.08 %)."""
    value, error = result(out, "symmetric")
    assert_allclose(value["carriage_link.mass"], 95.109, atol=0.2)
    assert_allclose(value["axis.viscous"], 203.50, rtol=0.01)
    assert_allclose(value["axis.coulomb"], 20.39, atol=0.4)
    assert_allclose(value["axis.offset"], -3.165, atol=0.4)
    assert error <= 4.2


def test_the_published_values_lie_within_our_error_bars(out, script):
    """The two computations share the log, so they differ by less than two standard errors, and these are not blown up."""
    found = {row["name"]: row for row in json.loads((out / "emps_asymmetric.json").read_text())["parameters"]}
    for name, published in script("emps").PUBLISHED["asymmetric"].items():
        if name in found:
            assert abs(found[name]["value"] - published) < 2 * found[name]["stderr"]
            assert found[name]["stderr"] < 0.02 * published


def test_nothing_is_doubted_about_a_good_log(out):
    """A log that determines all five parameters brings no warning, but says what no log can tell."""
    found = json.loads((out / "emps_asymmetric.json").read_text())
    assert found["warnings"] == []
    assert all(row["determined"] for row in found["parameters"])
    assert len(found["equivalent_descriptions"]) == 1


def test_saved_model_carries_the_identified_mass(out):
    """What the script saves is the answer it prints."""
    model = Model.load(out / "emps_asymmetric.yaml")
    value, _ = result(out, "asymmetric")
    assert_allclose(model.parameters["carriage_link.mass"].value, value["carriage_link.mass"], rtol=1e-12)


def test_command_line_gives_the_same_answer(measured, out, tmp_path):
    """`tau-dyn identify` with the column map is the script's computation."""
    log, json_path = measured("emps/DATA_EMPS.csv"), tmp_path / "emps.json"
    arguments = ["identify", "linear_axis", str(log), "--columns", str(COLUMNS), "--json", str(json_path), "--quiet"]
    assert main(arguments) == 0
    found = json.loads(json_path.read_text())
    value, _ = result(out, "asymmetric")
    assert {row["name"]: row["value"] for row in found["parameters"]} == pytest.approx(value, rel=1e-9)
    assert found["status"] == "ok"
