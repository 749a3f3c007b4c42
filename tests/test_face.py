"""The face: every public name is there, functions keep their names beside rooms called alike, importing loads nothing heavy."""

import subprocess
import sys
from importlib import import_module
from types import ModuleType

import pytest

import tau_dyn


@pytest.mark.parametrize("name", tau_dyn.__all__)
def test_every_public_name_is_there_and_is_no_room(name):
    """Each name of `__all__` gives what it promises."""
    assert not isinstance(getattr(tau_dyn, name), ModuleType)
    assert name in dir(tau_dyn)


@pytest.mark.parametrize("name", ["identify", "diagnose", "simulate", "calibrate"])
def test_a_room_does_not_hide_the_function_of_its_name(name):
    """`import tau_dyn.identify` loads the room; `tau_dyn.identify` stays the function."""
    room = import_module(f"tau_dyn.{name}")
    assert isinstance(room, ModuleType) and callable(getattr(tau_dyn, name))
    assert getattr(tau_dyn, name).__name__ == getattr(room, name).__name__


def test_an_unknown_name_is_an_attribute_error():
    """A misspelt name says so."""
    with pytest.raises(AttributeError, match="No tau_dyn attribute identfy"):
        tau_dyn.identfy  # noqa: B018


@pytest.mark.parametrize("code", ["import tau_dyn", "import tau_dyn.cli as c; c.build_app()"])
def test_importing_loads_nothing_heavy(code):
    """Neither the package nor the commands' help load Pinocchio, SciPy, pandas or cvxpy: those take seconds."""
    heavy = ("pinocchio", "scipy", "pandas", "cvxpy", "pyarrow", "jinja2")
    says = f"{code}; import sys; print([n for n in {heavy!r} if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", says], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
