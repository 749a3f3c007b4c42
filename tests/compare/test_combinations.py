"""Combinations of parameters that data determine are compared as what they are; what no data determined is not counted."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest

from tau_dyn.cli import main
from tau_dyn.compare import compare, read_side
from tau_dyn.render.kinds.comparison import describe_headline
from tau_dyn.render.kinds.fit_quality import list_combinations
from tau_dyn.render.presentation import present


def entry(name, value, stderr, unit="kg", **more):
    return {"name": name, "value": value, "stderr": stderr, "unit": unit, **more}


def result(path, base, *, members=("a.mass", "b.mass"), correlation=None, fixed=(), **more):
    """Write an identification: base parameters as (leading name, expression, value, stderr); members at nominal values."""
    singles = {name: (value, stderr) for name, text, value, stderr in base if name == text}
    content = {
        "command": "identify",
        "inputs": [{"path": f"{path.stem}.csv", "sha256": path.stem}],
        "parameters": [entry(n, *singles.get(n, (1.0, None))) for n in members if n not in dict(fixed)],
        "base_parameters": [entry(n, value, stderr, expression=text) for n, text, value, stderr in base],
        "correlation": correlation,
        "fixed_parameters": [{"name": n, "value": x, "unit": "kg"} for n, x in fixed],
    }
    path.write_text(json.dumps(content | more))
    return path


def compared(*paths):
    return compare(*map(read_side, paths))


def test_a_payload_shows_in_the_sum_of_two_masses(tmp_path, capsys):
    """A link that weighs 1 kg more, of which only the sum with its neighbour is known: 60 standard errors, on screen and page."""
    a = result(tmp_path / "a.json", [("a.mass", "a.mass + b.mass", 2.1952, 0.0059)])
    b = result(tmp_path / "b.json", [("a.mass", "a.mass + b.mass", 3.2035, 0.0097)])
    out, page = tmp_path / "c.json", tmp_path / "c.html"
    assert main(["compare", str(a), str(b), "--json", str(out), "--report", str(page)]) == 0
    said, found = " ".join(capsys.readouterr().out.split()), json.loads(out.read_text())
    assert "1 of 1 value with a standard error changed significantly: a.mass + b.mass;" in said
    assert "2 more values are not determined in either result." in said
    row = next(c for c in found["changes"] if c["name"] == "a.mass + b.mass")
    assert row["changed"] and row["combination"] and row["difference"] == pytest.approx(1.0083)
    assert row["stderr"] == pytest.approx((0.0059**2 + 0.0097**2) ** 0.5)
    assert found["n_compared"] == 1 and "a.mass + b.mass" in page.read_text()


def test_nominal_values_are_not_shown_as_unchanged(tmp_path, capsys):
    """Two masses that neither log shows are equal by decree: no row for them, one line that names them."""
    a, b = (result(tmp_path / f"{n}.json", [("c.mass", "c.mass", 1.0, 0.1)], members="a.mass b.mass c.mass".split())
            for n in "ab")  # fmt: skip
    assert main(["compare", str(a), str(b), "--json", str(tmp_path / "c.json")]) == 0
    said = capsys.readouterr().out
    assert "Not determined in either result, not compared: a.mass and b.mass." in said and said.count("a.mass") == 1
    assert json.loads((tmp_path / "c.json").read_text())["determined_by_neither"] == ["a.mass", "b.mass"]


def test_a_value_that_stayed_at_its_prior_in_both_is_no_finding(tmp_path):
    """A weighed mass that neither log adds to is the scale's value twice; once weighed, once estimated, it is compared."""
    weighed = {"parameters": [entry("a.mass", 0.8, 0.002, nominal=0.8, nominal_stderr=0.002)]}
    seen = {"parameters": [entry("a.mass", 0.9, 0.004, nominal=0.8, nominal_stderr=0.016)]}
    a, b, c = (result(tmp_path / f"{n}.json", [], **x) for n, x in zip("abc", (weighed, weighed, seen), strict=True))
    (kept,), (judged,) = compared(a, b).changes, compared(a, c).changes
    assert (kept.changed, kept.determined_by) == (None, "neither") and judged.changed


def test_the_same_combination_led_by_another_parameter_is_the_same(tmp_path):
    """`a + 0.5 b` of one is half of `b + 2 a` of the other, value and standard error."""
    a = result(tmp_path / "a.json", [("a.mass", "a.mass + 0.5*b.mass", 2.0, 0.1)])
    b = result(tmp_path / "b.json", [("b.mass", "b.mass + 2*a.mass", 6.0, 0.4)])
    (change,) = [c for c in compared(a, b).changes if c.combination]
    assert (change.a, change.b) == (2.0, 3.0) and change.stderr == pytest.approx((0.1**2 + 0.2**2) ** 0.5)


def test_other_coefficients_are_another_combination(tmp_path):
    """`a + b` and `a + 0.9 b` are two sums: neither is compared with the other, and that is said."""
    a = result(tmp_path / "a.json", [("a.mass", "a.mass + b.mass", 2.0, 0.1)])
    b = result(tmp_path / "b.json", [("a.mass", "a.mass + 0.9*b.mass", 6.0, 0.1)])
    found = compared(a, b)
    assert not any(c.combination for c in found.changes)
    assert found.only_a == ("a.mass + b.mass",) and found.only_b == ("a.mass + 0.9*b.mass",)
    assert any("different combinations" in w for w in found.warnings)


