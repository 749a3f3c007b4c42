"""Faults at random moments: commands killed, interrupted, starved of disk; a worker lost; a log growing; a study resumed.

    python experiments/faults.py [--runs 30] [--seed 0] [--only killed interrupted disk worker growing study]

`killed`       `identify` with --json, --report and --out over old outputs, SIGKILL after a random share of its processor time;
               each output must be the old one or the new one whole, and a rerun must give the new ones and tidy up.
`interrupted`  the same with SIGINT and SIGTERM: one line on stderr, status 130 or 143 (or 0 where it had ended), no traceback.
`disk`         the same under a random limit of a file's size: status 2, one line, the old outputs.
`worker`       `run_many` on two processes, each killed at a random item: the results of an undisturbed run.
`growing`      `check` of a log that another process appends to, line by line: status 0, and a hash of some state of it.
`study`        a journaled Monte Carlo study, killed at random until it is done: the table of an undisturbed run.

In: nothing; all is made in a temporary folder. Out: a table of outcomes; status 1 if one was wrong. Linux only.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
from faults_parts.judge import contents, fault_of, left_over, table
from faults_parts.processes import Ended, command, run

OUTPUTS = ("model.yaml", "result.json", "report.html")
IDENTIFY = command("identify", "linear_axis", "log.csv", "--quiet", "--out", "model.yaml", "--json", "result.json", "--report",
                   "report.html")  # fmt: skip
OLD = {name: f"the old {name}" for name in OUTPUTS}


def made_log(folder: Path) -> None:
    """Write a log of the linear axis: 12 s at 250 Hz."""
    t = np.arange(0, 12, 0.004)
    w = 2 * np.pi * np.array([0.5, 1.3])
    q = 0.1 * np.sin(w[0] * t) + 0.03 * np.sin(w[1] * t)
    v = 0.1 * w[0] * np.cos(w[0] * t) + 0.03 * w[1] * np.cos(w[1] * t)
    a = -0.1 * w[0] ** 2 * np.sin(w[0] * t) - 0.03 * w[1] ** 2 * np.sin(w[1] * t)
    rng = np.random.default_rng(0)
    tau = 95 * a + 20 * np.sign(v) + 200 * v + rng.normal(0, 1, len(t))
    rows = zip(t, q + rng.normal(0, 5e-6, len(t)), tau, strict=True)
    text = "\n".join(["t,q_axis,tau_axis", *(f"{x:.6f},{y:.9f},{z:.6f}" for x, y, z in rows)])
    (folder / "log.csv").write_text(text + "\n")


class Bench:
    """A folder with a log, and what `identify` makes of it undisturbed."""

    def __init__(self, folder: Path) -> None:
        """Run the command once."""
        self.folder = folder
        made_log(folder)
        whole = run(IDENTIFY, folder)
        if whole.status:
            raise SystemExit(f"the undisturbed run failed: {whole.err}")
        self.new, self.spent = contents(folder, OUTPUTS), whole.spent
        self.largest = max((folder / name).stat().st_size for name in OUTPUTS)

    def disturbed(self, **how) -> tuple[Ended, str, list[str]]:
        """Run the command over old outputs; return how it ended, what is wrong, and what it left beside them."""
        for name, text in OLD.items():
            (self.folder / name).write_text(text)
        ended = run(IDENTIFY, self.folder, **how)
        now = contents(self.folder, OUTPUTS)
        old: dict[str, str | None] = {name: text for name, text in OLD.items()}
        return ended, fault_of(now, old, self.new), left_over(self.folder, {*OUTPUTS, "log.csv"})

    def repeated(self) -> str:
        """Run the command again; return what is wrong with what it leaves."""
        again = run(IDENTIFY, self.folder)
        left = left_over(self.folder, {*OUTPUTS, "log.csv"})
        if again.status or contents(self.folder, OUTPUTS) != self.new:
            return f"the rerun differs (status {again.status})"
        return f"the rerun leaves {', '.join(left)}" if left else ""


def moments(rng: np.random.Generator, runs: int, spent: float) -> np.ndarray:
    """Return moments [s of processor time]: half of them anywhere, half in the last tenth, where files are written."""
    late = rng.uniform(0.9, 1.02, runs // 2)
    return spent * np.concatenate([rng.uniform(0.0, 1.0, runs - len(late)), late])


def killed(bench: Bench, runs: int, rng: np.random.Generator) -> Counter[str]:
    """SIGKILL."""
    outcomes: Counter[str] = Counter()
    for k, moment in enumerate(moments(rng, runs, bench.spent)):
        ended, wrong, left = bench.disturbed(after=moment)
        wrong = wrong or (bench.repeated() if left or k % 10 == 0 else "")
        kind = "ended before" if ended.status == 0 else "killed"
        outcomes[
            f"WRONG: {wrong}" if wrong else f"{kind}, outputs old or whole{', tidied by the rerun' if left else ''}"
        ] += 1
    return outcomes


def interrupted(bench: Bench, runs: int, rng: np.random.Generator) -> Counter[str]:
    """SIGINT and SIGTERM."""
    outcomes: Counter[str] = Counter()
    for k, moment in enumerate(moments(rng, runs, bench.spent)):
        send, status = ((signal.SIGINT, 130), (signal.SIGTERM, 143))[k % 2]
        ended, wrong, left = bench.disturbed(after=moment, send=send)
        lines = [line for line in ended.err.splitlines() if not line.startswith("warning: ")]
        if ended.status == -send and not lines:
            said = "while Python or the program loaded: ended without a word"
        elif ended.status == status and len(lines) == 1:
            said = f"one line, status {status}"
        elif ended.status == 0:
            said = "ended before"
        else:
            said = f"WRONG: status {ended.status}, {' / '.join(lines)[-150:]}"
        outcomes[f"{send.name}: {f'WRONG: {wrong or left}' if wrong or left else said}"] += 1
    return outcomes


def disk(bench: Bench, runs: int, rng: np.random.Generator) -> Counter[str]:
    """A limit of a file's size, which a write meets as a full disk does."""
    outcomes: Counter[str] = Counter()
    for most in np.geomspace(1, 2 * bench.largest, runs).astype(int):
        limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (int(most), int(most)))
        ended, wrong, left = bench.disturbed(prepare=limit)
        lines = [line for line in ended.err.splitlines() if not line.startswith("warning: ")]
        good = ended.status == 2 and len(lines) == 1 or ended.status == 0 and most >= bench.largest
        said = f"status {ended.status}" if good else f"WRONG: status {ended.status}, {' / '.join(lines)[-150:]}"
        outcomes[
            f"WRONG: {wrong or left}" if wrong or left else f"{said}, outputs old or whole, nothing beside them"
        ] += 1
    return outcomes


