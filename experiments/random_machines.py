"""Do random machines with loops, parts of their logs and hold-outs keep what is promised?

    python experiments/random_machines.py [--what forces command diagnosis] [--first 0] [--count 200] [--joints 6] [--out DIR]

forces: identities of the dynamics of machines of up to twelve joints. command: `check`, `columns` and `identify` on random parts
of logs; the result agrees with `docs/reference/result.schema.json` or the refusal is one sentence. diagnosis: on a model's own
data, without noise, nothing is confirmed (machines of up to `--joints`). Out: `random_machines.csv`, a row a case; those done are
passed over. Exit status 1 where something is wrong.
"""

import argparse
import json
import sys
import tempfile
import time
import traceback
from pathlib import Path

import pandas as pd
from fuzz_parts.judge_machines import judge_command, judge_diagnosis, judge_forces
from jsonschema import Draft202012Validator

from tau_dyn.exceptions import TauDynError

SCHEMA = Path(__file__).resolve().parents[1] / "docs" / "reference" / "result.schema.json"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", nargs="+", choices=("forces", "command", "diagnosis"), default=["forces", "command"])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--joints", type=int, default=6)
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    path, schema = args.out / "random_machines.csv", Draft202012Validator(json.loads(SCHEMA.read_text()))
    rows = pd.read_csv(path).fillna("").to_dict("records") if path.exists() else []
    done = {(row["what"], row["seed"]) for row in rows}
    for what in args.what:
        for seed in (s for s in range(args.first, args.first + args.count) if (what, s) not in done):
            begun = time.monotonic()
            wrong, refused = "", ""
            try:
                with tempfile.TemporaryDirectory() as folder:
                    wrong = {
                        "forces": lambda seed=seed: judge_forces(seed),
                        "command": lambda seed=seed, folder=folder: judge_command(seed, Path(folder), schema),
                        "diagnosis": lambda seed=seed: judge_diagnosis(seed, args.joints),
                    }[what]()
            except TauDynError as fault:
                refused = f"{fault.code}: {fault}"
            except Exception:
                wrong = traceback.format_exc(limit=-3)
            rows.append(
                {"what": what, "seed": seed, "wrong": wrong, "refused": refused, "seconds": time.monotonic() - begun}
            )
            pd.DataFrame(rows).to_csv(path, index=False)
            print(f"{what} {seed}: {wrong or refused or 'fine'}", flush=True)
    table = pd.DataFrame(rows)
    for what, part in table.groupby("what"):
        n, bad, no = len(part), int((part["wrong"] != "").sum()), int((part["refused"] != "").sum())
        print(f"{what}: {n} machines, {bad} wrong, {no} refused")
    return int((table["wrong"] != "").any())


if __name__ == "__main__":
    sys.exit(main())
