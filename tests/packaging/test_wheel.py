"""The wheel holds the package, whole and alone; built here without a network, by the tool that builds the real one."""

from __future__ import annotations

import importlib.util
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def script():
    """Return experiments/wheel_and_sdist.py, which says what belongs into a wheel."""
    spec = importlib.util.spec_from_file_location("wheel_and_sdist", ROOT / "experiments" / "wheel_and_sdist.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def names(tmp_path_factory) -> list[str]:
    """Return the files of the wheel that this checkout makes."""
    builder = pytest.importorskip("hatchling.builders.wheel")
    folder = tmp_path_factory.mktemp("dist")
    (path,) = builder.WheelBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"])
    with zipfile.ZipFile(path) as wheel:
        return wheel.namelist()


def test_the_wheel_holds_the_package_and_nothing_else(names, script):
    """Every source, template, robot and the type marker; no test, no cache, no file of another kind."""
    assert script.faults(names, script.sources(ROOT)) == []


@pytest.mark.parametrize(
    ("gone", "stray", "says"),
    [
        ("tau_dyn/py.typed", None, "py.typed is missing"),
        ("tau_dyn/urdf/gantry_tau.urdf.xacro", None, "gantry_tau.urdf.xacro is missing"),
        (None, "tau_dyn/notes.txt", "does not belong"),
        (None, "tests/test_face.py", "outside the package"),
        (None, "tau_dyn/.hidden.py", "does not belong"),
        (None, "tau_dyn/leftover.py", "in no checkout"),
    ],
)
def test_a_wheel_with_a_gap_or_a_stray_is_told(names, script, gone, stray, says):
    """What would be missing or would come along is named."""
    spoiled = [n for n in names if n != gone] + ([stray] if stray else [])
    assert any(says in fault for fault in script.faults(spoiled, script.sources(ROOT)))


def test_the_sdist_carries_what_the_tests_read():
    """Tests run from the unpacked sdist: every folder and file that they name beside themselves is in it."""
    import tomllib

    held = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    assert {"tests", "experiments", "docs", "identification", "urdf", "README.md"} <= set(held)
