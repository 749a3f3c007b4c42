"""An FMU's shared library, made with the C compiler of this computer where there is one."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tau_dyn.exceptions import InputError

SECONDS = 300  # s; a compiler that takes longer hangs
_FLAGS = ("-std=c99", "-O1", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off")


def find_compiler() -> str | None:
    """Return the C compiler: `$CC`, else `cc`, `gcc` or `clang`; None where there is none."""
    named = os.environ.get("CC", "").split()
    return next((found for name in (*named[:1], "cc", "gcc", "clang") if (found := shutil.which(name))), None)


def get_library_path(identifier: str) -> str:
    """Return where FMI 2.0 wants this computer's library in the archive."""
    if sys.platform == "win32":
        return f"binaries/win64/{identifier}.dll"
    if sys.platform == "darwin":
        return f"binaries/darwin64/{identifier}.dylib"
    machine = platform.machine().lower()
    return f"binaries/{'linux64' if machine in ('x86_64', 'amd64') else f'{machine}-linux'}/{identifier}.so"


def compile_library(source: str, with_: str) -> bytes:
    """Return the shared library of a source.

    Args:
        source: C99.
        with_: The compiler.

    Raises:
        InputError: The compiler does not take it.
    """
    with tempfile.TemporaryDirectory(prefix="tau_dyn_") as folder:
        text, library = Path(folder) / "fmu.c", Path(folder) / "fmu.so"
        text.write_text(source, encoding="utf-8")
        try:
            done = subprocess.run(
                [with_, *_FLAGS, str(text), "-o", str(library), "-lm"], capture_output=True, text=True, timeout=SECONDS
            )
        except (OSError, subprocess.TimeoutExpired) as fault:
            raise InputError(
                "not_available", f"the C compiler {with_} did not run ({fault}); name another one in CC"
            ) from None
        if done.returncode or not library.is_file():
            why = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr[:200])
            raise InputError(
                "not_available",
                f"the C compiler {with_} did not take the FMU's source ({why.strip()}); name another one in CC",
            )
        return library.read_bytes()
