"""Robots that move freely, and the experiments' runs of exported files in MuJoCo and Drake."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))


@pytest.fixture(scope="session")
def in_mujoco() -> Any:
    """`experiments/exports_parts/in_mujoco.py`."""
    pytest.importorskip("mujoco")
    return import_module("exports_parts.in_mujoco")


@pytest.fixture(scope="session")
def in_drake() -> Any:
    """`experiments/exports_parts/in_drake.py`."""
    pytest.importorskip("pydrake")
    return import_module("exports_parts.in_drake")
