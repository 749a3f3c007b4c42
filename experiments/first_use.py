"""What a newcomer waits for: install size and time, import, `--help` and the demo, on each CPython, from an empty environment.

    python experiments/first_use.py --pythons python3.11 python3.12 python3.13 [--no-demo] [--out DIR]

One after the other: a wheel is built once; each interpreter gets an empty virtual environment, the wheel is installed (downloads
included, unless pip has them cached), then each command is run `--repeat` times and the fastest is kept, as an idle machine would
show it. The demo runs once, with one BLAS thread; its CPU time hardly depends on what else the machine does. Prints the table
of docs/results/benchmarks.md.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
HEAD = ("CPython", "installed [MB]", "install [s]", "import [s]", "--help [s]", "demo [s]", "demo, CPU [s]")


def timed(*argv: object, cwd: Path) -> tuple[float, float]:
    """Run a program; return wall-clock and CPU time [s]."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | ONE_THREAD
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run([str(a) for a in argv], cwd=cwd, env=environment, capture_output=True, text=True)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, argv))}:\n{done.stderr[-2000:]}")
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def fastest(n: int, *argv: object, cwd: Path) -> float:
    """Return the shortest wall-clock time of several runs [s]."""
    return min(timed(*argv, cwd=cwd)[0] for _ in range(n))


def size_of(folder: Path) -> float:
    """Return how much a folder holds [MB]."""
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file() and not p.is_symlink()) / 1e6


def first_use(python: str, wheel: Path, work: Path, repeat: int, demo: bool) -> list[str]:
    """Return one line of the table."""
    venv = work / f"venv-{Path(python).name}-{abs(hash(python))}"
    timed(python, "-m", "venv", venv, cwd=work)
    inside, command = venv / "bin" / "python", venv / "bin" / "tau-dyn"
    bare = size_of(venv)
    install, _ = timed(inside, "-m", "pip", "install", "--quiet", wheel, cwd=work)
    installed = size_of(venv) - bare
    version = subprocess.run([inside, "-V"], capture_output=True, text=True, check=True).stdout.split()[1]
    nothing = fastest(repeat, inside, "-c", "pass", cwd=work)
    loading = fastest(repeat, inside, "-c", "import tau_dyn", cwd=work) - nothing
    asked = fastest(repeat, command, "--help", cwd=work)
    shown = timed(command, "demo", "--quiet", "--out", f"demo-{version}", cwd=work) if demo else (None, None)
    numbers = [f"{installed:.0f}", f"{install:.0f}", f"{loading:.2f}", f"{asked:.2f}"]
    return [version, *numbers, *("" if x is None else f"{x:.0f}" for x in shown)]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pythons", nargs="+", required=True, help="interpreters")
    parser.add_argument("--repeat", type=int, default=5, help="runs of import and --help, the fastest counts (5)")
    parser.add_argument("--no-demo", action="store_true", help="leave the demo out")
    parser.add_argument("--out", type=Path, help="write first_use.md here")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        timed(args.pythons[0], "-m", "venv", work / "maker", cwd=work)
        build = ("-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", work / "dist", ROOT)
        timed(work / "maker" / "bin" / "python", *build, cwd=work)
        (wheel,) = (work / "dist").glob("tau_dyn-*.whl")
        lines = [f"| {' | '.join(HEAD)} |", f"|{'---|' * len(HEAD)}"]
        for python in args.pythons:
            lines.append(f"| {' | '.join(first_use(python, wheel, work, args.repeat, not args.no_demo))} |")
            print("\n".join(lines), flush=True)
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        (args.out / "first_use.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
