"""Universal files (UFF, UNV): time records with names, units and rate of their own; damaged ones end in one sentence."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raising import raises_code
from scipy.signal import lfilter

from tau_dyn.exceptions import InputError
from tau_dyn.log import read_log
from tau_dyn.modes import build_records, find_modes

DT, N = 0.002, 1500
ACCELERATION, FORCE, DISPLACEMENT = 12, 13, 8


def write(path: Path, *channels: dict[str, Any], length: float = 1.0, **common: Any) -> Path:
    """Write functions to a universal file by hand, in text; a channel holds `data`, and what differs from the usual header."""
    lines = [
        "    -1",
        "   164",
        f"{1:10d}{'SI':>20s}{1:10d}",
        f"{length:25.16E}{1:25.16E}{1:25.16E}",
        f"{273.15:25.16E}",
        "    -1",
    ]
    for own in channels:
        c = {"node": 1, "direction": 3, "kind": ACCELERATION, "unit": "m/s^2", "function": 1, "dt": DT, "start": 0.0}
        c |= {"count": len(own["data"]), **common, **own}
        lines += ["    -1", "    58", *["NONE"] * 5]
        lines.append(
            f"{c['function']:5d}{0:10d}{0:5d}{0:10d} {'NONE':10s}{c['node']:10d}{c['direction']:4d} {'NONE':10s}{0:10d}{0:4d}"
        )
        lines.append(f"{4:10d}{c['count']:10d}{1:10d}{c['start']:13.5E}{c['dt']:13.5E}{0:13.5E}")
        lines.append(f"{17:10d}{0:5d}{0:5d}{0:5d} {'Time':20s} {'s':20s}")
        lines.append(f"{c['kind']:10d}{0:5d}{0:5d}{0:5d} {'NONE':20s} {c['unit']:20s}")
        lines += [f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':20s} {'NONE':20s}"] * 2
        data = [f"{x:20.12E}" for x in c["data"]]
        lines += ["".join(data[k : k + 4]) for k in range(0, len(data), 4)] + ["    -1"]
    path.write_text("\n".join(lines) + "\n")
    return path


def structure(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return a force (N,) [N] and the acceleration (N,) [m/s^2] of a mode at 12 Hz with 2 % of damping."""
    rng = np.random.default_rng(seed)
    force, pole = rng.normal(size=N), np.exp(DT * 2 * np.pi * 12 * (-0.02 + 1j))
    y = lfilter([1, -2, 1], [1, -2 * pole.real, abs(pole) ** 2], force)
    return force, y + 0.01 * y.std() * rng.normal(size=N)


def test_channels_have_names_units_and_rate_of_the_file(tmp_path) -> None:
    """Accelerations in g become m/s^2, a sensor along -z is turned round, a displacement in mm is in metres; 500 Hz."""
    pytest.importorskip("pyuff")
    force, y = structure()
    log = read_log(
        write(
            tmp_path / "bench.unv",
            {"data": force, "node": 3, "kind": FORCE, "unit": "N"},
            {"data": -y / 9.80665, "node": 12, "direction": -3, "unit": "g"},
            {"data": 1e3 * y, "node": 7, "direction": 1, "kind": DISPLACEMENT, "unit": "mm"},
        )
    )
    assert set(log.channels) == {"f_3z", "a_12z", "x_7x"}
    np.testing.assert_allclose(log.t, DT * np.arange(N), atol=1e-9)
    for name, expected in (("f_3z", force), ("a_12z", y), ("x_7x", y)):
        np.testing.assert_allclose(log.channels[name], expected, rtol=1e-9, atol=1e-9)


