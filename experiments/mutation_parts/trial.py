"""One mutant in a copy of the project: its own tests first, then its room's, quick ones first."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import warnings
from contextlib import ExitStack
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("src", "tests", "urdf", "docs", "experiments", "identification", "pyproject.toml", "README.md")
PYTEST = ("-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--no-header", "--tb=line")


def judged(item: dict[str, Any]) -> dict[str, Any]:
    """Return what became of a mutant: `killed`, `survived` or `timeout` (which counts as killed), and its difference.

    Args:
        item: `Mutant.to_dict()` with `folder` (copies are kept there, one a process), `tests` (of the room) and `limit` [s].
    """
    import cosmic_ray.plugins  # not needed for the physical faults
    from cosmic_ray.mutating import use_mutation

    root = copy_project(Path(item["folder"]))
    file = root / "src" / "tau_dyn" / item["module"]
    operator = cosmic_ray.plugins.get_operator(item["operator"])()
    none = {"outcome": "none", "was": "", "became": ""}
    with ExitStack() as changed:
        try:
            before, after = changed.enter_context(use_mutation(file, operator, item["occurrence"]))
        except AttributeError:  # cosmic-ray replaces no exception with a dot in its name
            return none
        if after is None or not _compiles(after):
            return none
        was, became = _changed(before, after)
        outcome = tested(root, _ordered(item["module"], item["tests"]), item["limit"])
    return {"outcome": outcome, "was": was, "became": became}


def tested(root: Path, tests: list[str], limit: float) -> str:
    """Run tests in a copy until one fails; `killed`, `survived` or `timeout`."""
    try:
        done = _pytest(root, tests, limit)
    except subprocess.TimeoutExpired:
        return "timeout"
    return "survived" if done.returncode in (0, 5) else "killed"


def quick_first(root: Path, tests: list[str]) -> list[str]:
    """Run tests once, unbroken, and return their files, those that take least time first; none where a test fails."""
    done = _pytest(root, ["--durations=0", "-vv", *tests])
    if done.returncode:
        return []
    paths = [root / test for test in tests]
    files = [f for path in paths for f in ([path] if path.suffix else sorted(path.rglob("test_*.py")))]
    took = dict.fromkeys((str(f.relative_to(root)) for f in files), 0.0)
    for seconds, file in re.findall(r"^([\d.]+)s (?:setup|call|teardown) +([^:]+)::", done.stdout, re.MULTILINE):
        took[file] += float(seconds)
    return sorted(took, key=lambda file: took[file])


def _pytest(root: Path, arguments: list[str], limit: float | None = None) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": str(root / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
    env |= {key: "1" for key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    command = [sys.executable, "-m", "pytest", *PYTEST, *arguments]
    return subprocess.run(command, cwd=root, env=env, timeout=limit, capture_output=True, text=True)


def copy_project(folder: Path) -> Path:
    """Return this process's copy of the project, made when first asked for."""
    root = folder / f"copy_{os.getpid()}"
    if not root.exists():
        root.mkdir(parents=True)
        for name in COPIED:
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy2
            copy(ROOT / name, root / name)
    return root


def _ordered(module: str, files: list[str]) -> list[str]:
    """Return test files with those named after a module in front."""
    own = f"test_{Path(module).stem}"
    return sorted(files, key=lambda file: not Path(file).name.startswith(own))


def _compiles(text: str) -> bool:
    """Return whether Python takes this text; what it refuses is no mutant, since any test notices."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)
            compile(text, "mutant", "exec", dont_inherit=True)
    except SyntaxError:
        return False
    return True


def _changed(before: str, after: str) -> tuple[str, str]:
    pairs = zip(before.splitlines(), after.splitlines(), strict=False)
    return next(((a.strip(), b.strip()) for a, b in pairs if a != b), ("", ""))
