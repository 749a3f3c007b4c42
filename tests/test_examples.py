"""The examples in the docstrings of the names at the top: each name has some, and they give what they say."""

from __future__ import annotations

import doctest
import inspect

import numpy as np
import pytest

import tau_dyn as td

NAMES = [name for name in td.__all__ if name != "__version__"]


@pytest.mark.parametrize("name", NAMES)
def test_an_example_gives_what_it_says(name, tmp_path, monkeypatch):
    """A newcomer copies it; so it runs as it stands, states at least one outcome, and that outcome is true."""
    monkeypatch.chdir(tmp_path)
    thing = getattr(td, name)
    globs = {"td": td, "np": np}
    found = doctest.DocTestParser().get_doctest(inspect.getdoc(thing) or "", globs, name, None, None)
    assert any(example.want for example in found.examples), f"{name} has no example with an outcome"
    said: list[str] = []
    runner = doctest.DocTestRunner(verbose=False, optionflags=doctest.ELLIPSIS)
    outcome = runner.run(found, out=said.append)
    assert outcome.failed == 0, "".join(said)
