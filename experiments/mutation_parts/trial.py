"""One mutant in a copy of the project: its own tests first, then its room's."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cosmic_ray.plugins
from cosmic_ray.mutating import use_mutation

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("src", "tests", "urdf", "docs", "experiments", "identification", "pyproject.toml", "README.md")
_PYTEST = ("-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--no-header", "--tb=line")


def judged(item: dict[str, Any]) -> dict[str, Any]:
    """Return what became of a mutant: `killed`, `survived` or `timeout` (which counts as killed), and its difference.

    Args:
        item: `Mutant.to_dict()` with `folder` (copies are kept there, one a process), `tests` (of the room) and `limit` [s].
    """
    root = _copy(Path(item["folder"]))
    file = root / "src" / "tau_dyn" / item["module"]
    operator = cosmic_ray.plugins.get_operator(item["operator"])()
    with use_mutation(file, operator, item["occurrence"]) as (before, after):
        if after is None:
            return {"outcome": "none", "was": "", "became": ""}
        was, became = _changed(before, after)
        for tests in _orders(root, item["module"], item["tests"]):
            outcome = tested(root, tests, item["limit"])
            if outcome != "survived":
                break
    return {"outcome": outcome, "was": was, "became": became}


def tested(root: Path, tests: list[str], limit: float) -> str:
    """Run tests in a copy until one fails; `killed`, `survived` or `timeout`."""
    env = {**os.environ, "PYTHONPATH": str(root / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
    env |= {key: "1" for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    command = [sys.executable, "-m", "pytest", *_PYTEST, *tests]
    try:
        done = subprocess.run(command, cwd=root, env=env, timeout=limit, capture_output=True)
    except subprocess.TimeoutExpired:
        return "timeout"
    return "survived" if done.returncode in (0, 5) else "killed"


def _copy(folder: Path) -> Path:
    root = folder / f"copy_{os.getpid()}"
    if not root.exists():
        root.mkdir(parents=True)
        for name in COPIED:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
            copy(ROOT / name, root / name)
    return root


def _orders(root: Path, module: str, tests: list[str]) -> list[list[str]]:
    """Return the test files named after a module, then all of its room's."""
    stem = Path(module).stem
    own = [str(f.relative_to(root)) for t in tests for f in sorted((root / t).rglob(f"test_{stem}*.py"))]
    return [own, tests] if own else [tests]


def _changed(before: str, after: str) -> tuple[str, str]:
    pairs = zip(before.splitlines(), after.splitlines(), strict=False)
    return next(((a.strip(), b.strip()) for a, b in pairs if a != b), ("", ""))
