"""The room's face: every name is there, and importing it loads nothing until a name is used."""

import subprocess
import sys

import pytest

import tau_dyn.control


@pytest.mark.parametrize("name", tau_dyn.control.__all__)
def test_every_name_is_there(name):
    """Each name of `__all__` gives what it promises."""
    assert callable(getattr(tau_dyn.control, name)) and name in dir(tau_dyn.control)


def test_a_name_loads_what_it_needs_alone():
    """The room alone loads neither Pinocchio nor SciPy; an unknown name is an attribute error."""
    says = "import sys, tau_dyn.control; print([n for n in ('pinocchio', 'scipy') if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", says], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    with pytest.raises(AttributeError, match="No tau_dyn.control attribute learning"):
        tau_dyn.control.learning  # noqa: B018
