"""Responses to unmeasured forces: resonances, damping and shapes with intervals; nothing that has a scale."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.log import Log
from tau_dyn.message_codes import get_code
from tau_dyn.modes import OperationalModes, find_operational_modes
from tau_dyn.render import build_page

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))
from operational_modes import OUTPUTS, SHAPES, record_ambient

HZ, DAMPING = np.array([3.1, 7.9, 15.2]), np.array([0.01, 0.02, 0.015])


@pytest.fixture(scope="module")
def found() -> OperationalModes:
    """Three modes under unmeasured white forces, 200 s at 100 Hz."""
    return find_operational_modes(record_ambient(20_000, 0, HZ, DAMPING), OUTPUTS)


def test_the_modes_of_the_structure_and_no_others_are_found(found):
    """Frequencies and damping lie within four of their standard errors, which are small."""
    assert len(found.modes) == 3
    for mode, f, z in zip(found.modes, HZ, DAMPING, strict=True):
        assert abs(mode.frequency_hz - f) < 4 * mode.frequency_stderr < 0.05 * f
        assert abs(mode.damping_ratio - z) < 4 * mode.damping_stderr < 4 * z


def test_shapes_are_those_of_the_structure(found):
    """The modal assurance criterion of each shape with the true one exceeds 0.99."""
    for mode, true in zip(found.modes, SHAPES, strict=True):
        inner = abs(np.vdot(mode.shape, true)) ** 2
        assert inner > 0.99 * np.vdot(mode.shape, mode.shape).real * (true @ true)


def test_standard_errors_shrink_with_the_length_of_the_log():
    """Four times the data halve the standard errors: the median over three logs and modes."""
    ratio = []
    for seed in range(3):
        short, long = (
            find_operational_modes(record_ambient(n, seed, HZ, DAMPING), OUTPUTS).modes for n in (20_000, 80_000)
        )
        ratio += [b.frequency_stderr / a.frequency_stderr for a, b in zip(short, long, strict=True)]
        ratio += [b.damping_stderr / a.damping_stderr for a, b in zip(short, long, strict=True)]
    assert np.median(ratio) == pytest.approx(0.5, abs=0.15)


def test_several_logs_count_as_one_longer(found):
    """Logs are not joined, and their correlations are added."""
    logs = [record_ambient(10_000, seed, HZ, DAMPING) for seed in range(4)]
    modes = find_operational_modes(logs, OUTPUTS).modes
    assert len(modes) == 3
    assert np.mean([b.damping_stderr / a.damping_stderr for a, b in zip(found.modes, modes, strict=True)]) < 1


def test_units_of_outputs_do_not_matter(found):
    """An output in thousandths of its unit changes its own row of the shapes only."""
    log = record_ambient(20_000, 0, HZ, DAMPING)
    scaled = replace(log, channels={**log.channels, "y2": 1000 * log.channels["y2"]})
    for a, b in zip(found.modes, find_operational_modes(scaled, OUTPUTS).modes, strict=True):
        assert b.damping_ratio == pytest.approx(a.damping_ratio, rel=1e-6)
        assert b.damping_stderr == pytest.approx(a.damping_stderr, rel=1e-4)
        assert b.shape[1] / b.shape[0] == pytest.approx(1000 * a.shape[1] / a.shape[0], rel=1e-6)


def test_what_needs_the_force_is_not_given(found):
    """Without the force a response has no scale: M, D, K and fits are null, with the reason."""
    result = found.to_dict()
    assert result["mdk"]["status"] == "not_identifiable" and result["mdk"]["K"] is None and result["mdk"]["why"]
    assert result["fit_percent"] == {"train": None, "holdout": None}
    assert len(result["modes"]) == 3 and result["modes"][0]["frequency_ci95"][0] < found.modes[0].frequency_hz


def test_it_is_shown_on_a_page_and_in_a_notebook(found):
    """The page and the notebook's view name the frequencies; the table has a row a mode."""
    page = build_page(found, logs=[("ambient.csv", "0" * 64)])
    assert "Stabilisation" in page and "ambient.csv" in page and "shapes have no scale" in page
    assert "Hz" in found._repr_html_() and len(found.to_pandas()) == 3


