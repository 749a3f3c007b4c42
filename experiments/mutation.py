"""Would the tests notice? Breaks rooms on purpose, one small change at a time, and runs their tests.

    python experiments/mutation.py --physical [--rooms log diagnose ...] [--limit 900] [--out DIR]
    python experiments/mutation.py [--rooms estimate effects ...] [--sample 60] [--seed 0] [--jobs 2] [--out DIR]

`--physical`: each fault of `mutation_parts/physical_faults.txt`, as a physicist errs (a sign, a factor, a lever not squared,
degrees of freedom, one side for two), is shown to its room's own tests, likely ones first, with `--limit` seconds. Out:
`physical.csv`, a row a fault, and `physical.md`, the shares by room and all that went unnoticed. A later call with the same DIR
tries those again alone.

Without: this checkout, with cosmic-ray installed (`pip install cosmic-ray`). A random sample of each room's mutants (another
operator, number, comparison, a loop that never runs, a decorator gone) is tried in copies of the project; the tests named after
the file run first, then the room's, quick ones first. Out: `mutation.csv`, a row a mutant; `mutation.md`, killed and survived by
room with the 95 % interval of the share, and every survivor with its line, to be explained or to be killed. Interrupted, it
goes on where it stopped.
"""

import argparse
import os
import time
from pathlib import Path

import pandas as pd
from mutation_parts.physical import Fault, fail_unbroken, judge, read_faults
from mutation_parts.trial import ROOT, judged, quick_first
from scipy.stats import binomtest

from tau_dyn.files import write_whole
from tau_dyn.scale import run_journaled

ROOMS: dict[str, list[str]] = {
    "log": ["tests/log"],
    "robot": ["tests/robot"],
    "mechanism": ["tests/mechanism"],
    "effects": ["tests/effects"],
    "model.py": ["tests/model"],
    "estimate": ["tests/estimate"],
    "identify": ["tests/identify"],
}
KNOWN = ROOT / "docs" / "results" / "data" / "physical_faults.csv"
"""The last campaign of physical faults; the test that noticed one runs first."""
EVERYWHERE = ["tests/test_frozen.py"]
"""What is asked of every core room."""
_SLACK, _FACTOR = 30.0, 4.0
"""Time a mutant's tests may take [s]: this, and this many times what the tests take unbroken."""


def main(rooms: list[str], sample: int, seed: int, jobs: int, out_dir: Path) -> pd.DataFrame:
    from mutation_parts.mutants import sampled  # cosmic-ray, which the physical faults do not need

    out_dir.mkdir(parents=True, exist_ok=True)
    rows = []
    for room in rooms:
        files, limit = _timed([*EVERYWHERE, *ROOMS[room]])
        items = [
            {**m.to_dict(), "name": m.name, "folder": str(out_dir), "tests": files, "limit": limit}
            for m in sampled(ROOT / "src" / "tau_dyn", room, sample, seed)
        ]
        journal = out_dir / f"mutation_{Path(room).stem}.jsonl"
        about = {"room": room, "sample": sample, "seed": seed}
        found = run_journaled(judged, items, journal, name=lambda item: item["name"], about=about, jobs=jobs)
        for k, (item, result) in enumerate(zip(items, found, strict=True), 1):
            rows.append({"room": room, **{key: item[key] for key in ("module", "line", "operator")}, **result})
            print(f"{room} {k}/{len(items)} {item['name']}: {result['outcome']}", flush=True)
    table = pd.DataFrame(rows)
    write_whole(out_dir / "mutation.csv", table.to_csv(index=False))
    write_whole(out_dir / "mutation.md", page(table))
    print(page(table))
    return table


def _timed(tests: list[str]) -> tuple[list[str], float]:
    """Return the files of tests, quick ones first, and how long a mutant may take [s]."""
    begun = time.monotonic()
    files = quick_first(ROOT, tests)
    if not files:
        raise SystemExit(f"{tests} fail without any mutation; mend them first")
    return files, _SLACK + _FACTOR * (time.monotonic() - begun)


