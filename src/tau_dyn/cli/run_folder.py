"""`--out FOLDER/`: a folder with all files that are needed to understand, repeat and compare a run.

It holds `run.json` (described in `compare/run.py`), `result.json`, `report.html` and the command's own file under its usual
name, such as `model.yaml`. A path that ends in `/`, has no suffix, or exists as a folder is a run folder; any other is a file.

A new folder is created atomically. An existing folder is used if it is empty, or if it holds a run of the same command with the
same options whose files were not changed; this run is replaced. No other files are overwritten. Only the demo writes into a
folder with other files. `run.json` is removed first and written last, so that a folder with a `run.json` is complete. Of two runs
that end at once the second waits, and replaces or refuses the first one's folder like any other.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from tau_dyn.exceptions import InputError
from tau_dyn.files import build_write_error, compute_sha256, get_owner_name, remove_stale_files
from tau_dyn.results import to_plain
from tau_dyn.version import __version__

_LIBRARIES = ("pin", "numpy", "scipy", "cvxpy", "clarabel", "pandas", "pyarrow", "xacro")


@dataclass
class RunFolder:
    """The folder of a run.

    Attributes:
        path: The folder.
        beside: Whether the folder may hold other files.
        started: Start of the run, in seconds since the epoch.
    """

    path: Path
    beside: bool = False
    started: float = field(default_factory=time.time)

    def check(self, command: str, configuration: dict[str, Any], inputs: set[Path]) -> None:
        """Reject a folder that is not free for this run, before any work is done.

        Args:
            command: The command of the run.
            configuration: Its options.
            inputs: Files that it reads, resolved.

        Raises:
            InputError: The folder cannot be written, or it holds files that would be lost.
        """
        near = next(p for p in (self.path.resolve(), *self.path.resolve().parents) if p.exists())
        if not near.is_dir():
            raise InputError("cannot_write", f"--out {self.path}: {near} is a file; name a folder")
        if not os.access(near, os.W_OK):
            raise InputError("cannot_write", f"--out {self.path}: {near} is write-protected; name another folder")
        if self.beside or not self._holds():
            return
        held = next((path for path in inputs if path.is_relative_to(self.path.resolve())), None)
        if held is not None:
            raise InputError(
                "cannot_write", f"{held} is an input of this command and is in {self.path}; name another folder"
            )
        if reason := self._kept_for(command, configuration):
            raise InputError("cannot_write", f"{self.path} {reason}; name another folder")

    def _holds(self) -> set[str]:
        return {p.name for p in self.path.iterdir()} if self.path.is_dir() else set()

    def _kept_for(self, command: str, configuration: dict[str, Any]) -> str:
        """Return the reason why the content of the folder must be kept; empty if it is an earlier run of the same call."""
        from tau_dyn.compare import RUN, is_run, read_run

        names = self._holds()
        if not is_run(self.path):
            return f"holds {_few(names)} and is no run folder"
        run = read_run(self.path)
        if run.command != command:
            return f"holds a run of tau-dyn {run.command}"
        ours = json.loads(json.dumps(configuration))
        other = [k for k in {**ours, **run.configuration} if ours.get(k) != run.configuration.get(k)]
        if other:
            return f"holds a run with other options ({_few(other)})"
        if foreign := names - {*run.files, RUN}:
            return f"holds {_few(foreign)}, which its run did not write"
        changed = [n for n in names & {*run.files} if _sha256(self.path / n) != run.files[n]]
        return f"holds {_few(changed)}, which was changed since its run" if changed else ""

    def files(self) -> tuple[Path, Path, Path]:
        """Return run.json, the result and the page."""
        from tau_dyn.compare import REPORT, RESULT, RUN

        return self.path / RUN, self.path / RESULT, self.path / REPORT

    def holds(self, path: Path) -> bool:
        """Return whether a file is in this folder."""
        return path.parent.resolve() == self.path.resolve()  # the location of a link, not its target

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Wait until no other run on this machine writes this folder, and hold it until the block ends."""
        handle = None
        with suppress(ImportError, OSError):  # Windows; a file system without locks
            import fcntl

            near = next(p for p in self.path.resolve().parents if p.is_dir())
            handle = os.open(near, os.O_RDONLY)
            fcntl.flock(handle, fcntl.LOCK_EX)
        try:
            yield
        finally:
            if handle is not None:
                os.close(handle)

    @contextmanager
    def writing(self) -> Iterator[Path]:
        """Yield an empty folder to write to; its files are moved to the destination if the block succeeds.

        Raises:
            InputError: The folder cannot be written.
        """
        there = self.path.is_dir()
        home = self.path.resolve() if there else self.path.resolve().parent
        start = f".{self.path.resolve().name[:120]}."
        staged = home / f"{start}{get_owner_name()}.run.part"
        try:
            home.mkdir(parents=True, exist_ok=True)
            remove_stale_files(home, start)
            staged.mkdir()
            try:
                yield staged
                for path in staged.iterdir():
                    _settle(path)
                _moved_in(staged, self.path) if there else staged.rename(self.path.resolve())
            finally:
                shutil.rmtree(staged, ignore_errors=True)
        except OSError as fault:
            raise build_write_error(self.path, fault) from fault

    def record(self, staged: Path, command: str, *, command_line: str, configuration: dict[str, Any], inputs: dict[str, str],
               seed: int, exit_status: int) -> dict[str, Any]:  # fmt: skip
        """Return the content of run.json for a run whose other files are staged."""
        from tau_dyn.compare import RecordedRun

        return RecordedRun(
            command=command,
            command_line=command_line,
            configuration=configuration,
            inputs=inputs,
            versions=list_versions(),
            seed=seed,
            started=datetime.fromtimestamp(self.started).astimezone().isoformat(timespec="seconds"),
            duration_s=round(time.time() - self.started, 3),
            exit_status=exit_status,
            files={p.name: _sha256(p) for p in sorted(staged.iterdir())},
        ).to_dict()


