"""Compile C source into a library for this machine, once, and keep the libraries in a folder.

A library's name is the hash of its source, of the compiler and of its flags; so a library found there is the one that would be
built. It is written under a unique name and then renamed, because several processes may build the same library. The folder is
`$XDG_CACHE_HOME/tau_dyn`, by default `~/.cache/tau_dyn`; code is loaded only from a folder that only the user may write to.
`TAU_DYN_COMPILE=0` turns compiling at run time off.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tau_dyn.exceptions import InputError
from tau_dyn.files import write_atomically

SECONDS = 300  # s; a compiler that takes longer hangs
MAX_LIBRARIES = 200
"""Libraries kept, about 50 kB each; the oldest leave."""
_FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off")


def find_compiler() -> str | None:
    """Return the C compiler: `$CC`, else `cc`, `gcc` or `clang`; `None` if there is no compiler."""
    named = os.environ.get("CC", "").split()
    return next((found for name in (*named[:1], "cc", "gcc", "clang") if (found := shutil.which(name))), None)


def compile_library(source: str, with_: str) -> bytes:
    """Return the shared library of a source.

    Args:
        source: C99.
        with_: The compiler.

    Raises:
        InputError: The compiler does not take it.
    """
    with tempfile.TemporaryDirectory(prefix="tau_dyn_") as folder:
        text, library = Path(folder) / "source.c", Path(folder) / "source.so"
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
                f"the C compiler {with_} did not take the source ({why.strip()}); name another one in CC",
            )
        return library.read_bytes()


def is_compiling_allowed() -> bool:
    """Return whether the user lets programs be compiled while they run."""
    return os.environ.get("TAU_DYN_COMPILE", "1").strip().lower() not in ("0", "no", "off", "false")


class LibraryCache:
    """Libraries in a folder, and those that this process has loaded."""

    def __init__(self, folder: Path | None = None) -> None:
        """Look into this folder; by default the user's."""
        self._folder = folder
        self._loaded: dict[str, ctypes.CDLL | None] = {}

    @property
    def folder(self) -> Path:
        """Where the libraries are."""
        if self._folder is not None:
            return self._folder
        named = os.environ.get("XDG_CACHE_HOME")
        try:
            return (Path(named) if named else Path.home() / ".cache") / "tau_dyn"
        except RuntimeError:  # a user without a home
            return Path(tempfile.gettempdir()) / f"tau_dyn_{os.getuid() if os.name == 'posix' else 'user'}"

    def find(self, source: str) -> ctypes.CDLL | None:
        """Return a source's library if it is built already."""
        compiler = find_compiler()
        if compiler is None:
            return None
        key = _hash(source, compiler)
        if self._loaded.get(key) is None and (library := _load(self.folder / f"{key}.so")) is not None:
            self._loaded[key] = library
        return self._loaded.get(key)

    def build(self, source: str) -> ctypes.CDLL | None:
        """Return a source's library, built if needed; None if that is not possible here."""
        found, compiler = self.find(source), find_compiler()
        if found is not None or compiler is None:
            return found
        key = _hash(source, compiler)
        if key not in self._loaded:
            try:
                self._loaded[key] = self._keep(key, compile_library(source, compiler))
            except (InputError, OSError):
                self._loaded[key] = None  # the same source is not tried again
        return self._loaded[key]

    def _keep(self, key: str, content: bytes) -> ctypes.CDLL | None:
        """Write a library into the folder, or, where that may not be, load it from a place of its own."""
        path = self.folder / f"{key}.so"
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with write_atomically(path) as temporary:
                temporary.write_bytes(content)
                temporary.chmod(0o700)
            _remove_oldest(self.folder)
            if (library := _load(path)) is not None:
                return library
        except (InputError, OSError):
            pass
        folder = tempfile.mkdtemp(prefix="tau_dyn_")
        try:
            (Path(folder) / "plant.so").write_bytes(content)
            return _load(Path(folder) / "plant.so")
        finally:
            shutil.rmtree(folder, ignore_errors=True)  # a loaded library stays in memory


def _hash(source: str, compiler: str) -> str:
    about = os.stat(compiler)
    words = (
        source,
        os.path.realpath(compiler),
        about.st_size,
        about.st_mtime_ns,
        _FLAGS,
        sys.platform,
        platform.machine(),
    )
    return hashlib.sha256(repr(words).encode()).hexdigest()[:40]


def _load(path: Path) -> ctypes.CDLL | None:
    """Load a library that only this user can have written; return `None` if the file is missing or is not a library."""
    try:
        if os.name == "posix":
            for place in (path, path.parent):
                about = place.stat()
                if about.st_uid != os.getuid() or about.st_mode & 0o022:
                    return None
        return ctypes.CDLL(str(path))
    except OSError:
        return None


def _remove_oldest(folder: Path) -> None:
    files = sorted(folder.glob("*.so"), key=lambda path: path.stat().st_mtime)
    for path in files[:-MAX_LIBRARIES]:
        path.unlink(missing_ok=True)