def test_a_unit_that_is_not_named_is_that_of_the_file(tmp_path) -> None:
    """Dataset 164 says how many of the file's lengths are a metre; a unit that nobody knows stays, with a warning."""
    pytest.importorskip("pyuff")
    force, y = structure()
    channels = {"data": 1000 * y, "unit": ""}, {"data": force, "node": 2, "kind": FORCE, "unit": "volt"}
    log = read_log(write(tmp_path / "bench.unv", *channels, length=1000.0))
    np.testing.assert_allclose(log.channels["a_1z"], y, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(log.channels["f_2z"], force, rtol=1e-9, atol=1e-9)
    assert any("'volt'" in w for w in log.warnings)


def test_resonances_follow_from_several_records(tmp_path) -> None:
    """Three records of the same channels are three stretches, never joined; an FRF in the file is left out, which is stated."""
    pytest.importorskip("pyuff")
    channels = []
    for seed in range(3):
        force, y = structure(seed)
        channels += [{"data": force, "kind": FORCE, "unit": "N"}, {"data": y, "node": 2}]
    log = read_log(write(tmp_path / "bench.uff", *channels, {"data": y, "function": 4}))
    assert any("no time records are left out" in w for w in log.warnings)
    assert [r.n_samples for r in build_records(log, ["f_1z"], ["a_2z"])] == [N, N, N]
    found = find_modes(log, ["f_1z"], ["a_2z"], order=2, delay=0)
    assert found.modes[0].frequency_hz == pytest.approx(12, rel=0.01)
    assert found.modes[0].damping_ratio == pytest.approx(0.02, rel=0.2)


@pytest.mark.parametrize(
    ("channels", "code"),
    [
        ([{"data": np.ones(50), "count": 2_000_000_000}], "damaged_file"),
        ([{"data": np.ones(50), "count": 60}], "damaged_file"),
        ([{"data": np.ones(50), "function": 4}], "file_format"),
        ([{"data": np.ones(50), "dt": 0.0}], "time_stamps"),
        ([{"data": np.ones(50)}, {"data": np.ones(40), "node": 2}], "mismatch"),
        ([{"data": np.ones(50)}, {"data": np.ones(50), "node": 2, "dt": 0.01}], "mismatch"),
        ([{"data": np.ones(50)}, {"data": np.ones(50), "node": 2, "start": 1.0}], "mismatch"),
        ([{"data": np.ones(50)}] * 2 + [{"data": np.ones(50), "node": 2}], "mismatch"),
    ],
)
def test_files_that_are_no_log_end_in_a_sentence(channels, code, tmp_path) -> None:
    """Samples that are announced and not there, no time, no rate, channels that do not go together."""
    pytest.importorskip("pyuff")
    with raises_code(code):
        read_log(write(tmp_path / "bench.unv", *channels))


def test_bytes_that_were_changed_end_in_a_sentence(tmp_path, rng) -> None:
    """Cut off or overwritten anywhere, a file is read or refused; nothing else happens."""
    pytest.importorskip("pyuff")
    whole = write(tmp_path / "bench.unv", {"data": np.arange(60.0)}, {"data": np.arange(60.0), "node": 2}).read_bytes()
    path, refused = tmp_path / "spoilt.unv", 0
    for _ in range(150):
        spoilt = bytearray(whole)
        for at in rng.integers(0, len(whole), 3):
            spoilt[at] = rng.integers(0, 256)
        path.write_bytes(spoilt[: rng.integers(1, len(whole))] if rng.random() < 0.4 else spoilt)
        try:
            read_log(path)
        except InputError as fault:
            assert "\n" not in str(fault)
            refused += 1
    assert refused > 20


def test_other_files_are_refused_without_the_extra(tmp_path, monkeypatch) -> None:
    """A text of another kind is no universal file; without the library one sentence names the extra."""
    path = tmp_path / "bench.unv"
    path.write_text("t,x\n0,1\n")
    with raises_code("file_format"):
        read_log(path)
    monkeypatch.setitem(sys.modules, "pyuff", None)
    with pytest.raises(InputError, match=r"tau_dyn\[uff\]"):
        read_log(write(path, {"data": np.ones(50)}))


def test_samples_that_cannot_be_there_are_refused_before_the_library_sees_the_file(tmp_path, monkeypatch) -> None:
    """Two thousand million samples in a file of a few kilobytes: refused without the library, which would believe it."""
    monkeypatch.setitem(sys.modules, "pyuff", None)
    with raises_code("damaged_file"):
        read_log(write(tmp_path / "bench.unv", {"data": np.ones(50), "count": 2_000_000_000}))