def _moved_in(staged: Path, folder: Path) -> None:
    """Move files into an existing folder: files of an earlier run are removed first, run.json is moved last."""
    from tau_dyn.compare import RUN, is_run, read_run

    new = sorted((p.name for p in staged.iterdir()), key=lambda n: n == RUN)
    if is_run(folder):
        before = read_run(folder).files
        (folder / RUN).unlink()
        for name in {*before} - {*new}:
            left = folder / name
            if Path(name).name == name and (left.is_symlink() or left.is_file()):  # a file in this folder
                left.unlink()
    for name in new:
        os.replace(staged / name, folder / name)


def _settle(path: Path) -> None:
    """Flush a file to disk, so that after a power failure no run has complete names but empty files."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def read_destination(text: str, own: str) -> Path | RunFolder:
    """Return the destination that `--out` names: a run folder, or the command's own file.

    Args:
        text: The value of `--out`.
        own: `DIR` for a command that fills a folder, `FOLDER/` for one without an own file, else the file's usual name.

    Raises:
        ValueError: A file is named, but the command writes a folder.
    """
    path = Path(text)
    slash = text.endswith(("/", os.sep))
    if own == "FOLDER/" and path.suffix and not (slash or path.is_dir()):
        raise ValueError(f"names a file; a folder is written here, such as {path.stem}/")
    if own in ("DIR", "FOLDER/") or slash or path.is_dir() or not (path.suffix or path.exists()):
        return RunFolder(path, beside=own == "DIR")
    return path


def collect_configuration(values: dict[str, Any]) -> dict[str, Any]:
    """Return every option of a call with its value, including defaults but not the destinations of results."""
    aside = ("out", "json", "report", "quiet", "verbose")
    return {name: to_plain(value) for name, value in sorted(values.items()) if name not in aside}


def list_versions() -> dict[str, str]:
    """Return the versions of the packages that compute, and the platform."""
    found = {"tau_dyn": __version__, "python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found | {"platform": f"{platform.system()} {platform.machine()}"}


def _sha256(path: Path) -> str:
    return compute_sha256(path) if path.is_file() else ""


def _few(names: set[str] | list[str]) -> str:
    several = sorted(names)
    return ", ".join(several[:3]) + (f" and {len(several) - 3} more" if len(several) > 3 else "")
