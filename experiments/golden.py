"""Have the answers drifted? Recomputes every watched value and holds it against the one that was written down.

    python experiments/golden.py [--only emps hidden] [--write] [--out DIR]

In: nothing but measured logs in $TAU_DYN_DATA (cases without theirs are passed over, and said to be). Out: `golden.json`, every
value beside the written one, and exit status 1 where one is off by more than its tolerance. `--write` takes the values found for
the new truth (`golden_parts/golden.json`): then the commit says why they changed. Tolerances and their reasons stand in
`golden_parts/cases.py`. Under another CPython or another number of BLAS threads the same command is the test that they agree:

    python3.13 -m venv v && v/bin/pip install . && v/bin/python experiments/golden.py
    OPENBLAS_NUM_THREADS=2 python experiments/golden.py
"""

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

from golden_parts.cases import CASES, REASONS
from golden_parts.drift import drifted, read_golden, write_golden

from tau_dyn.files import write_whole

DATA = Path(os.environ.get("TAU_DYN_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def main(names: list[str], write: bool, out_dir: Path) -> int:
    out_dir.mkdir(parents=True, exist_ok=True)
    golden, found, off = read_golden(), {}, []
    for name in names:
        case = CASES[name]
        absent = [x for x in case.data if not (DATA / x).exists()]
        if absent:
            print(f"{name}: passed over, {absent[0]} is not in {DATA}")
            continue
        found[name] = case.compute(DATA)
        rows = [] if write else drifted(case, found[name], golden.get(name, {}))
        off += [(name, *row) for row in rows]
        print(f"{name}: {len(found[name])} values, {'written' if write else f'{len(rows)} have drifted'}", flush=True)
    for name, what, was, now, kind in off:
        print(f"  {name}, {what}: {was} -> {now}; {kind}: {REASONS[kind][1]}")
    if write:
        write_golden({**golden, **found})
    write_whole(out_dir / "golden.json", json.dumps(_beside(found, golden), indent=1) + "\n")
    return 1 if off else 0


def _beside(found: dict[str, dict[str, Any]], golden: dict[str, dict[str, Any]]) -> dict[str, Any]:
    return {
        name: {key: [golden.get(name, {}).get(key), x] for key, x in values.items()} for name, values in found.items()
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES), metavar="CASE")
    parser.add_argument("--write", action="store_true", help="take what was found for the new truth")
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    args = parser.parse_args()
    sys.exit(main(args.only, args.write, args.out))
