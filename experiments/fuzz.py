"""Does every reader answer or refuse in one sentence, whatever the file holds?

    python experiments/fuzz.py [--reader NAME ...] [--minutes 10] [--seed 0] [--out DIR] [--limit 10] [--list]

Valid files of every reader are mutated by their structure (cells, nodes, attributes, types) and by their bytes; a case that
reaches lines of the package where none was before joins the corpus and is mutated further. Cases run in child processes with
6 GiB of address space and `--limit` seconds of CPU each; `--minutes` are of CPU, too, all readers together. Out: for each reader
a folder in DIR with the corpus, the first case of every kind of fault in `crashes/`, and `state.json`; a later call with the
same DIR goes on where it stopped. `table.csv` sums up. Exit status 1 where a fault was found.
"""

import argparse
import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd
from fuzz_parts.child import Child, load
from fuzz_parts.readers import READERS
from fuzz_parts.worker import work

BATCH = 4000
"""Cases of one child."""

MEMORY_DISK = "/dev/shm" if Path("/dev/shm").is_dir() else None
"""Where cases are written; opening a file on a disk takes longer than most readers."""

FIRST = {"cases": 0, "answer": 0, "refused": 0, "faults": 0, "lines": 0, "cpu_s": 0.0}


def main() -> int:
    args = parse()
    if args.list:
        print("\n".join(READERS))
        return 0
    load()
    names = args.reader or list(READERS)
    total = sum(READERS[name].weight for name in names)
    states = {}
    for name in names:
        share = 60 * args.minutes * READERS[name].weight / total
        states[name] = campaign(name, args.out / name, args.seed, share, args.limit)
        table(states).to_csv(args.out / "table.csv", index=False)
    print(table(states).to_string(index=False))
    return int(any(state["faults"] for state in states.values()))


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reader", nargs="+", choices=list(READERS), metavar="NAME")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"))
    parser.add_argument("--limit", type=float, default=10.0)
    parser.add_argument("--list", action="store_true")
    return parser.parse_args()


def campaign(name: str, folder: Path, seed: int, seconds: float, limit: float) -> dict:
    """Try cases of one reader for so many seconds of CPU; return and keep how far it came."""
    (folder / "crashes").mkdir(parents=True, exist_ok=True)
    kept = folder / "state.json"
    state = json.loads(kept.read_text()) if kept.exists() else {**FIRST, "seed": seed}
    end = state["cpu_s"] + seconds
    while state["cpu_s"] < end:
        with TemporaryDirectory(dir=MEMORY_DISK) as scratch:
            batch(name, folder, Path(scratch), state, end, limit)
        state["faults"] = len(list((folder / "crashes").glob("*.fault")))
        kept.write_text(json.dumps(state, indent=1))
        said = f"{state['cases']} cases, {state['cpu_s']:.0f} s, {state['lines']} lines, {state['faults']} faults"
        print(f"{name}: {said}", file=sys.stderr)
    return state


def batch(name: str, folder: Path, scratch: Path, state: dict, end: float, limit: float) -> None:
    """Run one child; end it where a case never returns, and keep the case where it dies."""
    before = state["cpu_s"]
    with Child(work, name, folder, scratch, state["seed"], state["cases"], BATCH, limit) as child:
        for said in child.said(60 + 6 * limit):
            state["cases"], state["lines"], state["cpu_s"] = said["n"] + 1, said["lines"], before + said["cpu_s"]
            if said["kind"] != "ready":
                state[said["kind"]] = state.get(said["kind"], 0) + 1
            if state["cpu_s"] > end:
                return
    if child.death:
        keep_death(folder, scratch, state, child.death, READERS[name].suffix)


def keep_death(folder: Path, scratch: Path, state: dict, how: str, suffix: str) -> None:
    """Keep the case at which a child died."""
    if not (scratch / "at").exists():
        raise SystemExit(f"{folder.name}: a child did not begin ({how})")
    n = int((scratch / "at").read_text())
    (folder / "crashes" / f"died_{n}{suffix}").write_bytes((scratch / f"case{suffix}").read_bytes())
    (folder / "crashes" / f"died_{n}.fault").write_text(json.dumps({"case": n, "kind": how, "where": "", "said": ""}))
    state["cases"], state["died"] = n + 1, state.get("died", 0) + 1


def table(states: dict[str, dict]) -> pd.DataFrame:
    """Return a row a reader."""
    columns = ("cases", "answer", "refused", "faults", "lines", "cpu_s")
    return pd.DataFrame([{"reader": name, **{c: round(s.get(c, 0)) for c in columns}} for name, s in states.items()])


if __name__ == "__main__":
    sys.exit(main())
