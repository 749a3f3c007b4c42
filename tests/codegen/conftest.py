"""C that a controller would take, compiled as one would compile it: every warning is an error."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

FLAGS = ("-std=c99", "-O0", "-Wall", "-Wextra", "-Werror", "-pedantic")


class Compiled:
    """A library made of one exported source and its header."""

    def __init__(self, source_and_header: tuple[str, str], name: str, folder: Path) -> None:
        """Write, compile and load."""
        source, header = source_and_header
        (folder / f"{name}.c").write_text(source)
        (folder / f"{name}.h").write_text(header)
        library = folder / f"{name}.so"
        command = ["cc", *FLAGS, "-shared", "-fPIC", "-o", str(library), str(folder / f"{name}.c"), "-lm"]
        subprocess.run(command, check=True)
        self._code, self._name = ctypes.CDLL(str(library)), name

    def __call__(self, function: str, *arguments: np.ndarray | int | ctypes.c_double | None) -> int:
        """Call `name_function`; arrays are passed as they are and may be written to."""
        return getattr(self._code, f"{self._name}_{function}")(*(_passed(x) for x in arguments))


def _passed(x: np.ndarray | int | ctypes.c_double | None):
    if x is None or isinstance(x, int | ctypes.c_double):
        return x
    assert x.dtype == np.float64 and x.flags.c_contiguous
    return x.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


@pytest.fixture
def compiled(tmp_path):
    """Return what compiles an exported source and its header under a name; skip where there is no compiler."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler here")
    return lambda source_and_header, name: Compiled(source_and_header, name, tmp_path)
