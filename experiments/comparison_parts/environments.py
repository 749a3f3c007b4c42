"""A tool's name -> an interpreter of its own in which it is installed, or why there is none."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

INSTALL_S = 900.0
"""Time that an installation may take [s]."""


class Missing(Exception):
    """The tool cannot be installed here; the message says why."""


@dataclass(frozen=True)
class Tool:
    """How a tool is installed and called.

    Attributes:
        adapter: File in `tools` that calls it.
        packages: What `pip install` is given; none for a tool that comes with this command's interpreter.
        python: Interpreter that its environment is made with.
        environment: Variables that it needs.
        absent: Why it cannot be had from the package index; empty where it can.
    """

    adapter: str
    packages: tuple[str, ...] = ()
    python: str = sys.executable
    environment: Mapping[str, str] = field(default_factory=dict)
    absent: str = ""


TOOLS = {
    "tau_dyn": Tool("tau_dyn_tool"),
    "baseline": Tool("baseline", ("numpy", "scipy", "pin")),
    "mujoco.sysid": Tool("mujoco_sysid", ("mujoco[sysid]",)),
    "FIGAROH": Tool("figaroh_tool", ("figaroh",)),
    "BAM": Tool("bam_tool", ("better-actuator-models", "optuna", "cmaes", "wandb", "scipy"), "python3.12"),
    "SLICOT": Tool("slicot", ("ctrlsys", "numpy", "scipy")),
    "FloBaRoID": Tool("flobaroid", absent="no package; needs Python 3.13 and iDynTree from source"),
}


def ensure_environment(name: str, cache: Path) -> str:
    """Return the interpreter of a tool's environment, made where it is absent.

    Raises:
        Missing: It cannot be made.
    """
    tool = TOOLS[name]
    if tool.absent:
        raise Missing(f"not installed: {tool.absent}")
    if not tool.packages:
        return sys.executable
    folder = cache / name.replace(".", "_").lower()
    python, done = folder / "bin" / "python", folder / "installed"
    if not done.is_file():
        base = shutil.which(tool.python)
        if base is None:
            raise Missing(f"not installed: it needs {tool.python}, which is not on the path")
        for command in (
            [base, "-m", "venv", "--clear", str(folder)],
            [str(python), "-m", "pip", "install", "-q", *tool.packages],
        ):
            try:
                ran = subprocess.run(command, capture_output=True, text=True, timeout=INSTALL_S, check=False)
            except subprocess.TimeoutExpired:
                raise Missing(f"not installed: not done in {INSTALL_S:.0f} s") from None
            if ran.returncode:
                said = [line for line in ran.stderr.splitlines() if line.startswith("ERROR")] or ran.stderr.splitlines()
                raise Missing(f"not installed: {(said or ['no word'])[-1][:200]}")
        done.write_text(" ".join(tool.packages) + "\n")
    return str(python)


def count_lines(adapter: Path) -> int:
    """Return the lines of code of an adapter: what a user has to write, without comments, docstring and blank lines."""
    text = adapter.read_text(encoding="utf-8").split('"""', 2)[-1] if adapter.is_file() else ""
    return sum(bool(line.strip()) and not line.strip().startswith("#") for line in text.splitlines())