def main_physical(rooms: list[str], limit: float, out_dir: Path) -> pd.DataFrame:
    """Show the physical faults of rooms to their tests."""
    out_dir.mkdir(parents=True, exist_ok=True)
    path, faults = out_dir / "physical.csv", [f for f in read_faults() if not rooms or f.room in rooms]
    for fault in faults:
        fault.apply(fault.path(ROOT).read_text(encoding="utf-8"))
    before = pd.read_csv(path).fillna("").to_dict("records") if path.exists() else []
    rows = {(r["room"], r["file"], r["was"], r["became"]): r for r in before}
    earlier = pd.read_csv(KNOWN).fillna("").to_dict("records") if KNOWN.exists() else []
    known = {(r["room"], r["file"], r["was"], r["became"]): r["by"] for r in [*earlier, *before] if r["by"]}

    def keep() -> pd.DataFrame:
        table = pd.DataFrame(rows.values())
        write_whole(path, table.to_csv(index=False))
        write_whole(out_dir / "physical.md", page_physical(table))
        return table

    def name(fault: Fault) -> tuple[str, str, str, str]:
        return fault.room, fault.file, fault.old, fault.new

    for room in dict.fromkeys(f.room for f in faults):
        mine = [f for f in faults if f.room == room]
        for k, fault in enumerate(mine, 1):
            if rows.get(name(fault), {}).get("outcome") != "noticed":
                made = judge(fault, out_dir, limit, known.get(name(fault), ""))
                rows[name(fault)] = dict(zip(("room", "file", "was", "became"), name(fault), strict=True)) | {
                    "why": fault.why,
                    **made,
                }
                print(f"{room} {k}/{len(mine)} {fault.file}: {fault.why}: {made}", flush=True)
                keep()
        told = [rows[name(f)] for f in mine]
        empty = fail_unbroken([row["by"] for row in told if row["by"]], out_dir)
        for row in told:
            row["outcome"] = "undecided" if row["by"] in empty else row["outcome"]
    table = keep()
    print(page_physical(table))
    return table


def page_physical(table: pd.DataFrame) -> str:
    """Return noticed faults by room and the list of the others, as Markdown."""
    lines = ["| room | faults | noticed |", "|---|---|---|"]
    for room, part in table.groupby("room", sort=False):
        lines.append(f"| `{room}` | {len(part)} | {int((part['outcome'] == 'noticed').sum())} |")
    lines += [f"| all | {len(table)} | {int((table['outcome'] == 'noticed').sum())} |", ""]
    for _, row in table[table["outcome"] != "noticed"].iterrows():
        lines.append(
            f"- {row['room']}/{row['file']}: {row['why']} ({row['outcome']}): `{row['was']}` became `{row['became']}`"
        )
    return "\n".join(lines) + "\n"


def page(table: pd.DataFrame) -> str:
    """Return the table by room and the list of survivors, as Markdown."""
    table = table[table["outcome"] != "none"]
    lines = ["| room | mutants | killed | share (95 %) |", "|---|---|---|---|"]
    for room, part in table.groupby("room", sort=False):
        killed, n = int((part["outcome"] != "survived").sum()), len(part)
        low, high = binomtest(killed, n).proportion_ci()
        lines.append(f"| `{room}` | {n} | {killed} | {100 * killed / n:.0f} % ({100 * low:.0f} to {100 * high:.0f}) |")
    lines += ["", "| survivor | was | became |", "|---|---|---|"]
    for _, row in table[table["outcome"] == "survived"].iterrows():
        was, became = (str(row[key]).replace("|", "\\|") for key in ("was", "became"))
        lines.append(f"| {row['module']}:{row['line']} | `{was}` | `{became}` |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--physical", action="store_true", help="the list of faults that a physicist makes")
    parser.add_argument("--rooms", nargs="+", default=[], metavar="ROOM")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds that a physical fault's tests may take")
    parser.add_argument("--sample", type=int, default=60, help="mutants a room")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    args = parser.parse_args()
    import mutation  # under its own name, so that other processes find its functions

    if args.physical:
        mutation.main_physical(args.rooms, args.limit, args.out)
    else:
        mutation.main(args.rooms or list(ROOMS), args.sample, args.seed, args.jobs, args.out)
