"""The whole path of a newcomer, on every CPython named: build wheel and sdist, install each, do what the README says, test.

    python experiments/wheel_and_sdist.py [--python python3.11 python3.12 python3.13] [--tests tests/cli ...] [--keep DIR]

The sdist is built from the checkout, the wheel from the sdist, as an index would. For each interpreter each of the two is
installed in an empty virtual environment; there the README's demo runs, and its Python on two logs that `simulate` makes.
The wheel's environment has the extra `test`, too: the tests, which the sdist carries, are run from the unpacked sdist after its
`src` is gone, so that only the wheel can give the package. Left out are the tests of the sources themselves (`SOURCES`);
`--tests` alone leaves out all. Exit status 1 where something is missing, stray, or fails.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CARRIED = (
    "py.typed",
    ".py",
    ".j2",
    ".css",
    ".js",
    ".LICENSE",
    ".xacro",
    ".urdf",
    ".yaml",
    ".stl",
    ".obj",
    ".dae",
    ".csv",
    ".h",
    ".c",
    ".pyi",
    ".c",
)
"""How files of the package may end."""
NEEDED = ("tau_dyn/py.typed", "tau_dyn/urdf/gantry_tau.urdf.xacro", "tau_dyn/render/templates/page.html.j2",
          "tau_dyn/render/templates/notebook.css", "tau_dyn/cli/__main__.py")  # fmt: skip
SOURCES = (
    "tests/test_rooms.py",
    "tests/test_frozen.py",
    "tests/packaging",
    "tests/docs/test_glossary.py",
    "tests/experiments/test_physical_faults.py",
)
"""Tests of the checkout, not of the package."""


def run(*argv: object, **options) -> None:
    """Run a program, or leave with its status."""
    print("$", *argv, flush=True)
    done = subprocess.run([str(a) for a in argv], **options)
    if done.returncode:
        sys.exit(done.returncode)


def faults(names: list[str], sources: list[str]) -> list[str]:
    """Return what is wrong with a wheel, one sentence each.

    Args:
        names: Its files.
        sources: Files of the package in the checkout, as they should be called in the wheel.
    """
    inside = [n for n in names if ".dist-info/" not in n]
    odd = [
        n
        for n in inside
        if not n.endswith(CARRIED) or "__pycache__" in n or any(p.startswith(".") for p in n.split("/"))
    ]
    return [
        *(f"{n} is missing" for n in (*NEEDED, *sources) if n not in names),
        *(f"{n} does not belong here" for n in odd),
        *(f"{n} stands outside the package" for n in inside if not n.startswith("tau_dyn/")),
        *(f"{n} is in no checkout" for n in inside if n not in sources),
        *([] if any(n.endswith(".dist-info/licenses/LICENSE") for n in names) else ["the licence is missing"]),
        *([] if any(n.endswith("entry_points.txt") for n in names) else ["the command tau-dyn is missing"]),
    ]


def sources(root: Path) -> list[str]:
    """Return the package's files in a checkout, as they should be called in the wheel."""
    kept = [
        p
        for folder in (
            "src/tau_dyn",
            "urdf",
            *(f"identification/{kind}" for kind in ("columns", "controllers", "robots")),
        )
        for p in (root / folder).rglob("*")
        if p.is_file() and "__pycache__" not in p.parts
    ]
    return [
        "tau_dyn/" + str(p.relative_to(root / ("src/tau_dyn" if "src" in p.relative_to(root).parts[:1] else ".")))
        for p in kept
    ]


def unpacked(archive: Path, folder: Path) -> Path:
    """Unpack an sdist and return its folder."""
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    (inside,) = folder.iterdir()
    return inside


def follow_readme(python: Path, folder: Path) -> None:
    """Do in an empty folder what the README says, with an environment's programs alone."""
    folder.mkdir()
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    command = python.with_name("tau-dyn")
    run(command, "demo", "--quiet", "--out", "demo", cwd=folder, env=clean)
    if not (folder / "demo" / "report.html").stat().st_size:
        sys.exit("the demo wrote no report")
    for name, seed in (("monday", 1), ("tuesday", 2)):
        made = (
            "simulate",
            "gantry_tau",
            "--set",
            "prototype=l1",
            "--motion",
            "fourier",
            "--seed",
            seed,
            "--out",
            f"{name}.csv",
        )
        run(command, *made, "--quiet", cwd=folder, env=clean)
    (lines,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    run(python, "-c", lines, cwd=folder, env=clean)
    if not (folder / "extended.yaml").stat().st_size:
        sys.exit("the README's lines wrote no model")


def try_tests(python: Path, sdist: Path, folder: Path, tests: list[str]) -> None:
    """Run tests of the unpacked sdist on the installed wheel."""
    place = unpacked(sdist, folder)
    shutil.rmtree(place / "src")
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    where = "import tau_dyn, sys; sys.exit('site-packages' not in tau_dyn.__file__)"
    run(python, "-c", where, cwd=place, env=clean)
    aside = [f"--ignore={path}" for path in SOURCES]
    run(python, "-m", "pytest", "-q", *tests, *aside, cwd=place, env=clean)


def main() -> None:
    """Build, look, install, follow the README, test."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tests", nargs="*", default=["tests"], help="what is run of the tests (default: all)")
    parser.add_argument("--python", nargs="+", default=[sys.executable], help="interpreters of the empty environments")
    parser.add_argument("--keep", type=Path, help="keep wheel and sdist here")
    parser.add_argument("--build-only", action="store_true", help="build and look inside")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        dist = args.keep or work / "dist"
        run(args.python[0], "-m", "venv", work / "maker")
        maker = work / "maker" / "bin" / "python"
        run(maker, "-m", "pip", "install", "--quiet", "build")
        run(maker, "-m", "build", "--outdir", dist, ROOT)
        wheel, sdist = next(dist.glob("*.whl")), next(dist.glob("*.tar.gz"))
        wrong = faults(zipfile.ZipFile(wheel).namelist(), sources(ROOT))
        print(f"{wheel.name} {wheel.stat().st_size / 1e6:.2f} MB, {sdist.name} {sdist.stat().st_size / 1e6:.2f} MB")
        if wrong:
            sys.exit("\n".join(wrong))
        if args.build_only:
            return
        for k, interpreter in enumerate(args.python):
            for archive, extra in ((sdist, ""), (wheel, "[test]" if args.tests else "")):
                place = work / f"{k}_{archive.suffix[1:]}"
                place.mkdir()
                run(interpreter, "-m", "venv", place / "venv")
                python = place / "venv" / "bin" / "python"
                run(python, "-m", "pip", "install", "--quiet", f"{archive}{extra}")
                follow_readme(python, place / "readme")
                if extra:
                    try_tests(python, sdist, place / "sdist", args.tests)
                shutil.rmtree(place)
            print(f"{interpreter}: fine", flush=True)


if __name__ == "__main__":
    main()