def worker(bench: Bench, runs: int, rng: np.random.Generator) -> Counter[str]:
    """A process of `run_many` that dies."""
    outcomes: Counter[str] = Counter()
    for k in range(max(1, runs // 10)):
        folder = bench.folder / f"workers{k}"
        folder.mkdir()
        victims = sorted({int(x) for x in rng.integers(0, 20, 3)})
        words = [sys.executable, str(Path(__file__).parent / "faults_parts" / "lost_worker.py"), *map(str, victims)]
        ended = run(words, folder)
        outcomes["results of an undisturbed run" if ended.status == 0 else f"WRONG: {ended.err[-150:]}"] += 1
    return outcomes


def growing(bench: Bench, runs: int, rng: np.random.Generator) -> Counter[str]:
    """A log that another process appends to."""
    outcomes: Counter[str] = Counter()
    whole = (bench.folder / "log.csv").read_bytes()
    folder = bench.folder / "growing"
    folder.mkdir()
    writer = (
        "import sys, time\nwhole = sys.stdin.buffer.read()\nstart = len(whole) // 3\n"
        "with open('g.csv', 'wb', buffering=0) as file:\n    file.write(whole[:start]); print('ready', flush=True)\n"
        "    for k in range(start, len(whole), 37):\n        file.write(whole[k:k + 37]); time.sleep(0.0005)\n"
    )
    for _ in range(max(1, runs // 5)):
        with subprocess.Popen(
            [sys.executable, "-c", writer], cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as process:
            assert process.stdin and process.stdout
            process.stdin.write(whole)
            process.stdin.close()
            process.stdout.readline()
            ended = run(command("check", "g.csv", "--quiet", "--json", "r.json"), folder)
            process.kill()
        read = json.loads((folder / "r.json").read_text())["inputs"][0]["sha256"] if ended.status == 0 else ""
        states = {hashlib.sha256(whole[:n]).hexdigest() for n in [*range(len(whole) // 3, len(whole), 37), len(whole)]}
        good = read in states
        outcomes[
            "read as it stood, hash of just that" if good else f"WRONG: status {ended.status} {ended.err[-150:]}"
        ] += 1
        (folder / "r.json").unlink(missing_ok=True)
    return outcomes


def study(bench: Bench, runs: int, rng: np.random.Generator) -> Counter[str]:
    """A journaled study, killed until it is done."""
    outcomes: Counter[str] = Counter()
    words = [sys.executable, str(Path(__file__).parent / "faults_parts" / "small_study.py")]
    folder = bench.folder / "study"
    folder.mkdir()
    spent = run(words, folder).spent
    whole = (folder / "table.csv").read_bytes()
    for _ in range(max(1, runs // 10)):
        shutil.rmtree(folder)
        folder.mkdir()
        kills = 0
        while not (folder / "table.csv").exists() and kills < 50:
            ended = run(words, folder, after=spent * float(rng.uniform(0.4, 1.0)))
            kills += ended.status == -signal.SIGKILL
            if ended.status not in (0, -signal.SIGKILL):
                break
        same = (folder / "table.csv").exists() and (folder / "table.csv").read_bytes() == whole
        outcomes[f"killed {kills} times, then the same bytes" if same else f"WRONG after {kills} kills"] += 1
    return outcomes


FAULTS = {
    "killed": killed,
    "interrupted": interrupted,
    "disk": disk,
    "worker": worker,
    "growing": growing,
    "study": study,
}


def main() -> None:
    """Inject faults and print what came of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=30, help="faults of each kind; the slow kinds do a part of it")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=tuple(FAULTS), default=list(FAULTS), metavar="FAULT")
    args = parser.parse_args()
    bad = 0
    with tempfile.TemporaryDirectory(prefix="faults_") as name:
        bench = Bench(Path(name))
        for fault in args.only:
            rng = np.random.default_rng([args.seed, list(FAULTS).index(fault)])
            outcomes = FAULTS[fault](bench, args.runs, rng)
            print(table(fault, outcomes), flush=True)
            bad += sum(count for what, count in outcomes.items() if "WRONG" in what)
            for path in Path(name).iterdir():
                if path.is_dir():
                    shutil.rmtree(path)
    raise SystemExit(1 if bad else 0)


if __name__ == "__main__":
    main()
