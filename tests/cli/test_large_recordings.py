"""`tau-dyn identify` on recordings larger than memory: a folder is one log; what is wrong is one line and status 2."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tau_dyn.cli import main
from tau_dyn.log import recording

T = np.arange(0, 24, 0.004)


@pytest.fixture(autouse=True)
def everything_is_large(monkeypatch) -> None:
    """Let small files take the way of large ones, in several blocks."""
    import tau_dyn.identify  # noqa: F401

    monkeypatch.setattr(recording, "MAX_IN_MEMORY_SAMPLES", 100)
    blocks = import_module("tau_dyn.identify.streaming")  # packages load their modules when a name is used
    monkeypatch.setattr(blocks, "SIZE", 1)
    monkeypatch.setattr(blocks, "MIN_BLOCK_ROWS", 101)


def frame() -> pd.DataFrame:
    """Return the linear axis: 95 kg with some friction, moved by two sines."""
    q = 0.1 * np.sin(2 * np.pi * 0.5 * T) + 0.03 * np.sin(2 * np.pi * 1.3 * T)
    v, a = np.gradient(q, T), np.gradient(np.gradient(q, T), T)
    tau = 95 * a + 20 * np.sign(v) + 200 * v + np.random.default_rng(0).normal(0, 1, len(T))
    return pd.DataFrame({"t": T, "q_axis": q, "tau_axis": tau})


def written(folder: Path, *parts: pd.DataFrame) -> Path:
    folder.mkdir()
    for k, part in enumerate(parts):
        part.to_parquet(folder / f"part_{k}.parquet", row_group_size=997)
    return folder


def test_a_folder_gives_mass_and_friction(tmp_path, capsys) -> None:
    """Three files of one recording give the 95 kg and the friction they were made with; result and page are written."""
    folder = written(tmp_path / "run", *(frame().iloc[k : k + 2000] for k in (0, 2000, 4000)))
    files = {"--json": tmp_path / "r.json", "--report": tmp_path / "r.html", "--out": tmp_path / "m.yaml"}
    argv = ["identify", "linear_axis", folder, *(x for pair in files.items() for x in pair), "--jobs", 2]
    assert main([str(a) for a in argv]) == 0
    values = {p["name"]: p["value"] for p in json.loads(files["--json"].read_text())["parameters"]}
    assert values["carriage_link.mass"] == pytest.approx(95, rel=0.02)
    assert values["axis.coulomb_pos"] == pytest.approx(20, rel=0.05)
    assert all(path.stat().st_size for path in files.values())


def bad(tmp_path: Path, kind: str) -> Path:
    whole = frame()
    half = whole.iloc[:3000], whole.iloc[3000:].copy()
    if kind == "empty":
        return written(tmp_path / "run")
    if kind == "columns":
        return written(tmp_path / "run", half[0], half[1].rename(columns={"tau_axis": "force"}))
    if kind == "nan":
        half[1].loc[4000, "q_axis"] = np.nan
    if kind == "backwards":
        return written(tmp_path / "run", half[1], half[0])
    return written(tmp_path / "run", *half)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("empty", "no Parquet file"),
        ("columns", "same columns"),
        ("nan", "row 1001, column q_axis"),
        ("backwards", "in time"),
    ],
)
def test_bad_recordings_end_with_status_2(tmp_path, capsys, kind: str, words: str) -> None:
    """One line that names the fault, no traceback, no file."""
    out = tmp_path / "r.json"
    assert main(["identify", "linear_axis", str(bad(tmp_path, kind)), "--json", str(out)]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    assert len(lines) == 1 and words in lines[0]
    assert not out.exists()


def test_commands_that_need_all_rows_say_so(tmp_path, capsys) -> None:
    """Diagnosis looks at all rows again and again; of a recording on disk it asks for an excerpt."""
    folder = written(tmp_path / "run", frame())
    assert main(["diagnose", "linear_axis", str(folder)]) == 2
    assert "give an excerpt" in capsys.readouterr().err
