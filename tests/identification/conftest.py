"""The measured data nobody here recorded, and the scripts that are tried on them."""

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def measured() -> Callable[[str], Path]:
    """Return a function from a data file's name, such as `emps/DATA_EMPS.csv`, to its path."""
    folder = Path(os.environ.get("TAU_DYN_DATA", ROOT.parent / "shared" / "data"))

    def path_of(name: str) -> Path:
        path = folder / name
        if not path.exists():
            text = f"{path} is absent; set TAU_DYN_DATA to the folder with the measured data"
            if os.environ.get("TAU_DYN_REQUIRE_DATA") == "1":
                pytest.fail(f"{text} (TAU_DYN_REQUIRE_DATA=1 demands them)")
            pytest.skip(text)
        return path

    return path_of


@pytest.fixture(scope="session")
def script() -> Callable[[str], ModuleType]:
    """Return a function that loads a script of `identification/` by name."""

    def load(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(f"identification_{name}", ROOT / "identification" / f"{name}.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load
