"""Every public robot log, every tool, one command: who predicts data that nobody trained on, and who says why?

    python experiments/comparison.py [--sets emps ...] [--tools tau_dyn ...] [--out DIR] [--cache DIR] [--page]

In: the logs of `$TAU_DYN_DATA` (by default `../shared/data`), recorded by others; a simulated arm whose truth is known. Each tool
gets the same samples in files (`comparison_parts/samples.py`) and runs in an environment of its own under `--cache`, which this
command makes with `pip install`. A tool or set that is missing is said and skipped. Out: `comparison.json` (everything, with
versions, date, seed and time) and `comparison.csv`, a row a set and tool; runs add to what stands in `--out`. `--page` writes
`docs/results/comparison.md`, its figure and its table from them.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import tempfile
import time
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from comparison_parts.case import Case
from comparison_parts.environments import TOOLS, Missing, count_lines, ensure_environment
from comparison_parts.page import write_page
from comparison_parts.samples import write_samples
from comparison_parts.score import judge, start_freely
from comparison_parts.sets import SETS

from tau_dyn.files import write_whole

TOOLS_FOLDER = Path(__file__).resolve().parent / "comparison_parts" / "tools"
LIMIT_S = 3600.0
"""Time that a tool may take for a set [s]."""
SEED = 30
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}


def run_tool(tool: str, python: str, samples: Path, out: Path) -> dict[str, Any]:
    """Run an adapter; return what it says, `skipped` with a reason where it has no answer."""
    command = [python, str(TOOLS_FOLDER / f"{TOOLS[tool].adapter}.py"), str(samples), str(out)]
    environment = os.environ | ONE_THREAD | TOOLS[tool].environment
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        return {"skipped": f"not done in {LIMIT_S:.0f} s"}
    if done.returncode != 0 or not (out / "answer.json").is_file():
        said = done.stderr.strip().splitlines() or ["no word"]
        return {"skipped": "failed: " + next((x for x in reversed(said) if "Error: " in x), said[-1])[:200]}
    return json.loads((out / "answer.json").read_text())


def run_case(case: Case, tools: dict[str, str]) -> list[dict[str, Any]]:
    """Return a row a tool: errors by channel, the difference from `tau_dyn` with its interval, and what was said."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        samples = Path(name) / "samples"
        held = write_samples(case, samples)
        for tool, python in tools.items():
            out = Path(name) / tool
            row = {"set": case.name, "kind": case.kind, "tool": tool, "date": str(date.today()), "seed": SEED}
            row |= {"lines": count_lines(TOOLS_FOLDER / f"{TOOLS[tool].adapter}.py")}
            row |= run_tool(tool, python, samples, out) if os.path.isfile(python) else {"skipped": python}
            if "skipped" not in row:
                try:
                    predicted = [np.load(p) for p in sorted(out.glob("held_*.npy"))]
                    if free := row.pop("free", None):
                        row["forecast"] = judge(case, held, predicted).errors().tolist()
                        predicted = [start_freely(x.target, p, free) for x, p in zip(held, predicted, strict=True)]
                    row |= judge(case, held, predicted).to_dict()
                except ValueError as fault:
                    row["skipped"] = str(fault)
            rows.append(row)
            print(
                {k: row.get(k) for k in ("set", "tool", "errors", "causes", "note", "skipped", "seconds")}, flush=True
            )
    return rows


def describe_case(case: Case) -> dict[str, Any]:
    """Return what the page says of a set."""
    keys = ("name", "kind", "known", "simulated", "causes", "refuted", "published", "origin", "channels")
    return {k: getattr(case, k) for k in keys} | {
        "train": [x.name for x in case.train],
        "held": [x.name for x in case.held],
    }


def main() -> None:
    """Run, keep, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="*", choices=SETS, default=list(SETS))
    parser.add_argument("--tools", nargs="+", choices=TOOLS, default=list(TOOLS))
    parser.add_argument("--out", type=Path, default=Path("out/comparison"))
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "tau_dyn_comparison")
    parser.add_argument(
        "--page", action="store_true", help="write docs/results/comparison.md from what stands in --out"
    )
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    kept = options.out / "comparison.json"
    results = json.loads(kept.read_text()) if kept.is_file() else {"sets": {}, "rows": []}
    pythons = {}
    for tool in options.tools if options.sets else ():
        try:
            pythons[tool] = ensure_environment(tool, options.cache)
        except Missing as reason:
            pythons[tool] = str(reason)
            print(f"{tool}: {reason}")
    for name in options.sets:
        try:
            cases = list(SETS[name]())
        except OSError as fault:
            print(f"{name}: skipped, {fault}")
            continue
        for case in cases:
            began = time.perf_counter()
            rows = run_case(case, pythons)
            results["sets"][case.name] = describe_case(case)
            ran = {(row["set"], row["tool"]) for row in rows}
            results["rows"] = [row for row in results["rows"] if (row["set"], row["tool"]) not in ran] + rows
            results["machine"] = f"{platform.machine()}, {os.cpu_count()} cores, CPython {platform.python_version()}"
            write_whole(kept, json.dumps(results, indent=1, default=float) + "\n")
            print(f"{case.name}: {time.perf_counter() - began:.0f} s", flush=True)
    if options.page:
        write_page(results)


if __name__ == "__main__":
    main()
