"""The scripts of `identification/`, to be tried on measured data."""

import importlib.util
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


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
