"""What changed between two results is named, and what did not is not."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tau_dyn.cli import main
from tau_dyn.compare import Side, compare, read_side
from tau_dyn.compare.read import Quantity
from tau_dyn.exceptions import InputError
from tau_dyn.model import Model
from tau_dyn.parameters import Parameters
from tau_dyn.robot import load_robot


def side(quantities, name="a", **more):
    """Return a side with these `name: (value, stderr, unit)`."""
    found = {n: Quantity(*q) for n, q in quantities.items()}
    given = {"errors": {}, "findings": {}, "logs": frozenset()} | more
    return Side(Path(name), name, "identify", found, **given)


def test_two_estimates_of_one_robot_name_a_change_once_in_twenty(rng):
    """Holm's test over 12 values: of 400 pairs drawn from one truth at most 32 name any change (5 % and three deviations)."""
    false = 0
    for _ in range(400):
        stderr = rng.uniform(0.1, 2, 12)
        a, b = ({f"p{k}": (10 + s * rng.standard_normal(), s, "kg") for k, s in enumerate(stderr)} for _ in range(2))
        false += bool(compare(side(a), side(b, "b")).changed)
    assert 5 <= false <= 32


def test_a_heavier_plate_is_named_with_its_interval():
    """9.13 +- 0.05 against 9.63 +- 0.05 kg: 0.5 kg, seven standard errors, with 0.36 to 0.64 as its interval."""
    a, b = (
        side({"plate": (9.13, 0.05, "kg"), "cart": (13.6, 0.2, "kg")}),
        side({"plate": (9.63, 0.05, "kg"), "cart": (13.5, 0.2, "kg")}, "b"),
    )
    found = compare(a, b)
    assert [c.name for c in found.changed] == ["plate"]
    assert_allclose(found.changed[0].ci95, (0.5 - 1.96 * 0.0707, 0.5 + 1.96 * 0.0707), atol=1e-3)


def test_a_value_that_no_data_determined_is_not_judged():
    """Nominal values differ without being changes."""
    found = compare(side({"m": (1.0, None, "kg")}), side({"m": (2.0, 0.1, "kg")}, "b"))
    assert found.changes[0].changed is None and found.changed == ()


def test_resonances_are_matched_by_frequency():
    """A log that misses the first resonance does not shift the others."""
    a = {"mode 1 frequency": (7.4, 0.01, "Hz"), "mode 2 frequency": (11.5, 0.02, "Hz")}
    b = {"mode 1 frequency": (11.52, 0.02, "Hz"), "mode 2 frequency": (20.0, 0.1, "Hz")}
    found = compare(side(a), side(b, "b"))
    assert [(c.name, c.a, c.b) for c in found.changes] == [("mode 2 frequency", 11.5, 11.52)]
    assert found.only_a == ("mode 1 frequency",) and found.only_b == ("mode 3 frequency",)


def test_causes_that_came_and_went_are_listed():
    """A cause found in one result only stands with its status beside `None`."""
    key = ("stribeck", ("cart1",))
    found = compare(
        side({}, findings={key: "confirmed"}), side({}, "b", findings={("backlash", ("cart2",)): "suspected"})
    )
    assert {(f.cause, f.a, f.b) for f in found.findings} == {
        ("stribeck", "confirmed", None),
        ("backlash", None, "suspected"),
    }


def test_results_from_the_same_recording_say_so():
    """Two analyses of one log are not independent."""
    one, two = (
        side({"m": (1.0, 0.1, "kg")}, logs=frozenset("x")),
        side({"m": (1.1, 0.1, "kg")}, "b", logs=frozenset("x")),
    )
    assert "same recordings" in compare(one, two).warnings[0]


def test_other_units_are_refused():
    """A value in N against one in N m is no comparison."""
    with pytest.raises(InputError, match=r"in N in one and in N m"):
        compare(side({"x": (1.0, 0.1, "N")}), side({"x": (1.0, 0.1, "N m")}, "b"))


def saved(tmp_path, name, mass, stderr):
    model = Model.of(load_robot("linear_axis"))
    (p,) = [p for p in model.parameters if p.name == "carriage_link.mass"]
    model = model.with_parameters(
        Parameters([replace(q, value=mass, stderr=stderr) if q is p else q for q in model.parameters])
    )
    model.save(tmp_path / name)
    return tmp_path / name


def test_the_command_compares_models(tmp_path, capsys):
    """Two model files: the sentence names the mass, the JSON carries it, the page escapes the paths."""
    a, b = saved(tmp_path, "<b>a.yaml", 95.0, 0.1), saved(tmp_path, "b.yaml", 97.0, 0.1)
    status = main(["compare", str(a), str(b), "--json", str(tmp_path / "r.json"), "--report", str(tmp_path / "r.html")])
    assert status == 0
    assert "carriage_link.mass" in capsys.readouterr().out
    result = json.loads((tmp_path / "r.json").read_text())
    row = next(c for c in result["changes"] if c["name"] == "carriage_link.mass")
    assert row["changed"] and row["difference"] == pytest.approx(2.0)
    page = (tmp_path / "r.html").read_text()
    assert "<b>a.yaml" not in page and "&lt;b&gt;a.yaml" in page


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "neither a model file"),
        ("[1]", "not a result of ours"),
        ('{"command": "identify", "status": "cannot_answer"}', "nothing to compare"),
        ('{"command": "identify", "parameters": [{"name": "m"}]}', "wrong kind"),
        ('{"command": "identify", "parameters": [{"name": "m", "value": "x"}]}', "wrong kind"),
    ],
)
def test_what_is_no_result_is_one_sentence(tmp_path, capsys, content, says):
    """A broken result ends with status 2 and one line; nothing is written."""
    bad, good = tmp_path / "bad.json", tmp_path / "good.json"
    bad.write_text(content)
    good.write_text('{"command": "identify", "parameters": [{"name": "m", "value": 1, "stderr": 0.1, "unit": "kg"}]}')
    assert main(["compare", str(good), str(bad), "--json", str(tmp_path / "out.json")]) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1 and not (tmp_path / "out.json").exists()


def test_reading_a_result_of_identify(tmp_path):
    """Parameters, errors and data hashes are read from the contract's entries."""
    path = tmp_path / "r.json"
    row = {"name": "cart1.viscous_pos", "value": 60.0, "stderr": 2.0, "unit": "N/(m/s)"}
    files = [{"path": "l.csv", "sha256": "s"}, {"path": "robot.urdf", "sha256": "r"}]
    held_out = {"relative_error_percent": 3.5}
    path.write_text(json.dumps({"command": "identify", "parameters": [row], "inputs": files, "holdout": held_out}))
    read = read_side(path)
    assert read.quantities["cart1.viscous_pos"] == Quantity(60.0, 2.0, "N/(m/s)")
    assert read.errors == {"holdout error": (3.5, "%")} and read.logs == {"s"}
    assert np.isclose(compare(read, side({"cart1.viscous_pos": (61.0, 2.0, "N/(m/s)")}, "b")).changes[0].stderr, 8**0.5)