def test_noise_alone_has_no_modes():
    """White sensor noise rings nowhere."""
    rng = np.random.default_rng(0)
    log = Log(np.arange(8000) / 100, {"y1": rng.normal(size=8000), "y2": rng.normal(size=8000)}, "noise.csv")
    with raises_code("not_identifiable"):
        find_operational_modes(log, ["y1", "y2"])


@pytest.mark.parametrize("seed", range(3))
def test_a_tone_leaves_the_modes_alone(seed):
    """A machine's tone as loud as the structure does not move its modes; a warning says so where it is taken for one."""
    log = record_ambient(20_000, seed, HZ, DAMPING)
    tone = {name: y + y.std() * np.sin(2 * np.pi * 20.0 * log.t) for name, y in log.channels.items()}
    seen = find_operational_modes(replace(log, channels=tone), OUTPUTS)
    for f in HZ:
        mode = min(seen.modes, key=lambda m: abs(m.frequency_hz - f))
        assert abs(mode.frequency_hz - f) < 4 * mode.frequency_stderr
    if any(abs(m.frequency_hz - 20) < 0.1 for m in seen.modes):
        assert any("20 Hz" in text and "tone" in text for text in seen.warnings)


def test_bad_input_is_refused():
    """Outputs must be named and whole, and a log long enough."""
    log = record_ambient(4000, 0, HZ, DAMPING)
    with raises_code("bad_option", "--outputs"):
        find_operational_modes(log, [])
    with raises_code("missing_column", "y9"):
        find_operational_modes(log, ["y9"])
    for order in (1, 1000, "many"):
        with raises_code("bad_option", f"--order {order}"):
            find_operational_modes(log, OUTPUTS, order=order)
    short = replace(log, t=log.t[:100], channels={k: v[:100] for k, v in log.channels.items()})
    with raises_code("too_little_data"):
        find_operational_modes(short, OUTPUTS)


@pytest.fixture(scope="module")
def set_ups() -> list[Log]:
    """Two logs that share `y1`; the second sensor stands at `y2` and then at `y3`, under five times the force."""
    logs = []
    for seed, (name, size) in enumerate([("y2", 1.0), ("y3", 5.0)]):
        whole = record_ambient(20_000, seed, HZ, DAMPING)
        channels = {key: size * whole.channels[key] for key in ("y1", name)}
        logs.append(Log(whole.t, channels, f"{name}.csv"))
    return logs


def test_set_ups_with_a_sensor_that_moves_on_give_one_shape(set_ups):
    """Frequencies within 3 standard errors, and each shape over all three outputs as that of the structure."""
    found = find_operational_modes(set_ups, OUTPUTS)
    assert len(found.modes) == 3
    for mode, f, true in zip(found.modes, HZ, SHAPES, strict=True):
        assert abs(mode.frequency_hz - f) < 3.5 * mode.frequency_stderr
        np.testing.assert_allclose(mode.shape / mode.shape[0], true / true[0], atol=0.08)
    assert "2 set-ups are joined by y1 (y2.csv: y2; y3.csv: y3)" in found.warnings


def test_a_frequency_that_differs_between_set_ups_is_told(set_ups):
    """A sensor of other mass moves a resonance by 2 %: the joined shape is not that of one structure."""
    heavier = record_ambient(20_000, 7, HZ * [1.0, 0.98, 1.0], DAMPING)
    other = Log(heavier.t, {key: heavier.channels[key] for key in ("y1", "y3")}, "heavier.csv")
    found = find_operational_modes([set_ups[0], other], OUTPUTS)
    (said,) = [w for w in found.warnings if get_code(w) == "setups_differ"]
    assert "7.9" in said and "heavier.csv" in said


def test_set_ups_without_a_sensor_that_stays_are_refused(set_ups):
    """Two logs that share no output say nothing of the scale of one shape against the other."""
    alone = [Log(log.t, {key: log.channels[key]}, key) for log, key in zip(set_ups, ("y2", "y3"), strict=True)]
    with raises_code("mismatch", "stays in its place"):
        find_operational_modes(alone, ["y2", "y3"])


def test_a_figure_is_the_stabilisation_diagram(found):
    """Each stable mode of each order is a point; a line is at each mode that was chosen."""
    (axis,) = found.plot().axes
    stable = [x.frequency_hz for x in found.stabilisation if x.kind == "stable"]
    assert list(axis.lines[0].get_xdata()) == stable and len(axis.lines) == 2 + len(found.modes)