def test_a_sum_is_compared_with_both_of_its_members(tmp_path):
    """Where the other motion tells both masses, errors correlated by -0.9, their sum is known better than either."""
    a = result(tmp_path / "a.json", [("a.mass", "a.mass + b.mass", 2.0, 0.01)])
    pair = [("a.mass", "a.mass", 1.4, 0.1), ("b.mass", "b.mass", 1.6, 0.1)]
    b = result(tmp_path / "b.json", pair, correlation=[[1.0, -0.9], [-0.9, 1.0]])
    (change,) = [c for c in compared(a, b).changes if c.combination]
    assert change.b == pytest.approx(3.0) and change.changed
    assert change.stderr == pytest.approx((0.01**2 + 2 * 0.1**2 * 0.1) ** 0.5)


def test_a_member_that_was_given_counts_with_its_value(tmp_path):
    """With one mass fixed at 0.5 kg the other is told alone; the sum is that much more."""
    a = result(tmp_path / "a.json", [("a.mass", "a.mass + b.mass", 2.0, 0.01)])
    b = result(tmp_path / "b.json", [("a.mass", "a.mass", 1.5, 0.02)], fixed=[("b.mass", 0.5)])
    (change,) = [c for c in compared(a, b).changes if c.combination]
    assert change.b == 2.0 and not change.changed


def test_a_broken_correlation_judges_no_sum(tmp_path):
    """Without the correlation of two masses the error of their sum is not known, so it is not compared."""
    a = result(tmp_path / "a.json", [("a.mass", "a.mass + b.mass", 2.0, 0.01)])
    b = result(
        tmp_path / "b.json", [("a.mass", "a.mass", 1.4, 0.1), ("b.mass", "b.mass", 1.6, 0.1)], correlation=[[1.0]]
    )
    assert not any(c.combination for c in compared(a, b).changes)


def test_a_file_without_combinations_is_said(tmp_path):
    """A result that holds no combinations beside one that does: the sum is not compared, and the reader is told."""
    a = result(tmp_path / "a.json", [("a.mass", "a.mass + b.mass", 2.0, 0.01), ("c.mass", "c.mass", 1.0, 0.1)],
               members=("a.mass", "b.mass", "c.mass"))  # fmt: skip
    side = read_side(a)
    bare = replace(side, path=tmp_path / "b.json", combinations=type(side.combinations)())
    found = compare(side, bare)
    assert found.only_a == ("a.mass + b.mass",) and any("holds no combinations" in w for w in found.warnings)


def test_the_headline_names_few_and_shows_no_algebra(tmp_path):
    """A base parameter of five masses is named by the one that leads it, a sum of two is named whole."""
    names = [f"{letter}_link.mass" for letter in "abcdef"]
    long = " + ".join(["a_link.mass", *(f"0.425*{name}" for name in names[1:5])])
    a, b = (
        result(tmp_path / f"{n}.json", [("a_link.mass", long, x, 0.01), ("f_link.mass", "f_link.mass", 1.0, 0.01)],
               members=names)
        for n, x in (("a", 2.0), ("b", 3.0))
    )  # fmt: skip
    said = describe_headline(compared(a, b))
    assert said.startswith("1 of 2 values with a standard error changed significantly: a_link.mass + …;")
    assert "0.425" not in said


def test_files_without_combinations_are_not_called_the_same(tmp_path):
    """Where a heavier link may hide in a sum that a file does not hold, the verdict is no `Same`."""
    whole = result(tmp_path / "a.json", [("a.mass", "a.mass + b.mass", 2.0, 0.1), ("c.mass", "c.mass", 1.0, 0.1)],
                   members=("a.mass", "b.mass", "c.mass"))  # fmt: skip
    bare = result(tmp_path / "b.json", [], members=("a.mass", "b.mass"))
    content = json.loads(bare.read_text())
    bare.write_text(json.dumps(content | {"parameters": [*content["parameters"], entry("c.mass", 1.0, 0.1)]}))
    shown = present(compared(whole, bare))
    assert (shown.verdict.level, shown.verdict.badge) == ("care", "Tested in part")
    assert shown.headline.endswith("2 more values and all combinations are not tested.")
    (tmp_path / "d.json").write_text(whole.read_text())
    assert present(compared(whole, tmp_path / "d.json")).verdict.badge == "Same"


def test_seen_only_together_begins_with_the_best_known():
    """Of two sums that a motion shows, the one known to 0.3 % stands before the one known to 20 %, whatever the robot's order."""
    rows = [entry("a", -1.0, 0.2, expression="a + b"), entry("c", 2.0, 0.006, expression="c + d")]
    said = list_combinations(SimpleNamespace(base_rows=lambda: rows, determined_combinations=None))  # type: ignore[arg-type]
    assert [s.split(" = ")[0] for s in said] == ["c + d", "a + b"]
