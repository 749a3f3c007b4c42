"""Former public names: each gives what it is called today, and says so."""

from importlib import import_module

import pytest

from tau_dyn.public_names import DEPRECATED

NAMES = [(package, old, new) for package, names in DEPRECATED.items() for old, new in names.items()]


@pytest.mark.parametrize(("package", "old", "new"), NAMES)
def test_a_former_name_gives_what_it_is_called_today(package, old, new):
    """Scripts of the last release run for one release more."""
    where, leaf = new.rsplit(".", 1) if "." in new else (package, new)
    with pytest.warns(DeprecationWarning, match=f"{package}.{old} is deprecated"):
        assert getattr(import_module(package), old) is getattr(import_module(where), leaf)
