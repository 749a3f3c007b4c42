"""A child process that tries cases of one reader, with limits on memory and time, and writes down what it found.

Case n of a reader is made from the random numbers of (seed, reader, n) and the corpus kept in the folder; so a campaign goes on
where it stopped. The case at hand lies in the scratch folder, with its number in `at`, where the parent finds it when the process
dies.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import time
import warnings
from contextlib import nullcontext
from pathlib import Path
from random import Random

from fuzz_parts.judge import Verdict, judge
from fuzz_parts.lines_seen import LinesSeen
from fuzz_parts.readers import READERS

MEMORY = 6 * 2**30
"""[bytes] Address space of a child; the libraries alone map 2 GiB."""
WATCHED = 6
"""Of so many cases one is watched line by line, which takes ten times as long as the case."""

MOST_KEPT = 200
"""Cases of the corpus."""

LARGEST_KEPT, SLOWEST_KEPT = 2**15, 0.3
"""[bytes, s] A case beyond these is tried, but does not join the corpus: mutated again, such cases would take all the time."""


def work(name: str, folder: Path, scratch: Path, seed: int, first: int, count: int, seconds: float) -> None:
    """Try cases `first` to `first + count - 1`."""
    warnings.simplefilter("ignore")
    reader = READERS[name]
    for made in (folder / "corpus", folder / "crashes"):
        made.mkdir(parents=True, exist_ok=True)
    valid = list(reader.valid(scratch))
    _check_valid(reader, valid, scratch, seconds)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what libraries print of broken files
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    kept = [path.read_bytes() for path in sorted((folder / "corpus").iterdir())]
    lines, path = LinesSeen(), scratch / f"case{reader.suffix}"
    for data in [*valid, *kept]:
        _watched(reader, path, data, lines, seconds)
    _say(first - 1, "ready", lines)
    for n in range(first, first + count):
        data = reader.mutated([*valid, *kept], Random(f"{seed} {name} {n}"))
        (scratch / "at").write_text(str(n))
        begun = time.process_time()
        verdict = _watched(reader, path, data, lines if n % WATCHED == 0 else None, seconds)
        if verdict.fault:
            _keep_crash(folder, n, data, verdict, reader.suffix)
        elif n % WATCHED == 0 and lines.new and len(kept) < MOST_KEPT and _light(data, begun):
            kept.append(data)
            (folder / "corpus" / f"{n:08d}").write_bytes(data)
        _say(n, verdict.kind, lines)


def _light(data: bytes, begun: float) -> bool:
    return len(data) <= LARGEST_KEPT and time.process_time() - begun <= SLOWEST_KEPT


def _say(n: int, kind: str, lines: LinesSeen) -> None:
    print(json.dumps({"n": n, "kind": kind, "lines": len(lines.seen), "cpu_s": time.process_time()}), flush=True)


def _check_valid(reader, valid: list[bytes], scratch: Path, seconds: float) -> None:
    """Refuse to mutate what is not read in the first place."""
    for k, data in enumerate(valid):
        path = scratch / f"valid{k}{reader.suffix}"
        path.write_bytes(data)
        verdict = judge(reader.read, path, 10 * seconds)
        if verdict.kind != "answer":
            raise SystemExit(f"{reader.name}: valid file {k} is not read: {verdict}")


def _watched(reader, path: Path, data: bytes, lines: LinesSeen | None, seconds: float) -> Verdict:
    path.write_bytes(data)
    with lines or nullcontext():
        return judge(reader.read, path, seconds)


def _keep_crash(folder: Path, n: int, data: bytes, verdict: Verdict, suffix: str) -> None:
    """Write the first case of every kind of fault."""
    key = hashlib.sha256(f"{verdict.kind} {verdict.where}".encode()).hexdigest()[:10]
    if not (folder / "crashes" / f"{key}.fault").exists():
        (folder / "crashes" / f"{key}{suffix}").write_bytes(data)
        (folder / "crashes" / f"{key}.fault").write_text(json.dumps({"case": n, **verdict._asdict()}, indent=1))
